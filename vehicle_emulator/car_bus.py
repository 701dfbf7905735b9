"""What a site routes from the car's own bus to that of the robots: wheel speeds, engine, gearbox and pedals."""

import math

from dbc.catalogue import Catalogue
from vehicle_emulator.plants.interface import PlantInputs, PlantState

MESSAGES = ("CAR_WheelSpeeds", "CAR_Powertrain")
_RPM_PER_RADPS = 30.0 / math.pi
_WHEELS = ("FrontLeft", "FrontRight", "RearLeft", "RearRight")


class CarBus:
    """Makes the messages of the car."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._selector = catalogue.enumeration("CAR_Powertrain", "Selector")

    def message(self, name: str, state: PlantState, inputs: PlantInputs) -> dict[str, float]:
        """Signals of one of `MESSAGES`, in the units of the DBC."""
        if name == "CAR_WheelSpeeds":
            return dict(zip(_WHEELS, state.wheel_speeds_radps, strict=True))
        return {
            "EngineSpeed": _RPM_PER_RADPS * state.engine_speed_radps,
            "Gear": state.gear,
            "Selector": self._selector[inputs.selector],
            "AcceleratorPedal": 100.0 * inputs.accelerator_norm,
            "BrakePedal": 100.0 * inputs.brake_norm,
        }
