"""State of our CAN controller on one bus, followed through all that tells of it: error frames, the driver, refusals, frames that arrive."""

import errno

from dbc import error_frames
from dbc.health import BusState, LinkHealth

_BUS_HAS_GONE = frozenset(
    {
        *(errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EIO, errno.EBADF),
        *(errno.EPIPE, errno.ECONNRESET, errno.ENOTCONN, errno.ESHUTDOWN),
    }
)
"""Refusals after which nothing can be sent or heard: the interface is down or was removed, the hub has gone. Any other one, of which
ENOBUFS is by far the most frequent, is of the one frame."""


class BusMonitor:
    """Follows one controller.

    Attributes:
        state: as far as it is known.
        bus_offs: times that it has gone bus-off.
        bus_errors: error frames that told of a destroyed or an unacknowledged frame.
        overflows: error frames that told of frames lost in the controller.
    """

    def __init__(self) -> None:
        self.state = BusState.ERROR_ACTIVE
        self.bus_offs = 0
        self.bus_errors = 0
        self.overflows = 0
        self._last_bus_off_ns: int | None = None
        self._tx_error_count = self._rx_error_count = -1

    def error_frame(self, classes: int, data: bytes, now_ns: int) -> None:
        """An error frame has arrived."""
        report = error_frames.read(classes, data)
        self.bus_errors += report.is_bus_error
        self.overflows += report.is_overflow
        if report.tx_error_count >= 0:
            self._tx_error_count, self._rx_error_count = report.tx_error_count, report.rx_error_count
        # Out of bus-off leads a restart alone: the kernel's slcan driver, for one, tells of an active controller and still sends nothing.
        if report.state is not None and (self.state is not BusState.BUS_OFF or classes & error_frames.RESTARTED):
            self._enter(report.state, now_ns)

    def told(self, state: BusState, tx_error_count: int, rx_error_count: int, now_ns: int) -> None:
        """The driver has told its state now; counters -1 where it has none."""
        if tx_error_count >= 0:
            self._tx_error_count, self._rx_error_count = tx_error_count, rx_error_count
        self._enter(state, now_ns)

    def refused(self, error_number: int, now_ns: int) -> None:
        """The bus has refused to take or to deliver a frame."""
        if error_number in _BUS_HAS_GONE:
            self._enter(BusState.DOWN, now_ns)

    def came_up(self, now_ns: int) -> None:
        """The bus was opened anew, or a frame has arrived: it is not down. That leads out of no other state."""
        if self.state is BusState.DOWN:
            self._enter(BusState.ERROR_ACTIVE, now_ns)

    def health(self, unconfirmed_ns: int, is_given_up: bool) -> LinkHealth:
        """All that is known.

        Args:
            unconfirmed_ns: see `LinkHealth`.
            is_given_up: it has gone bus-off too often and stays there for us, whatever its driver does.
        """
        state = BusState.BUS_OFF if is_given_up and self.state is not BusState.DOWN else self.state
        return LinkHealth(state, self._tx_error_count, self._rx_error_count, unconfirmed_ns, self.bus_offs, self._last_bus_off_ns)

    def _enter(self, state: BusState, now_ns: int) -> None:
        if state is self.state:
            return
        if state is BusState.BUS_OFF:
            self.bus_offs += 1
            self._last_bus_off_ns = now_ns
        elif state is BusState.DOWN:
            self._tx_error_count = self._rx_error_count = -1
        self.state = state
