"""The steering wheel of simple plants: the robot's answer, its limits, the driver's hands, and a wheel that nobody holds."""

import math

import pytest

from dbc.vehicle import load_vehicle
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.interface import SteeringInputs

VEHICLE = load_vehicle()
STEP_S = 1e-3


def turned(inputs, seconds, start_rad=0.0):
    wheel = SteeringWheel(VEHICLE, STEP_S)
    wheel.angle_rad = start_rad
    for _ in range(round(seconds / STEP_S)):
        wheel.step(inputs)
    return wheel


@pytest.mark.parametrize("seconds", [0.01, 0.03, 0.1])
def test_a_step_of_the_demand_is_answered_as_a_second_order_system_answers(seconds):
    robot = VEHICLE.robots.steering
    pole, zeta = 2.0 * math.pi * robot.bandwidth_hz, robot.damping_ratio
    damped = pole * math.sqrt(1.0 - zeta**2)
    swing = math.cos(damped * seconds) + zeta * pole / damped * math.sin(damped * seconds)
    wheel = turned(SteeringInputs(demand_rad=0.1, torque_limit_nm=1e6), seconds)
    assert wheel.angle_rad == pytest.approx(0.1 * (1.0 - math.exp(-zeta * pole * seconds) * swing), rel=1e-9)


def test_a_demand_that_moves_evenly_is_followed_with_the_lag_of_the_second_order():
    robot, wheel, steps, rate_radps = VEHICLE.robots.steering, SteeringWheel(VEHICLE, STEP_S), 1000, 2.0
    lag_s = 2.0 * robot.damping_ratio / (2.0 * math.pi * robot.bandwidth_hz)
    for k in range(steps):
        wheel.step(SteeringInputs(demand_rad=rate_radps * (k + 0.5) * STEP_S, torque_limit_nm=60.0))  # a held demand has the mean
    assert wheel.angle_rad == pytest.approx(rate_radps * (steps * STEP_S - lag_s), abs=1e-4)
    assert wheel.rate_radps == pytest.approx(rate_radps, abs=1e-3)


def test_the_torque_of_the_robot_stays_within_its_limit():
    wheel = SteeringWheel(VEHICLE, STEP_S)
    torques_nm = []
    for _ in range(200):
        wheel.step(SteeringInputs(demand_rad=3.0, torque_limit_nm=20.0))
        torques_nm.append(wheel.robot_nm)
    assert max(map(abs, torques_nm)) == 20.0
    assert 0.0 < turned(SteeringInputs(demand_rad=3.0, torque_limit_nm=20.0), 0.05).angle_rad < 0.6


def test_the_robot_holds_against_a_driver_up_to_its_limit_and_no_further():
    held = turned(SteeringInputs(demand_rad=0.5, torque_limit_nm=30.0, driver_torque_nm=-10.0), 1.0)
    assert held.angle_rad == pytest.approx(0.5, abs=1e-6)
    assert held.robot_nm == pytest.approx(12.0, abs=0.01)
    assert turned(SteeringInputs(demand_rad=0.5, torque_limit_nm=5.0, driver_torque_nm=-10.0), 1.0).angle_rad < -1.0


def test_a_released_wheel_returns_slowly_and_stays_at_the_centre():
    assert turned(SteeringInputs(demand_rad=5.0), 1.0, start_rad=2.0).angle_rad == pytest.approx(1.0, abs=0.05)
    rest = turned(SteeringInputs(demand_rad=5.0), 4.0, start_rad=2.0)
    assert (rest.angle_rad, rest.rate_radps, rest.robot_nm) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_wheel_stops_at_its_end(side):
    wheel = turned(SteeringInputs(driver_torque_nm=20.0 * side), 5.0)
    assert (wheel.angle_rad, wheel.rate_radps) == (side * VEHICLE.steering.ratio * VEHICLE.steering.road_wheel_limit_rad, 0.0)
