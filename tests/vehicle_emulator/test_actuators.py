import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_emulator.actuators import Servo

PERIOD_S = 1e-3


def servo(**changes: float) -> Servo:
    parameters = {"bandwidth_hz": 10.0, "damping_ratio": 0.9, "dead_time_s": 0.020, "rate_limit": 27.9, "low": -8.0, "high": 8.0}
    return Servo(PERIOD_S, **{**parameters, **changes})


def positions(robot: Servo, demand: float, steps: int) -> list[float]:
    return [robot.step(demand) for _ in range(steps)]


def test_nothing_moves_before_the_dead_time():
    track = positions(servo(), 1.0, 22)
    assert track[:20] == [0.0] * 20
    assert track[20] > 0.0


def test_settles_on_the_demand_with_little_overshoot():
    track = positions(servo(), 0.1, 300)
    assert track[-1] == pytest.approx(0.1, abs=1e-4)
    assert max(track) < 0.1 * 1.02


def test_bandwidth_is_that_of_a_second_order_lag():
    robot = servo(dead_time_s=0.0)
    track = [robot.step(0.01 * math.sin(2 * math.pi * 10.0 * k * PERIOD_S)) for k in range(1000)]
    assert max(track[500:]) == pytest.approx(0.01 / (2 * 0.9), rel=0.05)  # at the pole: 1 / (2 zeta)


def test_rate_limit_of_the_robot_and_of_the_command():
    robot = servo()
    track = positions(robot, 8.0, 200)
    assert max(b - a for a, b in pairwise(track)) == pytest.approx(27.9 * PERIOD_S)
    slow = servo()
    for _ in range(200):
        slow.step(8.0, rate_limit=2.0)
    assert slow.position == pytest.approx(2.0 * 0.180, rel=0.02)
    assert slow.is_at_rate_limit


def test_end_stop_holds_and_releases():
    robot = servo(low=0.0, high=1.0)
    positions(robot, 5.0, 500)
    assert robot.position == 1.0
    assert robot.is_at_end_stop
    assert robot.rate == 0.0
    positions(robot, 0.5, 400)
    assert robot.position == pytest.approx(0.5, abs=1e-3)
    assert not robot.is_at_end_stop


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=20))
def test_never_faster_nor_further_than_its_limits(demands: list[float]):
    robot = servo()
    before = robot.position
    for demand in demands:
        for _ in range(30):
            after = robot.step(demand)
            assert abs(after - before) <= 27.9 * PERIOD_S + 1e-12
            assert -8.0 <= after <= 8.0
            before = after
