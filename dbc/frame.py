"""The CAN frame as every core of xilgate sees it."""

from typing import NamedTuple


class CanFrame(NamedTuple):
    """One classical CAN data frame with an 11-bit identifier.

    Args:
        arbitration_id: identifier, 0 to 0x7FF.
        data: payload, 0 to 8 bytes.
        t_ns: monotonic time at which the frame was received or handed to the bus [ns].
    """

    arbitration_id: int
    data: bytes
    t_ns: int
