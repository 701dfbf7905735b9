"""Frames that do not count, and anything at all on the bus."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from tests.vehicle_emulator.robots.bench import CATALOGUE, STEP_NS, TIMEOUT_MS, Bench
from vehicle_emulator.robots.states import Dtc
from vehicle_emulator.robots.system import COMMAND_MESSAGES, STATUS_MESSAGES


def feed_bad(bench: Bench, name: str, make_bad: Callable[[CanFrame], CanFrame], milliseconds: int = TIMEOUT_MS + 20) -> None:
    """Everything good but one message."""
    bad_id = CATALOGUE.by_name[name].arbitration_id
    bench.send(
        milliseconds,
        lambda: [make_bad(frame) if frame.arbitration_id == bad_id else frame for frame in bench.gateway.frames("Engage", sr_deg=10.0)],
    )


def protected(name: str, payload: bytes) -> Callable[[CanFrame], CanFrame]:
    """Good protection around a payload, as from a gateway with another idea of its content."""
    protector = E2EProtector(CATALOGUE.by_name[name].e2e_data_id)
    return lambda frame: frame._replace(data=protector.protect(payload))


@pytest.mark.parametrize("name", COMMAND_MESSAGES)
@pytest.mark.parametrize(
    ("make_bad", "trouble", "source"),
    [
        (lambda frame: frame._replace(data=bytes([frame.data[0] ^ 1]) + frame.data[1:]), Dtc.COMMAND_CRC, "E2EFailure"),
        (lambda frame: frame._replace(data=frame.data[:7]), Dtc.COMMAND_OUT_OF_RANGE, "CommandTimeout"),
        (lambda frame: frame._replace(data=frame.data + b"\0"), Dtc.COMMAND_OUT_OF_RANGE, "CommandTimeout"),
    ],
)
def test_wrong_crc_and_wrong_length_count_as_no_message(name: str, make_bad, trouble: Dtc, source: str):
    bench = Bench().engage()
    feed_bad(bench, name, make_bad)
    assert (bench.state, bench.stop_source) == ("ControlledStop", source)
    node = "RC" if name == "GW_SafetyCommand" else name[:2]
    assert bench.system.rejected[node] == {trouble: 12}
    assert bench.wheel.angle_rad == 0.0 or name != "SR_Command"


@pytest.mark.parametrize("name", COMMAND_MESSAGES)
def test_a_counter_that_stands_still_counts_as_no_message(name: str):
    bench = Bench().engage()
    kept: list[CanFrame] = []
    feed_bad(bench, name, lambda frame: kept[0] if kept else kept.append(frame) or frame)
    assert (bench.state, bench.stop_source) == ("ControlledStop", "E2EFailure")
    node = "RC" if name == "GW_SafetyCommand" else name[:2]
    assert bench.system.rejected[node] == {Dtc.COMMAND_COUNTER: 11}


OUT_OF_RANGE = {
    "SR_Command": bytes(2) + b"\xff\x7f" + bytes(4),  # 1638 deg
    "AR_Command": bytes(2) + b"\xff\xff" + bytes(4),  # 655 %
    "BR_Command": bytes(6) + b"\xff\x0f",  # 2047 N
}


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_a_value_outside_the_dbc_is_refused_and_counted(name: str):
    bench = Bench().engage()
    feed_bad(bench, name, protected(name, OUT_OF_RANGE[name]))
    assert bench.state == "ControlledStop"
    assert bench.system.rejected[name[:2]][Dtc.COMMAND_OUT_OF_RANGE] >= 10
    assert bench.status(f"{name[:2]}_Diag")["CommandErrorCount"] == bench.system.rejected[name[:2]][Dtc.COMMAND_OUT_OF_RANGE] + sum(
        count for trouble, count in bench.system.rejected[name[:2]].items() if trouble is not Dtc.COMMAND_OUT_OF_RANGE
    )


@pytest.mark.parametrize(("name", "mode"), [("SR_Command", 6), ("SR_Command", 7), ("AR_Command", 6), ("BR_Command", 7)])
def test_a_mode_that_does_not_exist_is_refused(name: str, mode: int):
    bench = Bench().engage()
    feed_bad(bench, name, protected(name, CATALOGUE.encode(name, {"Mode": mode, "Enable": 1})))
    assert bench.state == "ControlledStop"
    assert bench.system.rejected[name[:2]][Dtc.COMMAND_OUT_OF_RANGE] >= 10


def test_a_request_that_does_not_exist_is_refused():
    bench = Bench().engage()
    feed_bad(bench, "GW_SafetyCommand", protected("GW_SafetyCommand", CATALOGUE.encode("GW_SafetyCommand", {"SystemRequest": 6})))
    assert bench.state == "ControlledStop"


command_ids = [CATALOGUE.by_name[name].arbitration_id for name in COMMAND_MESSAGES]
junk = st.one_of(
    st.builds(CanFrame, st.sampled_from(command_ids), st.binary(max_size=64), st.just(0)),
    st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8), st.just(0)),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(junk, max_size=6), max_size=40))
def test_junk_moves_nothing_and_raises_nothing(ticks: list[list[CanFrame]]):
    bench = Bench()
    for frames in ticks:
        inputs = bench.step(frames)
        assert (inputs.steering.torque_limit_nm, inputs.accelerator_norm, inputs.brake_norm) == (0.0, 0.0, 0.0)
    assert bench.state in ("Init", "Disarmed")
    for message in STATUS_MESSAGES:
        bench.status(message)


well_formed = st.sampled_from(COMMAND_MESSAGES).flatmap(lambda name: st.tuples(st.just(name), st.binary(min_size=8, max_size=8)))


@settings(max_examples=40, deadline=None)
@given(st.lists(well_formed, max_size=60))
def test_protected_frames_with_any_content_raise_nothing_and_stay_in_range(contents: list[tuple[str, bytes]]):
    bench = Bench().engage()
    protectors = {name: E2EProtector(CATALOGUE.by_name[name].e2e_data_id) for name in COMMAND_MESSAGES}
    for name, payload in contents:
        frame = CanFrame(CATALOGUE.by_name[name].arbitration_id, protectors[name].protect(payload), 0)
        bench.step([frame])
        for _ in range(4):
            inputs = bench.step()
            assert 0.0 <= inputs.accelerator_norm <= 1.0
            assert 0.0 <= inputs.brake_norm <= 1.0
            assert 0.0 <= inputs.steering.torque_limit_nm <= 60.0
            assert math.isfinite(inputs.steering.demand_rad)
    for message in STATUS_MESSAGES:
        bench.status(message)


def test_same_seed_and_frames_give_the_same_status():
    def record(seed: int) -> list[dict[str, float]]:
        bench, found = Bench(seed=seed).engage(), []
        for k in range(40):
            bench.run(10, sr_deg=5.0 * (k % 7), ar_percent=3.0 * (k % 5))
            found += [bench.status(message) for message in STATUS_MESSAGES]
        return found

    assert record(1) == record(1) != record(2)


def test_time_is_only_an_argument():
    late = 7_000_000_000_000
    bench = Bench()
    bench.ms = late // STEP_NS
    bench.engage()
    assert bench.status("RC_SafetyStatus")["ControllerTemperature"] == 25
