import math
from itertools import pairwise
from random import Random
from statistics import fmean

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.vehicle import load_vehicle
from vehicle_emulator.plant import GRAVITY_MPS2, FourWheelPlant, PlantInputs, PlantState

P = load_vehicle().plant
DT_S = 1e-3
COAST = PlantInputs(0.0, 0.0, 0.0)
MPS_100_KMH = 100 / 3.6


def drive(plant: FourWheelPlant, seconds: float, inputs: PlantInputs, dt_s: float = DT_S) -> PlantState:
    for _ in range(round(seconds / dt_s)):
        plant.step(dt_s, inputs)
    return plant.state


def corner(speed_mps: float, road_wheel_rad: float, seconds: float = 4.0) -> PlantState:
    """Steady cornering; a stiff cruise control holds the speed."""
    plant = FourWheelPlant(P, speed_mps=speed_mps)
    for _ in range(round(seconds / DT_S)):
        accelerator = min(max(0.08 + 0.5 * (speed_mps - plant.state.vx_mps), 0.0), 1.0)
        plant.step(DT_S, PlantInputs(road_wheel_rad, accelerator, 0.0))
    return plant.state


def kinetic_energy_j(state: PlantState) -> float:
    return 0.5 * P.mass_kg * (state.vx_mps**2 + state.vy_mps**2) + 0.5 * P.yaw_inertia_kgm2 * state.yaw_rate_radps**2


def test_coasting_slows_at_the_rate_of_the_resistances():
    state = drive(FourWheelPlant(P, speed_mps=30.0), 1.0, COAST)
    resistance_n = P.rolling_resistance_coefficient * P.mass_kg * GRAVITY_MPS2 + 0.6 * P.drag_area_m2 * 30.0**2 + P.drag_torque_force_n
    assert 30.0 - state.vx_mps == pytest.approx(resistance_n / P.mass_kg, rel=0.03)


def test_accelerates_like_a_compact_car():
    plant, seconds = FourWheelPlant(P), 0.0
    while plant.state.vx_mps < MPS_100_KMH and seconds < 20.0:
        plant.step(DT_S, PlantInputs(0.0, 1.0, 0.0))
        seconds += DT_S
    assert 8.0 < seconds < 14.0
    assert plant.state.y_m == 0.0


def test_drive_force_follows_the_pedal_with_its_lag():
    plant = FourWheelPlant(P)
    drive(plant, P.drive_lag_s, PlantInputs(0.0, 1.0, 0.0))
    rolling_n = P.rolling_resistance_coefficient * P.mass_kg * GRAVITY_MPS2
    expected_n = P.full_drive_force_n * (1.0 - math.exp(-1.0)) - rolling_n
    assert plant.state.ax_mps2 == pytest.approx(expected_n / P.mass_kg, rel=0.02)


def test_full_braking_stops_within_a_plausible_distance_and_stays():
    plant = FourWheelPlant(P, speed_mps=MPS_100_KMH)
    slowest_mps = 0.0
    for _ in range(5000):
        slowest_mps = min(slowest_mps, plant.step(DT_S, PlantInputs(0.0, 0.0, 1.0)).vx_mps)
    stopped = plant.state
    assert 38.0 < stopped.x_m < 60.0
    assert slowest_mps >= 0.0  # never backwards
    assert abs(stopped.vx_mps) < 1e-6
    resting = drive(plant, 10.0, PlantInputs(0.0, 0.0, 1.0))
    assert math.hypot(resting.x_m - stopped.x_m, resting.y_m - stopped.y_m) < 1e-4


def test_braking_in_a_bend_ends_at_rest():
    plant = FourWheelPlant(P, speed_mps=20.0)
    drive(plant, 1.0, PlantInputs(0.03, 0.0, 0.0))
    stopped = drive(plant, 6.0, PlantInputs(0.03, 0.0, 0.5))
    resting = drive(plant, 10.0, PlantInputs(0.03, 0.0, 0.5))
    assert math.hypot(stopped.vx_mps, stopped.vy_mps) < 1e-3
    assert math.hypot(resting.x_m - stopped.x_m, resting.y_m - stopped.y_m) < 0.01
    assert abs(resting.yaw_rad - stopped.yaw_rad) < 1e-3


def test_brake_holds_against_the_engine():
    state = drive(FourWheelPlant(P), 10.0, PlantInputs(0.0, 0.2, 0.5))
    assert abs(state.x_m) < 0.01


def test_full_lock_rolls_about_one_centre():
    plant = FourWheelPlant(P, speed_mps=1.0)
    state = drive(plant, 2.0, PlantInputs(0.5, 0.08, 0.0))
    assert state.yaw_rate_radps / state.vx_mps == pytest.approx(math.tan(0.5) / (P.cog_to_front_m + P.cog_to_rear_m), rel=0.02)
    assert all(abs(wheel.slip) < 0.005 for wheel in plant._wheels)  # no tyre scrubs against another


def test_steering_at_rest_moves_nothing():
    plant = FourWheelPlant(P)
    for k in range(2000):
        plant.step(DT_S, PlantInputs(0.5 * math.sin(0.01 * k), 0.0, 0.3))
    assert plant.state == PlantState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("speed_mps", [3.0, 10.0, 22.2, 30.0])
def test_steady_cornering_has_the_gain_of_the_linear_bicycle(speed_mps: float):
    wheelbase_m = P.cog_to_front_m + P.cog_to_rear_m
    weight_n = P.mass_kg * GRAVITY_MPS2

    def axle_stiffness_nprad(lever_m: float, compliance_radpn: float) -> float:
        load_n = weight_n * lever_m / wheelbase_m
        falling = 1.0 - P.tyre_load_sensitivity * (0.5 * load_n / P.tyre_nominal_load_n - 1.0)
        tyres_nprad = P.tyre_cornering_stiffness_per_load * load_n * falling
        return tyres_nprad / (1.0 + compliance_radpn * tyres_nprad)

    front = axle_stiffness_nprad(P.cog_to_rear_m, P.front_compliance_radpn)
    rear = axle_stiffness_nprad(P.cog_to_front_m, 0.0)
    understeer = P.mass_kg / wheelbase_m * (P.cog_to_rear_m / front - P.cog_to_front_m / rear)
    gain_per_s = speed_mps / (wheelbase_m + understeer * speed_mps**2)
    road_wheel_rad = 0.5 * (wheelbase_m + understeer * speed_mps**2) / speed_mps**2  # 0.5 m/s2
    state = corner(speed_mps, road_wheel_rad)
    assert state.yaw_rate_radps / road_wheel_rad == pytest.approx(gain_per_s, rel=0.03)
    assert state.ay_mps2 == pytest.approx(0.5, rel=0.03)


def test_understeers_like_a_front_driven_car():
    gains = [corner(22.2, steer).yaw_rate_radps / steer for steer in (0.005, 0.03, 0.06)]
    assert gains[0] < 22.2 / (P.cog_to_front_m + P.cog_to_rear_m)  # less than neutral
    assert gains[0] > gains[1] > gains[2]


def test_lateral_acceleration_saturates_below_friction():
    plant, highest_mps2 = FourWheelPlant(P, speed_mps=22.2), 0.0
    for k in range(10_000):
        accelerator = min(max(0.1 + 0.5 * (22.2 - plant.state.vx_mps), 0.0), 1.0)
        highest_mps2 = max(highest_mps2, plant.step(DT_S, PlantInputs(3e-5 * k, accelerator, 0.0)).ay_mps2)
    assert 7.5 < highest_mps2 < P.friction * GRAVITY_MPS2


def test_left_turn_loads_the_right_and_braking_the_front():
    plant = FourWheelPlant(P)
    front_left, front_right, rear_left, rear_right = (wheel.load_n(-4.0, 5.0) for wheel in plant._wheels)
    static = [wheel.load_n(0.0, 0.0) for wheel in plant._wheels]
    assert front_right > front_left
    assert rear_right > rear_left
    assert front_left + front_right > static[0] + static[1]
    total_n = front_left + front_right + rear_left + rear_right
    assert total_n == pytest.approx(P.mass_kg * GRAVITY_MPS2)
    # Moments about the centre of gravity balance the accelerations at its height.
    pitch_nm = (front_left + front_right) * P.cog_to_front_m - (rear_left + rear_right) * P.cog_to_rear_m
    roll_nm = 0.5 * P.track_front_m * (front_right - front_left) + 0.5 * P.track_rear_m * (rear_right - rear_left)
    assert pitch_nm == pytest.approx(P.mass_kg * 4.0 * P.cog_height_m)
    assert roll_nm == pytest.approx(P.mass_kg * 5.0 * P.cog_height_m)


def test_braking_takes_grip_from_cornering():
    def lateral(brake: float) -> float:
        plant = FourWheelPlant(P, speed_mps=25.0)
        drive(plant, 1.0, PlantInputs(0.08, 0.05, 0.0))
        return drive(plant, 0.3, PlantInputs(0.08, 0.0, brake)).ay_mps2

    assert lateral(0.9) < 0.7 * lateral(0.0)


def test_relaxation_delays_the_lateral_force():
    plant = FourWheelPlant(P, speed_mps=10.0)
    one_length_s = P.relaxation_length_m / 10.0
    early = drive(plant, one_length_s, PlantInputs(0.01, 0.0, 0.0)).ay_mps2
    instant = P.tyre_cornering_stiffness_per_load * 0.01 * GRAVITY_MPS2 * P.cog_to_rear_m / (P.cog_to_front_m + P.cog_to_rear_m)
    assert 0.4 * instant < early < 0.75 * instant


@settings(max_examples=15, deadline=None)
@given(
    speed_mps=st.floats(0.0, 36.0),
    steer=st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    accelerator=st.floats(0.0, 1.0),
    brake=st.floats(0.0, 1.0),
)
def test_left_and_right_are_mirror_images(speed_mps: float, steer: list[float], accelerator: float, brake: float):
    left, right = FourWheelPlant(P, speed_mps=speed_mps), FourWheelPlant(P, speed_mps=speed_mps)
    for angle, pedals in zip(steer, ((accelerator, 0.0), (0.0, brake), (0.0, 0.0)), strict=True):
        a = drive(left, 0.3, PlantInputs(angle, *pedals))
        b = drive(right, 0.3, PlantInputs(-angle, *pedals))
        mirrored = PlantState(b.x_m, -b.y_m, -b.yaw_rad, b.vx_mps, -b.vy_mps, -b.yaw_rate_radps, b.ax_mps2, -b.ay_mps2)
        assert a == pytest.approx(mirrored, rel=1e-6, abs=1e-6)


def elastic_energy_j(plant: FourWheelPlant) -> float:
    """What the tyres' lateral deflection stores: the integral of the Magic Formula over the relaxed slip."""
    stiffness_b = P.tyre_cornering_stiffness_per_load / (P.tyre_shape_c * P.friction)
    stored_j = 0.0
    for wheel in plant._wheels:
        grip_n = wheel.grip_n(wheel.load_n(plant.state.ax_mps2, plant.state.ay_mps2))
        slips = [(k + 0.5) / 50 * abs(wheel.slip) for k in range(50)]
        stored_j += grip_n * fmean(math.sin(P.tyre_shape_c * math.atan(stiffness_b * s)) for s in slips) * abs(wheel.slip)
    return P.relaxation_length_m * stored_j


@settings(max_examples=15, deadline=None)
@given(speed_mps=st.floats(0.5, 36.0), steer=st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=4))
def test_coasting_never_gains_energy(speed_mps: float, steer: list[float]):
    plant = FourWheelPlant(P, speed_mps=speed_mps)
    energies_j = [kinetic_energy_j(plant.state)]
    for angle in steer:
        for _ in range(5):
            drive(plant, 0.1, PlantInputs(angle, 0.0, 0.0))
            energies_j.append(kinetic_energy_j(plant.state) + elastic_energy_j(plant))
    assert all(after <= before + 0.1 for before, after in pairwise(energies_j))
    assert energies_j[-1] < energies_j[0]


def test_random_driving_stays_finite():
    random = Random(20)
    for _ in range(6):
        plant = FourWheelPlant(P, speed_mps=random.uniform(0.0, 36.0))
        for _ in range(20):
            inputs = PlantInputs(random.uniform(-0.55, 0.55), random.uniform(0.0, 1.0), random.choice([0.0, random.uniform(0.0, 1.0)]))
            state = drive(plant, 0.15, inputs)
            assert all(map(math.isfinite, state))
            assert math.hypot(state.ax_mps2, state.ay_mps2) < 1.2 * P.friction * GRAVITY_MPS2 + 1.0


def test_step_size_hardly_matters():
    def slalom(dt_s: float) -> PlantState:
        plant = FourWheelPlant(P, speed_mps=22.2)
        for k in range(round(4.0 / dt_s)):
            t_s = k * dt_s
            plant.step(dt_s, PlantInputs(0.04 * math.sin(3.0 * t_s), 0.0, 0.2 if t_s > 2.0 else 0.0))
        return plant.state

    coarse, fine = slalom(1e-3), slalom(0.25e-3)
    assert math.hypot(coarse.x_m - fine.x_m, coarse.y_m - fine.y_m) < 0.03
    assert coarse.yaw_rad == pytest.approx(fine.yaw_rad, abs=1e-3)
    assert coarse.vx_mps == pytest.approx(fine.vx_mps, abs=0.01)


def test_a_sideways_slide_at_walking_pace_comes_to_rest():
    plant = FourWheelPlant(P)
    plant._state = PlantState(0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.0, 0.0)
    state = drive(plant, 3.0, PlantInputs(0.0, 0.0, 0.3))
    assert abs(state.vy_mps) < 1e-3
    assert abs(state.yaw_rate_radps) < 1e-3


@pytest.mark.parametrize("grade", [0.06, -0.06])
def test_a_slope_pulls_with_its_share_of_the_weight(grade: float):
    level, inclined = (drive(FourWheelPlant(P, speed_mps=20.0, grade=g), 1.0, COAST) for g in (0.0, grade))
    expected_mps2 = -GRAVITY_MPS2 * grade / math.hypot(1.0, grade)
    assert inclined.vx_mps - level.vx_mps == pytest.approx(expected_mps2, rel=0.05)
    assert inclined.y_m == level.y_m == 0.0


def test_a_brake_holds_the_car_on_a_slope_and_without_one_it_rolls_back():
    held = drive(FourWheelPlant(P, grade=0.06), 10.0, PlantInputs(0.0, 0.0, 0.3))
    assert abs(held.x_m) < 1e-3
    assert drive(FourWheelPlant(P, grade=0.06), 2.0, COAST).vx_mps < -0.3
