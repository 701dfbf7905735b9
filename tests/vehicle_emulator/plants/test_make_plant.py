"""The choice of a plant by its name."""

import pytest

from dbc.errors import UserMistake
from dbc.vehicle import load_vehicle
from vehicle_emulator.plants import make_plant
from vehicle_emulator.plants.bicycle import BicyclePlant
from vehicle_emulator.plants.commonroad import CommonroadPlant
from vehicle_emulator.plants.interface import Level
from vehicle_emulator.plants.multibody.plant import MultibodyPlant

VEHICLE = load_vehicle()
POSE = (3.0, -2.0, 0.5)


def made(name):
    return make_plant(name, VEHICLE, Level(), POSE, speed_mps=10.0, progress=lambda text: None)


@pytest.mark.parametrize(("name", "kind"), [("multibody", MultibodyPlant), ("bicycle", BicyclePlant), ("commonroad", CommonroadPlant)])
def test_a_plant_starts_where_it_was_told(name, kind):
    if name == "commonroad":
        pytest.importorskip("vehiclemodels", reason="commonroad-vehicle-models is not installed")
    plant = made(name)
    assert isinstance(plant, kind)
    state = plant.state
    assert (state.x_m, state.y_m, state.yaw_rad, state.vx_mps) == pytest.approx((3.0, -2.0, 0.5, 10.0), abs=1e-3)


@pytest.mark.parametrize("name", ["", "tricycle", "bicycle:file", "fmu", "fmu:", "Multibody"])
def test_another_name_is_refused_with_the_choices(name):
    with pytest.raises(UserMistake) as caught:
        made(name)
    assert str(caught.value) == f"plant {name!r}: expected multibody, bicycle, commonroad or fmu:FILE"


def test_an_fmu_is_named_by_its_file(tmp_path):
    with pytest.raises(UserMistake, match=r"car\.fmu: no such file"):
        made(f"fmu:{tmp_path / 'car.fmu'}")
