"""Fault confinement of one node: its two error counters and the state that follows from them (ISO 11898-1:2015, 12.1.4)."""

from dataclasses import dataclass
from enum import IntEnum

WARNING_LIMIT = 96
PASSIVE_LIMIT = 128
BUS_OFF_LIMIT = 256
RECOVERY_SEQUENCES = 128
"""Times 11 consecutive recessive bits that a node in bus-off waits for before it takes part again."""
SEQUENCE_BITS = 11

_TRANSMIT_STEP = 8
# The standard allows 119 to 127 for a receiver that was error passive and has received a frame well.
_REC_AFTER_PASSIVE = 127


class ErrorState(IntEnum):
    """State of a node; warning is error active with a counter at 96 or more."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


def _state_of(count: int) -> ErrorState:
    if count < WARNING_LIMIT:
        return ErrorState.ACTIVE
    return ErrorState.WARNING if count < PASSIVE_LIMIT else ErrorState.PASSIVE


@dataclass(slots=True)
class ErrorCounters:
    """Transmit and receive error counter."""

    tec: int = 0
    rec: int = 0

    @property
    def tx_state(self) -> ErrorState:
        """State by the transmit error counter alone."""
        return ErrorState.BUS_OFF if self.is_off else _state_of(self.tec)

    @property
    def rx_state(self) -> ErrorState:
        """State by the receive error counter alone."""
        return _state_of(self.rec)

    @property
    def state(self) -> ErrorState:
        """State of the node."""
        return max(self.tx_state, self.rx_state)

    @property
    def is_passive(self) -> bool:
        """Error passive or bus-off: the node sends no dominant error flag, and suspends transmission."""
        return self.tec >= PASSIVE_LIMIT or self.rec >= PASSIVE_LIMIT

    @property
    def is_off(self) -> bool:
        """Bus-off."""
        return self.tec >= BUS_OFF_LIMIT

    def sent(self) -> None:
        """A frame was transmitted well."""
        if self.tec:
            self.tec -= 1

    def received(self) -> None:
        """A frame was received well."""
        if self.rec:
            self.rec = _REC_AFTER_PASSIVE if self.rec >= PASSIVE_LIMIT else self.rec - 1

    def transmit_failed(self) -> None:
        """The node sent an error flag as a transmitter."""
        self.tec += _TRANSMIT_STEP

    def unacknowledged(self) -> None:
        """Nobody acknowledged. An error passive transmitter does not count it: it is perhaps alone, which is no fault of its own."""
        if not self.is_passive:
            self.transmit_failed()

    def receive_failed(self) -> None:
        """The node detected an error as a receiver."""
        # From the limit on the value has no further meaning, so it stays there, as in controllers with 7 bits for it.
        self.rec = min(self.rec + 1, PASSIVE_LIMIT)

    def reset(self) -> None:
        """Bus-off is over."""
        self.tec = self.rec = 0
