"""When to try to come back onto a bus: after bus-off a few times and then never without the operator, after an interface was lost always.

A controller that comes back after bus-off disturbs whoever is on the bus if the reason still stands, so it may do so only
three times. Looking whether an interface is there again disturbs nobody.
"""

from dbc.health import BusState

_MS = 1_000_000
BUS_OFF_DELAYS_NS = (100 * _MS, 500 * _MS, 2_500 * _MS)
"""Wait before each attempt to leave bus-off [ns]; there are no more than these until the operator says so."""
REOPENING_DELAYS_NS = (100 * _MS, 200 * _MS, 500 * _MS, 1_000 * _MS, 2_000 * _MS)
"""Wait before each attempt to open a bus that is down [ns]; the last of them goes on."""


class Recovery:
    """Attempts to leave bus-off. A controller that its driver restarts by itself uses them up as well."""

    def __init__(self) -> None:
        self._made = 0
        self._armed_at = 0
        self._due_ns: int | None = None

    def has_given_up(self, bus_offs: int) -> bool:
        """Whether the controller has gone bus-off again after the last attempt.

        Args:
            bus_offs: times that it has, since the start.
        """
        return bus_offs - self._armed_at > len(BUS_OFF_DELAYS_NS)

    def is_due(self, state: BusState, bus_offs: int, now_ns: int) -> bool:
        """Whether to try now; a True counts as an attempt."""
        if state is not BusState.BUS_OFF:
            self._due_ns = None
            return False
        made = max(self._made, bus_offs - self._armed_at - 1)
        if made >= len(BUS_OFF_DELAYS_NS):
            return False
        if self._due_ns is None:
            self._due_ns = now_ns + BUS_OFF_DELAYS_NS[made]
        if now_ns < self._due_ns:
            return False
        self._made, self._due_ns = made + 1, None
        return True

    def rearm(self, state: BusState, bus_offs: int) -> None:
        """The operator allows all attempts again; a bus-off that lasts is the first that they are for."""
        self._made = 0
        self._armed_at = bus_offs - (state is BusState.BUS_OFF)
        self._due_ns = None


class Reopening:
    """Attempts to open a bus that is down."""

    def __init__(self) -> None:
        self._made = 0
        self._due_ns: int | None = None

    def is_due(self, state: BusState, now_ns: int) -> bool:
        """Whether to try now; a True counts as an attempt."""
        if state is not BusState.DOWN:
            self.rearm()
            return False
        if self._due_ns is None:
            self._due_ns = now_ns + REOPENING_DELAYS_NS[min(self._made, len(REOPENING_DELAYS_NS) - 1)]
        if now_ns < self._due_ns:
            return False
        self._made += 1
        self._due_ns = None
        return True

    def rearm(self) -> None:
        """Begin again with the shortest wait."""
        self._made, self._due_ns = 0, None
