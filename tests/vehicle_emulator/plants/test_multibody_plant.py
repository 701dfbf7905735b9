"""The whole car as its users see it: what it does when it is driven, braked, steered, pushed, parked and lifted."""

import itertools
import math

import numpy as np
import pytest

from vehicle_emulator.plants.interface import GRAVITY_MPS2, Level, PlantFaults, PlantInputs, RoadPoint, Selector, SteeringInputs
from vehicle_emulator.plants.multibody.layout import STATE, slices
from vehicle_emulator.plants.multibody.plant import MultibodyPlant

S = slices(STATE)
STEP_S = 0.001
STRAIGHT = SteeringInputs(torque_limit_nm=60.0)


class Slope:
    """A plane that rises along x and y."""

    def __init__(self, slope_x: float, slope_y: float = 0.0) -> None:
        self._slopes = slope_x, slope_y

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        slope_x, slope_y = self._slopes
        return RoadPoint(slope_x * x_m + slope_y * y_m, slope_x, slope_y, 1.0)


class Split:
    """A level road with ice on its right half."""

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        return RoadPoint(0.0, 0.0, 0.0, 1.0 if y_m > 0.0 else 0.2)


def drive(plant, seconds, inputs):
    """Hold inputs, or what a function of time makes them, and return all states."""
    act = inputs if callable(inputs) else lambda _time_s, _state: inputs
    return [plant.step(STEP_S, act(k * STEP_S, plant.state)) for k in range(round(seconds / STEP_S))]


def at_speed(speed_mps, steering_rad):
    """Inputs that hold a speed while the steering wheel follows a function of time."""

    def inputs(time_s, state):
        accelerator = min(max(0.1 + 0.3 * (speed_mps - state.vx_mps), 0.0), 1.0)
        return PlantInputs(SteeringInputs(steering_rad(time_s), torque_limit_nm=60.0), accelerator)

    return inputs


def changed(vehicle, **sections):
    """A vehicle with other numbers in sections of `multibody`."""
    multibody = vehicle.multibody
    updates = {name: getattr(multibody, name).model_copy(update=values) for name, values in sections.items()}
    return vehicle.model_copy(update={"multibody": multibody.model_copy(update=updates)})


# --- at rest ---


@pytest.mark.parametrize("speed_mps", [0.0, 25.0])
def test_starts_settled_where_it_is_put(vehicle, speed_mps):
    state = MultibodyPlant(vehicle, Level(), (3.0, -4.0, 1.0), speed_mps).state
    assert (state.x_m, state.y_m, state.yaw_rad) == pytest.approx((3.0, -4.0, 1.0), abs=1e-9)
    assert (state.z_m, state.roll_rad, state.pitch_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert state.vx_mps == pytest.approx(speed_mps)
    assert sum(state.wheel_loads_n) == pytest.approx(vehicle.multibody.masses.mass_kg * GRAVITY_MPS2)
    assert state.wheel_speeds_radps[0] == pytest.approx(speed_mps / vehicle.multibody.tyre.radius_m, rel=0.03)


@pytest.mark.parametrize("yaw_rad", [0.0, 2.0])
def test_starts_settled_on_a_slope_with_its_wheels_straight(vehicle, yaw_rad):
    start = MultibodyPlant(vehicle, Slope(0.05, 0.1), (3.0, 4.0, yaw_rad)).state
    assert (start.x_m, start.y_m) == pytest.approx((3.0, 4.0), abs=1e-6)
    assert start.yaw_rad == pytest.approx(yaw_rad, abs=0.002)
    assert abs(start.steering_wheel_rad) < 0.03
    across = math.atan(0.1 * math.cos(yaw_rad) - 0.05 * math.sin(yaw_rad))
    along = math.atan(0.05 * math.cos(yaw_rad) + 0.1 * math.sin(yaw_rad))
    assert start.pitch_rad == pytest.approx(-along, abs=math.radians(0.3))
    assert abs(across) < abs(start.roll_rad) < 1.4 * abs(across)
    assert start.roll_rad * across > 0.0


def test_goes_on_at_its_start_speed(vehicle):
    plant = MultibodyPlant(vehicle, Level(), speed_mps=20.0)
    states = drive(plant, 1.0, at_speed(20.0, lambda _: 0.0))
    assert all(abs(state.vx_mps - 20.0) < 0.5 for state in states)
    assert all(abs(state.pitch_rad) < math.radians(0.6) for state in states)


@pytest.mark.parametrize("yaw_rad", [0.0, 1.2, math.pi])
def test_brakes_hold_the_car_on_a_slope_for_a_minute(vehicle, yaw_rad):
    plant = MultibodyPlant(vehicle, Slope(0.12), (0.0, 0.0, yaw_rad))
    start = plant.step(STEP_S, PlantInputs(STRAIGHT, brake_norm=0.4, selector=Selector.NEUTRAL))
    plant.car.advance(STEP_S, 60_000)
    end = plant.step(STEP_S, PlantInputs(STRAIGHT, brake_norm=0.4, selector=Selector.NEUTRAL))
    assert math.hypot(end.x_m - start.x_m, end.y_m - start.y_m) < 0.001
    assert math.hypot(start.pitch_rad, start.roll_rad) == pytest.approx(math.atan(0.12), rel=0.15)


def test_park_holds_the_car_on_a_slope_without_brakes(vehicle):
    plant = MultibodyPlant(vehicle, Slope(0.12))
    states = drive(plant, 10.0, PlantInputs(selector=Selector.PARK))
    assert abs(states[-1].x_m - states[2000].x_m) < 0.001
    assert abs(states[-1].x_m) < 0.1


def test_steering_from_lock_to_lock_does_not_move_a_standing_car(vehicle):
    plant = MultibodyPlant(vehicle, Level())
    lock_rad = vehicle.steering.road_wheel_limit_rad * vehicle.steering.ratio
    inputs = lambda t, _: PlantInputs(SteeringInputs(lock_rad * math.sin(math.pi * t), torque_limit_nm=60.0), brake_norm=0.3)  # noqa: E731
    states = drive(plant, 8.0, inputs)
    places = np.array([(state.x_m, state.y_m) for state in states[2000:]])
    assert np.ptp(places, axis=0).max() < 0.001
    assert max(state.steering_wheel_rad for state in states) > 0.98 * lock_rad


def test_the_steering_wheel_stops_at_its_lock(focus):
    lock_rad = focus.steering.road_wheel_limit_rad * focus.steering.ratio
    plant = MultibodyPlant(focus, Level())
    drive(plant, 3.0, lambda t, _: PlantInputs(SteeringInputs(min(8.0 * t, 1.5 * lock_rad), torque_limit_nm=60.0)))
    assert lock_rad < plant.state.steering_wheel_rad < lock_rad + math.radians(9.0)


def test_a_car_in_neutral_rolls_down_as_fast_as_gravity_lets_it(focus):
    plant = MultibodyPlant(focus, Slope(-0.08))
    states = drive(plant, 5.0, PlantInputs(STRAIGHT, selector=Selector.NEUTRAL))
    steepness = math.atan(0.08)
    most = GRAVITY_MPS2 * (math.sin(steepness) - focus.multibody.tyre.rolling_resistance * math.cos(steepness))
    # Wheels to be spun up are 3 % of the mass; driveline and air take the rest.
    assert 0.9 * most < (states[-1].vx_mps - states[999].vx_mps) / 4.0 < 0.97 * most


# --- driving and braking ---


def test_accelerates_like_a_car_of_its_class(vehicle):
    states = drive(MultibodyPlant(vehicle, Level()), 25.0, PlantInputs(STRAIGHT, accelerator_norm=1.0))
    to_100_s = next(k for k, state in enumerate(states) if state.vx_mps > 100.0 / 3.6) * STEP_S
    assert 7.0 < to_100_s < 20.0
    assert abs(states[-1].y_m) < 0.01
    assert states[1500].pitch_rad < 0.0


def test_brakes_from_100_kmh_within_a_normal_distance(focus):
    plant = MultibodyPlant(focus, Level(), speed_mps=100.0 / 3.6)
    states = drive(plant, 5.0, PlantInputs(STRAIGHT, brake_norm=1.0))
    assert 36.0 < states[-1].x_m < 46.0
    assert abs(states[-1].vx_mps) < 0.01
    braking = states[1500]
    assert braking.pitch_rad > math.radians(0.5)
    assert braking.wheel_loads_n[0] > braking.wheel_loads_n[2]
    assert -11.0 < braking.ax_mps2 < -8.0


def test_a_stopped_car_stays_where_it_stopped(vehicle):
    plant = MultibodyPlant(vehicle, Level(), speed_mps=10.0)
    states = drive(plant, 6.0, PlantInputs(STRAIGHT, brake_norm=0.5))
    assert abs(states[-1].x_m - states[-1000].x_m) < 1e-4
    assert min(state.vx_mps for state in states) > -0.3


def test_anti_lock_keeps_wheels_turning_and_the_car_steerable(focus):
    without = changed(focus, brakes={"has_abs": False})

    def swerve(car):
        plant = MultibodyPlant(car, Level(0.5), speed_mps=22.0)
        steer = lambda t, _: PlantInputs(SteeringInputs(1.5 * (t > 0.5), torque_limit_nm=60.0), brake_norm=1.0)  # noqa: E731
        return drive(plant, 2.0, steer)[-1]

    turned, skidded = swerve(focus), swerve(without)
    assert min(turned.wheel_speeds_radps) > 0.7 * turned.vx_mps / focus.multibody.tyre.radius_m
    assert max(map(abs, skidded.wheel_speeds_radps)) < 0.1
    assert turned.y_m > 1.0
    assert abs(skidded.y_m) < 0.3 * turned.y_m


def test_braking_on_half_ice_turns_the_car_to_the_side_that_grips(focus):
    plant = MultibodyPlant(focus, Split(), speed_mps=15.0)
    state = drive(plant, 0.8, PlantInputs(STRAIGHT, brake_norm=0.6))[-1]
    assert state.yaw_rad > math.radians(1.0)


def test_reverse_drives_backwards(vehicle):
    state = drive(MultibodyPlant(vehicle, Level()), 5.0, PlantInputs(STRAIGHT, accelerator_norm=0.2, selector=Selector.REVERSE))[-1]
    assert state.gear == -1
    assert state.vx_mps < -1.0
    assert max(state.wheel_speeds_radps) < 0.0
    assert abs(state.y_m) < 0.05


def test_only_the_driven_axle_spins_on_ice(vehicle):
    states = drive(MultibodyPlant(vehicle, Level(0.1)), 1.5, PlantInputs(STRAIGHT, accelerator_norm=1.0))
    front, rear = (max(state.wheel_speeds_radps[wheel] for state in states) for wheel in (0, 2))
    driven, other = (front, rear) if vehicle.multibody.front_drive_share == 1.0 else (rear, front)
    assert driven > 1.2 * other


# --- cornering ---


def test_step_steer_builds_up_like_a_car(focus):
    plant = MultibodyPlant(focus, Level(), speed_mps=80.0 / 3.6)
    states = drive(plant, 4.0, at_speed(80.0 / 3.6, lambda t: math.radians(60.0) * (t > 0.5)))
    end, yaw_rates = states[-1], np.array([state.yaw_rate_radps for state in states])
    rise_s = np.argmax(yaw_rates > 0.9 * end.yaw_rate_radps) * STEP_S - 0.5
    assert 5.5 < end.ay_mps2 < 8.0
    assert math.radians(3.0) < end.roll_rad < math.radians(5.5)
    assert 0.1 < rise_s < 0.4
    assert 1.0 <= yaw_rates.max() / end.yaw_rate_radps < 1.3
    assert end.wheel_loads_n[1] > end.wheel_loads_n[0]


def test_understeers(vehicle):
    """Steering beyond Ackermann's grows with lateral acceleration: 1 to 5 degrees per g."""
    masses, gradients = vehicle.multibody.masses, []
    for angle_rad in (0.2, 0.5):
        states = drive(MultibodyPlant(vehicle, Level(), speed_mps=22.0), 4.0, at_speed(22.0, lambda t, a=angle_rad: a * min(t, 1.0)))
        end, base_m = states[-1], masses.cog_to_front_m + masses.cog_to_rear_m
        beyond_rad = end.steering_wheel_rad / vehicle.steering.ratio - base_m * end.yaw_rate_radps / end.vx_mps
        gradients.append(math.degrees(beyond_rad) / (end.ay_mps2 / GRAVITY_MPS2))
    assert 1.0 < gradients[0] < 5.0
    assert gradients[1] > gradients[0]


@pytest.mark.parametrize(("name", "least", "most"), [("focus", 8.0, 9.3), ("van", 6.0, 8.3)])
def test_lateral_acceleration_has_its_limit(request, name, least, most):
    vehicle = request.getfixturevalue(name)
    plant = MultibodyPlant(vehicle, Level(), speed_mps=25.0)
    states = drive(plant, 8.0, at_speed(25.0, lambda t: math.radians(30.0) * t))
    assert least < max(state.ay_mps2 for state in states) < most
    assert max(state.roll_rad for state in states) < math.radians(8.0)


def test_turns_round_the_circle_of_its_wheels_when_it_is_slow(focus):
    plant = MultibodyPlant(focus, Level(), speed_mps=2.0)
    states = drive(plant, 30.0, at_speed(2.0, lambda t: 6.0 * min(t, 1.0)))
    end, masses = states[-1], focus.multibody.masses
    radius_m = (masses.cog_to_front_m + masses.cog_to_rear_m) / math.tan(end.steering_wheel_rad / focus.steering.ratio)
    assert end.vx_mps / end.yaw_rate_radps == pytest.approx(radius_m, rel=0.03)
    assert end.yaw_rad > 1.5 * math.pi
    assert max(abs(b.yaw_rad - a.yaw_rad) for a, b in itertools.pairwise(states)) < 0.01


def test_released_steering_wheel_returns(focus):
    plant = MultibodyPlant(focus, Level(), speed_mps=15.0)
    held = drive(plant, 1.5, at_speed(15.0, lambda _: 1.0))[-1]
    released = drive(plant, 2.0, PlantInputs(accelerator_norm=0.1))[-1]
    assert held.steering_wheel_rad > 0.95
    assert abs(held.steering_robot_nm) > 1.0
    assert abs(released.steering_wheel_rad) < 0.05
    assert released.steering_robot_nm == 0.0


def test_the_drivers_hands_turn_the_released_wheel(focus):
    plant = MultibodyPlant(focus, Level(), speed_mps=15.0)
    state = drive(plant, 1.0, PlantInputs(SteeringInputs(driver_torque_nm=3.0), accelerator_norm=0.1))[-1]
    assert state.steering_wheel_rad > 0.2
    assert state.yaw_rate_radps > 0.05


def test_without_friction_and_road_the_steering_robot_is_its_servo(focus):
    vehicle = changed(focus, steering={"friction_nm": 0.0})
    plant, servo = MultibodyPlant(vehicle, Level(), is_lifted=True), focus.robots.steering
    pole, damping = 2.0 * math.pi * servo.bandwidth_hz, servo.damping_ratio
    fast = pole * math.sqrt(1.0 - damping**2)
    states = drive(plant, 0.3, PlantInputs(SteeringInputs(0.1, torque_limit_nm=60.0)))
    for k, state in enumerate(states, start=1):
        t = k * STEP_S
        ringing = math.cos(fast * t) + damping / math.sqrt(1.0 - damping**2) * math.sin(fast * t)
        assert state.steering_wheel_rad == pytest.approx(0.1 * (1.0 - math.exp(-damping * pole * t) * ringing), abs=1e-6)


def test_the_steering_robot_is_no_stronger_than_its_limit(focus):
    states = drive(MultibodyPlant(focus, Level()), 0.3, PlantInputs(SteeringInputs(5.0, torque_limit_nm=7.0)))
    assert max(state.steering_robot_nm for state in states) == 7.0


def test_steering_can_be_imposed(focus):
    plant = MultibodyPlant(focus, Level(), speed_mps=10.0)
    for _ in range(1000):
        plant.impose_steering(1.0, 0.0)
        plant.step(STEP_S, PlantInputs(accelerator_norm=0.1))
    assert plant.state.steering_wheel_rad == pytest.approx(1.0, abs=0.01)
    assert plant.state.yaw_rate_radps > 0.15


# --- faults ---


def test_a_gust_pushes_the_car_to_its_left(vehicle):
    plant = MultibodyPlant(vehicle, Level(), speed_mps=20.0)
    states = drive(plant, 0.5, PlantInputs(STRAIGHT, 0.1, faults=PlantFaults(push_n=2000.0)))
    assert states[20].ay_mps2 > 0.5
    assert states[-1].y_m > 0.02


def test_weak_drive_and_brakes(focus):
    def speed_after(seconds, start_mps, inputs):
        return drive(MultibodyPlant(focus, Level(), speed_mps=start_mps), seconds, inputs)[-1].vx_mps

    full, weak = PlantFaults(), PlantFaults(drive_norm=0.5, brake_norm=0.5)
    gained = [speed_after(3.0, 10.0, PlantInputs(STRAIGHT, 0.8, faults=faults)) - 10.0 for faults in (full, weak)]
    lost = [20.0 - speed_after(1.0, 20.0, PlantInputs(STRAIGHT, 0.0, 0.3, faults=faults)) for faults in (full, weak)]
    assert 0.3 < gained[1] / gained[0] < 0.6
    assert 0.4 < lost[1] / lost[0] < 0.7


# --- on the lift ---


def test_on_the_lift_the_body_stays_and_the_driven_wheels_turn(vehicle):
    plant = MultibodyPlant(vehicle, Level(), (5.0, 6.0, 0.7), is_lifted=True)
    start = plant.state
    states = drive(plant, 3.0, PlantInputs(SteeringInputs(2.0, torque_limit_nm=60.0), accelerator_norm=0.2))
    end, driven = states[-1], slice(0, 2) if vehicle.multibody.front_drive_share == 1.0 else slice(2, 4)
    assert end[:12] == start[:12]
    assert end[6:15] == pytest.approx((0.0,) * 9, abs=1e-12)
    assert end.wheel_loads_n == (0.0,) * 4
    assert end.steering_wheel_rad == pytest.approx(2.0, abs=0.02)
    assert min(end.wheel_speeds_radps[driven]) > 5.0
    assert sum(speed > 0.1 for speed in end.wheel_speeds_radps) == 2
    stopped = drive(plant, 1.5, PlantInputs(brake_norm=0.3, selector=Selector.NEUTRAL))[-1]
    assert max(map(abs, stopped.wheel_speeds_radps)) < 0.01


def test_on_the_lift_the_suspension_droops(focus):
    plant = MultibodyPlant(focus, Level(), is_lifted=True)
    droop_m = focus.multibody.front.droop_travel_m
    assert all(-droop_m - 0.03 < travel_m < -droop_m for travel_m in plant.car.state[S.travel_m])


# --- determinism ---


def test_the_same_inputs_give_the_same_bytes(focus):
    ends = []
    for _ in range(2):
        plant = MultibodyPlant(focus, Slope(0.03, 0.02), (1.0, 2.0, 0.5), 12.0)
        drive(plant, 1.0, at_speed(15.0, lambda t: math.sin(5.0 * t)))
        ends.append(bytes(plant.car.state))
    assert ends[0] == ends[1]
