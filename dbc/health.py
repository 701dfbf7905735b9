"""What is known of the health of a bus, as a value: the link measures it, whoever decides reads it."""

from dataclasses import dataclass
from enum import Enum


class BusState(Enum):
    """State of our CAN controller on a bus (ISO 11898-1 fault confinement), or that there is no bus any more."""

    ERROR_ACTIVE = "error-active"
    ERROR_WARNING = "error-warning"
    ERROR_PASSIVE = "error-passive"
    BUS_OFF = "bus-off"
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class LinkHealth:
    """One bus as its link sees it at one moment.

    Args:
        tx_error_count, rx_error_count: error counters of the controller; -1 where the interface does not tell.
        unconfirmed_ns: age of the oldest own frame that was handed over and has not been seen on the bus, or that was refused, as were
            all since [ns]; 0 when there is none.
        bus_offs: times that the controller went bus-off since the start.
        last_bus_off_ns: monotonic time of the last one [ns]; None when there was none.
    """

    state: BusState = BusState.ERROR_ACTIVE
    tx_error_count: int = -1
    rx_error_count: int = -1
    unconfirmed_ns: int = 0
    bus_offs: int = 0
    last_bus_off_ns: int | None = None


WELL = LinkHealth()
"""A bus without any trouble."""
