"""What an error frame says of our CAN controller: SocketCAN's layout (linux/can/error.h), which the emulated bus shares."""

from typing import NamedTuple

from dbc.health import BusState

# Classes, in the identifier.
CONTROLLER = 0x004
PROTOCOL = 0x008
TRANSCEIVER = 0x010
NO_ACKNOWLEDGE = 0x020
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100
COUNTERS = 0x200

_LENGTH_BYTES = 8
# data[1] of the class CONTROLLER.
_OVERFLOW = 0x01 | 0x02
_STATE_OF_STATUS = (
    (0x10 | 0x20, BusState.ERROR_PASSIVE),
    (0x04 | 0x08, BusState.ERROR_WARNING),
    (0x40, BusState.ERROR_ACTIVE),
)
# ISO 11898-1:2015, 12.1.4: a counter from which the controller is in the state.
_STATE_OF_COUNT = ((128, BusState.ERROR_PASSIVE), (96, BusState.ERROR_WARNING), (0, BusState.ERROR_ACTIVE))


class ErrorReport(NamedTuple):
    """One error frame, read.

    Args:
        state: that the controller has entered; None when the frame tells of none.
        tx_error_count, rx_error_count: error counters; -1 when the frame tells of none.
        is_bus_error: something went wrong on the wire: a frame was destroyed, or nobody acknowledged.
        is_overflow: the controller has lost frames, because it was not read or could not send them.
    """

    state: BusState | None
    tx_error_count: int
    rx_error_count: int
    is_bus_error: bool
    is_overflow: bool


def read(classes: int, data: bytes) -> ErrorReport:
    """Read an error frame; one that is too short is read as if it were filled with zeros.

    Args:
        classes: its identifier, without the flag that makes it an error frame.
    """
    data = data.ljust(_LENGTH_BYTES, b"\0")
    tx, rx = (data[6], data[7]) if classes & COUNTERS else (-1, -1)
    return ErrorReport(
        state=_state(classes, data[1], max(tx, rx)),
        tx_error_count=tx,
        rx_error_count=rx,
        is_bus_error=bool(classes & (PROTOCOL | TRANSCEIVER | NO_ACKNOWLEDGE | BUS_ERROR)),
        is_overflow=bool(classes & CONTROLLER and data[1] & _OVERFLOW),
    )


def _state(classes: int, status: int, error_count: int) -> BusState | None:
    """State that is told, and where none is, the one that follows from the counters."""
    if classes & BUS_OFF:
        return BusState.BUS_OFF
    if classes & RESTARTED:
        return BusState.ERROR_ACTIVE
    if classes & CONTROLLER:
        for bits, state in _STATE_OF_STATUS:
            if status & bits:
                return state
    return next((state for limit, state in _STATE_OF_COUNT if error_count >= limit), None)
