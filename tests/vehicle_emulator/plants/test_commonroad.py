"""The car of commonroad-vehicle-models as a plant: its frame turned into ours, its pedals, and that it stands where it should."""

import math
import sys

import pytest

from dbc.vehicle import load_vehicle
from vehicle_emulator.plants.extras import ExtraMissing
from vehicle_emulator.plants.interface import Level, PlantFaults, PlantInputs, Selector, SteeringInputs
from vehicle_emulator.road import RoadDescription, make_road

pytest.importorskip("vehiclemodels", reason="commonroad-vehicle-models is not installed")

from vehicle_emulator.plants.commonroad import CommonroadPlant, NotOnThisRoad, load_car

VEHICLE = load_vehicle()
MASS_KG = load_car().numbers.m


def driven(inputs, seconds, *, speed_mps=0.0, pose=(0.0, 0.0, 0.0)):
    plant = CommonroadPlant(VEHICLE, Level(), pose, speed_mps)
    for _ in range(round(seconds * 1000)):
        plant.step(1e-3, inputs)
    return plant.state


def steering(road_wheel_rad):
    return SteeringInputs(VEHICLE.steering.ratio * road_wheel_rad, 60.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_in_a_turn_it_leans_outwards_and_loads_its_outer_wheels(side):
    state = driven(PlantInputs(steering(0.03 * side)), 2.0, speed_mps=20.0)
    assert side * state.yaw_rate_radps > 0.2
    assert side * state.y_m > 2.0
    assert side * state.roll_rad > 0.05
    front_left, front_right, rear_left, rear_right = (load if side > 0.0 else -load for load in state.wheel_loads_n)
    assert front_right > front_left + 1000.0
    assert rear_right > rear_left + 500.0
    front_left, front_right, rear_left, rear_right = state.wheel_speeds_radps
    assert side * (front_right - front_left) > 0.5
    assert side * (rear_right - rear_left) > 0.5
    assert state.ay_mps2 == pytest.approx(state.vx_mps * state.yaw_rate_radps, rel=0.02)
    assert sum(state.wheel_loads_n) == pytest.approx(MASS_KG * 9.81, rel=0.02)


def test_it_dives_under_the_brake_and_squats_under_the_accelerator():
    braked = driven(PlantInputs(steering(0.0), brake_norm=0.4), 1.0, speed_mps=20.0)
    assert braked.ax_mps2 == pytest.approx(-0.4 * VEHICLE.pedals.full_brake_force_n / MASS_KG, rel=0.05)
    assert braked.pitch_rad > 0.005
    pulled = driven(PlantInputs(steering(0.0), accelerator_norm=0.5), 1.0, speed_mps=10.0)
    assert pulled.ax_mps2 == pytest.approx(0.5 * VEHICLE.pedals.full_drive_force_n / MASS_KG, rel=0.05)
    assert pulled.pitch_rad < -0.002


def test_it_pulls_away_stops_and_stands():
    plant = CommonroadPlant(VEHICLE, Level(), (3.0, -2.0, math.pi / 2))
    for _ in range(1000):
        plant.step(1e-3, PlantInputs(steering(0.0)))
    assert (plant.state.x_m, plant.state.y_m, plant.state.vx_mps) == (3.0, -2.0, 0.0)
    for _ in range(3000):
        plant.step(1e-3, PlantInputs(steering(0.0), accelerator_norm=0.5))
    assert plant.state.vx_mps == pytest.approx(3.0 * 0.5 * VEHICLE.pedals.full_drive_force_n / MASS_KG, rel=0.05)
    assert plant.state.x_m == pytest.approx(3.0, abs=0.05)
    for _ in range(3000):
        plant.step(1e-3, PlantInputs(steering(0.0), brake_norm=0.5))
    stood = plant.state
    for _ in range(2000):
        plant.step(1e-3, PlantInputs(steering(0.2), brake_norm=0.5))
    assert (plant.state.vx_mps, plant.state.vy_mps, plant.state.yaw_rate_radps) == (0.0, 0.0, 0.0)
    assert math.dist((plant.state.x_m, plant.state.y_m), (stood.x_m, stood.y_m)) < 1e-3
    assert plant.state.wheel_speeds_radps == (0.0, 0.0, 0.0, 0.0)
    assert plant.state.pitch_rad == pytest.approx(0.0, abs=5e-3)


def test_faults_and_selector_take_the_pedals_away():
    def speed_mps(**inputs):
        return driven(PlantInputs(steering(0.0), **inputs), 0.5, speed_mps=10.0).vx_mps

    assert speed_mps(accelerator_norm=1.0, selector=Selector.NEUTRAL) == pytest.approx(10.0, abs=0.05)
    assert speed_mps(accelerator_norm=1.0, faults=PlantFaults(drive_norm=0.0)) == pytest.approx(10.0, abs=0.05)
    assert speed_mps(brake_norm=1.0, faults=PlantFaults(brake_norm=0.0)) == pytest.approx(10.0, abs=0.05)
    assert speed_mps(accelerator_norm=1.0) > 11.5


@pytest.mark.parametrize("description", [RoadDescription(grade_percent=3.0), RoadDescription(friction=[{"factor": 0.5}])])
def test_a_road_that_it_does_not_know_is_refused(description):
    with pytest.raises(NotOnThisRoad, match="allowed: a level one of grip 1"):
        CommonroadPlant(VEHICLE, make_road(description))


def test_without_the_library_it_is_told_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "vehiclemodels", None)
    with pytest.raises(ExtraMissing, match=r"the library vehiclemodels: .venv/bin/pip install '\.\[commonroad\]'"):
        CommonroadPlant(VEHICLE, Level())
