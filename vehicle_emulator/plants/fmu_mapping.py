"""Which variable of an FMU is which input and output of a plant, read from a TOML file.

    step_ms = 10                                            # of the co-simulation; default 1
    [inputs]                                                # the FMU's variable = factor * ours + offset
    road_wheel_rad = { variable = "Steer", factor = 57.29578 }
    accelerator_norm = "Gas"                                # the same with factor 1
    [outputs]                                               # ours = factor * the FMU's variable + offset
    x_m = "Car.x"
    [start]                                                 # parameters and start values, as inputs
    yaw_rad = "Car.yaw_0"
    [parameters]                                            # other parameters and start values of the FMU
    "Car.mass" = 1500.0
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator, Field, field_validator

from dbc.errors import UserMistake
from dbc.section import Section, between, misfit, read_section
from vehicle_emulator.plants.interface import PlantState

_WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
WHEEL_SPEEDS = tuple(f"wheel_speed_{wheel}_radps" for wheel in _WHEELS)
WHEEL_LOADS = tuple(f"wheel_load_{wheel}_n" for wheel in _WHEELS)
INPUTS = (
    *("steering_wheel_rad", "steering_wheel_rate_radps", "road_wheel_rad"),
    *("steering_demand_rad", "steering_torque_limit_nm", "driver_torque_nm"),
    *("accelerator_norm", "brake_norm", "gear", "drive_fault_norm", "brake_fault_norm", "push_n"),
    *("road_z_m", "road_slope_x", "road_slope_y", "road_friction"),
)
"""What an FMU can be given. The first three are our own steering wheel; the next three are for an FMU that has one itself. The gear is
1, 0 or -1 by the selector; the road is that under the reference point."""
OUTPUTS = (
    *(field for field in PlantState._fields if field not in ("wheel_speeds_radps", "wheel_loads_n")),
    *WHEEL_SPEEDS,
    *WHEEL_LOADS,
)
"""What an FMU can give: the fields of `PlantState`, wheels one by one."""
NEEDED = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps", "ax_mps2", "ay_mps2")
"""Without these nobody could tell the navigation system where the car is. What else is not mapped stays at its default, but the
steering wheel, which then is our own."""
STARTS = ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps")

_TYPES = ("Real", "Float64")
_CAUSALITIES = {
    "inputs": ("input", "parameter"),
    "outputs": ("output", "local", "calculatedParameter"),
    "start": ("parameter", "input", "local", "output"),
    "parameters": ("parameter", "input", "local", "output"),
}
_MOST_NAMES = 20


class MappingError(UserMistake):
    """A mapping does not fit; one line per mistake, each with file, key, value and what is allowed."""


class Link(Section):
    """One of our quantities and a variable of the FMU."""

    variable: Annotated[str, Field(min_length=1)]
    factor: Annotated[float, between(-1e9, 1e9)] = 1.0
    offset: float = 0.0

    @field_validator("factor")
    @classmethod
    def _is_not_zero(cls, factor: float) -> float:
        if factor == 0.0:
            raise misfit("a factor other than 0")
        return factor


def _as_link(value: object) -> object:
    return {"variable": value} if isinstance(value, str) else value


Links = dict[str, Annotated[Link, BeforeValidator(_as_link)]]


class FmuMapping(Section):
    """The content of a mapping file.

    Args:
        step_ms: communication step; in between, the car goes on at the velocities that it had.
    """

    step_ms: Annotated[int, between(1, 100)] = 1
    inputs: Links
    outputs: Links
    start: Links = Field(default_factory=dict)
    parameters: dict[str, float] = Field(default_factory=dict)

    @field_validator("inputs", "outputs", "start")
    @classmethod
    def _has_known_keys(cls, links: Links, info: Any) -> Links:  # noqa: ANN401 - pydantic's
        known = {"inputs": INPUTS, "outputs": OUTPUTS, "start": STARTS}[info.field_name]
        if unknown := [key for key in links if key not in known]:
            raise misfit(f"no key {unknown[0]!r}; known: {', '.join(known)}")
        if info.field_name == "outputs" and (missing := [key for key in NEEDED if key not in links]):
            raise misfit(f"all of {', '.join(NEEDED)}; missing: {', '.join(missing)}")
        return links


class Channel(NamedTuple):
    """A link resolved: our key, and the FMU's variable by its reference."""

    key: str
    reference: int
    factor: float
    offset: float


def load_mapping(path: Path) -> FmuMapping:
    """Read a mapping.

    Raises:
        MappingError: missing file, malformed TOML, unknown or missing key, value out of range.
    """
    return read_section(path, FmuMapping, MappingError)


class Variables:
    """The variables of an FMU, for one mapping file.

    Args:
        path: of the mapping file, for messages.
        variables: of the FMU's model description: name, valueReference, type, causality and dimensions.
    """

    def __init__(self, path: Path, variables: Iterable[Any]) -> None:
        self._path = path
        self._by_name: Mapping[str, Any] = {variable.name: variable for variable in variables}

    def channels(self, section: str, links: Links) -> list[Channel]:
        """The links of a section, resolved.

        Raises:
            MappingError: a variable is not there, or cannot be used for this.
        """
        return [
            Channel(key, self.reference(section, key, link.variable), link.factor, link.offset) for key, link in links.items()
        ]

    def reference(self, section: str, key: str, name: str) -> int:
        """The reference of a variable that is mapped in a section.

        Raises:
            MappingError: it is not there, or cannot be used for this.
        """
        place, allowed = f"{self._path}: {section}.{key} = {name!r}", _CAUSALITIES[section]
        variable = self._by_name.get(name)
        usable = [v.name for v in self._by_name.values() if v.causality in allowed and v.type in _TYPES and not v.dimensions]
        known = ", ".join(usable[:_MOST_NAMES]) + (f" and {len(usable) - _MOST_NAMES} more" if len(usable) > _MOST_NAMES else "")
        if variable is None:
            raise MappingError(f"{place}: the FMU has no such variable; known: {known or 'none'}")
        if variable.type not in _TYPES or variable.dimensions:
            kind = f"array of {variable.type}" if variable.dimensions else variable.type
            raise MappingError(f"{place}: a variable of type {kind}; allowed: {' or '.join(_TYPES)}")
        if variable.causality not in allowed:
            raise MappingError(f"{place}: a variable of causality {variable.causality}; allowed: {', '.join(allowed)}; known: {known}")
        reference: int = variable.valueReference
        return reference
