"""The cars that can be emulated, behind one interface: a multibody car, the paper's bicycle, an FMU, a published model."""

from pathlib import Path

from dbc.errors import UserMistake
from dbc.vehicle import Vehicle
from vehicle_emulator.plants.bicycle import BicyclePlant
from vehicle_emulator.plants.commonroad import CommonroadPlant
from vehicle_emulator.plants.fmu import FmuPlant
from vehicle_emulator.plants.interface import Plant, Progress, Road
from vehicle_emulator.plants.multibody.plant import MultibodyPlant

CHOICES = "multibody, bicycle, commonroad or fmu:FILE"

Pose = tuple[float, float, float]


def make_plant(name: str, vehicle: Vehicle, road: Road, pose: Pose, *, speed_mps: float, progress: Progress) -> Plant:
    """A car at a pose, x [m], y [m] and yaw [rad], rolling at a speed.

    Args:
        name: one of `CHOICES`.
        progress: told in one line each what takes time.

    Raises:
        UserMistake: the name is not known, or the car cannot be had as it was asked for.
        SetupFailure: it cannot be built on this machine.
    """
    kind, _, path = name.partition(":")
    match kind, path:
        case "multibody", "":
            return MultibodyPlant(vehicle, road, pose, speed_mps, progress)
        case "bicycle", "":
            return BicyclePlant(vehicle, road, pose, speed_mps)
        case "commonroad", "":
            return CommonroadPlant(vehicle, road, pose, speed_mps)
        case "fmu", file if file:
            return FmuPlant(Path(file), vehicle, road, pose, speed_mps)
        case _:
            raise UserMistake(f"plant {name!r}: expected {CHOICES}")
