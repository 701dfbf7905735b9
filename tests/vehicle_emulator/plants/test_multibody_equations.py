"""The equations of motion against mechanics: what is conserved, what is symmetric, how fast the fastest motion is."""

import math

import numpy as np
import pytest

from vehicle_emulator.plants.interface import GRAVITY_MPS2
from vehicle_emulator.plants.multibody.equations import build_functions
from vehicle_emulator.plants.multibody.layout import FELT, INPUTS, MOTION, STATE, numbers, slices
from vehicle_emulator.plants.multibody.library import MOTIONS, CompiledCar
from vehicle_emulator.plants.multibody.parameters import CarParameters, car_parameters
from vehicle_emulator.plants.multibody.stability import largest_pole

S, U, M, F = slices(STATE), slices(INPUTS), slices(MOTION), slices(FELT)
STEP_S = 0.001
LEVEL = (0.0, 0.0, 0.0, 1.0) * 4
FAR_BELOW = (-1000.0, 0.0, 0.0, 1.0) * 4


def changed(section, **changes):
    """The same section with other numbers; a section is changed by a dictionary."""
    values = {name: changed(getattr(section, name), **value) if isinstance(value, dict) else value for name, value in changes.items()}
    return section.model_copy(update=values)


def place(car: CompiledCar, numbers_of_car: CarParameters, *, speed_mps=0.0, **inputs):
    """Put a car on a level road in its design position, rolling at a speed."""
    multibody = numbers_of_car.multibody
    car.state[:] = [0.0] * len(car.state)
    car.state[S.attitude] = (1.0, 0.0, 0.0, 0.0)
    car.state[S.velocity_mps] = (speed_mps, 0.0, 0.0)
    car.state[S.spin_radps] = (speed_mps / (multibody.tyre.radius_m - 0.006),) * 4
    car.state[S.brake_bristle] = (float(np.sign(speed_mps)),) * 4
    car.state[S.engine_radps] = (90.0,)
    car.advance(0.0, 0)
    car.state[2] = -car.outputs[2]
    hold(car, **inputs)


def hold(car: CompiledCar, **inputs):
    """Set all inputs; those that are not named to rest."""
    car.inputs[:] = [0.0] * len(car.inputs)
    for name, value in ({"drive_share": 1.0, "brake_share": 1.0, "torque_limit_nm": 60.0, "road": LEVEL} | inputs).items():
        car.inputs[getattr(U, name)] = value if isinstance(value, tuple) else (value,)


# --- free flight ---


class Mechanics:
    """Energy and momenta of a state, from positions and velocities of its masses alone."""

    def __init__(self, car: CarParameters) -> None:
        self.car, p = car, car.multibody
        m = p.masses
        base_m = m.cog_to_front_m + m.cog_to_rear_m
        self.loads_n = np.array([m.cog_to_rear_m] * 2 + [m.cog_to_front_m] * 2) * 0.5 * m.mass_kg * GRAVITY_MPS2 / base_m
        self.axles = (p.front, p.front, p.rear, p.rear)
        self.wheel_kg = np.array([axle.wheel_kg for axle in self.axles])
        self.sprung_kg = m.mass_kg - self.wheel_kg.sum()
        sides = np.array([1.0, -1.0, 1.0, -1.0])
        hubs = np.column_stack(
            (
                [m.cog_to_front_m] * 2 + [-m.cog_to_rear_m] * 2,
                sides * [0.5 * axle.track_m for axle in self.axles],
                p.tyre.radius_m - self.loads_n / p.tyre.stiffness_npm - m.cog_height_m,
            )
        )
        self.hubs = hubs + (self.wheel_kg[:, None] * hubs).sum(axis=0) / self.sprung_kg
        slants = sides * [2.0 * axle.roll_centre_m / axle.track_m for axle in self.axles]
        self.slides = np.column_stack(([axle.hub_slope for axle in self.axles], slants, np.ones(4)))
        self.inertia = np.diag((m.sprung_roll_inertia_kgm2, m.sprung_pitch_inertia_kgm2, m.sprung_yaw_inertia_kgm2))

    def masses(self, x):
        """Rotation of the body, places and velocities of body and wheels in the local frame, axes of the wheels in the body."""
        w, i, j, k = x[S.attitude] / np.linalg.norm(x[S.attitude])
        turn = np.array(
            [
                [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
                [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
                [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
            ]
        )
        arms = self.hubs + x[S.travel_m][:, None] * self.slides
        inside = x[S.velocity_mps] + np.cross(x[S.rates_radps], arms) + x[S.travel_mps][:, None] * self.slides
        places = np.vstack((x[S.position_m], x[S.position_m] + arms @ turn.T))
        speeds = np.vstack((turn @ x[S.velocity_mps], inside @ turn.T))
        return turn, places, speeds, self.axes(x)

    def axes(self, x):
        p = self.car.multibody
        angle, base_m = x[S.steering_rad][0] / self.car.steering_ratio, p.masses.cog_to_front_m + p.masses.cog_to_rear_m
        axes = np.tile((0.0, 1.0, 0.0), (4, 1))
        for wheel, side in ((0, 1.0), (1, -1.0)):
            inwards = p.steering.ackermann_share * side * 0.5 * p.front.track_m / base_m
            own = math.atan2(math.sin(angle), math.cos(angle) - inwards * math.sin(angle))
            axes[wheel] = (-math.sin(own), math.cos(own), 0.0)
        return axes

    def energy(self, x):
        p = self.car.multibody
        _, places, speeds, _ = self.masses(x)
        masses = np.append(self.sprung_kg, self.wheel_kg)
        spins = np.array([axle.wheel_inertia_kgm2 for axle in self.axles]) * x[S.spin_radps] ** 2
        moving = 0.5 * (masses * (speeds**2).sum(axis=1)).sum() + 0.5 * x[S.rates_radps] @ self.inertia @ x[S.rates_radps]
        moving += 0.5 * spins.sum() + 0.5 * p.steering.inertia_kgm2 * x[S.steering_radps][0] ** 2
        stored = GRAVITY_MPS2 * (masses * places[:, 2]).sum()
        for i, axle in enumerate(self.axles):
            q = x[S.travel_m][i]
            beyond = max(q - axle.bump_travel_m, 0.0) + min(q + axle.droop_travel_m, 0.0)
            stored += (self.loads_n[i] - axle.wheel_kg * GRAVITY_MPS2) * q + 0.5 * axle.spring_npm * q**2
            stored += axle.stop_npm2 * abs(beyond) ** 3 / 3.0
            stored += 0.125 * axle.anti_roll_npm * (q - x[S.travel_m][i ^ 1]) ** 2
        turned_too_far = max(abs(x[S.steering_rad][0]) - self.car.road_wheel_limit_rad * self.car.steering_ratio, 0.0)
        return moving + stored + p.steering.stop_nmprad2 * turned_too_far**3 / 3.0

    def momenta(self, x):
        """Linear momentum, and angular momentum about the centre of gravity of all masses, in the local frame."""
        turn, places, speeds, axes = self.masses(x)
        masses = np.append(self.sprung_kg, self.wheel_kg)
        linear = (masses[:, None] * speeds).sum(axis=0)
        centre = (masses[:, None] * places).sum(axis=0) / masses.sum()
        wheels = np.array([axle.wheel_inertia_kgm2 for axle in self.axles]) * x[S.spin_radps]
        own = turn @ (self.inertia @ x[S.rates_radps] + (wheels[:, None] * axes).sum(axis=0))
        return linear, own + np.cross(places - centre, masses[:, None] * (speeds - linear / masses.sum())).sum(axis=0)


def without_dissipation(car: CarParameters) -> CarParameters:
    """Also with a steering wheel so heavy that the gyroscopic moment of the wheels does not throw it against its stop."""
    free = {"bump_nspm": 0.0, "rebound_nspm": 0.0, "bearing_nms": 0.0}
    return changed(
        car,
        multibody={"drag_area_m2": 0.0, "front": free, "rear": free, "steering": {"friction_nm": 0.0, "inertia_kgm2": 5.0}},
        powertrain={"driveline": {"drag_nm": 0.0, "drag_nms": 0.0}},
    )


def hanging_m(car: CarParameters, mechanics: Mechanics) -> list[float]:
    """Travel at which the wheels rest on their droop stops when nothing else holds them."""
    travel_m = []
    for axle, load_n in zip(mechanics.axles, mechanics.loads_n, strict=True):
        preload_n, stop = load_n - axle.wheel_kg * GRAVITY_MPS2, axle.stop_npm2
        spring_n = preload_n - axle.spring_npm * axle.droop_travel_m
        way_m = (math.sqrt(axle.spring_npm**2 + 4.0 * stop * spring_n) - axle.spring_npm) / (2.0 * stop)
        travel_m.append(-axle.droop_travel_m - way_m)
    return travel_m


@pytest.mark.parametrize("spin_radps", [0.0, 60.0])
@pytest.mark.parametrize("steering_rad", [0.0, 3.0])
def test_free_flight_conserves_energy_and_momenta(vehicle, compiled, spin_radps, steering_rad):
    """Thrown with a tumbling body, wheels that bounce on their stops and a steering wheel that nobody holds."""
    car = without_dissipation(car_parameters(vehicle))
    flying, mechanics = compiled(car), Mechanics(car)
    place(flying, car, torque_limit_nm=0.0, road=FAR_BELOW)
    flying.state[S.velocity_mps] = (15.0, -2.0, 3.0)
    flying.state[S.rates_radps] = (0.8, -0.5, 1.0)
    ways_m = (0.003, -0.002, 0.0, 0.004)
    flying.state[S.travel_m] = [rest_m + way_m for rest_m, way_m in zip(hanging_m(car, mechanics), ways_m, strict=True)]
    flying.state[S.spin_radps] = (spin_radps, spin_radps, 0.5 * spin_radps, -spin_radps)
    flying.state[S.steering_rad], flying.state[S.steering_radps] = (steering_rad,), (0.3,)
    before = np.array(flying.state)
    flying.advance(STEP_S, 2000)
    after = np.array(flying.state)
    (linear, angular), (linear_after, angular_after) = mechanics.momenta(before), mechanics.momenta(after)
    fallen = np.array([0.0, 0.0, -car.multibody.masses.mass_kg * GRAVITY_MPS2 * 2000 * STEP_S])
    errors = (
        mechanics.energy(after) / mechanics.energy(before) - 1.0,
        np.linalg.norm(linear_after - fallen - linear) / np.linalg.norm(linear),
        np.linalg.norm(angular_after - angular) / np.linalg.norm(angular),
    )
    assert np.all(np.abs(errors) < (1e-9, 1e-12, 1e-11)), errors
    assert abs(after[S.travel_m] - before[S.travel_m]).max() > 0.001
    assert abs(after[S.attitude] - before[S.attitude]).max() > 0.5


# --- the integrator ---


def test_no_motion_is_too_fast_for_the_step(vehicle):
    pole_radps, where = largest_pole(vehicle)
    assert 100.0 < pole_radps < 2.5 / STEP_S, where


def slalom(car: CompiledCar, parameters: CarParameters, substeps: int):
    """Six seconds of slalom from 20 m/s with braking and drive; place and yaw at the end, inputs held for 1 ms each."""
    gear = {"ratio": 4.0, "clutch": 1.0, "lockup": 1.0}
    place(car, parameters, speed_mps=20.0, **gear)
    for k in range(6000):
        demand_rad, accelerator, brake = 0.8 * math.sin(0.003 * k), 0.3 * (k < 3000), 0.3 * (k > 4000)
        hold(car, demand_rad=demand_rad, accelerator=accelerator, brake=brake, **gear)
        car.advance(STEP_S / substeps, substeps)
    return np.array(car.outputs[:6])


def test_a_smaller_step_drives_the_same_way(focus, compiled):
    parameters = car_parameters(focus)
    ends = {substeps: slalom(compiled(parameters), parameters, substeps) for substeps in (1, 2, 8)}
    usual, half = (np.linalg.norm(ends[n][:2] - ends[8][:2]) for n in (1, 2))
    assert half < usual < 0.002
    assert 60.0 < np.linalg.norm(ends[1][:2]) < 130.0


def test_what_is_felt_is_of_the_state_that_is_reached(focus, compiled):
    parameters = car_parameters(focus)
    car, derivatives = compiled(parameters), build_functions(parameters).derivatives
    place(car, parameters, speed_mps=20.0, demand_rad=1.0, brake=0.3)
    car.advance(STEP_S, 400)
    _, felt = derivatives(np.array(car.state), np.array(car.inputs), numbers(parameters))
    assert np.allclose(car.outputs[MOTIONS:], np.array(felt).ravel(), rtol=1e-4, atol=1e-3)
    assert abs(felt[F.acceleration_mps2][1]) > 1.0


# --- symmetry ---

TURNED_OVER = {"position_m": (1,), "attitude": (1, 3), "velocity_mps": (1,), "rates_radps": (0, 2)}
"""Components that change their sign in a mirror; those of the wheels change places."""
WHEEL_SIGNS = {"slip_y": -1.0}
PAIRED = ("travel_m", "travel_mps", "spin_radps", "slip_x", "slip_y", "brake_bristle")


def mirrored(state):
    image = np.array(state)
    for name, components in TURNED_OVER.items():
        for component in components:
            image[getattr(S, name).start + component] *= -1.0
    for name in PAIRED:
        image[getattr(S, name)] = image[getattr(S, name)][[1, 0, 3, 2]] * WHEEL_SIGNS.get(name, 1.0)
    for name in ("steering_rad", "steering_radps", "column_bristle", "resistance_nm"):
        image[getattr(S, name)] *= -1.0
    return image


def test_left_is_the_mirror_image_of_right(vehicle, compiled):
    parameters = car_parameters(vehicle)
    left, right = compiled(parameters), compiled(parameters)
    slope = {1.0: (0.0, 0.05, 0.08), -1.0: (0.0, 0.05, -0.08)}
    for car, side in ((left, 1.0), (right, -1.0)):
        place(car, parameters, speed_mps=15.0)
        grips = (0.6, 1.0, 0.6, 1.0)[:: int(side)]
        road = tuple(number for grip in grips for number in (*slope[side], grip))
        for k in range(30):
            brake, push_n = 0.5 * (k > 15), 1000.0 * side * (k < 8)
            steered = {"demand_rad": side * math.sin(0.3 * k), "driver_nm": side * 2.0, "push_n": push_n}
            hold(car, **steered, brake=brake, road=road, ratio=5.0, clutch=1.0)
            car.advance(STEP_S, 100)
    difference = np.array(left.state) - mirrored(right.state)
    assert abs(difference).max() < 1e-7 * abs(np.array(left.state)).max()
    assert abs(left.state[S.position_m][1]) > 0.5
