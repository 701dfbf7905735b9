"""Limit profiles: their numbers, the arithmetic of held demands, and rounding onto the steps of the bus."""

import dataclasses
import math
import re
from dataclasses import replace

import pytest

from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.vehicle import FOCUS, load_vehicle
from gateway import limits
from gateway.limits import (
    BENCH,
    COMFORT_STOP,
    EMERGENCY_STOP,
    LIFTED,
    NOMINAL,
    PROFILES,
    PROVING_GROUND,
    Resolution,
    clamp,
    coarsest,
    lateral_acceleration_mps2,
    road_wheel_rad,
    steps_down,
    steps_up,
    steps_within,
)

pytestmark = pytest.mark.req("G1")

NUMBERS = {  # written down a second time: a changed limit needs a changed safety concept
    "nominal": (18.85, 13.9, 3.0, 5.0, 2.0, 3.5, 10.0, 20.0, 36.0, 0.3),
    "proving_ground": (18.85, 13.9, 15.0, 200.0, 3.3, 10.0, 20.0, 64.0, 36.0, 0.3),
    "bench": (1.57, 1.75, 1.0, 2.0, 1.0, 3.5, 2.0, 20.0, 8.4, 0.3),
}
TYRES_MPS2 = 9.0


@pytest.mark.parametrize("name", NUMBERS)
def test_the_numbers_of_each_profile(name):
    profile = PROFILES[name]
    assert (
        profile.steering_wheel_limit_rad, profile.steering_wheel_rate_radps, profile.lateral_acceleration_mps2, profile.lateral_jerk_mps3,
        profile.acceleration_mps2, profile.deceleration_mps2, profile.drive_jerk_mps3, profile.brake_jerk_mps3,
        profile.max_speed_mps, profile.standstill_brake_norm,
    ) == NUMBERS[name]  # fmt: skip
    assert profile.name == name
    assert (profile.comfort_stop, profile.safe_stop) == (COMFORT_STOP, EMERGENCY_STOP)


def test_the_grades_of_a_stop():
    assert (COMFORT_STOP.deceleration_mps2, COMFORT_STOP.jerk_mps3) == (1.0, 0.3)
    assert (EMERGENCY_STOP.deceleration_mps2, EMERGENCY_STOP.jerk_mps3) == (2.5, 1.5)


def test_profiles_are_frozen_and_complete():
    assert set(PROFILES.values()) == {NOMINAL, PROVING_GROUND, LIFTED, BENCH}
    with pytest.raises(dataclasses.FrozenInstanceError):
        NOMINAL.acceleration_mps2 = 9.0


@pytest.mark.parametrize("profile", PROFILES.values(), ids=str)
def test_every_profile_lets_its_stops_and_its_standstill_through(profile):
    assert profile.safe_stop.deceleration_mps2 <= profile.deceleration_mps2
    assert profile.safe_stop.jerk_mps3 <= profile.brake_jerk_mps3
    assert profile.standstill_brake_norm * 10.0 <= profile.deceleration_mps2  # full brake is 1 g


def beside_m(limit_mps2, jerk_mps3, time_s, step_s=1e-5):
    """Distance beside the path by brute force: acceleration grows with a jerk up to a limit."""
    acceleration = speed = distance = 0.0
    for _ in range(round(time_s / step_s)):
        acceleration = min(acceleration + jerk_mps3 * step_s, limit_mps2)
        speed += acceleration * step_s
        distance += speed * step_s
    return distance


@pytest.mark.parametrize("name", NUMBERS)
def test_the_table_of_held_demands_is_what_the_limits_give(name):
    row = next(line for line in limits.__doc__.splitlines() if line.startswith(f"| {name} "))
    lateral, held_250, from_straight, held_500, drive, faster = map(float, re.findall(r"(\d+(?:\.\d+)?) m", row))
    profile = PROFILES[name]
    assert lateral == min(profile.lateral_acceleration_mps2, TYRES_MPS2)
    assert held_250 == pytest.approx(0.5 * lateral * 0.25**2, abs=0.0051)
    assert held_500 == pytest.approx(0.5 * lateral * 0.5**2, abs=0.0051)
    assert from_straight == pytest.approx(beside_m(lateral, profile.lateral_jerk_mps3, 0.25), rel=0.05)
    assert drive == profile.acceleration_mps2
    assert faster == pytest.approx(0.5 * drive, abs=0.051)


@pytest.mark.parametrize("car", [FOCUS, FOCUS.with_name("van.toml")], ids=lambda path: path.stem)
@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_steps_are_too_coarse_when_one_of_them_exceeds_a_rate(car, profile):
    vehicle, tick_s = load_vehicle(car), 0.006
    steps = coarsest(vehicle, profile, tick_s)
    wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
    end_rad = road_wheel_rad(profile.lateral_acceleration_mps2, wheelbase_m, profile.max_speed_mps)
    last_mps2 = profile.lateral_acceleration_mps2 - lateral_acceleration_mps2(
        end_rad - steps.steering_wheel_rad / vehicle.steering.ratio, wheelbase_m, profile.max_speed_mps
    )  # what the last step before the bound makes
    rates = steps.steering_wheel_rad / tick_s / profile.steering_wheel_rate_radps, last_mps2 / tick_s / profile.lateral_jerk_mps3
    assert max(rates) == pytest.approx(1.0, rel=1e-3)
    assert max(rates) <= 1.0
    forces_n = vehicle.pedals.full_drive_force_n, vehicle.pedals.full_brake_force_n
    pedals = zip((steps.accelerator_norm, steps.brake_norm), forces_n, (profile.drive_jerk_mps3, profile.brake_jerk_mps3), strict=True)
    for step_norm, force_n, jerk_mps3 in pedals:
        assert step_norm * force_n / vehicle.model.mass_kg / tick_s == pytest.approx(jerk_mps3)
    assert steps.steering_wheel_rad > Resolution().steering_wheel_rad
    assert steps.accelerator_norm > Resolution().accelerator_norm


def test_both_rates_can_be_what_makes_a_step_too_coarse():
    vehicle = load_vehicle()
    assert coarsest(vehicle, BENCH, 0.006).steering_wheel_rad < BENCH.steering_wheel_rate_radps * 0.006
    slow = replace(BENCH, steering_wheel_rate_radps=0.5)
    assert coarsest(vehicle, slow, 0.006).steering_wheel_rad == 0.5 * 0.006


def test_resolution_is_that_of_the_robots_dbc():
    catalogue, step = load(), Resolution()

    def sent(name, signal, value):
        return catalogue.decode(catalogue.by_name[name], frame(catalogue, name, {signal: value}))[signal]

    for steps in (1, -1, 3, 777):
        angle_deg = math.degrees(steps * step.steering_wheel_rad)
        assert sent("SR_Command", "AngleCommand", angle_deg) == pytest.approx(angle_deg, abs=1e-9)
    for name, step_norm in (("AR_Command", step.accelerator_norm), ("BR_Command", step.brake_norm)):
        assert sent(name, "PositionCommand", 100.0 * step_norm) == pytest.approx(0.01, abs=1e-12)
    assert sent("SR_Command", "AngleCommand", math.degrees(0.49 * step.steering_wheel_rad)) == 0.0


def frame(catalogue, name, values):
    return CanFrame(catalogue.by_name[name].arbitration_id, catalogue.encode(name, values), 0)


@pytest.mark.parametrize(("value", "expected"), [(-3.0, -2.0), (-2.0, -2.0), (0.5, 0.5), (1.0, 1.0), (1.5, 1.0)])
def test_clamp(value, expected):
    assert clamp(value, -2.0, 1.0) == expected


@pytest.mark.parametrize(
    ("value", "up", "down"),
    [(0.0, 0, 0), (0.25, 1, 1), (0.26, 2, 1), (0.24, 1, 0), (-0.25, -1, -1), (-0.26, -1, -2), (-0.24, 0, -1), (0.5, 2, 2)],
)
def test_steps_beside_a_value(value, up, down):
    assert (steps_up(value, 0.25), steps_down(value, 0.25)) == (up, down)


def test_a_multiple_that_floats_miss_is_still_a_multiple():
    assert math.floor(0.3 / 0.1) == 2
    assert steps_down(0.3, 0.1) == steps_up(0.3, 0.1) == 3
    assert steps_down(0.1 + 0.2, 0.1) == steps_up(0.1 + 0.2, 0.1) == 3
    assert steps_down(0.3 - 1e-9, 0.1) == 2
    assert steps_up(0.3 + 1e-9, 0.1) == 4


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, 0), (0.13, 1), (0.37, 1), (0.38, 2), (0.6, 2), (0.7, 2), (9.0, 2), (-0.6, -2), (-0.7, -2), (-9.0, -2)],
)
def test_steps_within_bounds_that_are_no_multiples(value, expected):
    assert steps_within(value, -0.7, 0.7, 0.25) == expected


@pytest.mark.parametrize("vx_mps", [1.0, 7.5, 36.0])
@pytest.mark.parametrize("wheelbase_m", [2.648, 3.75])
def test_lateral_acceleration_and_road_wheel_angle_are_inverse(vx_mps, wheelbase_m):
    angle_rad = road_wheel_rad(3.0, wheelbase_m, vx_mps)
    assert math.tan(angle_rad) == pytest.approx(3.0 * wheelbase_m / vx_mps**2)
    assert lateral_acceleration_mps2(angle_rad, wheelbase_m, vx_mps) == pytest.approx(3.0)
    assert lateral_acceleration_mps2(-angle_rad, wheelbase_m, -vx_mps) == pytest.approx(-3.0)


def test_lateral_acceleration_of_a_known_bend():
    assert lateral_acceleration_mps2(math.atan(2.5 / 100.0), 2.5, 20.0) == pytest.approx(4.0)  # 20 m/s on a radius of 100 m
