"""One node of the emulated bus: its mailboxes, its error counters and its way out of bus-off."""

from dataclasses import dataclass, field
from heapq import heappop, heappush

from vehicle_emulator.bus.confinement import RECOVERY_SEQUENCES, ErrorCounters, ErrorState
from vehicle_emulator.bus.frame import BusFrame

Request = tuple[int, int, BusFrame]
"""A frame to send: its rank in arbitration, the order in which it was handed over, the frame."""


@dataclass(slots=True)
class NodeStatistics:
    """What one node has done and met.

    Args:
        transmitted: frames sent well.
        received: frames heard well and taken.
        lost: frames heard that the node was too slow to take.
        refused: frames refused because its queue was full or it was in bus-off.
        errors: attempts to send a frame, its own or another's, that failed while it took part.
        counters: its error counters.
    """

    transmitted: int = 0
    received: int = 0
    lost: int = 0
    refused: int = 0
    errors: int = 0
    counters: ErrorCounters = field(default_factory=ErrorCounters)

    @property
    def tec(self) -> int:
        """Transmit error counter."""
        return self.counters.tec

    @property
    def rec(self) -> int:
        """Receive error counter."""
        return self.counters.rec

    @property
    def state(self) -> ErrorState:
        """State of fault confinement."""
        return self.counters.state


class Recovery:
    """Wait of a node in bus-off for 128 sequences of 11 recessive bits.

    Args:
        begin_ns: time from which they count [ns].
        sequence_ns: duration of one [ns].
    """

    def __init__(self, begin_ns: int, sequence_ns: int) -> None:
        self._begin_ns = self._recessive_since_ns = begin_ns
        self._sequence_ns = sequence_ns
        self._missing = RECOVERY_SEQUENCES

    def has_begun(self, now_ns: int) -> bool:
        """Whether recessive bits count already."""
        return self._begin_ns <= now_ns

    @property
    def end_ns(self) -> int:
        """When the node takes part again, if the bus stays idle [ns]."""
        return self._recessive_since_ns + self._missing * self._sequence_ns

    def interrupt(self, start_ns: int) -> None:
        """Somebody starts to send."""
        self._missing -= max(0, start_ns - self._recessive_since_ns) // self._sequence_ns

    def resume(self, idle_ns: int) -> None:
        """The bus becomes idle; the 11 recessive bits before are a sequence: delimiter, end of frame and intermission."""
        self._recessive_since_ns = max(self._begin_ns, idle_ns - self._sequence_ns)


@dataclass(slots=True, eq=False)
class Node:
    """A node as the bus core sees it.

    Args:
        number: its name for the caller.
        statistics: what the caller may look at.
        queue: pending frames, a heap; the one on the wire is not among them.
        on_wire: the frame that is being sent.
        suspended_until_ns: end of its suspended transmission [ns].
        restart_ns: time in bus-off after which it recovers by itself [ns]; None: never.
        reports_bus_errors: whether it is told of every error.
        counters: those of `statistics`.
    """

    number: int
    statistics: NodeStatistics = field(default_factory=NodeStatistics)
    queue: list[Request] = field(default_factory=list)
    on_wire: Request | None = None
    suspended_until_ns: int = 0
    restart_ns: int | None = None
    reports_bus_errors: bool = False
    counters: ErrorCounters = field(init=False)

    def __post_init__(self) -> None:
        self.counters = self.statistics.counters

    @property
    def pending(self) -> int:
        """Frames not sent yet."""
        return len(self.queue) + (self.on_wire is not None)

    def put(self, request: Request) -> None:
        """Take a frame to send."""
        heappush(self.queue, request)

    def start(self) -> None:
        """The first of its frames goes onto the wire."""
        self.on_wire = heappop(self.queue)

    def retry(self) -> None:
        """The frame on the wire failed and is pending again, in its old place."""
        if self.on_wire is not None:
            heappush(self.queue, self.on_wire)
            self.on_wire = None
