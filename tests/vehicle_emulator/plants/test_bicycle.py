"""The bicycle as a plant: it is the controller's model where that holds, and a car that stands, rolls and reverses where it does not."""

import math
from random import Random

import casadi as ca
import numpy as np
import pytest

from controller.model import single_track
from dbc.vehicle import load_vehicle
from vehicle_emulator.plants.bicycle import BicyclePlant, attitude
from vehicle_emulator.plants.interface import GRAVITY_MPS2, Level, PlantFaults, PlantInputs, RoadPoint, Selector, SteeringInputs
from vehicle_emulator.road import RoadDescription, make_road

VEHICLE = load_vehicle()
RATIO = VEHICLE.steering.ratio
STEP_S = 1e-3


def holding(road_wheel_rad=0.0):
    return SteeringInputs(demand_rad=RATIO * road_wheel_rad, torque_limit_nm=60.0)


def driven(inputs, seconds, *, speed_mps=0.0, road=None, yaw_rad=0.0):
    plant = BicyclePlant(VEHICLE, road or Level(), (0.0, 0.0, yaw_rad), speed_mps)
    for _ in range(round(seconds / STEP_S)):
        plant.step(STEP_S, inputs)
    return plant.state


def model_after(speed_mps, road_wheels_rad, t_r):
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    rhs = ca.Function("rhs", [x, u], [single_track(x, u, VEHICLE.model)])
    state = ca.DM([speed_mps, 0, 0, 0, 0, 0])
    for road_wheel_rad in road_wheels_rad:
        inputs = ca.DM([road_wheel_rad, t_r])
        k1 = rhs(state, inputs)
        k2 = rhs(state + 0.5 * STEP_S * k1, inputs)
        k3 = rhs(state + 0.5 * STEP_S * k2, inputs)
        k4 = rhs(state + STEP_S * k3, inputs)
        state += STEP_S / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(state).ravel()


@pytest.mark.parametrize(("speed_mps", "road_wheel_rad", "t_r"), [(8.0, 0.05, 0.0), (16.7, -0.03, 0.6), (30.0, 0.02, -0.4)])
def test_above_walking_pace_it_is_the_model_of_the_controller(speed_mps, road_wheel_rad, t_r):
    full_n = VEHICLE.model.max_wheel_torque_nm / VEHICLE.model.wheel_radius_m
    pedals = VEHICLE.pedals
    inputs = PlantInputs(
        holding(road_wheel_rad), max(t_r, 0.0) * full_n / pedals.full_drive_force_n, max(-t_r, 0.0) * full_n / pedals.full_brake_force_n
    )
    plant = BicyclePlant(VEHICLE, Level(), speed_mps=speed_mps)
    road_wheels_rad = [plant.step(STEP_S, inputs).steering_wheel_rad / RATIO for _ in range(2000)]
    state, expected = plant.state, model_after(speed_mps, road_wheels_rad, t_r)
    reached = (state.vx_mps, state.vy_mps, state.yaw_rate_radps, state.x_m, state.y_m, state.yaw_rad)
    assert reached == pytest.approx(expected, rel=2e-4, abs=2e-4)


def test_at_walking_pace_it_rolls_about_its_centre_of_turn():
    state = driven(PlantInputs(holding(0.3), accelerator_norm=0.05), 3.0, speed_mps=0.8)
    p = VEHICLE.model
    assert state.yaw_rate_radps / state.vx_mps == pytest.approx(0.3 / (p.cog_to_front_m + p.cog_to_rear_m), rel=0.03)
    assert state.vy_mps / state.yaw_rate_radps == pytest.approx(p.cog_to_rear_m, rel=0.05)


def test_a_standing_car_does_not_move_when_it_is_steered():
    before, after = BicyclePlant(VEHICLE, Level()).state, driven(PlantInputs(holding(0.4)), 2.0)
    assert after.steering_wheel_rad == pytest.approx(0.4 * RATIO)
    assert (after.x_m, after.y_m, after.yaw_rad, after.vx_mps, after.vy_mps) == (before.x_m, before.y_m, before.yaw_rad, 0.0, 0.0)


@pytest.mark.parametrize("heading_rad", [0.0, math.pi / 2, 2.5])
def test_the_brake_holds_on_a_slope_in_every_direction(heading_rad):
    state = driven(PlantInputs(holding(), brake_norm=0.3), 10.0, road=make_road(RoadDescription(grade_percent=12.0)), yaw_rad=heading_rad)
    assert math.hypot(state.x_m, state.y_m) <= 1e-3
    assert (state.vx_mps, state.vy_mps, state.yaw_rate_radps) == (0.0, 0.0, 0.0)


def test_without_brake_it_rolls_back_down_the_slope_and_the_brake_stops_it_for_good():
    road = make_road(RoadDescription(grade_percent=10.0))
    plant = BicyclePlant(VEHICLE, road)
    for _ in range(2000):
        plant.step(STEP_S, PlantInputs(holding(), selector=Selector.NEUTRAL))
    slope_rad, p = math.atan(0.1), VEHICLE.model
    expected_mps2 = GRAVITY_MPS2 * math.sin(slope_rad) - p.rolling_resistance_n / p.mass_kg
    assert plant.state.vx_mps == pytest.approx(-2.0 * expected_mps2, rel=2e-3)
    assert plant.state.z_m == pytest.approx(0.1 * plant.state.x_m)
    for _ in range(1000):
        plant.step(STEP_S, PlantInputs(holding(), brake_norm=0.5))
    assert plant.state.vx_mps == 0.0


def test_a_braked_car_stops_and_does_not_drive_backwards():
    state = driven(PlantInputs(holding(), brake_norm=1.0), 3.0, speed_mps=10.0)
    p = VEHICLE.model
    assert state.vx_mps == 0.0
    assert state.x_m == pytest.approx(0.5 * 100.0 / ((VEHICLE.pedals.full_brake_force_n + p.rolling_resistance_n) / p.mass_kg), rel=0.01)


@pytest.mark.parametrize(("selector", "gear", "sign"), [(Selector.DRIVE, 1, 1), (Selector.REVERSE, -1, -1), (Selector.NEUTRAL, 0, 0)])
def test_the_selector_decides_where_the_accelerator_drives(selector, gear, sign):
    state = driven(PlantInputs(holding(), accelerator_norm=0.5, selector=selector), 1.0)
    assert state.gear == gear
    assert math.copysign(1.0, state.vx_mps) * (abs(state.vx_mps) > 0.5) == sign
    assert state.wheel_speeds_radps == (state.vx_mps / VEHICLE.model.wheel_radius_m,) * 4


def test_in_reverse_left_steering_turns_it_to_the_right():
    state = driven(PlantInputs(holding(0.2), accelerator_norm=0.2, selector=Selector.REVERSE), 3.0)
    assert state.vx_mps < -1.0
    assert state.yaw_rate_radps < -0.05
    assert state.yaw_rate_radps / state.vx_mps == pytest.approx(0.2 / 2.648, rel=0.1)


def test_park_holds_the_car():
    steep = make_road(RoadDescription(grade_percent=15.0))
    state = driven(PlantInputs(holding(), accelerator_norm=1.0, selector=Selector.PARK), 2.0, road=steep)
    assert state.vx_mps == state.x_m == 0.0


def test_faults_take_drive_and_brake_away_and_push_the_car_aside():
    whole = driven(PlantInputs(holding(), accelerator_norm=0.8), 1.0)
    weak = driven(PlantInputs(holding(), accelerator_norm=0.8, faults=PlantFaults(drive_norm=0.5)), 1.0)
    assert weak.vx_mps == pytest.approx(0.5 * whole.vx_mps, rel=0.1)
    assert driven(PlantInputs(holding(), brake_norm=1.0, faults=PlantFaults(brake_norm=0.0)), 1.0, speed_mps=10.0).vx_mps > 9.0
    assert driven(PlantInputs(holding(), faults=PlantFaults(push_n=2000.0)), 1.0, speed_mps=20.0).y_m > 0.05


def test_the_acceleration_is_that_of_the_ground_without_gravity():
    turning = driven(PlantInputs(holding(0.02), accelerator_norm=0.2), 3.0, speed_mps=20.0)
    assert turning.ay_mps2 == pytest.approx(turning.vx_mps * turning.yaw_rate_radps, rel=0.02)
    rolling = driven(PlantInputs(holding(), selector=Selector.NEUTRAL), 0.5, road=make_road(RoadDescription(grade_percent=10.0)))
    assert rolling.ax_mps2 == pytest.approx(-0.976 + 0.133, abs=0.01)


def test_the_acceleration_is_how_the_velocity_over_the_ground_changes():
    plant = BicyclePlant(VEHICLE, Level(), speed_mps=30.0)

    def velocity(state):
        along, left = (math.cos(state.yaw_rad), math.sin(state.yaw_rad)), (-math.sin(state.yaw_rad), math.cos(state.yaw_rad))
        return np.array((state.vx_mps * along[0] + state.vy_mps * left[0], state.vx_mps * along[1] + state.vy_mps * left[1]))

    for _ in range(1500):
        before, state = plant.state, plant.step(STEP_S, PlantInputs(holding(0.03), accelerator_norm=0.1))
    change = (velocity(state) - velocity(before)) / STEP_S
    along = change @ (math.cos(state.yaw_rad), math.sin(state.yaw_rad))
    left = change @ (-math.sin(state.yaw_rad), math.cos(state.yaw_rad))
    assert abs(state.yaw_rate_radps * state.vy_mps) > 0.05
    assert (state.ax_mps2, state.ay_mps2) == pytest.approx((along, left), abs=5e-3)


def test_a_road_that_falls_to_the_right_pulls_the_car_to_the_right():
    road = make_road(RoadDescription(cross_fall_percent=5.0))
    state = driven(PlantInputs(holding(), selector=Selector.NEUTRAL), 1.0, speed_mps=20.0, road=road)
    assert state.y_m < -0.02
    assert state.roll_rad == pytest.approx(math.atan(0.05), rel=1e-3)


def test_a_car_lies_on_the_road_as_the_road_does():
    assert attitude(RoadPoint(0.0, 0.1, 0.0, 1.0), 0.0) == pytest.approx((0.0, -math.atan(0.1)))
    assert attitude(RoadPoint(0.0, 0.0, 0.1, 1.0), 0.0) == pytest.approx((math.atan(0.1), 0.0))
    roll_rad, pitch_rad = attitude(RoadPoint(0.0, 0.3, -0.2, 1.0), 0.7)
    up = np.array((
        math.sin(pitch_rad) * math.cos(roll_rad) * math.cos(0.7) + math.sin(roll_rad) * math.sin(0.7),
        math.sin(pitch_rad) * math.cos(roll_rad) * math.sin(0.7) - math.sin(roll_rad) * math.cos(0.7),
        math.cos(pitch_rad) * math.cos(roll_rad),
    ))  # fmt: skip
    assert up / up[2] == pytest.approx((-0.3, 0.2, 1.0))


def test_another_period_than_its_own_is_refused():
    with pytest.raises(ValueError, match="made for"):
        BicyclePlant(VEHICLE, Level()).step(2e-3, PlantInputs())


def test_random_pedals_steering_and_slopes_give_finite_numbers():
    rng = Random(7)
    plant = BicyclePlant(VEHICLE, make_road(RoadDescription(grade_percent=15.0, cross_fall_percent=10.0)), speed_mps=20.0)
    for _ in range(60):
        steering = SteeringInputs(rng.uniform(-8, 8), rng.choice([0.0, 60.0]), rng.uniform(-20, 20))
        inputs = PlantInputs(steering, rng.random(), rng.choice([0.0, rng.random()]), rng.choice(list(Selector)))
        for _ in range(200):
            state = plant.step(STEP_S, inputs)
        assert all(math.isfinite(number) for field in state for number in (field if isinstance(field, tuple) else (field,)))
        assert abs(state.yaw_rate_radps) < 10.0
