import math

import pytest

from dbc.catalogue import load
from dbc.frame import CanFrame
from vehicle_emulator.car_bus import MESSAGES, CarBus
from vehicle_emulator.plants.interface import PlantInputs, PlantState, Selector

CATALOGUE = load()


def on_the_bus(name: str, state: PlantState, inputs: PlantInputs) -> dict[str, float]:
    spec = CATALOGUE.by_name[name]
    payload = CATALOGUE.encode(name, CarBus(CATALOGUE).message(name, state, inputs))
    return CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, payload, 0))


def test_wheels_and_powertrain_in_the_units_of_the_dbc():
    state = PlantState(wheel_speeds_radps=(1.0, -2.0, 60.5, 300.0), engine_speed_radps=100.0, gear=-1)
    inputs = PlantInputs(accelerator_norm=0.253, brake_norm=1.0, selector=Selector.REVERSE)
    wheels = on_the_bus("CAR_WheelSpeeds", state, inputs)
    assert wheels == {"FrontLeft": 1.0, "FrontRight": -2.0, "RearLeft": 60.5, "RearRight": 300.0}
    powertrain = on_the_bus("CAR_Powertrain", state, inputs)
    assert powertrain["EngineSpeed"] == pytest.approx(100.0 * 60.0 / (2.0 * math.pi), abs=0.13)
    assert powertrain["Gear"] == -1
    assert powertrain["AcceleratorPedal"] == pytest.approx(25.3)
    assert powertrain["BrakePedal"] == 100.0


@pytest.mark.parametrize("selector", list(Selector))
def test_every_position_of_the_lever_has_its_entry(selector: Selector):
    value = on_the_bus("CAR_Powertrain", PlantState(), PlantInputs(selector=selector))["Selector"]
    assert CATALOGUE.enumeration("CAR_Powertrain", "Selector")[selector] == value


def test_all_messages_of_the_car_are_made():
    assert set(MESSAGES) == {name for name, spec in CATALOGUE.by_name.items() if spec.sender == "CAR"}
