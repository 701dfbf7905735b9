"""The steering wheel of simple plants: the robot's answer, its limits, the driver's hands, and a wheel that nobody holds."""

import math

import pytest

from dbc.vehicle import load_vehicle
from vehicle_emulator.plants.column import SteeringWheel, second_order_transition
from vehicle_emulator.plants.interface import SteeringInputs

VEHICLE = load_vehicle()
STEP_S = 1e-3


def turned(inputs, seconds, start_rad=0.0):
    wheel = SteeringWheel(VEHICLE, STEP_S)
    wheel.impose(start_rad, 0.0)
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


@pytest.mark.parametrize("zeta", [0.5, 1.0, 2.0])
def test_many_small_steps_are_one_large_one(zeta):
    def state(steps):
        a, b, c, d = second_order_transition(60.0, zeta, 0.05 / steps)
        error, rate = 1.0, 3.0
        for _ in range(steps):
            error, rate = a * error + b * rate, c * error + d * rate
        return error, rate

    assert state(50) == pytest.approx(state(1), rel=1e-9)


def test_a_demand_that_moves_evenly_is_followed_without_lag():
    wheel = SteeringWheel(VEHICLE, STEP_S)
    for k in range(1, 1001):
        wheel.step(SteeringInputs(demand_rad=2.0 * k * STEP_S, demand_rate_radps=2.0, torque_limit_nm=60.0))
    assert (wheel.angle_rad, wheel.rate_radps) == pytest.approx((2.0, 2.0), abs=1e-6)


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
