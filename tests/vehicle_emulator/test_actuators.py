"""Each stage of the actuator chain alone, and the second-order stage against the analytic step response."""

import math
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_emulator.actuators import (
    Backlash,
    DeadTime,
    MotionProfile,
    PedalSpring,
    PositionSensor,
    Servo,
    quantised,
    second_order_transition,
)

PERIOD_S = 1e-3


def second_order_step(t_s: float, bandwidth_hz: float, damping_ratio: float) -> float:
    """Unit step response of omega^2 / (s^2 + 2 zeta omega s + omega^2), from the textbook."""
    omega = 2.0 * math.pi * bandwidth_hz
    if damping_ratio == 1.0:
        return 1.0 - math.exp(-omega * t_s) * (1.0 + omega * t_s)
    if damping_ratio < 1.0:
        damped = omega * math.sqrt(1.0 - damping_ratio**2)
        ratio = damping_ratio * omega / damped
        return 1.0 - math.exp(-damping_ratio * omega * t_s) * (math.cos(damped * t_s) + ratio * math.sin(damped * t_s))
    root = math.sqrt(damping_ratio**2 - 1.0)
    fast, slow = omega * (damping_ratio + root), omega * (damping_ratio - root)
    return 1.0 - (fast * math.exp(-slow * t_s) - slow * math.exp(-fast * t_s)) / (fast - slow)


@pytest.mark.parametrize("damping_ratio", [0.3, 0.9, 1.0, 1.6])
@pytest.mark.parametrize("bandwidth_hz", [5.0, 10.0, 40.0])
def test_servo_is_the_analytic_step_response_exactly(bandwidth_hz: float, damping_ratio: float):
    servo = Servo(PERIOD_S, bandwidth_hz, damping_ratio)
    for k in range(1, 400):
        assert servo.step(1.0) == pytest.approx(second_order_step(k * PERIOD_S, bandwidth_hz, damping_ratio), abs=1e-9)


@pytest.mark.parametrize("damping_ratio", [0.9, 1.0])
def test_servo_is_the_analytic_ramp_response_exactly(damping_ratio: float):
    servo, omega, slope = Servo(PERIOD_S, 10.0, damping_ratio), 2.0 * math.pi * 10.0, 3.0
    integral = 0.0  # of the step response, by Simpson's rule
    for k in range(1, 300):
        left, middle, right = (second_order_step((k - 1 + share) * PERIOD_S, 10.0, damping_ratio) for share in (0.0, 0.5, 1.0))
        integral += slope * PERIOD_S * (left + 4.0 * middle + right) / 6.0
        assert servo.step(slope * k * PERIOD_S, slope) == pytest.approx(integral, abs=1e-8)
    assert slope * 299 * PERIOD_S - servo.position == pytest.approx(slope * 2.0 * damping_ratio / omega, rel=1e-3)


def test_servo_with_half_its_bandwidth_left_takes_twice_the_time():
    whole, half = Servo(PERIOD_S, 10.0, 0.9), Servo(2 * PERIOD_S, 10.0, 0.9)
    for _ in range(100):
        assert half.step(1.0, share=0.5) == pytest.approx(whole.step(1.0), abs=1e-12)


def test_servo_stops_at_its_end_and_comes_back():
    servo = Servo(PERIOD_S, 10.0, 0.9)
    hits = [servo.step(2.0) > 1.0 and servo.stop_at(0.0, 1.0) for _ in range(200)]
    assert any(hits)
    assert (servo.position, servo.rate) == (1.0, 0.0)
    for _ in range(300):
        servo.step(0.5)
        servo.stop_at(0.0, 1.0)
    assert servo.position == pytest.approx(0.5, abs=1e-6)
    assert not servo.stop_at(0.0, 1.0)


def test_dead_time_without_jitter_is_a_pure_shift():
    stage, random = DeadTime(PERIOD_S, 0.020, 0.0, Random(1)), Random(2)
    inputs = [random.random() for _ in range(200)]
    assert [stage.step(u) for u in inputs][20:] == inputs[:-20]


def test_jittered_dead_times_cover_their_range_in_order_and_repeat_with_their_seed():
    def delays(seed: int) -> list[int]:
        stage, found = DeadTime(PERIOD_S, 0.020, 0.004, Random(seed)), {}
        for k in range(20_000):
            found.setdefault(stage.step(float(1 + k // 50)), k)
        order = [value for value in found if value >= 1.0]
        assert order == sorted(order)
        return [found[value] - 50 * (int(value) - 1) for value in order if value < 399]

    assert delays(1) == delays(1) != delays(2)
    assert set(delays(1)) == set(range(16, 25))
    assert sum(delays(1)) / len(delays(1)) == pytest.approx(20.0, abs=0.5)


def test_a_fast_demand_is_not_reordered_by_jitter():
    stage = DeadTime(PERIOD_S, 0.010, 0.008, Random(3))
    track = [stage.step(float(k)) for k in range(500)]
    assert track == sorted(track)


def test_reset_forgets_what_is_under_way():
    stage = DeadTime(PERIOD_S, 0.020, 0.0, Random(1))
    stage.step(5.0)
    stage.reset(1.0)
    assert [stage.step(1.0) for _ in range(50)] == [1.0] * 50


@given(st.floats(-100.0, 100.0), st.floats(1e-4, 1.0))
def test_quantised_is_a_multiple_and_near(value: float, resolution: float):
    assert abs(quantised(value, resolution) - value) <= 0.5 * resolution * (1 + 1e-9)
    assert math.remainder(quantised(value, resolution), resolution) == pytest.approx(0.0, abs=1e-9)


def test_profile_is_the_trapezoid_of_its_limits():
    profile = MotionProfile(PERIOD_S, acceleration_limit=100.0)
    track = [profile.step(2.0, rate_limit=10.0) for _ in range(400)]
    # 0.1 s up to 10/s covers 0.5, 0.1 s at that rate 1.0, 0.1 s down 0.5.
    for t_s, expected in ((0.05, 0.125), (0.1, 0.5), (0.15, 1.0), (0.2, 1.5), (0.25, 1.875), (0.3, 2.0)):
        assert track[round(t_s / PERIOD_S) - 1] == pytest.approx(expected, abs=1e-9)
    assert track[-1] == pytest.approx(2.0, abs=1e-12)
    assert profile.rate == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(0.1, 20.0)), min_size=1, max_size=8), st.floats(5.0, 2000.0))
def test_profile_never_breaks_its_limits(demands: list[tuple[float, float]], acceleration_limit: float):
    profile = MotionProfile(PERIOD_S, acceleration_limit)
    change = acceleration_limit * PERIOD_S
    for demand, rate_limit in demands:
        for _ in range(60):
            position, rate = profile.position, profile.rate
            profile.step(demand, rate_limit)
            assert abs(profile.rate - rate) <= change * (1 + 1e-9)
            assert abs(profile.rate) <= max(rate_limit, abs(rate) - change) * (1 + 1e-9)
            assert profile.position - position == pytest.approx(0.5 * (rate + profile.rate) * PERIOD_S, abs=2e-12)


@settings(max_examples=60, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(0.5, 20.0), st.floats(5.0, 2000.0))
def test_profile_reaches_a_standing_demand_without_overshoot(demand: float, rate_limit: float, acceleration_limit: float):
    profile = MotionProfile(PERIOD_S, acceleration_limit)
    time_s = abs(demand) / rate_limit + 2.0 * math.sqrt(abs(demand) / acceleration_limit)  # at most: cruise, and speeding up and braking
    track = [profile.step(demand, rate_limit) for _ in range(math.ceil(time_s / PERIOD_S) + 3)]
    assert max(math.copysign(1.0, demand) * position for position in track) <= abs(demand) + 1e-12
    assert all((b - a) * math.copysign(1.0, demand) >= -1e-12 for a, b in pairwise(track))
    assert track[-1] == pytest.approx(demand, abs=1e-9)


def test_a_lower_rate_limit_brakes_a_fast_profile():
    profile = MotionProfile(PERIOD_S, 100.0)
    for _ in range(100):
        profile.step(100.0, 10.0)
    assert profile.rate == pytest.approx(10.0)
    for _ in range(80):
        profile.step(100.0, 2.0)
    assert profile.rate == pytest.approx(2.0)
    assert profile.is_at_rate_limit


def test_backlash_lags_by_half_its_play_and_turns_after_all_of_it():
    lash = Backlash(0.2)
    assert [lash.step(x) for x in (0.05, 0.1, 0.3, 1.0)] == pytest.approx([0.0, 0.0, 0.2, 0.9])
    assert [lash.step(x) for x in (0.95, 0.85, 0.8, 0.5)] == pytest.approx([0.9, 0.9, 0.9, 0.6])
    lash.reset(3.0)
    assert lash.step(3.05) == 3.0


def test_pedal_spring_and_its_inverse():
    spring = PedalSpring(preload_n=20.0, full_stroke_n=420.0, friction_n=10.0)
    assert spring.force_n(0.0, 1.0) == 0.0
    assert spring.force_n(0.5, 1.0) == pytest.approx(230.0)
    assert spring.force_n(0.5, -1.0) == pytest.approx(210.0)
    assert spring.position_norm(spring.force_n(0.37, 1.0)) == pytest.approx(0.37)
    assert (spring.position_norm(0.0), spring.position_norm(25.0), spring.position_norm(1e4)) == (0.0, 0.0, 1.0)


def test_sensor_resolves_and_is_noisy_by_its_seed():
    def readings(seed: int) -> list[float]:
        sensor = PositionSensor(0.01, 0.02, Random(seed))
        return [sensor.read(1.234) for _ in range(4000)]

    assert readings(1) == readings(1) != readings(2)
    values = readings(1)
    mean = sum(values) / len(values)
    assert mean == pytest.approx(1.234, abs=0.002)
    assert math.sqrt(sum((v - mean) ** 2 for v in values) / len(values)) == pytest.approx(0.0202, rel=0.05)
    assert all(math.remainder(v, 0.01) == pytest.approx(0.0, abs=1e-9) for v in values)


@pytest.mark.parametrize("damping_ratio", [0.5, 1.0, 2.0])
def test_many_small_steps_of_the_second_order_are_one_large_one(damping_ratio: float):
    def state(steps: int) -> tuple[float, float]:
        a, b, c, d = second_order_transition(60.0, damping_ratio, 0.05 / steps)
        error, rate = 1.0, 3.0
        for _ in range(steps):
            error, rate = a * error + b * rate, c * error + d * rate
        return error, rate

    assert state(50) == pytest.approx(state(1), rel=1e-9)
