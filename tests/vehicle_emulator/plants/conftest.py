"""Cars of fifteen degrees of freedom for the tests of this folder."""

import pytest

from dbc.vehicle import FOCUS, Vehicle, load_vehicle
from vehicle_emulator.plants.multibody.library import CompiledCar, build
from vehicle_emulator.plants.multibody.parameters import CarParameters, car_parameters

VEHICLE_FILES = {"focus": FOCUS, "van": FOCUS.with_name("van.toml")}


@pytest.fixture(scope="session")
def focus() -> Vehicle:
    return load_vehicle(VEHICLE_FILES["focus"])


@pytest.fixture(scope="session")
def van() -> Vehicle:
    return load_vehicle(VEHICLE_FILES["van"])


@pytest.fixture(scope="session", params=VEHICLE_FILES)
def vehicle(request) -> Vehicle:
    return load_vehicle(VEHICLE_FILES[request.param])


@pytest.fixture(scope="session")
def compiled():
    """Makes a car on memory of its own, in the design position on a level road at 0."""

    def make(car: Vehicle | CarParameters) -> CompiledCar:
        numbers = car_parameters(car) if isinstance(car, Vehicle) else car
        return CompiledCar(build(numbers, lambda _: None), numbers)

    return make
