"""Limits of angle, position, torque and force; interlock; the other modes; and the driver who is stronger."""

import math

import pytest

from tests.vehicle_emulator.robots.bench import DTC, VEHICLE, Bench, command_of
from vehicle_emulator.driver import Driver
from vehicle_emulator.plants.interface import Selector
from vehicle_emulator.robots.faults import RobotFaults
from vehicle_emulator.robots.system import NODES


def test_accelerator_yields_to_the_brake():
    bench = Bench().engage().run(800, ar_percent=60.0)
    assert bench.inputs.accelerator_norm == pytest.approx(0.6, abs=3e-3)
    bench.run(800, ar_percent=60.0, br_percent=10.0)
    assert bench.inputs.accelerator_norm == 0.0
    assert bench.inputs.brake_norm == pytest.approx(0.1, abs=2e-3)


def test_an_angle_beyond_what_was_learned_is_clipped():
    bench = Bench().engage().run(1000, sr_deg=700.0)
    assert bench.wheel.angle_rad == pytest.approx(VEHICLE.robots.steering.learned_range_rad, abs=0.01)
    status = bench.status("SR_Status")
    assert status["LimitAngle"] == 1
    assert status["Warning"] == 1
    bench.run(500, sr_deg=0.0)
    assert bench.status("SR_Status")["LimitAngle"] == 0


@pytest.mark.parametrize(("limit_n", "expected"), [(110.0, (110.0 - 25.0) / 385.0), (20.0, 0.0)])
def test_a_force_limit_says_how_far_the_pedal_goes(limit_n: float, expected: float):
    bench = Bench().engage()
    bench.send(800, lambda: command_of(bench, "BR", percent=80.0, ForceLimit=limit_n))
    assert bench.inputs.brake_norm == pytest.approx(expected, abs=8.0 / 385.0)  # one bit of the command is 8 N
    assert bench.status("BR_Status")["LimitForce"] == 1
    assert bench.status("BR_Status")["ForceActual"] <= limit_n + 8.0


def test_the_torque_limit_is_the_least_of_command_and_robot():
    bench = Bench().engage()
    bench.send(50, lambda: command_of(bench, "SR", TorqueLimit=12.5))
    assert bench.inputs.steering.torque_limit_nm == 12.5
    bench.send(50, lambda: command_of(bench, "SR", TorqueLimit=120.0))
    assert bench.inputs.steering.torque_limit_nm == VEHICLE.robots.steering.torque_limit_nm


def test_too_little_torque_shows():
    bench = Bench().engage()
    bench.send(60, lambda: command_of(bench, "SR", TorqueLimit=2.0))
    assert bench.status("SR_Status")["LimitTorque"] == 1
    assert abs(bench.status("SR_Status")["TorqueActual"]) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("torque_nm", [15.0, -15.0])
def test_torque_mode_applies_the_torque(torque_nm: float):
    bench = Bench().run(50, "Disarm").run(50, "Arm")
    bench.send(30, lambda: command_of(bench, "SR", mode="Torque", TorqueFeedForward=torque_nm))
    assert bench.state == "Engaged"
    assert bench.wheel.robot_nm == pytest.approx(torque_nm)
    assert bench.wheel.angle_rad * torque_nm > 0.0
    bench.send(30, lambda: command_of(bench, "SR", mode="Torque", TorqueFeedForward=torque_nm, TorqueLimit=5.0))
    assert bench.wheel.robot_nm == pytest.approx(math.copysign(5.0, torque_nm))


def test_torque_feed_forward_adds_to_the_torque_of_the_servo():
    plain, added = Bench().engage().run(300, sr_deg=10.0), Bench().engage().run(300, sr_deg=10.0)
    plain.send(10, lambda: command_of(plain, "SR", angle_deg=10.0))
    added.send(10, lambda: command_of(added, "SR", angle_deg=10.0, TorqueFeedForward=4.0))
    stiffness = VEHICLE.multibody.steering.inertia_kgm2 * (2.0 * math.pi * VEHICLE.robots.steering.bandwidth_hz) ** 2
    shift = added.inputs.steering.demand_rad - plain.inputs.steering.demand_rad
    assert stiffness * shift == pytest.approx(4.0)


def test_selector_and_driver_torque_pass_through():
    bench = Bench()
    bench.driver = Driver(steering_torque_nm=1.5, accelerator_norm=0.2, brake_norm=0.1, selector=Selector.REVERSE)
    inputs = bench.step()
    assert inputs.selector is Selector.REVERSE
    assert inputs.steering.driver_torque_nm == 1.5
    assert (inputs.accelerator_norm, inputs.brake_norm) == (0.2, 0.1)


def override(**changes: float) -> Bench:
    bench = Bench().engage().run(500, sr_deg=20.0, ar_percent=30.0)
    bench.driver = Driver(**changes)
    return bench


@pytest.mark.parametrize(
    ("node", "hard", "soft"),
    [
        ("SR", {"steering_torque_nm": -7.0}, {"steering_torque_nm": 5.0}),
        ("AR", {"accelerator_norm": 0.4}, {"accelerator_norm": 0.34}),
        ("BR", {"brake_norm": 0.06}, {"brake_norm": 0.04}),
    ],
)
def test_the_driver_takes_over_from_each_robot(node: str, hard: dict, soft: dict):
    bench = override(**soft).run(300, sr_deg=20.0, ar_percent=30.0)
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 0
    needed_ms = round(1e3 * VEHICLE.robots.steering.override_time_s)
    bench = override(**hard).run(needed_ms - 1, sr_deg=20.0, ar_percent=30.0)
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 0
    bench.run(3, sr_deg=20.0, ar_percent=30.0)
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 1
    assert {name for name in NODES if bench.status(f"{name}_Status")["DriverOverride"]} == {node}
    assert {bench.robot_state(name) for name in NODES} == {"Override"}
    assert bench.inputs.steering.torque_limit_nm == 0.0
    assert bench.state == "Engaged"  # so that the gateway learns why, and disarms
    bench.run(1000, sr_deg=20.0, ar_percent=30.0)
    assert bench.system.pedals == (0.0, 0.0)
    bench.driver = Driver()
    bench.run(100, "Disarm")
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 0
    assert (bench.state, bench.robot_state("SR")) == ("Disarmed", "Standby")


@pytest.mark.parametrize("button", [False, True])
def test_after_an_override_the_robots_stay_released_in_a_stop(button: bool):
    bench = override(steering_torque_nm=20.0).run(300, sr_deg=20.0, ar_percent=30.0)
    bench.driver = Driver(is_stop_button_pressed=button)
    bench.silence(500)  # the gateway has died
    assert bench.state == ("EStop" if button else "ControlledStop")
    bench.system.faults["BR"] = RobotFaults(dtc=DTC["SpeedLimit"])  # a soft fault presses no brake against the driver either
    bench.silence(500)
    assert [bench.robot_state(name) for name in NODES] == ["Override", "Override", "FaultSoft"]
    assert bench.inputs.steering.torque_limit_nm == 0.0
    assert bench.system.pedals == (0.0, 0.0)


def test_an_override_wins_over_a_stop_of_the_same_millisecond():
    bench = override(steering_torque_nm=20.0).run(round(1e3 * VEHICLE.robots.steering.override_time_s) - 1)
    bench.driver = Driver(steering_torque_nm=20.0, is_dead_man_pressed=False)
    bench.run(3)
    assert bench.state == "ControlledStop"
    assert {bench.robot_state(name) for name in NODES} == {"Override"}


def test_an_override_lasts_over_a_disarm_while_the_driver_pulls():
    bench = override(steering_torque_nm=20.0).run(300).run(100, "Disarm")
    assert (bench.state, bench.robot_state("SR")) == ("Disarmed", "Standby")
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 1
    bench.run(50, "Arm").run(50, "Engage").run(50, "Arm")
    assert bench.state == "Disarmed"
    bench.driver = Driver()
    bench.run(50, "Arm").run(50, "Engage")
    assert bench.state == "Engaged"
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 0


def test_a_short_pull_is_no_override():
    bench = override(steering_torque_nm=20.0).run(90, sr_deg=20.0)
    bench.driver = Driver()
    bench.run(20, sr_deg=20.0)
    bench.driver = Driver(steering_torque_nm=20.0)
    bench.run(90, sr_deg=20.0)
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 0


def test_a_driver_on_the_pedals_is_no_override_before_engagement():
    bench = Bench()
    bench.driver = Driver(accelerator_norm=0.3)
    bench.run(50, "Disarm").run(300, "Arm")
    assert bench.status("RC_SafetyStatus")["DriverOverride"] == 0
    assert bench.inputs.accelerator_norm == 0.3


def test_a_pedal_that_the_foot_has_taken_presses_on_no_robot():
    bench = Bench().engage().run(500, br_percent=20.0)
    assert bench.status("BR_Status")["ForceActual"] > 80.0
    bench.driver = Driver(brake_norm=0.22)
    bench.run(20, br_percent=20.0)
    assert bench.inputs.brake_norm == 0.22
    assert bench.status("BR_Status")["ForceActual"] == 0.0
    assert bench.status("BR_Status")["PositionActual"] == pytest.approx(20.0, abs=0.3)
