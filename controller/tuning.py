"""The service through which people look at and change the parameters of a running controller, and its client.

A request is one JSON object on the key `xilgate/controller/parameters`, told apart by `op`: list, get, set, revert, history.
The answer is one JSON object, told apart by `answer`. Requests come from outside and are answered on threads of Zenoh, one
after the other by a lock; the control thread never waits for any of this (see `parameters`).
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import Literal

import msgspec

from controller.parameters import Accepted, Entry, ParameterStore, Refused
from gateway.telemetry import DEFAULT_BASE_PORT, Source, TelemetryError, TlsSection, ask

SERVICE = "parameters"

log = logging.getLogger("xilgate.controller")


class _Request(msgspec.Struct, frozen=True, kw_only=True, tag_field="op", tag=lambda name: name.removesuffix("Request").lower()):
    """One of the requests below."""


class ListRequest(_Request, frozen=True, kw_only=True):
    """All parameters."""


class GetRequest(_Request, frozen=True, kw_only=True):
    """Some parameters."""

    names: list[str]


class SetRequest(_Request, frozen=True, kw_only=True):
    """Other values for some parameters: all of them, or none when one is refused."""

    changes: dict[str, float]
    who: str


class RevertRequest(_Request, frozen=True, kw_only=True):
    """Take back a change by its number, the last that stands, or all."""

    what: int | Literal["last", "all"]
    who: str


class HistoryRequest(_Request, frozen=True, kw_only=True):
    """The audit trail."""


class Value(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter as it is now.

    Args:
        default: the value with which the controller started.
    """

    name: str
    value: float
    unit: str
    smallest: float
    largest: float
    default: float
    description: str


class _Answer(msgspec.Struct, frozen=True, kw_only=True, tag_field="answer", tag=str.lower):
    """One of the answers below, `Accepted` or `Refused`."""


class Values(_Answer, frozen=True, kw_only=True):
    """Parameters.

    Args:
        version: of the newest accepted change.
        in_force: version with which the control loop works.
    """

    version: int
    in_force: int
    parameters: list[Value]


class History(_Answer, frozen=True, kw_only=True):
    """The audit trail, oldest change first."""

    version: int
    entries: list[Entry]


Request = ListRequest | GetRequest | SetRequest | RevertRequest | HistoryRequest
Answer = Values | History | Accepted | Refused
_REQUESTS: msgspec.json.Decoder[Request] = msgspec.json.Decoder(Request)
_ANSWERS: msgspec.json.Decoder[Answer] = msgspec.json.Decoder(Answer)


class TuningService:
    """Answers requests on a store.

    Args:
        clock: monotonic time [ns].
    """

    def __init__(self, store: ParameterStore, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._store = store
        self._clock = clock
        self._lock = threading.Lock()  # between clients; the control thread does not know of it
        self._encoder = msgspec.json.Encoder()

    def answer(self, payload: bytes) -> bytes:
        """The answer to one request; to what is none, a refusal that says why."""
        try:
            request = _REQUESTS.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            return self._encoder.encode(Refused(reasons=[f"not a request: {error}"]))
        with self._lock:
            return self._encoder.encode(self._answer(request))

    def _answer(self, request: Request) -> Answer:
        store = self._store
        match request:
            case SetRequest(changes=changes, who=who):
                return self._logged(store.propose(changes, who, self._clock()))
            case RevertRequest(what=what, who=who):
                return self._logged(store.revert(what, who, self._clock()))
            case GetRequest(names=names):
                reasons = store.unknown(names)
                return Refused(reasons=reasons) if reasons else self._values(dict.fromkeys(names))
            case ListRequest():
                return self._values(store.table)
            case HistoryRequest():
                return History(version=store.newest.version, entries=list(store.newest.history))

    def _values(self, names: Iterable[str]) -> Values:
        store = self._store
        newest = store.newest
        parameters = [
            Value(
                name=name, value=newest.value(about), unit=about.unit, smallest=about.smallest, largest=about.largest,
                default=store.starting.value(about), description=about.description,
            )
            for name, about in ((name, store.table[name]) for name in names)
        ]  # fmt: skip
        return Values(version=newest.version, in_force=store.in_force, parameters=parameters)

    def _logged(self, verdict: Accepted | Refused) -> Accepted | Refused:
        if isinstance(verdict, Refused):
            others = f", and {len(verdict.reasons) - 1} more" if len(verdict.reasons) > 1 else ""
            log.info("parameters refused: %s%s", verdict.reasons[0], others)
        elif verdict.changes:
            entry = self._store.newest.history[-1]
            changes = ", ".join(f"{change.name} {change.old:g} -> {change.new:g}" for change in entry.changes)
            reverted = f", takes back {entry.reverts}" if entry.reverts else ""
            log.info("parameters version %d by %s%s: %s", entry.version, entry.who, reverted, changes)
        return verdict


def request(content: Request, base_port: int = DEFAULT_BASE_PORT, tls: TlsSection | None = None) -> Answer:
    """Ask the controller that runs on these ports, or on another machine.

    Raises:
        TelemetryError: no controller answers.
    """
    answer = ask(Source.CONTROLLER, SERVICE, msgspec.json.encode(content), base_port, tls=tls)
    try:
        return _ANSWERS.decode(answer)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise TelemetryError(f"the controller's answer is none: {error}; is it of another version?") from error
