"""The numbers of one car, read from one TOML file in which every number carries its source."""

from pathlib import Path
from typing import Any

from dbc.errors import UserMistake
from dbc.ins import InsParameters
from dbc.multibody import MultibodyParameters
from dbc.powertrain import PowertrainParameters
from dbc.robots import Robots
from dbc.section import NotNegative, Positive, Section, checked, read_toml

FOCUS = Path(__file__).with_name("focus.toml")


class VehicleError(UserMistake):
    """A vehicle file cannot be used; one line per mistake, each with file and key."""


class Body(Section):
    """Outline of the car."""

    length_m: Positive
    width_m: Positive
    front_overhang_m: NotNegative


class Steering(Section):
    """Steering wheel to road wheel."""

    ratio: Positive
    road_wheel_limit_rad: Positive


class Pedals(Section):
    """Calibration of the pedals as the gateway believes it."""

    full_drive_force_n: Positive
    full_brake_force_n: Positive


class ModelParameters(Section):
    """Parameters of the controller's bicycle model: M, I_z, L_f, L_r, K_f, K_r, T_max, R, C_r0, C_r2 of the paper, and lags."""

    mass_kg: Positive
    yaw_inertia_kgm2: Positive
    cog_to_front_m: Positive
    cog_to_rear_m: Positive
    front_cornering_stiffness_nprad: Positive
    rear_cornering_stiffness_nprad: Positive
    max_wheel_torque_nm: Positive
    wheel_radius_m: Positive
    rolling_resistance_n: NotNegative
    air_drag_nps2pm2: NotNegative
    steer_lag_s: Positive
    drive_lag_s: Positive


class Vehicle(Section):
    """One car: what it is, what the controller believes of it, and its instruments."""

    name: str
    body: Body
    steering: Steering
    pedals: Pedals
    model: ModelParameters
    multibody: MultibodyParameters
    powertrain: PowertrainParameters
    robots: Robots
    ins: InsParameters


def load_vehicle(path: Path = FOCUS) -> Vehicle:
    """Read a vehicle file.

    Raises:
        VehicleError: missing file, malformed TOML, number without source, unknown or missing key, value out of range.
    """
    tree = _without_sources(read_toml(path, VehicleError), str(path), "")
    return checked(path, tree, Vehicle, VehicleError)


def _without_sources(tree: dict[str, Any], path: str, prefix: str) -> dict[str, Any]:
    """Replace every `{ value, source }` by its value; a number on its own is refused."""
    plain: dict[str, Any] = {}
    for key, entry in tree.items():
        name = f"{prefix}{key}"
        if isinstance(entry, dict) and "value" in entry:
            if set(entry) != {"value", "source"} or not str(entry["source"]).strip():
                raise VehicleError(f"{path}: {name}: expected {{ value = ..., source = \"...\" }}")
            plain[key] = entry["value"]
        elif isinstance(entry, dict):
            plain[key] = _without_sources(entry, path, f"{name}.")
        elif isinstance(entry, str) and not prefix:
            plain[key] = entry
        else:
            raise VehicleError(f"{path}: {name}: a number needs its source: {{ value = {entry}, source = \"...\" }}")
    return plain
