"""The whole robot system: enable conditions, timeouts, sessions and modes, stops, watchdog."""

import math
from itertools import pairwise

import pytest

from tests.vehicle_emulator.robots.bench import CATALOGUE, TIMEOUT_MS, VEHICLE, Bench, command_of
from vehicle_emulator.driver import Driver
from vehicle_emulator.robots.states import Dtc
from vehicle_emulator.robots.system import COMMAND_MESSAGES, NODES

RAMP_OUT_MS = round(1e3 * VEHICLE.robots.steering.ramp_out_s)


def test_engages_through_armed_only():
    bench = Bench().run(60, "Engage", sr_deg=90.0, ar_percent=50.0)
    assert bench.state == "Disarmed"
    bench.run(50, "Arm", sr_deg=90.0, ar_percent=50.0)
    assert (bench.state, bench.robot_state("SR")) == ("Armed", "Armed")
    assert bench.wheel.angle_rad == 0.0
    assert bench.inputs.steering.torque_limit_nm == 0.0
    bench.run(100, "Engage", sr_deg=90.0, ar_percent=50.0)
    assert (bench.state, bench.robot_state("SR")) == ("Engaged", "Engaged")
    assert bench.wheel.angle_rad > 0.5


def test_starts_up_by_itself_and_is_ready_then():
    bench = Bench()
    assert bench.step().steering.torque_limit_nm == 0.0
    assert (bench.state, bench.robot_state("SR")) == ("Init", "Init")
    assert bench.status("RC_SafetyStatus")["SrReady"] == 0
    bench.silence(40)
    assert (bench.state, bench.robot_state("SR")) == ("Disarmed", "Standby")
    status = bench.status("RC_SafetyStatus")
    assert status["SrReady"] == status["ArReady"] == status["BrReady"] == status["DeadManPressed"] == 1


def without(bench: Bench, lost: str) -> None:
    """One cycle without one of the messages."""
    lost_id = CATALOGUE.by_name[lost].arbitration_id
    bench.step([frame for frame in bench.gateway.frames("Engage") if frame.arbitration_id != lost_id])
    bench.silence(9)


@pytest.mark.parametrize("lost", COMMAND_MESSAGES)
def test_engagement_needs_every_command_to_be_fresh(lost: str):
    bench = Bench().run(50, "Disarm")
    bench.silence(TIMEOUT_MS + 1)
    bench.step([bench.gateway.safety("Arm")])
    for _ in range(5):
        without(bench, lost)
        assert bench.state != "Engaged"
    bench.run(30, "Arm").run(20, "Engage")
    assert bench.state == "Engaged"


def test_engagement_needs_the_dead_man():
    bench = Bench().run(50, "Disarm").run(50, "Arm")
    bench.driver = Driver(is_dead_man_pressed=False)
    bench.run(50, "Engage")
    assert bench.state == "Armed"
    assert bench.status("RC_SafetyStatus")["DeadManPressed"] == 0
    bench.driver = Driver()
    bench.run(50, "Engage")
    assert bench.state == "Engaged"


def moved(bench: Bench) -> dict[str, bool]:
    return {"SR": bench.inputs.steering.torque_limit_nm > 0.0, "BR": bench.inputs.brake_norm > 0.01}


@pytest.mark.parametrize("node", ["SR", "BR"])
@pytest.mark.parametrize("change", [{"enable": False}, {"mode": "Standby"}, {"mode": "Off"}])
def test_each_robot_needs_its_own_enable_and_mode(node: str, change: dict):
    bench = Bench().engage()
    bench.send(300, lambda: command_of(bench, node, **change))
    assert moved(bench) == {"SR": node != "SR", "BR": node != "BR"}
    assert bench.robot_state(node) == "Armed"
    assert bench.state == "Engaged"  # the others go on


@pytest.mark.parametrize("lost", COMMAND_MESSAGES)
def test_each_command_times_out_to_the_millisecond(lost: str):
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
    timed_out = {node: bool(bench.status(f"{node}_Status")["CommandTimeout"]) for node in NODES}
    assert timed_out == {node: lost in ("GW_SafetyCommand", f"{node}_Command") for node in NODES}
    assert {bench.robot_state(node) for node in NODES} == {"SafeStop"}
    troubled = "RC" if lost == "GW_SafetyCommand" else lost[:2]
    assert [(entry.node, entry.dtc) for entry in bench.system.memory.entries] == [(troubled, 1)]


def test_what_the_robots_do_when_the_gateway_dies():
    bench = Bench().engage().run(500, sr_deg=60.0, ar_percent=40.0)
    bench.silence(TIMEOUT_MS - 20)
    limits = [bench.step().steering.torque_limit_nm for _ in range(RAMP_OUT_MS + 50)]
    assert limits[0] == 60.0
    fading = [limit for limit in limits if 0.0 < limit < 60.0]
    assert len(fading) == pytest.approx(RAMP_OUT_MS, abs=2)
    assert all(a - b == pytest.approx(60.0 / RAMP_OUT_MS) for a, b in pairwise(fading))
    assert limits[-1] == 0.0
    assert math.degrees(bench.inputs.steering.demand_rad) == pytest.approx(60.0, abs=0.5)  # held while it fades
    assert bench.inputs.accelerator_norm < 0.02
    spring = VEHICLE.robots.brake
    norm = (spring.stop_force_n - spring.preload_n - spring.friction_n) / (spring.full_stroke_n - spring.preload_n)
    assert bench.inputs.brake_norm == pytest.approx(norm, abs=2e-3)
    assert norm * 15_300.0 / VEHICLE.multibody.masses.mass_kg == pytest.approx(3.2, abs=0.1)  # m/s2, within what UN R157 allows
    bench.silence(3000)
    assert bench.inputs.accelerator_norm == 0.0
    assert bench.inputs.brake_norm == pytest.approx(norm, abs=2e-3)


def test_stop_runs_to_standstill_whatever_is_asked_then_disarms():
    bench = Bench().engage().silence(TIMEOUT_MS + 1)
    for request in ("Engage", "Arm", "Disarm", "None"):
        bench.run(100, request)
        assert bench.state == "ControlledStop", request
    assert bench.inputs.brake_norm > 0.3
    bench.speed_mps = 0.0
    bench.run(300, "Engage")
    assert bench.state == "ControlledStop"
    assert bench.inputs.brake_norm > 0.3  # also at standstill
    bench.run(500, "Disarm")
    assert (bench.state, bench.stop_source) == ("Disarmed", "None")
    assert bench.inputs.brake_norm == 0.0


def test_the_end_of_a_stop_is_open_to_a_gateway_that_was_restarted():
    bench = Bench().engage().silence(TIMEOUT_MS + 1)
    bench.speed_mps = 0.0
    bench.send(50, lambda: [bench.gateway.safety("Disarm", SessionId=9)])
    assert bench.state == "Disarmed"
    assert bench.status("RC_SafetyStatus")["SessionId"] == 9


@pytest.mark.parametrize(
    ("driver", "state", "source"),
    [
        (Driver(is_dead_man_pressed=False), "ControlledStop", "DeadmanReleased"),
        (Driver(is_stop_button_pressed=True), "EStop", "CabinButton"),
    ],
)
def test_the_driver_stops_the_robots(driver: Driver, state: str, source: str):
    bench = Bench().engage()
    bench.driver = driver
    bench.run(200, sr_deg=30.0, ar_percent=50.0)
    assert (bench.state, bench.stop_source) == (state, source)
    assert bench.robot_state("BR") == ("SafeStop" if state == "ControlledStop" else "EStop")
    assert bench.status("RC_SafetyStatus")["EmergencyStopActive"] == (state == "EStop")
    assert bench.inputs.accelerator_norm == 0.0
    assert bench.inputs.brake_norm > 0.2


def test_emergency_stop_of_the_gateway():
    bench = Bench().engage()
    gateway = bench.gateway
    bench.send(200, lambda: [gateway.safety("Engage", EmergencyStopRequest=1), *gateway.frames("Engage", ar_percent=90.0)[1:]])
    assert (bench.state, bench.stop_source) == ("EStop", "GatewayRequest")
    assert bench.inputs.accelerator_norm == 0.0


def test_a_car_faster_than_the_gateway_allows_is_stopped():
    bench = Bench().engage()
    gateway = bench.gateway
    bench.send(50, lambda: [gateway.safety("Engage", MaxSpeed=73), *gateway.frames("Engage")[1:]])
    assert bench.state == "Engaged"  # 72 km/h
    bench.send(50, lambda: [gateway.safety("Engage", MaxSpeed=71), *gateway.frames("Engage")[1:]])
    assert (bench.state, bench.stop_source) == ("ControlledStop", "SpeedLimit")


def test_sideways_counts_as_motion():
    bench = Bench().engage()
    gateway, bench.speed_mps, bench.sideways_mps = bench.gateway, 0.0, -20.0
    bench.send(50, lambda: [gateway.safety("Engage", MaxSpeed=71), *gateway.frames("Engage")[1:]])
    assert (bench.state, bench.stop_source) == ("ControlledStop", "SpeedLimit")
    bench.run(100, "Disarm")
    assert bench.state == "ControlledStop"  # it slides
    bench.sideways_mps = 0.0
    bench.run(100, "Disarm")
    assert bench.state == "Disarmed"


def test_the_stop_button_turns_a_controlled_stop_into_an_emergency_stop():
    bench = Bench().engage().run(50, "ControlledStop")
    bench.driver = Driver(is_stop_button_pressed=True)
    bench.run(20, "ControlledStop")
    assert (bench.state, bench.stop_source) == ("EStop", "CabinButton")
    assert bench.status("RC_SafetyStatus")["EmergencyStopActive"] == 1
    assert {bench.robot_state(node) for node in NODES} == {"EStop"}


def test_disarming_hands_the_car_over_at_once():
    bench = Bench().engage().run(500, sr_deg=30.0, ar_percent=50.0).run(20, "Disarm", sr_deg=30.0)
    assert bench.state == "Disarmed"
    assert bench.inputs.steering.torque_limit_nm == 0.0
    bench.run(800, "Disarm")
    assert (bench.inputs.accelerator_norm, bench.inputs.brake_norm) == (0.0, 0.0)


@pytest.mark.parametrize("request_", ["Arm", "Engage"])
def test_a_session_changes_in_standby_only(request_: str):
    bench = Bench()
    bench.send(50, lambda: [bench.gateway.safety("Disarm", SessionId=3), *bench.gateway.frames("Disarm")[1:]])
    bench.send(50, lambda: [bench.gateway.safety("Arm", SessionId=3), *bench.gateway.frames("Arm")[1:]])
    if request_ == "Engage":
        bench.send(50, lambda: [bench.gateway.safety("Engage", SessionId=3), *bench.gateway.frames("Engage")[1:]])
    bench.send(TIMEOUT_MS, lambda: [bench.gateway.safety(request_, SessionId=4), *bench.gateway.frames("Engage")[1:]])
    assert bench.status("RC_SafetyStatus")["SessionId"] == 3
    assert bench.system.rejected["RC"][Dtc.COMMAND_OUT_OF_RANGE] >= 10
    bench.send(20, lambda: [bench.gateway.safety(request_, SessionId=4), *bench.gateway.frames("Engage")[1:]])
    assert bench.state == ("ControlledStop" if request_ == "Engage" else "Armed")
    if request_ == "Arm":  # it fell back to Disarmed when the old session had timed out, and the new one began there
        assert bench.status("RC_SafetyStatus")["SessionId"] == 4


def test_an_engaged_robot_refuses_another_active_mode():
    bench = Bench().engage().run(300, sr_deg=20.0)
    before = bench.wheel.angle_rad
    bench.send(TIMEOUT_MS - 20, lambda: command_of(bench, "SR", mode="Torque", TorqueFeedForward=20.0))
    assert bench.state == "Engaged"
    assert bench.wheel.angle_rad == pytest.approx(before, abs=1e-3)  # the last command that counted holds
    bench.send(30, lambda: command_of(bench, "SR", mode="Torque", TorqueFeedForward=20.0))
    assert (bench.state, bench.stop_source) == ("ControlledStop", "CommandTimeout")


def test_a_mode_changes_through_standby():
    bench = Bench().engage()
    bench.send(30, lambda: command_of(bench, "BR", mode="Standby", enable=False))
    bench.send(600, lambda: command_of(bench, "BR", mode="Force", ForceCommand=217.5))
    assert bench.state == "Engaged"
    assert bench.inputs.brake_norm == pytest.approx(0.5, abs=2e-3)  # (217.5 - 15 - 10) / 385
    assert bench.status("BR_Status")["ForceActual"] == pytest.approx(207.5, abs=11.0)


def test_session_and_measurement_are_echoed_and_a_question_asked_with_every_status():
    bench = Bench()
    bench.step([bench.gateway.safety("None", MeasurementId=9, SessionId=77)])
    status = bench.status("RC_SafetyStatus")
    assert status["MeasurementId"] == 9
    assert status["SessionId"] == 77
    first = status["WatchdogQuestion"]
    bench.silence(10)
    assert bench.status("RC_SafetyStatus")["WatchdogQuestion"] == (first + 1) % 256


def test_a_gateway_that_repeats_its_answer_has_hung():
    bench = Bench().engage()
    gateway = bench.gateway
    began_ms = bench.ms
    while bench.state == "Engaged" and bench.ms < began_ms + 500:
        bench.send(1, lambda: [gateway.safety("Engage", WatchdogAnswer=0xE1), *gateway.frames("Engage")[1:]])
    assert (bench.state, bench.stop_source) == ("ControlledStop", "WatchdogAnswer")
    assert bench.ms - began_ms == pytest.approx(TIMEOUT_MS, abs=11)
