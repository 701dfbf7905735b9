"""A frame on the emulated bus, and its rank in arbitration."""

from typing import NamedTuple

EXTENDED = 0x01
"""29-bit identifier."""
REMOTE = 0x02
"""Remote frame: asks for data and carries none."""
FD = 0x04
"""CAN FD frame."""
ERROR = 0x08
"""Report of an error to one node, laid out as SocketCAN's error frames; never on the wire."""
BITRATE_SWITCH = 0x10
"""CAN FD data phase at the higher bit rate."""
ERROR_STATE_INDICATOR = 0x20
"""CAN FD sender is error passive."""


class BusFrame(NamedTuple):
    """One frame of any kind on the bus.

    Args:
        arbitration_id: identifier, 11 or 29 bits.
        data: payload, up to 8 bytes, up to 64 in CAN FD; empty in a remote frame.
        flags: sum of the flags of this module.
        length_bytes: payload length; in a remote frame the length asked for.
    """

    arbitration_id: int
    data: bytes
    flags: int
    length_bytes: int


def arbitration_key(frame: BusFrame) -> int:
    """The arbitration field as one number: of the nodes that start together, the one with the lowest goes on.

    With the same base identifier a data frame comes before a remote frame, and a standard frame before an extended one.
    """
    remote = 1 if frame.flags & REMOTE else 0
    if not frame.flags & EXTENDED:
        # Identifier, RTR, and IDE, which is dominant; the rest is as wide as an extended frame's.
        return frame.arbitration_id << 21 | remote << 20
    base, extension = frame.arbitration_id >> 18, frame.arbitration_id & 0x3FFFF
    # Base identifier, SRR and IDE, both recessive, the 18 bits that follow, and RTR.
    return base << 21 | 0b11 << 19 | extension << 1 | remote
