"""Emulated CAN bus, pure part: which node may send when, who hears what, and what errors do to whom.

It follows ISO 11898-1 to the length of every frame; single bits are not simulated. A node sends its pending frames in the order
of their identifiers, as a controller with enough mailboxes does. Where it idealises, docs/bus.md says so.
"""

from collections.abc import Callable
from itertools import count
from typing import NamedTuple

from dbc.frame_length import CLASSICAL_TAIL_BITS, INTERMISSION_BITS
from vehicle_emulator.bus import error_frames
from vehicle_emulator.bus.attempt import DELIMITER_BITS, FLAG_BITS, Attempt, BitTiming, Outcome, arbitrate
from vehicle_emulator.bus.confinement import SEQUENCE_BITS, ErrorCounters
from vehicle_emulator.bus.frame import BusFrame, arbitration_key
from vehicle_emulator.bus.load import LoadMeter
from vehicle_emulator.bus.node import Node, NodeStatistics, Recovery

DEFAULT_BITRATE_BPS = 500_000
DEFAULT_DATA_BITRATE_BPS = 2_000_000
QUEUE_FRAMES = 64
"""Pending frames of one node; further ones are refused, as by a full transmit queue."""
LOAD_WINDOW_NS = 1_000_000_000

_SUSPEND_BITS = 8


class Delivery(NamedTuple):
    """A frame that arrives at all its receivers at the same time, or an error frame that tells one node what has happened.

    Args:
        frame: the frame as its receivers see it.
        t_ns: time of its end on the bus, on the caller's clock [ns].
        receivers: nodes that hear it, without those that have sent it.
        senders: nodes that have sent it; none of an error frame.
    """

    frame: BusFrame
    t_ns: int
    receivers: tuple[int, ...]
    senders: tuple[int, ...] = ()


class BusCore:
    """Nodes on one bus.

    Time is on the caller's clock and never decreases. Calling it for a node that has not joined is the caller's mistake and
    raises `KeyError`.

    Args:
        bitrate_bps: nominal bit rate [bit/s].
        data_bitrate_bps: bit rate of the data phase of CAN FD frames that switch [bit/s].
        queue_frames: pending frames that a node may have.
        restart_ms: time after which a node leaves bus-off by itself [ms]; None: only when asked to.
    """

    def __init__(
        self,
        bitrate_bps: int = DEFAULT_BITRATE_BPS,
        data_bitrate_bps: int = DEFAULT_DATA_BITRATE_BPS,
        *,
        queue_frames: int = QUEUE_FRAMES,
        restart_ms: int | None = None,
    ) -> None:
        # Whole nanoseconds: at the usual bit rates exact, and otherwise nearer than any oscillator.
        self.timing = BitTiming(round(1e9 / bitrate_bps), round(1e9 / data_bitrate_bps))
        self._queue_frames = queue_frames
        self._restart_ms = restart_ms
        self._members: dict[int, Node] = {}
        self._statistics: dict[int, NodeStatistics] = {}
        self._online: tuple[Node, ...] = ()
        self._recovering: dict[int, Recovery] = {}
        self._requests = count()
        self._disturbances: dict[int | None, int] = {}
        self._attempt: Attempt | None = None
        self._plan: Attempt | None = None
        self._outbox: list[Delivery] = []
        self._load = LoadMeter(LOAD_WINDOW_NS)
        self._origin_ns: int | None = None
        self._now_ns = 0
        self._idle_ns = 0

    @property
    def nodes(self) -> dict[int, NodeStatistics]:
        """Statistics of the nodes that are on the bus."""
        return self._statistics

    @property
    def now_ns(self) -> int:
        """The latest time that it was told [ns]."""
        return self._now_ns

    @property
    def disturbed_ids(self) -> int:
        """Identifiers with a disturbance that is not used up."""
        return len(self._disturbances)

    def join(self, node: int) -> None:
        """Connect a node; it hears every frame that begins from now on."""
        if node in self._members:
            raise ValueError(f"node {node} has joined already")
        member = self._members[node] = Node(node)
        self._statistics[node] = member.statistics
        self.set_restart(node, self._restart_ms)
        self._go_online()

    def leave(self, node: int) -> NodeStatistics:
        """Disconnect a node and return its final statistics; what it has not sent yet is lost."""
        member = self._members.pop(node)
        self._recovering.pop(node, None)
        self._go_online()
        if (attempt := self._attempt) is not None:
            attempt.receivers = tuple(other for other in attempt.receivers if other is not member)
            attempt.beaten = tuple(other for other in attempt.beaten if other is not member)
            if member in attempt.senders:
                attempt.senders = tuple(other for other in attempt.senders if other is not member)
                self._break_off(attempt)
        return self._statistics.pop(node)

    def pending(self, node: int) -> int:
        """Frames of a node that are not sent yet."""
        return self._members[node].pending

    def room(self, node: int) -> int:
        """Frames that may be handed over until the node's queue is full."""
        return self._queue_frames - self._members[node].pending

    def set_restart(self, node: int, restart_ms: int | None) -> None:
        """Set after what time in bus-off the node recovers by itself [ms]; None: only when asked to."""
        self._members[node].restart_ns = None if restart_ms is None else restart_ms * 1_000_000

    def report_bus_errors(self, node: int, is_on: bool) -> None:
        """Set whether the node is told of every single error, and not of changes of its state alone."""
        self._members[node].reports_bus_errors = is_on

    def transmit(self, node: int, frame: BusFrame, now_ns: int) -> bool:
        """Hand a frame to a node's controller.

        Args:
            node: its sender.
            frame: the frame; no error frame.
            now_ns: time of the request [ns].

        Returns:
            Whether it was taken: the queue has room and the node is not in bus-off.
        """
        self._run(now_ns)
        member = self._members[node]
        if member.pending >= self._queue_frames or member.counters.is_off:
            member.statistics.refused += 1
            return False
        member.put((arbitration_key(frame), next(self._requests), frame))
        self._plan = None
        return True

    def advance(self, now_ns: int) -> list[Delivery]:
        """Let time pass.

        Returns:
            What has arrived by `now_ns` since the last call, in the order of time, error frames included.
        """
        self._run(now_ns)
        deliveries, self._outbox = self._outbox, []
        return deliveries

    def next_event_ns(self) -> int | None:
        """Time at which `advance` has something to tell, or an attempt fails [ns]; None while nothing can happen.

        The attempts of an error passive node that nobody acknowledges go on without end and change nothing; they are no events.
        """
        if self._outbox:
            return self._now_ns
        times_ns = [recovery.end_ns for recovery in self._recovering.values()] if self._attempt is None else []
        attempt = self._expected()
        if attempt is not None and not self._is_futile(attempt):
            times_ns.append(attempt.end_ns)
        return min(times_ns, default=None)

    def disturb(self, arbitration_id: int | None, count: int) -> None:
        """Destroy the next attempts to send a frame by a bit error; a call takes the place of an earlier one for the same identifier.

        Args:
            arbitration_id: of the frames to destroy; None for any.
            count: attempts, retransmissions included; 0 takes back what is left.
        """
        if count < 0:
            raise ValueError(f"count {count} of a disturbance: expected 0 or more")
        self._disturbances.pop(arbitration_id, None)
        if count:
            self._disturbances[arbitration_id] = count
        self._plan = None

    def restart(self, node: int, now_ns: int) -> bool:
        """Make a node leave bus-off; it takes part again after 128 sequences of 11 recessive bits.

        Returns:
            Whether the node was in bus-off and not recovering yet.
        """
        self._run(now_ns)
        member = self._members[node]
        recovery = self._recovering.get(node)
        if not member.counters.is_off or (recovery is not None and recovery.has_begun(now_ns)):
            return False
        self._recovering[node] = Recovery(now_ns, self._sequence_ns)
        return True

    def load(self, now_ns: int) -> float:
        """Bus load over the last second, 0 to 1: frames, error frames and intermissions."""
        self._run(now_ns)
        return self._load.window(now_ns)

    def mean_load(self, now_ns: int) -> float:
        """Bus load since the first call that told the time, 0 to 1."""
        self._run(now_ns)
        elapsed_ns = now_ns - (self._origin_ns or 0)
        return self._load.busy_ns(now_ns) / elapsed_ns if elapsed_ns else 0.0

    def record_loss(self, node: int) -> None:
        """Note that a node could not take the frame that was just delivered to it."""
        statistics = self._statistics[node]
        statistics.received -= 1
        statistics.lost += 1

    @property
    def _sequence_ns(self) -> int:
        return SEQUENCE_BITS * self.timing.bit_ns

    def _run(self, until_ns: int) -> None:
        """All that ends by a time, and all that begins before it: at that very time somebody else may still join arbitration."""
        if self._origin_ns is None:
            self._origin_ns = self._now_ns = self._idle_ns = until_ns
        elif until_ns == self._now_ns:
            return
        if until_ns < self._now_ns:
            raise ValueError(f"time goes back from {self._now_ns} to {until_ns} ns")
        while True:
            if self._attempt is not None:
                if self._attempt.end_ns > until_ns:
                    break
                self._finish(self._attempt)
                continue
            start_ns = self._start_ns()
            if self._recovering and self._rejoin_by(until_ns if start_ns is None else min(until_ns, start_ns)):
                continue
            if start_ns is None or start_ns >= until_ns:
                break
            self._begin(self._plan or self._arbitrate(start_ns))
        self._now_ns = until_ns

    def _start_ns(self) -> int | None:
        """When the next attempt begins as things stand [ns]; None while no frame is pending."""
        free_ns: int | None = None
        for node in self._online:
            if node.queue and (free_ns is None or node.suspended_until_ns < free_ns):
                free_ns = node.suspended_until_ns
        # What could begin before the time of the last call has begun: whatever is pending was asked for by then.
        return None if free_ns is None else max(free_ns, self._idle_ns, self._now_ns)

    def _arbitrate(self, start_ns: int) -> Attempt:
        return arbitrate(self._online, self._disturbances, start_ns, self.timing)

    def _expected(self) -> Attempt | None:
        """The attempt that is going on, or begins next as things stand: another request before its start may change it."""
        if self._attempt is not None:
            return self._attempt
        if self._plan is None and (start_ns := self._start_ns()) is not None:
            self._plan = self._arbitrate(start_ns)
        return self._plan

    def _is_futile(self, attempt: Attempt) -> bool:
        """Whether the end of an attempt changes nothing: nobody acknowledges, and the sender does not count it any more."""
        is_unheard = attempt.outcome is Outcome.UNACKNOWLEDGED and not self._recovering
        return is_unheard and all(node.counters.is_passive and not node.reports_bus_errors for node in attempt.senders)

    def _begin(self, attempt: Attempt) -> None:
        self._attempt, self._plan = attempt, None
        for node in attempt.senders:
            node.start()
        for recovery in self._recovering.values():
            recovery.interrupt(attempt.start_ns)
        if self._disturbances and attempt.outcome is Outcome.DESTROYED:
            self._spend_disturbance(attempt.frame.arbitration_id)
        self._load.add(attempt.start_ns, attempt.end_ns + INTERMISSION_BITS * self.timing.bit_ns)

    def _spend_disturbance(self, arbitration_id: int) -> None:
        key = arbitration_id if arbitration_id in self._disturbances else None
        if key in self._disturbances:
            self._disturbances[key] -= 1
            if not self._disturbances[key]:
                del self._disturbances[key]

    def _break_off(self, attempt: Attempt) -> None:
        """The sender has left in the middle: the receivers miss its bits, unless only recessive ones were to come."""
        bit_ns = self.timing.bit_ns
        if attempt.senders or attempt.outcome is not Outcome.SENT or self._now_ns >= attempt.end_ns - CLASSICAL_TAIL_BITS * bit_ns:
            return
        attempt.outcome = Outcome.DESTROYED
        attempt.end_ns = self._now_ns + (2 * FLAG_BITS + DELIMITER_BITS) * bit_ns
        self._load.cut(attempt.end_ns + INTERMISSION_BITS * bit_ns)

    def _finish(self, attempt: Attempt) -> None:
        self._attempt = None
        self._idle_ns = attempt.end_ns + INTERMISSION_BITS * self.timing.bit_ns
        if attempt.outcome is Outcome.SENT:
            self._deliver(attempt)
        else:
            self._fail(attempt)
        for node in attempt.senders:
            if node.counters.is_passive:
                node.suspended_until_ns = self._idle_ns + _SUSPEND_BITS * self.timing.bit_ns
        for recovery in self._recovering.values():
            recovery.resume(self._idle_ns)

    def _deliver(self, attempt: Attempt) -> None:
        receivers, senders = tuple([node.number for node in attempt.receivers]), tuple([node.number for node in attempt.senders])
        self._outbox.append(Delivery(attempt.frame, attempt.end_ns, receivers, senders))
        for node in attempt.senders:
            node.on_wire = None
            node.statistics.transmitted += 1
            if node.counters.tec:
                self._count(node, ErrorCounters.sent, attempt.end_ns)
        for node in attempt.receivers:
            node.statistics.received += 1
            if node.counters.rec:
                self._count(node, ErrorCounters.received, attempt.end_ns)
        for node in attempt.beaten:
            self._count(node, ErrorCounters.transmit_failed, attempt.end_ns)

    def _fail(self, attempt: Attempt) -> None:
        is_destroyed = attempt.outcome is Outcome.DESTROYED
        for node in attempt.senders:
            node.retry()
            self._count(node, ErrorCounters.transmit_failed if is_destroyed else ErrorCounters.unacknowledged, attempt.end_ns)
        for node in attempt.receivers:
            self._count(node, ErrorCounters.receive_failed, attempt.end_ns)
        for node in (*attempt.senders, *attempt.receivers):
            node.statistics.errors += 1
            if node.reports_bus_errors:
                is_sender = node in attempt.senders
                report = error_frames.destroyed(node.counters, is_sender) if is_destroyed else error_frames.unacknowledged(node.counters)
                self._tell(node, report, attempt.end_ns)

    def _count(self, node: Node, event: Callable[[ErrorCounters], None], t_ns: int) -> None:
        """Let an event change the counters of a node, and the node know when its state has changed."""
        before = node.counters.state
        event(node.counters)
        if node.counters.state is before:
            return
        self._tell(node, error_frames.state_changed(node.counters), t_ns)
        if node.counters.is_off:
            # Drivers drop what is pending.
            node.queue.clear()
            self._go_online()
            if node.restart_ns is not None:
                self._recovering[node.number] = Recovery(t_ns + node.restart_ns, self._sequence_ns)

    def _rejoin_by(self, t_ns: int) -> bool:
        """Let the first of the recovering nodes that is ready by a time take part again; whether there is one."""
        number, recovery = min(self._recovering.items(), key=lambda item: item[1].end_ns)
        if recovery.end_ns > t_ns:
            return False
        del self._recovering[number]
        node = self._members[number]
        node.counters.reset()
        self._tell(node, error_frames.restarted(node.counters), recovery.end_ns)
        self._go_online()
        return True

    def _go_online(self) -> None:
        """Note anew which nodes take part in what begins from now on."""
        self._online = tuple(node for node in self._members.values() if not node.counters.is_off)
        self._plan = None

    def _tell(self, node: Node, frame: BusFrame, t_ns: int) -> None:
        self._outbox.append(Delivery(frame, t_ns, (node.number,)))
