import math
from collections.abc import Callable

import pytest

from dbc.catalogue import load
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from dbc.vehicle import load_vehicle
from tests.vehicle_emulator.gateway_stub import GatewayStub
from vehicle_emulator.robot_system import RobotSystem

CATALOGUE = load()
VEHICLE = load_vehicle()
STEP_NS = 1_000_000
TIMEOUT_MS = CATALOGUE.by_name["SR_Command"].timeout_ns // STEP_NS
SYSTEM_STATES = {raw: name for name, raw in CATALOGUE.enumeration("RC_SafetyStatus", "SystemState").items()}
STOP_SOURCES = {raw: name for name, raw in CATALOGUE.enumeration("RC_SafetyStatus", "StopSource").items()}
ROBOT_STATES = {raw: name for name, raw in CATALOGUE.enumeration("SR_Status", "State").items()}


class Bench:
    """Robots, a gateway stub and a millisecond clock; the gateway sends every 10 ms."""

    def __init__(self) -> None:
        self.gateway = GatewayStub(CATALOGUE)
        self.system = RobotSystem(VEHICLE, CATALOGUE, 1e-3)
        self.ms = 0
        self.speed_mps = 20.0

    def step(self, frames: list[CanFrame] | None = None, is_dead_man_pressed: bool = True) -> None:
        self.ms += 1
        self.system.step(self.ms * STEP_NS, frames or [], self.speed_mps, is_dead_man_pressed)

    def run(self, milliseconds: int, request: str, **demands: float) -> None:
        self.send(milliseconds, lambda: self.gateway.frames(request, **demands))

    def send(self, milliseconds: int, make_frames: Callable[[], list[CanFrame]]) -> None:
        for _ in range(milliseconds):
            self.step(make_frames() if self.ms % 10 == 0 else None)

    def engage(self) -> "Bench":
        self.run(50, "Disarm")
        self.run(50, "Arm")
        self.run(50, "Engage")
        assert self.state == "Engaged"
        return self

    def silence(self, milliseconds: int) -> None:
        for _ in range(milliseconds):
            self.step()

    @property
    def state(self) -> str:
        return SYSTEM_STATES[int(self.system.status("RC_SafetyStatus")["SystemState"])]

    @property
    def stop_source(self) -> str:
        return STOP_SOURCES[int(self.system.status("RC_SafetyStatus")["StopSource"])]

    def robot_state(self, node: str) -> str:
        return ROBOT_STATES[int(self.system.status(f"{node}_Status")["State"])]


def test_engages_through_armed_only():
    bench = Bench()
    bench.run(50, "Engage", sr_deg=90.0, ar_percent=50.0)
    assert bench.state == "Disarmed"
    bench.run(50, "Arm", sr_deg=90.0, ar_percent=50.0)
    assert bench.state == "Armed"
    assert bench.robot_state("SR") == "Armed"
    assert bench.system.positions == (0.0, 0.0, 0.0)
    bench.run(100, "Engage", sr_deg=90.0, ar_percent=50.0)
    assert bench.state == "Engaged"
    assert bench.robot_state("SR") == "Engaged"
    assert bench.system.positions.steering_wheel_rad > 0.5


def test_engagement_needs_the_dead_man():
    bench = Bench()
    bench.run(50, "Arm")
    for _ in range(5):
        bench.step(bench.gateway.frames("Engage"), is_dead_man_pressed=False)
    assert bench.state == "Armed"
    bench.step(bench.gateway.frames("Engage"))
    assert bench.state == "Engaged"


def test_engagement_needs_fresh_robot_commands():
    bench = Bench()
    bench.step([bench.gateway.safety("Arm")])
    bench.step([bench.gateway.safety("Engage")])
    assert bench.state == "Armed"
    bench.step(bench.gateway.frames("Engage"))
    assert bench.state == "Engaged"


def test_robots_go_where_they_are_told():
    bench = Bench().engage()
    bench.run(600, "Engage", sr_deg=-45.0, br_percent=30.0)
    positions = bench.system.positions
    assert positions.steering_wheel_rad == pytest.approx(math.radians(-45.0), abs=1e-3)
    assert positions.brake_norm == pytest.approx(0.3, abs=1e-3)
    status = bench.system.status("BR_Status")
    assert status["PositionActual"] == pytest.approx(30.0, abs=0.1)
    assert status["PositionStroke"] == pytest.approx(300.0 * VEHICLE.robots.brake.stroke_m, abs=0.1)


def test_command_rate_limit_is_obeyed():
    bench = Bench().engage()
    gateway = bench.gateway
    slow = {"rate_dps": 100.0}
    bench.send(
        500, lambda: [gateway.safety("Engage"), gateway.steering(200.0, **slow), gateway.pedal("AR", 0.0), gateway.pedal("BR", 0.0)]
    )
    assert math.degrees(bench.system.positions.steering_wheel_rad) == pytest.approx(100.0 * 0.48, rel=0.05)


@pytest.mark.parametrize(("enable", "mode"), [(False, "AnglePosition"), (True, "Torque"), (True, "Standby")])
def test_own_enable_bit_and_mode_are_needed(enable: bool, mode: str):
    bench = Bench().engage()
    gateway = bench.gateway
    bench.send(
        300,
        lambda: [gateway.safety("Engage"), gateway.steering(90.0, enable, mode), gateway.pedal("AR", 0.0), gateway.pedal("BR", 20.0)],
    )
    assert bench.system.positions.steering_wheel_rad == 0.0
    assert bench.robot_state("SR") == "Armed"
    assert bench.system.positions.brake_norm == pytest.approx(0.2, abs=1e-3)  # the others go on


@pytest.mark.parametrize("lost", ["GW_SafetyCommand", "SR_Command", "AR_Command", "BR_Command"])
def test_each_command_times_out_at_the_catalogues_timeout(lost: str):
    bench = Bench().engage()
    lost_id = CATALOGUE.by_name[lost].arbitration_id
    while bench.ms % 10:
        bench.step()
    bench.step(bench.gateway.frames("Engage"))  # the last of the lost message, at age zero
    for age_ms in range(1, TIMEOUT_MS + 2):
        frames = bench.gateway.frames("Engage") if age_ms % 10 == 0 else []
        bench.step([frame for frame in frames if frame.arbitration_id != lost_id])
        assert bench.state == ("Engaged" if age_ms <= TIMEOUT_MS else "ControlledStop")
    assert bench.stop_source == "CommandTimeout"
    timed_out = {node: bool(bench.system.status(f"{node}_Status")["CommandTimeout"]) for node in ("SR", "AR", "BR")}
    assert timed_out == {node: lost in ("GW_SafetyCommand", f"{node}_Command") for node in ("SR", "AR", "BR")}
    assert {bench.robot_state(node) for node in ("SR", "AR", "BR")} == {"SafeStop"}


def test_what_the_robots_do_when_the_gateway_dies():
    bench = Bench().engage()
    bench.run(500, "Engage", sr_deg=60.0, ar_percent=40.0)
    bench.silence(TIMEOUT_MS + 250)
    held = bench.system.positions
    assert math.degrees(held.steering_wheel_rad) == pytest.approx(60.0, abs=0.1)
    assert held.accelerator_norm < 0.02
    deceleration_mps2 = held.brake_norm * VEHICLE.plant.full_brake_force_n / VEHICLE.plant.mass_kg
    assert deceleration_mps2 == pytest.approx(3.0, rel=0.02)
    bench.silence(2000)
    assert bench.system.positions.steering_wheel_rad == pytest.approx(0.0, abs=1e-3)


def test_stop_runs_to_standstill_whatever_is_asked_then_disarms():
    bench = Bench().engage()
    bench.silence(TIMEOUT_MS + 1)
    for request in ("Engage", "Arm", "Disarm", "None"):
        bench.run(100, request)
        assert bench.state == "ControlledStop", request
    assert bench.system.positions.brake_norm > 0.3
    bench.speed_mps = 0.0
    bench.run(100, "Engage")
    assert bench.state == "ControlledStop"
    bench.run(500, "Disarm")
    assert (bench.state, bench.stop_source) == ("Disarmed", "None")
    assert bench.system.positions.brake_norm == pytest.approx(0.0, abs=1e-3)


def test_robots_that_were_never_engaged_stay_neutral_when_the_gateway_dies():
    bench = Bench()
    bench.run(100, "Arm", sr_deg=90.0, ar_percent=50.0, br_percent=50.0)
    bench.silence(500)
    assert bench.state == "Disarmed"
    assert bench.stop_source == "None"
    assert bench.system.positions == (0.0, 0.0, 0.0)
    assert bench.system.status("SR_Status")["CommandTimeout"]


@pytest.mark.parametrize(
    ("values", "state", "source"),
    [
        ({"request": "ControlledStop"}, "ControlledStop", "GatewayRequest"),
        ({"request": "Engage", "EmergencyStopRequest": 1}, "EStop", "GatewayRequest"),
    ],
)
def test_stops_on_request(values: dict, state: str, source: str):
    bench = Bench().engage()
    bench.step([bench.gateway.safety(**values)])
    assert (bench.state, bench.stop_source) == (state, source)
    assert bool(bench.system.status("RC_SafetyStatus")["EmergencyStopActive"]) == (state == "EStop")


def test_stops_when_the_dead_man_is_released():
    bench = Bench().engage()
    bench.step(is_dead_man_pressed=False)
    assert (bench.state, bench.stop_source) == ("ControlledStop", "DeadmanReleased")
    assert not bench.system.status("RC_SafetyStatus")["DeadManPressed"]


def test_disarming_while_engaged_releases_everything():
    bench = Bench().engage()
    bench.run(400, "Engage", sr_deg=30.0, br_percent=50.0)
    bench.run(1500, "Disarm", sr_deg=30.0, br_percent=50.0)
    assert bench.state == "Disarmed"
    assert bench.system.positions == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


def test_accelerator_yields_to_the_brake():
    bench = Bench().engage()
    bench.run(500, "Engage", ar_percent=60.0)
    assert bench.system.positions.accelerator_norm == pytest.approx(0.6, abs=1e-3)
    bench.run(500, "Engage", ar_percent=60.0, br_percent=10.0)
    assert bench.system.positions.accelerator_norm == pytest.approx(0.0, abs=1e-3)
    assert bench.system.positions.brake_norm == pytest.approx(0.1, abs=1e-3)


def feed_bad(bench: Bench, name: str, make_bad: Callable[[CanFrame], CanFrame]) -> None:
    """Everything good but one message, for longer than its timeout."""
    bad_id = CATALOGUE.by_name[name].arbitration_id
    bench.send(
        TIMEOUT_MS + 20,
        lambda: [make_bad(frame) if frame.arbitration_id == bad_id else frame for frame in bench.gateway.frames("Engage", sr_deg=10.0)],
    )


def test_wrong_crc_counts_as_no_message():
    bench = Bench().engage()
    feed_bad(bench, "SR_Command", lambda frame: frame._replace(data=bytes([frame.data[0] ^ 0x01]) + frame.data[1:]))
    assert (bench.state, bench.stop_source) == ("ControlledStop", "CommandTimeout")
    assert bench.system.positions.steering_wheel_rad == 0.0


def test_wrong_length_counts_as_no_message():
    bench = Bench().engage()
    feed_bad(bench, "SR_Command", lambda frame: frame._replace(data=frame.data[:7]))
    assert bench.state == "ControlledStop"


def test_value_outside_the_dbc_counts_as_no_message():
    bench = Bench().engage()
    protector = E2EProtector(CATALOGUE.by_name["AR_Command"].e2e_data_id)
    too_far = bytes(2) + b"\xff\xff" + bytes(4)
    feed_bad(bench, "AR_Command", lambda frame: frame._replace(data=protector.protect(too_far)))
    assert bench.state == "ControlledStop"
    assert bench.system.positions.accelerator_norm == 0.0


def test_replayed_counter_counts_as_no_message():
    bench = Bench().engage()
    replayed = bench.gateway.steering(10.0)
    bench.step([replayed])
    feed_bad(bench, "SR_Command", lambda _: replayed)
    assert (bench.state, bench.stop_source) == ("ControlledStop", "CommandTimeout")


def test_watchdog_and_session_are_answered():
    bench = Bench()
    bench.step([bench.gateway.safety("None", WatchdogChallenge=0xA5, SessionId=77)])
    status = bench.system.status("RC_SafetyStatus")
    assert status["WatchdogResponse"] == 0x5A
    assert status["SessionId"] == 77
    assert status["SrReady"] == status["ArReady"] == status["BrReady"] == status["DeadManPressed"] == 1


def test_unknown_frames_are_ignored():
    bench = Bench().engage()
    bench.step([CanFrame(0x7FF, b"\x00" * 8, 0), CanFrame(0x210, b"", 0)])
    assert bench.state == "Engaged"
