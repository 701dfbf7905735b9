"""Packets between the hub and a node: frames with their time in a fixed layout, and everything rare as a MessagePack object."""

import struct
from collections.abc import Iterable
from typing import Annotated

import msgspec

from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

VERSION = 3
"""Of the packets; hub and node refuse each other when theirs differ."""
MAX_PACKET_BYTES = 4096
MAX_FILTERS = 64

OWN = 0x40
"""Flag of a packet, beside those of its frame: the node that it goes to has sent this frame itself."""

_FRAME, _CONTROL = 1, 2
# Kind of packet, flags, length, nothing, identifier, time; the data follow.
_HEADER = struct.Struct("<BBBxIq")
_HEADER_BYTES = _HEADER.size
_CONTROL_KIND = bytes((_CONTROL,))

_FRAME_FLAGS = EXTENDED | REMOTE | FD | ERROR | BITRATE_SWITCH | ERROR_STATE_INDICATOR
_FD_FLAGS = BITRATE_SWITCH | ERROR_STATE_INDICATOR
_MAX_STANDARD_ID = 0x7FF
_MAX_EXTENDED_ID = 0x1FFFFFFF
_CLASSICAL_LENGTHS = frozenset(range(9))
# ISO 11898-1: data length codes 9 to 15 of CAN FD.
_FD_LENGTHS = _CLASSICAL_LENGTHS | {12, 16, 20, 24, 32, 48, 64}

Identifier = Annotated[int, msgspec.Meta(ge=0, le=_MAX_EXTENDED_ID)]


class WireError(ValueError):
    """A packet or frame that no CAN bus could carry; the text says why."""


class Hello(msgspec.Struct, frozen=True, tag=True, forbid_unknown_fields=True):
    """First packet in either direction: the node asks to join; the hub answers when it has.

    Args:
        version: of the packets that the sender speaks.
    """

    version: int


class Filter(msgspec.Struct, frozen=True, array_like=True):
    """One filter of python-can.

    Args:
        can_id: identifier.
        can_mask: bits of it that count.
        extended: whether only frames with an extended identifier pass, or only those without; None: both.
    """

    can_id: int
    can_mask: int
    extended: bool | None


def named_ids(filters: Iterable[Filter]) -> frozenset[int]:
    """Identifiers that filters name and let pass in standard frames: most frames are judged by these, without a look at every filter."""
    return frozenset(one.can_id for one in filters if not one.extended)


class Settings(msgspec.Struct, frozen=True, tag=True, forbid_unknown_fields=True):
    """What a node wants to hear.

    Args:
        filters: frames that match none of them are not sent to it; None: everything is.
        own_frames: whether it hears the frames that it has sent, when they are through.
        bus_errors: whether it is told of every error, and not of changes of its state alone.
        restart_ms: time after which it leaves bus-off by itself [ms], 0: never; None: as the hub has it.
    """

    filters: Annotated[tuple[Filter, ...], msgspec.Meta(max_length=MAX_FILTERS)] | None = None
    own_frames: bool = False
    bus_errors: bool = False
    restart_ms: Annotated[int, msgspec.Meta(ge=0, le=3_600_000)] | None = None


class Restart(msgspec.Struct, frozen=True, tag=True, forbid_unknown_fields=True):
    """The node asks to leave bus-off."""


class Disturb(msgspec.Struct, frozen=True, tag=True, forbid_unknown_fields=True):
    """Destroy the next attempts to send a frame on the wire.

    Args:
        arbitration_id: of the frames; None for any.
        count: attempts; 0 takes back what is left.
    """

    arbitration_id: Identifier | None
    count: Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]


Control = Hello | Settings | Restart | Disturb

_encode = msgspec.msgpack.Encoder().encode
_DECODER: msgspec.msgpack.Decoder[Control] = msgspec.msgpack.Decoder(Control)


def pack(frame: BusFrame, t_ns: int, *, is_own: bool = False) -> bytes:
    """Packet for a frame.

    Args:
        frame: the frame; `check` says whether it can be.
        t_ns: to the hub: monotonic time of the request [ns], 0 if unknown. To a node: end of the frame since the epoch [ns].
        is_own: whether it goes back to the node that has sent it.
    """
    flags = frame.flags | OWN if is_own else frame.flags
    return _HEADER.pack(_FRAME, flags, frame.length_bytes, frame.arbitration_id, t_ns) + frame.data


def pack_control(control: Control) -> bytes:
    """Packet for anything but a frame."""
    return _CONTROL_KIND + _encode(control)


def unpack(packet: bytes) -> tuple[BusFrame, int, bool] | Control:
    """What is in a packet: a control object, or a frame with its time [ns] and whether it is the receiver's own.

    Raises:
        WireError: no packet of this protocol, or a frame that cannot be.
    """
    if packet[:1] == _CONTROL_KIND:
        try:
            return _DECODER.decode(packet[1:])
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise WireError(f"control packet: {error}") from error
    if len(packet) < _HEADER_BYTES:
        raise WireError(f"packet of {len(packet)} bytes, expected {_HEADER_BYTES} or more")
    kind, flags, length_bytes, arbitration_id, t_ns = _HEADER.unpack_from(packet)
    if kind != _FRAME:
        raise WireError(f"packet of kind {kind}")
    frame = BusFrame(arbitration_id, packet[_HEADER_BYTES:], flags & ~OWN, length_bytes)
    check(frame)
    return frame, t_ns, bool(flags & OWN)


def check(frame: BusFrame) -> None:
    """Refuse a frame that no bus carries.

    Raises:
        WireError: identifier, length, data or flags that do not fit together.
    """
    arbitration_id, data, flags, length_bytes = frame
    max_id = _MAX_EXTENDED_ID if flags & EXTENDED else _MAX_STANDARD_ID
    if not 0 <= arbitration_id <= max_id:
        raise WireError(f"arbitration id 0x{arbitration_id:X} outside [0, 0x{max_id:X}]")
    if flags & ~_FRAME_FLAGS:
        raise WireError(f"unknown flags 0x{flags:X}")
    if flags & FD and flags & REMOTE:
        raise WireError("remote frame in CAN FD, which has none")
    if flags & _FD_FLAGS and not flags & FD:
        raise WireError("bit rate switch or error state indicator in a classical frame")
    if length_bytes not in (_FD_LENGTHS if flags & FD else _CLASSICAL_LENGTHS):
        raise WireError(f"{'CAN FD' if flags & FD else 'CAN'} frame of {length_bytes} bytes")
    if len(data) != (0 if flags & REMOTE else length_bytes):
        raise WireError(f"{len(data)} bytes of data in a frame of length {length_bytes}")
