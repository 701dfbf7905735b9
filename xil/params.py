"""`xilgate params`: look at and change the parameters of a running controller."""

import getpass
import math
import socket
import threading
import time
from collections.abc import Callable, Iterable
from datetime import datetime, timedelta
from typing import Literal, TypeVar

from rich.table import Table
from rich.text import Text

from controller.parameters import Accepted, Refused
from controller.tuning import Answer, GetRequest, History, HistoryRequest, ListRequest, Request, RevertRequest, SetRequest, Values, request
from dbc.errors import SetupFailure, UserMistake
from gateway.telemetry import ParameterChange, ParametersSample, Subscriber, TlsSection, decode

AnswerT = TypeVar("AnswerT", bound=Answer)


class ParameterMistake(UserMistake):
    """A request that is none, or that the controller refuses; one line per reason."""


def values(names: list[str], base_port: int, tls: TlsSection | None = None) -> Values:
    """The named parameters of the controller that runs on these ports; all of them, when none is named.

    Raises:
        ParameterMistake: there is no such parameter.
        TelemetryError: no controller answers.
    """
    return _asked(GetRequest(names=names) if names else ListRequest(), Values, base_port, tls)


def change(assignments: list[str], base_port: int, tls: TlsSection | None = None) -> Accepted:
    """Set parameters, each given as `NAME=VALUE`: all of them, or none when one is refused.

    Raises:
        ParameterMistake: one of them is not that, or is refused.
        TelemetryError: no controller answers.
    """
    return _asked(SetRequest(changes=parsed(assignments), who=_who()), Accepted, base_port, tls)


def revert(what: str, base_port: int, tls: TlsSection | None = None) -> Accepted:
    """Take back a change by its number, the `last` that stands, or `all`.

    Raises:
        ParameterMistake: it is none of these, or cannot be taken back.
        TelemetryError: no controller answers.
    """
    chosen: int | Literal["last", "all"]
    match what:
        case "last" | "all":
            chosen = what
        case number if number.isascii() and number.isdecimal():
            chosen = int(number)
        case _:
            raise ParameterMistake(f"revert {what!r}: the number of a change, last or all")
    return _asked(RevertRequest(what=chosen, who=_who()), Accepted, base_port, tls)


def history(base_port: int, tls: TlsSection | None = None) -> History:
    """The audit trail.

    Raises:
        TelemetryError: no controller answers.
    """
    return _asked(HistoryRequest(), History, base_port, tls)


def follow(
    base_port: int, stop: threading.Event, tell: Callable[[ParametersSample], None], tls: TlsSection | None = None
) -> None:
    """Tell every change that comes in force, until `stop` is set.

    Raises:
        TelemetryError: no controller answers.
    """

    def on_sample(topic: str, payload: bytes) -> None:
        if isinstance(sample := decode(topic, payload), ParametersSample):
            tell(sample)

    if tls is None:  # a reader of another machine may not use its services
        values([], base_port)
    with Subscriber(on_sample, ["parameters"], base_port, tls):
        stop.wait()


def parsed(assignments: list[str]) -> dict[str, float]:
    """Changes from `NAME=VALUE`.

    Raises:
        ParameterMistake: one of them is not that.
    """
    changes: dict[str, float] = {}
    for text in assignments:
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not name or not math.isfinite(value):
            raise ParameterMistake(f"{text!r}: NAME=VALUE with a number, for example planner.safe_time_s=1.8")
        if name in changes:
            raise ParameterMistake(f"{name} is given twice")
        changes[name] = value
    return changes


def _asked(content: Request, kind: type[AnswerT], base_port: int, tls: TlsSection | None) -> AnswerT:
    answer = request(content, base_port, tls)
    if isinstance(answer, Refused):
        raise ParameterMistake("\n".join(answer.reasons))
    if not isinstance(answer, kind):
        raise SetupFailure(f"the controller answers {type(answer).__name__} where {kind.__name__} is due; is it of another version?")
    return answer


def _who() -> str:
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # an account without a name, as in a container
        user = "unknown"
    return f"{user}@{socket.gethostname()}"[:80]


def values_table(answer: Values) -> Table:
    """Parameters for people; what differs from the start is marked."""
    table = _table(f"parameters, version {answer.version}", "name", "value", "unit", "range", "default", "", "description")
    for value in answer.parameters:
        is_changed = value.value != value.default
        cells = (value.name, f"{value.value:g}", value.unit, f"{value.smallest:g} to {value.largest:g}", f"{value.default:g}")
        table.add_row(*map(Text, (*cells, "changed" if is_changed else "", value.description)), style="bold" if is_changed else "")
    return table


def changes_table(answer: Accepted) -> Table | Text:
    """What a request changed."""
    if not answer.changes:
        return Text(f"parameters, version {answer.version}: nothing to change")
    table = _table(f"parameters, version {answer.version}", "name", "old", "new")
    _add_changes(table, answer.changes)
    return table


def history_table(answer: History, is_clock_shared: bool = True) -> Table:
    """The audit trail for people, oldest change first; without times where the controller's clock is that of another machine."""
    table = _table(f"parameters, version {answer.version}", "version", "time", "who", "takes back", "name", "old", "new")
    for entry in answer.entries:
        taken_back, time_of_day = ", ".join(map(str, entry.reverts)), _time_of_day(entry.accepted_ns) if is_clock_shared else ""
        _add_changes(table, entry.changes, str(entry.version), time_of_day, entry.who, taken_back)
    return table


def line(sample: ParametersSample, is_clock_shared: bool = True) -> str:
    """One change in one line, with its time, or that of its arrival where the controller's clock is that of another machine."""
    taken_back = f" takes back {', '.join(map(str, sample.reverts))}:" if sample.reverts else ""
    changes = ", ".join(f"{one.name} {one.old:g} -> {one.new:g}" for one in sample.changes)
    time_of_day = _time_of_day(sample.t_ns if is_clock_shared else time.monotonic_ns())
    return f"{time_of_day}  version {sample.version} by {sample.who}:{taken_back} {changes}"


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0), header_style="dim")
    for column in columns:
        is_number = column in ("value", "old", "new", "default")
        table.add_column(column, no_wrap=column != "description", justify="right" if is_number else "left")
    return table


def _add_changes(table: Table, changes: Iterable[ParameterChange], *first: str) -> None:
    for one in changes:
        table.add_row(*map(Text, (*first, one.name, f"{one.old:g}", f"{one.new:g}")))
        first = ("",) * len(first)


def _time_of_day(monotonic_ns: int) -> str:
    age = timedelta(microseconds=(time.monotonic_ns() - monotonic_ns) / 1e3)
    return (datetime.now().astimezone() - age).strftime("%H:%M:%S")
