"""The control path between gateway and controller: fixed little-endian datagrams, newest value wins.

Every datagram: magic, version, kind, boot id of the sender, sequence number, body, and a keyed MAC of all before it. `unpack`
answers None to anything else, so that what comes from outside is a value or a rejection, never an exception.
Times are CLOCK_MONOTONIC and mean something on one host only.
"""

import hmac
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from hashlib import blake2b

HORIZON_STEPS = 30
"""Steering and drive demands that a command carries: the plan of the controller (N of the paper)."""
PLAN_PERIOD_NS = 40_000_000
"""Time between two demands of the plan [ns] (T_s of the paper)."""
KEY_BYTES = 32
MAX_DATAGRAM_BYTES = 2048
"""Room for every datagram; what is longer is none of ours, and its end is not even read."""

_MAGIC = 0x4758  # "XG"
_VERSION = 3
_HEADER = struct.Struct("<HBBIQ")
_MAC_BYTES = 16
"""A forger who may try 10,000 times a second for a year succeeds with probability 1e-27."""


class Kind(IntEnum):
    """What a datagram carries."""

    VEHICLE_STATE = 1
    CONTROL_COMMAND = 2
    OPERATOR_REQUEST = 3
    OPERATOR_REPLY = 4


class Mode(IntEnum):
    """Operating mode of the gateway; what each means is told in `modes`."""

    STANDBY = 0
    READY = 1
    ENGAGED = 2
    SAFE_STOP = 3
    FAULT = 4
    COMFORT_STOP = 5
    SILENT = 6


class CommandStatus(IntEnum):
    """What the controller says of its own command."""

    OK = 0
    DEGRADED = 1
    FAILED = 2


class Operation(IntEnum):
    """What an operator asks for."""

    ENGAGE = 1
    DISENGAGE = 2
    RESET = 3
    ARM = 4
    STOP = 5


@dataclass(frozen=True, slots=True)
class VehicleState:
    """State estimate at the centre of gravity, ISO 8855 axes, in the local frame of the navigation system.

    Args:
        t_ns: monotonic time at which the navigation data were valid [ns].
        steer_rad: measured road-wheel angle [rad].
        drive_norm: measured drive and brake demand, -1 to 1, positive drives.
        is_valid: False when a required message is missing or bad; the numbers are then the last good ones.
    """

    boot_id: int
    seq: int
    t_ns: int
    mode: Mode
    is_valid: bool
    x_m: float
    y_m: float
    yaw_rad: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    steer_rad: float
    drive_norm: float


@dataclass(frozen=True, slots=True)
class ControlCommand:
    """One answer of the controller to one state.

    Args:
        state_seq: sequence number of the state that this answers.
        t_ns: monotonic time from which the first demand holds [ns].
        lateral_error_m, heading_error_rad: distance of the car to the left of its path [m], and of its heading from the path's [rad].
        steer_rad: road-wheel angle [rad], left positive.
        drive_norm: -1 (full brake of the model) to 1 (full drive).
        plan_steer_rad, plan_drive_norm: demands of the whole plan, shape (30,), from `t_ns` on, one every 40 ms.
    """

    boot_id: int
    seq: int
    state_seq: int
    t_ns: int
    status: CommandStatus
    solve_time_ns: int
    lateral_error_m: float
    heading_error_rad: float
    steer_rad: float
    drive_norm: float
    plan_steer_rad: tuple[float, ...]
    plan_drive_norm: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class OperatorRequest:
    """A request of the operator; it acts once, when its sequence number is new.

    Args:
        t_ns: when it was made, monotonic [ns]: what was recorded yesterday must not arm a car today.
    """

    boot_id: int
    seq: int
    operation: Operation
    t_ns: int


@dataclass(frozen=True, slots=True)
class OperatorReply:
    """What became of a request.

    Args:
        boot_id, seq: of the request that this answers.
        refusals: every condition that is not met, by name; empty when the request was granted.
    """

    boot_id: int
    seq: int
    operation: Operation
    mode: Mode
    refusals: tuple[str, ...]


Datagram = VehicleState | ControlCommand | OperatorRequest | OperatorReply

_STATE = struct.Struct("<QBB9d")
_COMMAND = struct.Struct(f"<QQBQ4d{HORIZON_STEPS}d{HORIZON_STEPS}d")
_REQUEST = struct.Struct("<BQ")
_REPLY = struct.Struct("<BB")
_SEPARATOR = "\x1f"
_MAX_REFUSALS_BYTES = 1024
_BODY_BYTES: Mapping[int, tuple[int, int]] = {
    Kind.VEHICLE_STATE: (_STATE.size, _STATE.size),
    Kind.CONTROL_COMMAND: (_COMMAND.size, _COMMAND.size),
    Kind.OPERATOR_REQUEST: (_REQUEST.size, _REQUEST.size),
    Kind.OPERATOR_REPLY: (_REPLY.size, _REPLY.size + _MAX_REFUSALS_BYTES),
}
"""Shortest and longest body of each kind."""


def pack(message: Datagram, key: bytes) -> bytes:
    """Wire form of a datagram.

    Args:
        key: of the rig, `KEY_BYTES` long.
    """
    kind, body = _body(message)
    content = _HEADER.pack(_MAGIC, _VERSION, kind, message.boot_id, message.seq) + body
    return content + _mac(content, key)


def unpack(datagram: bytes, key: bytes) -> Datagram | None:
    """The message in a datagram, or None when any byte of it is not as it must be for whoever has the key."""
    if len(datagram) < _HEADER.size + _MAC_BYTES:
        return None
    magic, version, kind, boot_id, seq = _HEADER.unpack_from(datagram)
    shortest, longest = _BODY_BYTES.get(kind, (1, 0))
    if magic != _MAGIC or version != _VERSION or not shortest <= len(datagram) - _HEADER.size - _MAC_BYTES <= longest:
        return None
    content, mac = datagram[:-_MAC_BYTES], datagram[-_MAC_BYTES:]
    if not hmac.compare_digest(_mac(content, key), mac):
        return None
    try:
        return _message(kind, boot_id, seq, content)
    except ValueError:  # a number that its enumeration does not know, text that is not ASCII
        return None


def _mac(content: bytes, key: bytes) -> bytes:
    return blake2b(content, key=key, digest_size=_MAC_BYTES).digest()


def _body(message: Datagram) -> tuple[Kind, bytes]:
    match message:
        case VehicleState():
            return Kind.VEHICLE_STATE, _STATE.pack(
                message.t_ns, message.mode, message.is_valid, message.x_m, message.y_m, message.yaw_rad,
                message.vx_mps, message.vy_mps, message.yaw_rate_radps, message.ax_mps2,
                message.steer_rad, message.drive_norm,
            )
        case ControlCommand():
            return Kind.CONTROL_COMMAND, _COMMAND.pack(
                message.state_seq, message.t_ns, message.status, message.solve_time_ns,
                message.lateral_error_m, message.heading_error_rad,
                message.steer_rad, message.drive_norm, *message.plan_steer_rad, *message.plan_drive_norm,
            )
        case OperatorRequest():
            return Kind.OPERATOR_REQUEST, _REQUEST.pack(message.operation, message.t_ns)
        case OperatorReply():
            refusals = _SEPARATOR.join(message.refusals).encode("ascii", "replace")[:_MAX_REFUSALS_BYTES]
            return Kind.OPERATOR_REPLY, _REPLY.pack(message.operation, message.mode) + refusals


def _message(kind: int, boot_id: int, seq: int, content: bytes) -> Datagram | None:
    """What a datagram of the right length says; None when a number in it is not finite, or a yes or no neither."""
    if kind == Kind.VEHICLE_STATE:
        t_ns, mode, is_valid, *numbers = _STATE.unpack_from(content, _HEADER.size)
        return VehicleState(boot_id, seq, t_ns, Mode(mode), bool(is_valid), *numbers) if is_valid in (0, 1) and _finite(numbers) else None
    if kind == Kind.CONTROL_COMMAND:
        state_seq, t_ns, status, solve_time_ns, *numbers = _COMMAND.unpack_from(content, _HEADER.size)
        lateral_error_m, heading_error_rad, steer_rad, drive_norm, *plan = numbers
        return ControlCommand(
            boot_id, seq, state_seq, t_ns, CommandStatus(status), solve_time_ns, lateral_error_m, heading_error_rad, steer_rad, drive_norm,
            tuple(plan[:HORIZON_STEPS]), tuple(plan[HORIZON_STEPS:]),
        ) if _finite(numbers) else None
    if kind == Kind.OPERATOR_REQUEST:
        operation, t_ns = _REQUEST.unpack_from(content, _HEADER.size)
        return OperatorRequest(boot_id, seq, Operation(operation), t_ns)
    operation, mode = _REPLY.unpack_from(content, _HEADER.size)
    refusals = content[_HEADER.size + _REPLY.size :].decode("ascii")
    return OperatorReply(boot_id, seq, Operation(operation), Mode(mode), tuple(refusals.split(_SEPARATOR)) if refusals else ())


def _finite(numbers: list[float]) -> bool:
    return all(map(math.isfinite, numbers))
