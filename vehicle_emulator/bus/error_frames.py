"""What a node is told about errors: frames laid out as SocketCAN's error frames (linux/can/error.h)."""

from vehicle_emulator.bus.confinement import ErrorCounters, ErrorState
from vehicle_emulator.bus.frame import ERROR, BusFrame

# Classes, in the identifier.
CONTROLLER = 1 << 2
PROTOCOL = 1 << 3
NO_ACKNOWLEDGE = 1 << 5
BUS_OFF = 1 << 6
BUS_ERROR = 1 << 7
RESTARTED = 1 << 8
COUNTERS = 1 << 9

_LENGTH_BYTES = 8
# data[1]: the side whose counter is the higher says what it has reached; both when they have reached the same.
_TX_STATUS = {ErrorState.ACTIVE: 0x40, ErrorState.WARNING: 0x08, ErrorState.PASSIVE: 0x20}
_RX_STATUS = {ErrorState.ACTIVE: 0x40, ErrorState.WARNING: 0x04, ErrorState.PASSIVE: 0x10}
_STATE_OF_STATUS = (
    (_TX_STATUS[ErrorState.PASSIVE] | _RX_STATUS[ErrorState.PASSIVE], ErrorState.PASSIVE),
    (_TX_STATUS[ErrorState.WARNING] | _RX_STATUS[ErrorState.WARNING], ErrorState.WARNING),
    (_TX_STATUS[ErrorState.ACTIVE], ErrorState.ACTIVE),
)
# data[2] and data[3]: kind and place of a bus error.
_BIT_ERROR_WHILE_SENDING = 0x01 | 0x80
_STUFF_ERROR = 0x04
_IN_CRC_SEQUENCE = 0x08
_IN_ACKNOWLEDGE_SLOT = 0x19


def state_changed(counters: ErrorCounters) -> BusFrame:
    """The node has entered the state that its counters say."""
    if counters.state is ErrorState.BUS_OFF:
        return _frame(BUS_OFF, counters)
    tx, rx = counters.tx_state, counters.rx_state
    status = (_TX_STATUS[tx] if tx >= rx else 0) | (_RX_STATUS[rx] if rx >= tx else 0)
    return _frame(CONTROLLER, counters, status)


def restarted(counters: ErrorCounters) -> BusFrame:
    """The node takes part again after bus-off."""
    return _frame(RESTARTED, counters)


def destroyed(counters: ErrorCounters, is_sender: bool) -> BusFrame:
    """A frame was destroyed on the wire while the node sent or received it."""
    return _frame(PROTOCOL | BUS_ERROR, counters, 0, _BIT_ERROR_WHILE_SENDING if is_sender else _STUFF_ERROR, _IN_CRC_SEQUENCE)


def unacknowledged(counters: ErrorCounters) -> BusFrame:
    """Nobody acknowledged the frame that the node sent."""
    return _frame(NO_ACKNOWLEDGE | BUS_ERROR, counters, 0, 0, _IN_ACKNOWLEDGE_SLOT)


def state_in(frame: BusFrame) -> ErrorState | None:
    """State of its receiver that an error frame tells; None when it tells none."""
    if frame.arbitration_id & BUS_OFF:
        return ErrorState.BUS_OFF
    if frame.arbitration_id & RESTARTED:
        return ErrorState.ACTIVE
    if frame.arbitration_id & CONTROLLER:
        return next((state for status, state in _STATE_OF_STATUS if frame.data[1] & status), None)
    return None


def _frame(classes: int, counters: ErrorCounters, *details: int) -> BusFrame:
    """`details` are data[1] and what follows it."""
    data = bytes((0, *details)).ljust(6, b"\0") + bytes((min(counters.tec, 255), counters.rec))
    return BusFrame(classes | COUNTERS, data, ERROR, _LENGTH_BYTES)
