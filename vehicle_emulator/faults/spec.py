"""One fault as data: a flat table of keys, the same in a scenario, in a file, on the command line and over Zenoh.

    kind = "bad_crc"            one of `kinds.KINDS`
    name = "steering garbled"   optional; the kind, with a number where it is needed
    messages = ["SR_Status"]    parameters of the kind
    from_s = 3.0                when, see `kinds.TIMING` and `kinds.COUNTING`
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import ConfigDict, PlainValidator, ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from dbc.errors import UserMistake
from dbc.section import Section, read_section
from vehicle_emulator.faults.condition import Condition, ConditionError
from vehicle_emulator.faults.kinds import KINDS, Kind, Parameter, Value, Word, keys, shown

MAX_FAULTS = 100
"""Faults that a run takes at a time."""
_NAME = Word()


class FaultMistake(UserMistake):
    """A fault cannot be used; one line per mistake, each with the key, its value and what is allowed."""


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """One fault, checked.

    Args:
        name: by which it is listed and cleared; empty until it has one.
        kind: one of `kinds.KINDS`.
        values: all other keys that were given or have a default.
    """

    name: str
    kind: str
    values: Mapping[str, Value]

    def number(self, key: str) -> float:
        """A number of the fault."""
        value = self.values[key]
        assert isinstance(value, int | float)
        return value

    def words(self, key: str) -> tuple[str, ...]:
        """Names of the fault, or its word."""
        value = self.values[key]
        assert isinstance(value, str | tuple)
        return (value,) if isinstance(value, str) else value

    @property
    def text(self) -> str:
        """What was asked for, as people type it: the kind and what differs from the defaults."""
        parameters = keys(KINDS[self.kind])
        given = [f"{key}={shown(value)}" for key, value in self.values.items() if value != parameters[key].default]
        return " ".join([self.kind, *given])

    def as_data(self) -> dict[str, Value]:
        """The fault as `parse_faults` takes it."""
        return {"kind": self.kind, **({"name": self.name} if self.name else {}), **self.values}


def parse_faults(content: object) -> tuple[FaultSpec, ...]:
    """The faults of a list of tables, each with a name.

    Raises:
        ValidationError: some are none; every mistake with place, value and what is allowed.
    """
    return named(_parsed(content))


def _parsed(content: object) -> list[FaultSpec]:
    if not isinstance(content, list | tuple) or len(content) > MAX_FAULTS:
        raise _refusal([_mistake((), content, f"allowed: a list of at most {MAX_FAULTS} faults, each a table with kind")])
    mistakes: list[InitErrorDetails] = []
    specs: list[FaultSpec] = []
    for place, entry in enumerate(content):
        mistakes += _check(place, entry, specs)
    if not mistakes:
        mistakes = [_mistake((place, "name"), specs[place].name, "allowed: names that differ") for place in _repeated(specs)]
    if mistakes:
        raise _refusal(mistakes)
    return specs


Faults = Annotated[tuple[FaultSpec, ...], PlainValidator(parse_faults)]
"""Faults as a field of a pydantic model, for example of a scenario."""


class _FaultFile(Section):
    """What is read of a file: a scenario can be one."""

    model_config = ConfigDict(extra="ignore")
    faults: Faults


def load_faults(path: Path) -> tuple[FaultSpec, ...]:
    """Read the `[[faults]]` of a TOML file; what else is in it is left alone, so that it can be a scenario.

    Raises:
        FaultMistake: missing file, malformed TOML, no faults in it, or one that is none; the text names file, key and what is allowed.
    """
    return read_section(path, _FaultFile, FaultMistake).faults


def fault_of(content: object) -> FaultSpec:
    """One fault from outside, with the name that it was given, if any.

    Raises:
        FaultMistake: it is none.
    """
    try:
        return _parsed([content])[0]
    except ValidationError as error:
        raise FaultMistake("\n".join(_line(details) for details in error.errors())) from error


def fault_of_words(kind: str, assignments: Sequence[str]) -> FaultSpec:
    """One fault from a command line: its kind and `KEY=VALUE`s.

    Raises:
        FaultMistake: it is none.
    """
    known = keys(KINDS[kind]) if kind in KINDS else {}
    content: dict[str, object] = {}
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        if not separator or not key:
            raise FaultMistake(f"{assignment!r}: KEY=VALUE, for example duration_s=2")
        if key in content or key == "kind":
            raise FaultMistake(f"{assignment!r}: {key} is given twice")
        content[key] = known[key].domain.read(text) if key in known else text
    return fault_of({**content, "kind": kind})


def named(specs: Iterable[FaultSpec], taken: Iterable[str] = ()) -> tuple[FaultSpec, ...]:
    """The same faults, each with a name: those without one get their kind, and a number where that is taken."""
    result = list(specs)
    names = {*taken, *(spec.name for spec in result)}
    for place, spec in enumerate(result):
        if not spec.name:
            tries = (spec.kind if number == 1 else f"{spec.kind}-{number}" for number in range(1, len(names) + 2))
            name = next(name for name in tries if name not in names)
            names.add(name)
            result[place] = replace(spec, name=name)
    return tuple(result)


def _repeated(specs: Sequence[FaultSpec]) -> list[int]:
    names = [spec.name for spec in specs]
    return [place for place, name in enumerate(names) if name and name in names[:place]]


def _check(place: int, entry: object, specs: list[FaultSpec]) -> list[InitErrorDetails]:
    """The mistakes of one entry; an entry without any is added to the faults."""
    if not isinstance(entry, Mapping):
        return [_mistake((place,), entry, "allowed: a table with kind")]
    kind = KINDS.get(entry["kind"]) if isinstance(entry.get("kind"), str) else None
    if kind is None:
        return [_mistake((place, "kind"), entry.get("kind", entry), f"allowed: {', '.join(KINDS)}")]
    known, name = keys(kind), entry.get("name", "")
    mistakes = [] if name == "" or _NAME.accept(name) else [_mistake((place, "name"), name, f"allowed: {_NAME.allowed}")]
    takes = f"unknown key; {kind.name} takes {', '.join(known)}, name"
    mistakes += [_mistake((place, str(key)), entry[key], takes) for key in entry.keys() - known.keys() - {"kind", "name"}]
    values: dict[str, Value] = {}
    for key, parameter in known.items():
        if (mistake := _take(place, key, parameter, entry, values)) is not None:
            mistakes.append(mistake)
    mistakes = sorted(mistakes, key=lambda mistake: str(mistake["loc"])) or _misfits(place, kind, values, entry)
    if not mistakes:
        specs.append(FaultSpec(str(name), kind.name, MappingProxyType(values)))
    return mistakes


def _take(place: int, key: str, parameter: Parameter, entry: Mapping[str, object], values: dict[str, Value]) -> InitErrorDetails | None:
    """Put one parameter into the values, or say what is wrong with it."""
    if key not in entry:
        if parameter.default is not None:
            values[key] = parameter.default
        elif not parameter.is_optional:
            return _mistake((place, key), entry, f"missing; allowed: {parameter.domain.allowed}")
        return None
    value = parameter.domain.accept(entry[key])
    if value is None:
        return _mistake((place, key), entry[key], f"allowed: {parameter.domain.allowed}")
    values[key] = value
    return None


def _misfits(place: int, kind: Kind, values: Mapping[str, Value], entry: Mapping[str, object]) -> list[InitErrorDetails]:
    """What is wrong with values that are right each on its own."""
    amounts = [parameter.name for parameter in kind.parameters if parameter.default is not None]
    if kind.needs_one and not any(values[key] for key in amounts):
        return [_mistake((place,), entry, f"allowed: at least one of {', '.join(amounts)} that is not 0")]
    if "until_s" in values and "duration_s" in values:
        return [_mistake((place, "until_s"), values["until_s"], "allowed: one of until_s and duration_s")]
    if "until_s" in values and not _number(values, "until_s") > _number(values, "from_s"):
        return [_mistake((place, "until_s"), values["until_s"], f"allowed: more than from_s, {_number(values, 'from_s'):g}")]
    if "condition" in values:
        try:
            Condition(str(values["condition"]))
        except ConditionError as error:
            return [_mistake((place, "condition"), values["condition"], str(error))]
    return []


def _number(values: Mapping[str, Value], key: str) -> float:
    value = values[key]
    assert isinstance(value, int | float)
    return value


def _mistake(place: tuple[int | str, ...], value: object, text: str) -> InitErrorDetails:
    # The text is an argument, because pydantic reads braces in a template.
    return InitErrorDetails(type=PydanticCustomError("fit", "{text}", {"text": text}), loc=place, input=value)


def _refusal(mistakes: list[InitErrorDetails]) -> ValidationError:
    return ValidationError.from_exception_data("faults", mistakes)


def _line(details: ErrorDetails) -> str:
    key, value = ".".join(map(str, details["loc"][1:])), details["input"]
    shown_value = "" if isinstance(value, Mapping) else f" = {value!r}"
    return f"{key}{shown_value}: {details['msg']}" if key else f"{shown_value.removeprefix(' = ')} {details['msg']}".strip()
