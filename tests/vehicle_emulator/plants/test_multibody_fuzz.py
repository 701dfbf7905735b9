"""A hundred drives of fifteen seconds in which everything is random: nothing may become infinite or undefined."""

import math
from random import Random

import pytest

from dbc.vehicle import FOCUS, load_vehicle
from vehicle_emulator.plants.interface import Level, PlantFaults, PlantInputs, RoadPoint, Selector, SteeringInputs
from vehicle_emulator.plants.multibody.layout import INPUTS, MOTION, slices
from vehicle_emulator.plants.multibody.plant import MultibodyPlant

U, M = slices(INPUTS), slices(MOTION)
VEHICLE_FILES = {"focus": FOCUS, "van": FOCUS.with_name("van.toml")}
DRIVES, SECONDS = 100, 15
BLOCK_STEPS = 25
HOLD_BLOCKS = 8
"""Inputs change every 0.2 s."""


class Hills:
    """A road of random waves, up to 20 % steep, with the same grip everywhere until somebody changes it."""

    def __init__(self, random: Random) -> None:
        self.friction = 1.0
        self._waves = [(random.uniform(0.02, 0.06), random.uniform(-math.pi, math.pi)) for _ in range(2)]
        self._steepness = random.uniform(0.0, 0.14)

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        (a, phase_a), (b, phase_b) = self._waves
        height_m = self._steepness * (math.sin(a * x_m + phase_a) / a + math.sin(b * y_m + phase_b) / b)
        slopes = self._steepness * math.cos(a * x_m + phase_a), self._steepness * math.cos(b * y_m + phase_b)
        return RoadPoint(height_m, *slopes, self.friction)


def pedal(random: Random) -> float:
    return random.choice((0.0, 0.0, 0.0, random.random(), 1.0))


def random_inputs(random: Random, ratios: list[float]) -> tuple[float, ...]:
    """All inputs but the road."""
    return (
        random.choice((0.0, random.uniform(-11.0, 11.0))),
        random.choice((0.0, 60.0)),
        random.choice((0.0, random.uniform(-20.0, 20.0))),
        1.0 - pedal(random),
        pedal(random),
        random.choice(ratios),
        random.random(),
        random.choice((0.0, 1.0)),
        float(random.random() < 0.05),
        random.random() if random.random() < 0.1 else 1.0,
        random.random() if random.random() < 0.1 else 1.0,
        random.choice((0.0, 0.0, random.uniform(-5000.0, 5000.0))),
        0.0,
    )


@pytest.mark.parametrize("name", VEHICLE_FILES)
def test_random_driving_stays_finite(name):
    vehicle = load_vehicle(VEHICLE_FILES[name])
    gearbox = vehicle.powertrain.gearbox
    ratios = [gearbox.final_drive * ratio for ratio in (*gearbox.ratios, 0.0, -gearbox.reverse_ratio)]
    fastest_mps = steepest_rad = 0.0
    for seed in range(DRIVES // len(VEHICLE_FILES)):
        random = Random(f"{name} {seed}")
        road = Hills(random)
        plant = MultibodyPlant(vehicle, road, (0.0, 0.0, random.uniform(-3.0, 3.0)), random.choice((0.0, random.uniform(-8.0, 50.0))))
        car = plant.car
        for block in range(SECONDS * 1000 // BLOCK_STEPS):
            if block % HOLD_BLOCKS == 0:
                road.friction = random.choice((1.0, random.uniform(0.05, 1.2)))
                car.inputs[: U.road.start] = random_inputs(random, ratios)
            planes = []
            for x_m, y_m in zip(car.outputs[M.hubs_x_m], car.outputs[M.hubs_y_m], strict=True):
                z_m, slope_x, slope_y, friction = road.at(x_m, y_m)
                planes += (z_m - slope_x * x_m - slope_y * y_m, slope_x, slope_y, friction * random.choice((1.0, 0.3)))
            car.inputs[U.road] = planes
            car.advance(0.001, BLOCK_STEPS)
            fastest_mps = max(fastest_mps, abs(car.outputs[M.velocity_mps][0]))
            steepest_rad = max(steepest_rad, *map(abs, car.outputs[M.angles_rad][:2]))
        assert all(map(math.isfinite, car.state)), seed
        assert all(map(math.isfinite, car.outputs)), seed
    assert fastest_mps > 40.0
    assert steepest_rad > 0.15


@pytest.mark.parametrize("name", VEHICLE_FILES)
def test_random_driving_with_gearbox_and_lift_stays_finite(name):
    vehicle = load_vehicle(VEHICLE_FILES[name])
    for seed, is_lifted in enumerate((False, False, True)):
        random = Random(f"{name} lever {seed}")
        plant = MultibodyPlant(vehicle, Level(random.uniform(0.3, 1.0)), speed_mps=random.uniform(0.0, 30.0), is_lifted=is_lifted)
        for k in range(5000):
            if k % 250 == 0:
                steering = SteeringInputs(random.uniform(-8.0, 8.0), 60.0, random.uniform(-5.0, 5.0))
                faults = PlantFaults(random.random(), random.random(), random.uniform(-2000.0, 2000.0))
                inputs = PlantInputs(steering, pedal(random), pedal(random), random.choice(list(Selector)), faults)
            plant.step(0.001, inputs)
        assert all(map(math.isfinite, plant.car.state)), seed
