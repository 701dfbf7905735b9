"""The recording of a run: series, times, what was lost, and the gateway's modes."""

import threading

import pytest

from gateway.telemetry import StateSample, StatusSample, WorldSample
from xil.recording import Gap, ModeChange, Recording

START_NS = 3_000_000_000


def at(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def world(t_s: float, seq: int = 0, x_m: float = 0.0) -> WorldSample:
    return WorldSample(
        t_ns=at(t_s), seq=seq, x_m=x_m, y_m=0.0, yaw_rad=0.0, vx_mps=0.0, vy_mps=0.0, yaw_rate_radps=0.0, ax_mps2=0.0, ay_mps2=0.0,
        sr_angle_rad=0.0, ar_position_norm=0.0, br_position_norm=0.0, robots_engaged=True,
    )  # fmt: skip


def state(t_s: float, mode: str) -> StateSample:
    return StateSample(
        t_ns=at(t_s), seq=0, mode=mode, is_valid=True, x_m=0.0, y_m=0.0, yaw_rad=0.0, vx_mps=0.0, vy_mps=0.0, yaw_rate_radps=0.0,
        ax_mps2=0.0, sr_angle_rad=0.0, ar_position_norm=0.0, br_position_norm=0.0, sr_command_rad=0.0, ar_command_norm=0.0,
        br_command_norm=0.0,
    )  # fmt: skip


def status(t_s: float, mode: str, reason: str) -> StatusSample:
    return StatusSample(
        t_ns=at(t_s), seq=0, mode=mode, reason=reason, blockers=[], command_age_ms=0.0, frames_received=0, frames_rejected={},
        commands_rejected={}, ticks=0, ticks_late=0, step_cpu_ms=0.0,
    )  # fmt: skip


def recording_of(*samples) -> Recording:
    recording = Recording(START_NS)
    for sample in samples:
        recording.add(sample)
    return recording


def test_series_and_times_belong_to_their_topic():
    recording = recording_of(world(0.5, x_m=1.5), state(0.6, "READY"), world(0.7, x_m=2.5))
    assert recording.series("world", "x_m").tolist() == [1.5, 2.5]
    assert recording.times_s("world") == pytest.approx([0.5, 0.7])
    assert recording.series("state", "is_valid").tolist() == [1.0]
    assert recording.texts("state", "mode") == ["READY"]
    assert recording.latest("world") == world(0.7, x_m=2.5)


def test_empty_recording_answers_with_nothing():
    recording = Recording(START_NS)
    assert recording.latest("world") is None
    assert recording.series("world", "x_m").shape == (0,)
    assert recording.lost("world") == 0
    assert recording.mode_changes() == []


def test_lost_samples_are_counted_by_their_numbers():
    assert recording_of(world(0.0, 4), world(0.1, 5), world(0.4, 8), world(0.6, 10)).lost("world") == 3


def test_publisher_that_starts_anew_has_lost_nothing():
    assert recording_of(world(0.0, 7), world(0.1, 8), world(0.2, 0), world(0.3, 1)).lost("world") == 0


def test_longest_gap_lies_within_the_span_and_counts_its_ends():
    recording = recording_of(*(world(t_s) for t_s in (0.0, 1.0, 1.1, 1.3, 1.35, 3.0)))
    assert recording.longest_gap("world", 1.0, 1.35) == Gap(pytest.approx(1.1), pytest.approx(0.2))
    assert recording.longest_gap("world", 1.0, 2.0) == Gap(pytest.approx(1.35), pytest.approx(0.65))


def test_mode_changes_take_time_from_the_state_and_reason_from_the_status():
    recording = recording_of(
        status(0.0, "STANDBY", "started"), state(0.02, "STANDBY"), state(0.04, "READY"), status(0.10, "READY", "everything ready"),
        state(0.12, "READY"), status(0.20, "ENGAGED", "operator engaged"), state(0.22, "ENGAGED"), state(0.24, "SAFE_STOP"),
        status(0.30, "SAFE_STOP", "controller silent"),
    )  # fmt: skip
    assert recording.mode_changes() == [
        ModeChange(0.0, "STANDBY", "started"),
        ModeChange(pytest.approx(0.04), "READY", "everything ready"),
        ModeChange(pytest.approx(0.20), "ENGAGED", "operator engaged"),
        ModeChange(pytest.approx(0.24), "SAFE_STOP", "controller silent"),
    ]


def test_threads_may_add_at_the_same_time():
    recording = Recording(START_NS)

    def add_many() -> None:
        for k in range(500):
            recording.add(world(k * 0.01, k))

    threads = [threading.Thread(target=add_many) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(recording.samples("world")) == 2000
