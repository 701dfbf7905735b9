"""Packet between the hub and a node: one frame with its time stamp, always of the same size."""

import struct

from vehicle_emulator.bus.core import BITRATE_SWITCH, ERROR, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

HELLO = b"xilgate bus 1"
"""First packet from the hub to a node that has joined; the number is the version of the packet layout."""

_LAYOUT = struct.Struct("<qIBB64s")
PACKET_BYTES = _LAYOUT.size

_ALL_FLAGS = EXTENDED | REMOTE | FD | ERROR | BITRATE_SWITCH | ERROR_STATE_INDICATOR
_MAX_STANDARD_ID = 0x7FF
_MAX_EXTENDED_ID = 0x1FFFFFFF
_CLASSICAL_LENGTHS = frozenset(range(9))
# ISO 11898-1: data length codes 9 to 15 of CAN FD.
_FD_LENGTHS = _CLASSICAL_LENGTHS | {12, 16, 20, 24, 32, 48, 64}


class WireError(ValueError):
    """A packet or frame that no CAN bus could carry; the text says why."""


def pack(frame: BusFrame, t_ns: int) -> bytes:
    """Packet for a frame.

    Args:
        frame: the frame.
        t_ns: time stamp since the epoch [ns]; 0 from a node, whose frames get theirs from the hub.

    Raises:
        WireError: identifier, length or flags that do not fit together.
    """
    _check(frame)
    return _LAYOUT.pack(t_ns, frame.arbitration_id, frame.flags, frame.length_bytes, frame.data)


def unpack(packet: bytes) -> tuple[BusFrame, int]:
    """Frame and time stamp [ns since the epoch] of a packet.

    Raises:
        WireError: wrong size, or a frame that cannot be.
    """
    if len(packet) != PACKET_BYTES:
        raise WireError(f"packet of {len(packet)} bytes, expected {PACKET_BYTES}")
    t_ns, arbitration_id, flags, length_bytes, data = _LAYOUT.unpack(packet)
    frame = BusFrame(arbitration_id, b"" if flags & REMOTE else data[:length_bytes], flags, length_bytes)
    _check(frame)
    return frame, t_ns


def _check(frame: BusFrame) -> None:
    max_id = _MAX_EXTENDED_ID if frame.flags & EXTENDED else _MAX_STANDARD_ID
    # Error frames report their class in an identifier of 29 bits whatever their format, as in SocketCAN.
    if frame.flags & ERROR:
        max_id = _MAX_EXTENDED_ID
    if not 0 <= frame.arbitration_id <= max_id:
        raise WireError(f"arbitration id 0x{frame.arbitration_id:X} outside [0, 0x{max_id:X}]")
    if frame.flags & ~_ALL_FLAGS:
        raise WireError(f"unknown flags 0x{frame.flags:X}")
    if frame.length_bytes not in (_FD_LENGTHS if frame.flags & FD else _CLASSICAL_LENGTHS):
        raise WireError(f"{'CAN FD' if frame.flags & FD else 'CAN'} frame of {frame.length_bytes} bytes")
    if len(frame.data) != (0 if frame.flags & REMOTE else frame.length_bytes):
        raise WireError(f"{len(frame.data)} bytes of data in a frame of length {frame.length_bytes}")
