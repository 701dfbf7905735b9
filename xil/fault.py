"""`xilgate fault`: inject faults into a running emulator, look at them and take them back."""

from typing import Any

import msgspec
from rich.table import Table
from rich.text import Text

from dbc.errors import SetupFailure
from vehicle_emulator.faults.kinds import COUNTING, KINDS, TIMING, Names, Parameter, Word, shown
from vehicle_emulator.faults.operations import ADD, CLEAR, LIST
from vehicle_emulator.faults.spec import fault_of_words
from vehicle_emulator.service import request


class Told(msgspec.Struct, frozen=True, kw_only=True):
    """A fault as the emulator tells of it.

    Args:
        fault: what was asked for, as people type it.
        state: waiting, active or over.
        hits: frames that it has hit.
    """

    name: str
    fault: str
    state: str
    hits: int


def add(kind: str, assignments: list[str], base_port: int) -> list[Told]:
    """Add a fault to the emulator that runs on these ports, given as its kind and `KEY=VALUE`s.

    Raises:
        FaultMistake: it is no fault.
        UserMistake: the emulator refuses it.
        TelemetryError: no emulator answers.
    """
    return _asked(ADD, fault_of_words(kind, assignments).as_data(), base_port)


def listing(base_port: int) -> list[Told]:
    """All faults of the emulator; see `add`."""
    return _asked(LIST, {}, base_port)


def clear(name: str | None, base_port: int) -> list[Told]:
    """Take a fault back, or all of them; those that were. See `add`."""
    return _asked(CLEAR, {} if name is None else {"name": name}, base_port)


def table(faults: list[Told], title: str) -> Table:
    """Faults for people."""
    result = _table(f"{title}: {len(faults)}", "name", "state", "hits", "fault")
    for fault in faults:
        cells = (fault.name, fault.state, str(fault.hits), fault.fault)
        result.add_row(*map(Text, cells), style="bold" if fault.state == "active" else "")
    return result


def kinds_table() -> Table:
    """Every kind of fault, and the keys that it takes."""
    result = _table("kinds of faults", "kind", "on", "what happens", "keys")
    for kind in KINDS.values():
        keys = "\n".join(_key(parameter) for parameter in kind.parameters)
        result.add_row(kind.name, kind.group.value, Text(kind.description), Text(keys))
    for title, parameters in (("any kind", TIMING), ("single frames", COUNTING)):
        result.add_row("", title, "", Text("\n".join(_key(parameter) for parameter in parameters)))
    return result


def kinds_data() -> dict[str, Any]:
    """The same for programs."""
    return {
        "kinds": [
            {"kind": kind.name, "on": kind.group.value, "description": kind.description, "is_counted": kind.is_counted}
            | {"keys": _keys(kind.parameters)}
            for kind in KINDS.values()
        ],
        "timing": _keys(TIMING),
        "counting": _keys(COUNTING),
    }  # fmt: skip


def _keys(parameters: tuple[Parameter, ...]) -> list[dict[str, Any]]:
    return [
        {"key": one.name, "description": one.description, "allowed": one.domain.allowed, "default": one.default} for one in parameters
    ]


def _key(parameter: Parameter) -> str:
    if isinstance(parameter.domain, Names):
        return f"{parameter.name}: messages, nodes, identifiers or *"
    if isinstance(parameter.domain, Word) and not parameter.domain.choices:
        return f"{parameter.name}: {parameter.description}"
    default = "" if parameter.default is None else f"; else {shown(parameter.default)}"
    return f"{parameter.name}: {parameter.description} ({parameter.domain.allowed}{default})"


def _table(title: str, *columns: str) -> Table:
    result = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0), header_style="dim")
    for column in columns:
        result.add_column(column, no_wrap=column in ("name", "kind", "state"), justify="right" if column == "hits" else "left")
    return result


def _asked(op: str, arguments: dict[str, Any], base_port: int) -> list[Told]:
    result = request(op, arguments, base_port)
    try:
        return msgspec.convert(result, list[Told])
    except msgspec.ValidationError as error:
        raise SetupFailure(f"the emulator's answer is no list of faults: {error}; is it of another version?") from error
