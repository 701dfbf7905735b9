"""The safety driver: holds a rolling start and a standing car, lets go once the robots drive, and holds a car that they hand back."""

import pytest

from dbc.vehicle import FOCUS, load_vehicle
from vehicle_emulator.driver import Driver
from vehicle_emulator.emulator import STEP_S
from vehicle_emulator.plants.interface import Level, PlantInputs, PlantState, SteeringInputs
from vehicle_emulator.plants.multibody.plant import MultibodyPlant
from vehicle_emulator.road import RoadDescription, make_road
from vehicle_emulator.safety_driver import STRONGEST_NM, SafetyDriver

VEHICLES = [load_vehicle(FOCUS), load_vehicle(FOCUS.parent / "van.toml")]
by_vehicle = pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda vehicle: vehicle.name)


def drive(plant: MultibodyPlant, driver: SafetyDriver, seconds: float) -> list[PlantState]:
    states = []
    for _ in range(round(seconds / STEP_S)):
        person = driver.step(STEP_S, plant.state, was_engaged=False, are_robots_active=False)
        steering = SteeringInputs(driver_torque_nm=person.steering_torque_nm)
        states.append(plant.step(STEP_S, PlantInputs(steering, person.accelerator_norm, person.brake_norm)))
    return states


@pytest.mark.parametrize(
    ("vehicle", "speed_mps"),
    [(vehicle, speed_mps) for vehicle in VEHICLES for speed_mps in (2.78, 5.0, 15.0, 22.2, 30.0)],
    ids=lambda value: getattr(value, "name", value),
)
def test_holds_the_speed_and_the_line_of_a_rolling_start(vehicle, speed_mps):
    states = drive(MultibodyPlant(vehicle, Level(), speed_mps=speed_mps), SafetyDriver(speed_mps), 6.0)
    assert max(abs(state.vx_mps - speed_mps) for state in states) < 0.3
    assert max(abs(state.y_m) for state in states) < 0.01


def test_the_integral_holds_the_speed_on_a_slope():
    road = make_road(RoadDescription(grade_percent=4.0))
    last = drive(MultibodyPlant(VEHICLES[0], road, speed_mps=15.0), SafetyDriver(15.0), 12.0)[-1]
    assert last.vx_mps == pytest.approx(15.0, abs=0.3)


@by_vehicle
def test_stands_on_the_brake_until_the_robots_drive(vehicle):
    plant, driver = MultibodyPlant(vehicle, make_road(RoadDescription(grade_percent=12.0))), SafetyDriver(0.0)
    states = drive(plant, driver, 2.0)
    assert max(abs(state.vx_mps) for state in states[1000:]) < 1e-3
    person = driver.step(STEP_S, plant.state, was_engaged=False, are_robots_active=False)
    assert (person.accelerator_norm, person.brake_norm) == (0.0, 0.3)


def test_never_brakes_and_never_presses_beyond_the_floor():
    driver = SafetyDriver(20.0)
    pressed = [driver.step(STEP_S, PlantState(vx_mps=0.0), was_engaged=False, are_robots_active=False) for _ in range(1000)]
    assert {person.accelerator_norm for person in pressed} == {1.0}
    lifted = driver.step(STEP_S, PlantState(vx_mps=40.0), was_engaged=False, are_robots_active=False)
    assert (lifted.accelerator_norm, lifted.brake_norm) == (0.0, 0.0)


def test_what_is_wound_up_is_bounded():
    driver = SafetyDriver(20.0)
    for _ in range(60_000):
        driver.step(STEP_S, PlantState(vx_mps=0.0), was_engaged=False, are_robots_active=False)
    for _ in range(2_000):
        person = driver.step(STEP_S, PlantState(vx_mps=24.0), was_engaged=False, are_robots_active=False)
    assert person.accelerator_norm == 0.0


@pytest.mark.parametrize("speed_mps", [0.0, 20.0])
def test_does_nothing_while_the_robots_drive_or_stop(speed_mps):
    driver, state = SafetyDriver(speed_mps), PlantState(vx_mps=0.0, steering_wheel_rad=0.5)
    assert driver.step(STEP_S, state, was_engaged=False, are_robots_active=False) != Driver()
    assert driver.step(STEP_S, state, was_engaged=True, are_robots_active=True) == Driver()


def test_holds_a_car_that_was_handed_back_from_when_it_is_slow_until_the_robots_drive_again():
    driver = SafetyDriver(20.0)
    story = [(15.0, False), (2.1, False), (-1.9, False), (3.0, False), (0.0, False), (0.0, True), (0.0, False)]
    people = [driver.step(STEP_S, PlantState(vx_mps=vx), was_engaged=True, are_robots_active=active) for vx, active in story]
    off, holding = Driver(), Driver(brake_norm=0.3)
    assert people == [off, off, holding, holding, holding, off, holding]


@pytest.mark.parametrize("speed_mps", [0.0, 20.0])
@pytest.mark.parametrize(
    ("angle_rad", "rate_radps", "torque_nm"),
    [(0.0, 0.0, 0.0), (0.1, 0.0, -2.0), (-0.1, 0.0, 2.0), (0.0, 1.0, -2.0), (3.0, 0.0, -STRONGEST_NM), (-3.0, 0.0, STRONGEST_NM)],
)
def test_hands_turn_the_wheel_straight_as_strongly_as_hands_can(speed_mps, angle_rad, rate_radps, torque_nm):
    state = PlantState(vx_mps=speed_mps, steering_wheel_rad=angle_rad, steering_wheel_rate_radps=rate_radps)
    person = SafetyDriver(speed_mps).step(STEP_S, state, was_engaged=False, are_robots_active=False)
    assert person.steering_torque_nm == pytest.approx(torque_nm)
