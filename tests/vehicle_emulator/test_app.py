import gc
import threading
import time

import can
import pytest

from dbc.catalogue import load
from dbc.link import LinkError, bus_names
from gateway import telemetry
from tests.support.processes import free_base_port
from vehicle_emulator import app
from vehicle_emulator.app import EmulatorOptions, StepClock, world_sample
from vehicle_emulator.emulator import STEP_NS, GroundTruth, StartPose
from vehicle_emulator.plants.interface import PlantState

MS_NS = 1_000_000


def test_clock_makes_every_step_once_on_the_grid():
    clock = StepClock(start_ns=7)
    made = [step for now in (7, 7 + MS_NS - 1, 7 + MS_NS, 7 + 4 * MS_NS + 3, 7 + 4 * MS_NS + 4) for step in clock.due(now)]
    assert made == [7 + k * MS_NS for k in (1, 2, 3, 4)]
    assert clock.skipped == 0


def test_clock_catches_up_after_a_short_stall_and_skips_after_a_long_one():
    clock = StepClock(start_ns=0)
    assert len(clock.due(50 * MS_NS)) == 50
    assert clock.skipped == 0
    steps = clock.due(500 * MS_NS)
    assert list(steps) == [500 * MS_NS]
    assert clock.skipped == 449
    assert list(clock.due(501 * MS_NS)) == [501 * MS_NS]


def test_world_sample_carries_the_truth_unchanged():
    numbers = {name: 0.1 * (k + 1) for k, name in enumerate(PlantState._fields) if not name.startswith("wheel") and name != "gear"}
    state = PlantState(**numbers, wheel_speeds_radps=(1.0, 2.0, 3.0, 4.0), gear=3)
    truth = GroundTruth(state, 0.9, 0.11, 0.12, are_robots_engaged=True, is_lifted=True)
    sample = world_sample(truth, t_ns=123, seq=4)
    assert (sample.sr_angle_rad, sample.ar_position_norm, sample.br_position_norm) == (0.9, 0.11, 0.12)
    assert (sample.robots_engaged, sample.is_lifted, sample.wheel_speeds_radps) == (True, True, [1.0, 2.0, 3.0, 4.0])
    same = set(numbers) & set(sample.__struct_fields__)
    assert same >= {"x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps", "engine_speed_radps"}
    assert {name: getattr(sample, name) for name in same} == {name: numbers[name] for name in same}
    assert (sample.t_ns, sample.seq) == (123, 4)


def test_an_unknown_bus_is_refused_with_one_line():
    with pytest.raises(LinkError, match="nosuch:bus0"):
        app.run(EmulatorOptions(bus_names("nosuch:bus0")), threading.Event())


@pytest.fixture
def base_port():
    yield free_base_port()
    gc.unfreeze()
    gc.enable()


def test_runs_in_real_time_on_a_bus_and_tells_the_world(base_port: int):
    channel = f"emulator-{base_port}"
    stop = threading.Event()
    samples: list[telemetry.WorldSample] = []
    options = EmulatorOptions(bus_names(f"virtual:{channel}"), start=StartPose(speed_mps=10.0), telemetry_base_port=base_port)
    listener = can.Bus(channel=channel, interface="virtual")
    worker = threading.Thread(target=app.run, args=(options, stop))
    worker.start()
    try:
        with telemetry.Subscriber(lambda topic, payload: samples.append(telemetry.decode(topic, payload)), ["world"], base_port):
            deadline_s = time.monotonic() + 10.0
            while len(samples) < 25 and time.monotonic() < deadline_s:
                time.sleep(0.02)
    finally:
        stop.set()
        worker.join(timeout=10.0)
    assert not worker.is_alive()
    seen: set[int] = set()
    while (message := listener.recv(timeout=0)) is not None:
        seen.add(message.arbitration_id)
    listener.shutdown()
    assert seen == {spec.arbitration_id for spec in load().by_name.values() if spec.sender != "GW" and spec.cycle_time_ns}
    assert len(samples) >= 25
    first, last = samples[0], samples[-1]
    assert last.vx_mps == pytest.approx(10.0, abs=0.5)
    # 20 steps of 1 ms per sample, whatever the machine's clock does.
    assert last.x_m - first.x_m == pytest.approx(10.0 * 0.020 * (last.seq - first.seq), rel=0.05)
    assert (last.t_ns - first.t_ns) % STEP_NS == 0
    assert last.y_m == pytest.approx(0.0, abs=1e-3)
