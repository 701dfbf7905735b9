"""Parameters of the running controller: weights, limits and safe distances, which change between two cycles.

A table says what there is; the store checks a request as a whole, numbers what it accepts, and keeps an audit trail. All that
the store knows is one immutable `ParameterSet`, replaced by a single assignment: whoever changes parameters and the control
thread, which takes the newest set at the edge of its cycle, need no lock between them and can never see half a change.

These are numbers that every solver is given at every solve. What is written into generated code, model, horizon and sample
time, is no parameter.
"""

import difflib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar

import msgspec

from controller.planning.options import RANGES, PlannerOptions
from controller.problem import OcpOptions
from dbc.errors import UserMistake
from gateway.telemetry import ParameterChange

HISTORY_LENGTH = 1000
"""Changes that are remembered. The log of the process and the record of the run hold all of them."""
_MOST_REASONS = 8
_LONGEST_NAME = 80

OptionsT = TypeVar("OptionsT", OcpOptions, PlannerOptions)
Numbers: TypeAlias = "float | tuple[Numbers, ...]"
Place: TypeAlias = tuple[str | int, ...]


class Parameter(msgspec.Struct, frozen=True, kw_only=True):
    """One number that may change while the controller runs.

    Args:
        name: `GROUP.FIELD`, or `GROUP.FIELD.ELEMENT` where the field has several numbers, or with `.min` or `.max` for bounds.
        unit: of the number; empty where it has none.
        path: field of the options, then places within it.
        smallest, largest: what is accepted, both included.
        description: one line for people.
    """

    name: str
    unit: str
    path: Place
    smallest: float
    largest: float
    description: str

    @property
    def group(self) -> str:
        """`ocp` or `planner`: which options the number belongs to."""
        return self.name.partition(".")[0]


@dataclass(frozen=True)
class _Field:
    """Description of a field of the options; the text of a vector names its element by {}."""

    description: str
    smallest: float
    largest: float
    unit: str = ""


_UNITS = {
    "v_x": "m/s", "v_y": "m/s", "omega": "rad/s", "X": "m", "Y": "m", "psi": "rad",
    "delta": "rad", "t_r": "", "delta_a": "rad", "t_a": "",
}  # fmt: skip
_HEAVIEST = 1e5
_STATE_VECTORS = {
    "state_weights": _Field("weight on the tracking error of {} (Q)", 0.0, _HEAVIEST),
    "terminal_weights": _Field("weight on the tracking error of {} at the end of the horizon (Q_N)", 0.0, _HEAVIEST),
    "terminal_box": _Field("largest tracking error of {} at the end of the horizon", 0.01, 1000.0),
}
# Without any weight on an input the problem may have no solution, or many.
_INPUT_VECTORS = {
    "input_weights": _Field("weight on {} (R)", 1e-3, _HEAVIEST),
    "input_difference_weights": _Field("weight on the change of {} from one sample to the next (S)", 0.0, _HEAVIEST),
}
_WEIGHTS = {name for name in (*_STATE_VECTORS, *_INPUT_VECTORS) if name.endswith("_weights")}
_OCP_NUMBERS = {
    "lateral_acceleration_mps2": _Field("lateral acceleration that the tyres can hold; bounds the yaw rate", 0.5, 10.0, "m/s²"),
}
# Zero stays inside every bound, and the brake stays available.
_BOUND_RANGES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "v_x": ((-5.0, -0.1), (0.5, 70.0)),
    "v_y": ((-10.0, -0.1), (0.1, 10.0)),
    "omega": ((-3.0, -0.05), (0.05, 3.0)),
    "delta": ((-0.6, -0.02), (0.02, 0.6)),
    "t_r": ((-1.0, -0.2), (0.0, 1.0)),
}
_ANY_BOUND = ((-1000.0, 0.0), (0.0, 1000.0))
_PLANNER_NUMBERS = {
    "safe_time_s": "time gap to an object, before and behind",
    "safe_longitudinal_m": "distance to an object at standstill, before and behind",
    "safe_lateral_m": "distance from the side of the car to an object",
    "detection_range_m": "range beyond which an object does not exist, from the car's front",
    "reference_room_m": "from the reference to the edge of the corridor where an object makes it pass",
    "side_hysteresis_m": "by how much less of a shift the other side must need to be taken instead",
    "crawl_mps": "slowest reference speed before the end of the path",
    "speed_margin_mps": "difference to the measured speed up to which the profile is taken as it is",
    "acceleration_mps2": "rate at which the reference speed leaves that margin, and brakes for an object",
    "hardest_deceleration_mps2": "deceleration for an object that appears too late for that",
    "lateral_acceleration_mps2": "lateral acceleration of a shift that is begun in time",
    "hardest_lateral_acceleration_mps2": "lateral acceleration of a shift that is begun late",
    "tightest_curvature_radpm": "largest curvature of a shifted reference",
    "search_slack_m": "by how much the search for the closest point exceeds the distance driven",
    "corridor_relief_m": "room left to a car found outside the corridor, beyond where it is",
}
"""What people read of each number of the planner; ranges are those of `planning.options.RANGES`."""
_UNIT_OF_SUFFIX = {"_mps2": "m/s²", "_mps": "m/s", "_radpm": "1/m", "_m": "m", "_s": "s"}
_NORTHLESS = ("state_weights", "terminal_weights")
"""Here X and Y weigh alike: the cost must not know north."""


def table(ocp: OcpOptions) -> list[Parameter]:
    """All parameters of a controller for this problem, in the order in which people read them."""
    model, parameters = ocp.model, []
    for vectors, names in ((_STATE_VECTORS, model.states), (_INPUT_VECTORS, model.inputs)):
        for field, about in vectors.items():
            for place, name in enumerate(names[: len(getattr(ocp, field))]):
                unit = _UNITS.get(name, "")
                unit = _per_square(unit) if field in _WEIGHTS else unit
                parameters.append(_parameter("ocp", (field, place), replace(about, unit=unit), name))
    for field, names in (("state_bounds", model.bounded), ("input_bounds", model.inputs)):
        for place, name in enumerate(names):
            for side, (end, word) in enumerate((("min", "smallest"), ("max", "largest"))):
                smallest, largest = _BOUND_RANGES.get(name, _ANY_BOUND)[side]
                about = _Field(f"{word} {{}}", smallest, largest, _UNITS.get(name, ""))
                parameters.append(_parameter("ocp", (field, place, side), about, name, end))
    parameters += [_parameter("ocp", (field,), about) for field, about in _OCP_NUMBERS.items()]
    for field, description in _PLANNER_NUMBERS.items():
        unit = next(unit for suffix, unit in _UNIT_OF_SUFFIX.items() if field.endswith(suffix))
        parameters.append(_parameter("planner", (field,), _Field(description, *RANGES[field], unit)))
    return parameters


def _per_square(unit: str) -> str:
    return f"1/({unit})²" if "/" in unit else f"1/{unit}²" if unit else "1"


def _parameter(group: str, path: Place, about: _Field, *elements: str) -> Parameter:
    return Parameter(
        name=".".join((group, str(path[0]), *elements)),
        unit=about.unit,
        path=path,
        smallest=about.smallest,
        largest=about.largest,
        description=about.description.format(*elements),
    )


class Accepted(msgspec.Struct, frozen=True, kw_only=True, tag_field="answer", tag="accepted"):
    """A request was accepted; it is in force from the next cycle edge on.

    Args:
        version: of the parameters that it made; the one before, when it changed nothing.
    """

    version: int
    changes: list[ParameterChange]


class Refused(msgspec.Struct, frozen=True, kw_only=True, tag_field="answer", tag="refused"):
    """A request was refused as a whole.

    Args:
        reasons: one line each.
    """

    reasons: list[str]


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A change in the audit trail.

    Args:
        version: its number, from 1 on.
        accepted_ns: when [ns].
        who: whoever asked for it, as he called himself.
        reverts: numbers of the changes that it took back.
    """

    version: int
    accepted_ns: int
    who: str
    changes: list[ParameterChange]
    reverts: list[int]


@dataclass(frozen=True)
class ParameterSet:
    """The parameters as they are, and how they came to be so.

    Args:
        version: number of the newest change; 0 are the starting values.
        history: the newest `HISTORY_LENGTH` changes, oldest first.
    """

    version: int
    ocp: OcpOptions
    planner: PlannerOptions
    history: tuple[Entry, ...] = ()

    def value(self, parameter: Parameter) -> float:
        """Value of one parameter."""
        value = getattr(self.ocp if parameter.group == "ocp" else self.planner, str(parameter.path[0]))
        for place in parameter.path[1:]:
            value = value[place]
        return float(value)


class ParameterStore:
    """Checks and keeps the parameters of a running controller.

    `propose` and `revert` belong to one thread or one lock; `take` belongs to the control thread and needs neither.
    """

    def __init__(self, ocp: OcpOptions, planner: PlannerOptions) -> None:
        self.table = {parameter.name: parameter for parameter in table(ocp)}
        self.starting = self.newest = self._taken = ParameterSet(0, ocp, planner)

    @property
    def in_force(self) -> int:
        """Version that the control thread has taken."""
        return self._taken.version

    def take(self) -> tuple[ParameterSet, list[Entry]] | None:
        """The newest parameters and what led to them, when they changed since the call before."""
        newest, before = self.newest, self._taken
        if newest is before:
            return None
        self._taken = newest
        return newest, [entry for entry in newest.history if entry.version > before.version]

    def unknown(self, names: Iterable[str]) -> list[str]:
        """What there is to say about names that are none; empty when all are known."""
        mistakes = (f"no parameter {name[:_LONGEST_NAME]!r}" + self._near(name) for name in names if name not in self.table)
        return list(itertools.islice(mistakes, _MOST_REASONS))  # a request may hold thousands

    def propose(self, changes: Mapping[str, float], who: str, now_ns: int) -> Accepted | Refused:
        """Check a request, and accept all of it or nothing."""
        if not changes:
            return Refused(reasons=["no parameter is named"])
        known = {name: (self.table[name], value) for name, value in changes.items() if name in self.table}
        reasons = self.unknown(changes) + [
            f"{name} = {value:g}: from {about.smallest:g} to {about.largest:g} {about.unit}".rstrip()
            for name, (about, value) in known.items()
            if not about.smallest <= value <= about.largest  # so for NaN as well
        ]
        return Refused(reasons=reasons) if reasons else self._accept(changes, who, now_ns, ())

    def revert(self, what: int | str, who: str, now_ns: int) -> Accepted | Refused:
        """Take back a change by its number, the `last` one that stands, or `all`: each parameter gets the value from before.

        That is a change of its own; it cannot be taken back, but the values can be set again.
        """
        standing = self._standing()
        if what == "all":
            values = {name: self.starting.value(parameter) for name, parameter in self.table.items()}
            return self._accept(values, who, now_ns, [entry.version for entry in standing])
        if what == "last" and not standing:
            return Refused(reasons=["there is no change to take back"])
        chosen = [entry for entry in standing if entry.version == what] if what != "last" else standing[-1:]
        if not chosen:
            known = ", ".join(str(entry.version) for entry in standing[-_MOST_REASONS:]) or "none"
            return Refused(reasons=[f"change {what!r} does not stand; these do, newest last: {known}; or last, all"])
        old = {change.name: change.old for change in chosen[0].changes}
        later = [entry.version for entry in standing if entry.version > chosen[0].version and {c.name for c in entry.changes} & old.keys()]
        if later:
            return Refused(reasons=[f"change {later[-1]} set the same parameters after {chosen[0].version}: take it back first"])
        return self._accept(old, who, now_ns, [chosen[0].version])

    def _standing(self) -> list[Entry]:
        """Changes that are neither taken back nor take others back."""
        history = self.newest.history
        reverted = {number for entry in history for number in entry.reverts}
        return [entry for entry in history if not entry.reverts and entry.version not in reverted]

    def _near(self, name: str) -> str:
        near = difflib.get_close_matches(name[:_LONGEST_NAME], self.table, cutoff=0.4)
        return f"; near: {', '.join(near)}" if near else ""

    def _accept(self, values: Mapping[str, float], who: str, now_ns: int, reverts: Iterable[int]) -> Accepted | Refused:
        """Make the next version, unless the numbers do not go together."""
        before, who = self.newest, who.strip()
        if not 0 < len(who) <= _LONGEST_NAME or not who.isprintable():
            return Refused(reasons=[f"who = {who[:_LONGEST_NAME]!r}: 1 to {_LONGEST_NAME} printable characters"])
        old = {name: before.value(self.table[name]) for name in values}
        changes = [ParameterChange(name=name, old=old[name], new=float(new)) for name, new in values.items() if new != old[name]]
        if not changes:
            return Accepted(version=before.version, changes=[])
        paths = {(parameter.group, parameter.path): change.new for change in changes for parameter in (self.table[change.name],)}
        try:
            ocp, planner = _changed(before.ocp, "ocp", paths), _changed(before.planner, "planner", paths)
        except UserMistake as error:
            return Refused(reasons=[str(error)])
        if reasons := _north_seekers(before.ocp, ocp):
            return Refused(reasons=reasons)
        entry = Entry(version=before.version + 1, accepted_ns=now_ns, who=who, changes=changes, reverts=list(reverts))
        self.newest = ParameterSet(entry.version, ocp, planner, (*before.history, entry)[-HISTORY_LENGTH:])
        return Accepted(version=entry.version, changes=changes)


def _changed(options: OptionsT, group: str, values: Mapping[tuple[str, Place], float]) -> OptionsT:
    """The options with other numbers in the places that belong to this group."""
    fields: dict[str, Any] = {}
    for (owner, (field, *places)), value in values.items():
        if owner == group:
            fields[str(field)] = _put(fields.get(str(field), getattr(options, str(field))), places, value)
    return replace(options, **fields)


def _put(whole: Numbers, places: Sequence[str | int], value: float) -> Numbers:
    """A number, or a tuple with another number in one place."""
    if not isinstance(whole, tuple):
        return value
    return tuple(_put(part, places[1:], value) if place == places[0] else part for place, part in enumerate(whole))


def _north_seekers(before: OcpOptions, after: OcpOptions) -> list[str]:
    """Weights that were changed such that the cost depends on where north is."""
    x, y = after.model.position_index
    return [
        f"ocp.{field}.X and ocp.{field}.Y must be equal, the cost does not know north: set both in one request"
        for field in _NORTHLESS
        if (weights := getattr(after, field)) != getattr(before, field) and weights[x : x + 1] != weights[y : y + 1]
    ]
