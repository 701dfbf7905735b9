"""What people can ask of a running emulator, over Zenoh: an operation by its name, with arguments.

A request is one JSON object on the key `xilgate/emulator/operations`: `op`, the name of an operation, and `arguments`. The answer is
one, told apart by `answer`: done with the result of the operation, or refused with the reason in one line. Requests come from
outside and are prepared on threads of Zenoh; the thread of the car does what is left at the edge of a step and never waits.
"""

import logging
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

import msgspec

from dbc.errors import UserMistake
from gateway.telemetry import DEFAULT_BASE_PORT, Source, TelemetryError, ask
from vehicle_emulator.operation import Action, Operation

SERVICE = "operations"
PATIENCE_S = 1.0
"""Time that a request waits for the car's next step [s]."""
_MAX_WAITING = 64
_MAX_REASON = 1_000

log = logging.getLogger("xilgate.emulator")


class Request(msgspec.Struct, frozen=True, kw_only=True):
    """What somebody asks."""

    op: str
    arguments: dict[str, Any] = {}


class _Answer(msgspec.Struct, frozen=True, kw_only=True, tag_field="answer", tag=str.lower):
    """One of the answers below."""


class Done(_Answer, frozen=True, kw_only=True):
    """The operation was done."""

    result: Any


class Refused(_Answer, frozen=True, kw_only=True):
    """It was not, for this reason."""

    reason: str


Answer = Done | Refused
_REQUESTS: msgspec.json.Decoder[Request] = msgspec.json.Decoder(Request)
_ANSWERS: msgspec.json.Decoder[Answer] = msgspec.json.Decoder(Answer)


class EmulatorService:
    """Hands requests from threads of Zenoh to the thread of the car.

    Args:
        operations: by name; each is prepared where the request comes in and done by `run_due`.
    """

    def __init__(self, operations: Mapping[str, Operation]) -> None:
        self._operations = dict(operations)
        self._waiting: deque[tuple[Action, Future[object]]] = deque()

    def answer(self, payload: bytes) -> bytes:
        """The answer to one request; to what is none, a refusal that says why."""
        try:
            request = _REQUESTS.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            return msgspec.json.encode(Refused(reason=f"not a request: {error}"))
        try:
            answer: Answer = Done(result=self._done(request))
        except UserMistake as mistake:
            answer = Refused(reason="; ".join(str(mistake).splitlines())[:_MAX_REASON])
        log.info("%s: %s", request.op[:80], "done" if isinstance(answer, Done) else f"refused: {answer.reason}")
        return msgspec.json.encode(answer)

    def run_due(self, now_ns: int) -> None:
        """Do what was asked for, one thing at most; called at the edge of every step."""
        if not self._waiting:
            return
        action, future = self._waiting.popleft()
        if not future.set_running_or_notify_cancel():
            return  # whoever asked has given up
        try:
            future.set_result(action(now_ns))
        except UserMistake as mistake:
            future.set_exception(mistake)

    def _done(self, request: Request) -> object:
        if (operation := self._operations.get(request.op)) is None:
            raise UserMistake(f"op = {request.op!r}: allowed: {', '.join(sorted(self._operations))}")
        action = operation(request.arguments)
        if len(self._waiting) >= _MAX_WAITING:
            raise UserMistake(f"{_MAX_WAITING} requests wait already; ask again")
        future: Future[object] = Future()
        self._waiting.append((action, future))
        try:
            return future.result(timeout=PATIENCE_S)
        except TimeoutError:
            if not future.cancel():
                return future.result()  # it was being done at that very moment
            raise UserMistake(f"the emulator has not stepped for {PATIENCE_S:g} s; nothing was done") from None


def request(op: str, arguments: Mapping[str, object], base_port: int = DEFAULT_BASE_PORT) -> object:
    """Ask the emulator that runs on these ports, and wait for the result.

    Raises:
        UserMistake: it refuses.
        TelemetryError: no emulator answers.
    """
    payload = ask(Source.EMULATOR, SERVICE, msgspec.json.encode(Request(op=op, arguments=dict(arguments))), base_port)
    try:
        answer = _ANSWERS.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise TelemetryError(f"the emulator's answer is none: {error}; is it of another version?") from error
    if isinstance(answer, Refused):
        raise UserMistake(answer.reason)
    return answer.result
