"""The control path between gateway and controller: fixed little-endian datagrams, newest value wins.

Every datagram: magic, version, kind, boot id of the sender, sequence number, body, CRC-32 of all before it. `unpack`
answers None to anything else, so that what comes from outside is a value or a rejection, never an exception.
Times are CLOCK_MONOTONIC and mean something on one host only.
"""

import math
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

HORIZON_STEPS = 30
"""Steering and drive demands that a command carries: the plan of the controller (N of the paper)."""
PLAN_PERIOD_NS = 40_000_000
"""Time between two demands of the plan [ns] (T_s of the paper)."""

_MAGIC = 0x4758  # "XG"
_VERSION = 1
_HEADER = struct.Struct("<HBBIQ")
_CRC = struct.Struct("<I")


class Kind(IntEnum):
    """What a datagram carries."""

    VEHICLE_STATE = 1
    CONTROL_COMMAND = 2
    OPERATOR_REQUEST = 3


class Mode(IntEnum):
    """Operating mode of the gateway."""

    STANDBY = 0
    READY = 1
    ENGAGED = 2
    SAFE_STOP = 3
    FAULT = 4


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
    steer_rad: float
    drive_norm: float
    plan_steer_rad: tuple[float, ...]
    plan_drive_norm: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class OperatorRequest:
    """A request of the operator; it acts once, when its sequence number is new."""

    boot_id: int
    seq: int
    operation: Operation


Datagram = VehicleState | ControlCommand | OperatorRequest

_STATE = struct.Struct("<QB?9d")
_COMMAND = struct.Struct(f"<QQBQ2d{HORIZON_STEPS}d{HORIZON_STEPS}d")
_REQUEST = struct.Struct("<B")


def pack(message: Datagram) -> bytes:
    """Wire form of a datagram."""
    match message:
        case VehicleState():
            kind, body = Kind.VEHICLE_STATE, _STATE.pack(
                message.t_ns, message.mode, message.is_valid, message.x_m, message.y_m, message.yaw_rad,
                message.vx_mps, message.vy_mps, message.yaw_rate_radps, message.ax_mps2,
                message.steer_rad, message.drive_norm,
            )
        case ControlCommand():
            kind, body = Kind.CONTROL_COMMAND, _COMMAND.pack(
                message.state_seq, message.t_ns, message.status, message.solve_time_ns,
                message.steer_rad, message.drive_norm, *message.plan_steer_rad, *message.plan_drive_norm,
            )
        case OperatorRequest():
            kind, body = Kind.OPERATOR_REQUEST, _REQUEST.pack(message.operation)
    content = _HEADER.pack(_MAGIC, _VERSION, kind, message.boot_id, message.seq) + body
    return content + _CRC.pack(zlib.crc32(content))


def unpack(datagram: bytes) -> Datagram | None:
    """The message in a datagram, or None when any byte of it is not as it must be."""
    if len(datagram) < _HEADER.size + _CRC.size:
        return None
    content, (crc,) = datagram[: -_CRC.size], _CRC.unpack(datagram[-_CRC.size :])
    if zlib.crc32(content) != crc:
        return None
    magic, version, kind, boot_id, seq = _HEADER.unpack_from(content)
    body = content[_HEADER.size :]
    if magic != _MAGIC or version != _VERSION:
        return None
    try:
        match kind:
            case Kind.VEHICLE_STATE:
                t_ns, mode, is_valid, *numbers = _STATE.unpack(body)
                return VehicleState(boot_id, seq, t_ns, Mode(mode), is_valid, *numbers) if _finite(numbers) else None
            case Kind.CONTROL_COMMAND:
                state_seq, t_ns, status, solve_time_ns, *numbers = _COMMAND.unpack(body)
                steer_rad, drive_norm, *plan = numbers
                if not _finite(numbers):
                    return None
                return ControlCommand(
                    boot_id, seq, state_seq, t_ns, CommandStatus(status), solve_time_ns, steer_rad, drive_norm,
                    tuple(plan[:HORIZON_STEPS]), tuple(plan[HORIZON_STEPS:]),
                )
            case Kind.OPERATOR_REQUEST:
                return OperatorRequest(boot_id, seq, Operation(_REQUEST.unpack(body)[0]))
    except (struct.error, ValueError):
        return None
    return None


def _finite(numbers: list[float]) -> bool:
    return all(map(math.isfinite, numbers))
