"""One CAN bus, polled: frames in, frames out, and the health of the bus, never an exception for what a bus does."""

import contextlib
import threading
import time
from collections import Counter
from queue import SimpleQueue
from types import TracebackType
from typing import Self

from dbc.bus_monitor import BusMonitor
from dbc.can_io import ERROR_CLASS_MASK, ERROR_FLAG, MAX_STANDARD_ID, OPENING_ERRORS, Arrival, Port, open_port
from dbc.confirmation import Confirmation
from dbc.errors import SetupFailure
from dbc.frame import CanFrame
from dbc.health import BusState, LinkHealth
from dbc.recovery import Recovery, Reopening
from dbc.traffic import Traffic, TrafficMeter

CARE_NS = 50_000_000
"""How often a link looks after what is not urgent: its driver, recovery, a bus that is to be opened again, load [ns]."""
DEFAULT_BITRATE_BPS = 500_000
SILENT_STATES = frozenset({BusState.BUS_OFF, BusState.DOWN})
"""In which nothing is sent."""


class LinkError(SetupFailure):
    """The bus cannot be opened; one line that says why."""


class CanLink:
    """A CAN bus that is polled, never waited for.

    Frames carry the monotonic time of the poll that fetched them. A link comes in two kinds. Without `ids` it hears all that
    others send, and leaves bus-off as its interface is set up to. With `ids` it is that of a node which is answerable for what it
    sends: it hears these messages alone, sees its own frames on the bus and keeps them to itself, has no more than two of a
    message on their way, and leaves bus-off as `dbc.recovery` has it. A frame with an identifier of its own that it has not sent
    is handed on like any other.

    Nothing is sent while the bus is down or the controller is bus-off. A bus that is down is opened again, beside the caller's
    thread, because drivers may take their time.

    Args:
        bus_name: `INTERFACE:CHANNEL`.
        ids: 11-bit identifiers to hear, own ones included; None for all.
        bitrate_bps: of the bus, for its load [bit/s].

    Attributes:
        ignored: received frames that nobody is shown, by cause.
        unsent: frames that were to be sent and were not, by cause; a later frame supersedes each.
        refused_polls: polls that the bus refused.

    Raises:
        LinkError: no such bus, or it does not open.
    """

    def __init__(self, bus_name: str, ids: frozenset[int] | None = None, bitrate_bps: int = DEFAULT_BITRATE_BPS) -> None:
        interface, separator, channel = bus_name.partition(":")
        if not (separator and interface and channel):
            raise LinkError(f"bus {bus_name!r}: expected INTERFACE:CHANNEL, for example socketcan:vcan0")
        self._target = (interface, channel, ids)
        try:
            self._port = open_port(*self._target)
        except OPENING_ERRORS as error:
            raise LinkError(f"bus {bus_name!r} does not open: {error}") from error
        self.name = bus_name
        self.ignored: Counter[str] = Counter()
        self.unsent: Counter[str] = Counter()
        self.refused_polls = 0
        self._is_node = ids is not None
        self._opener = _Opener(self._target)
        self._is_opening = False
        self._monitor = BusMonitor()
        self._confirmation = Confirmation()
        self._recovery, self._reopening = Recovery(), Reopening()
        self._meter = TrafficMeter(bitrate_bps)
        self._lost_at_closed_ports = 0
        self._lost = 0
        self._care_ns = 0
        self._refused_since_ns: int | None = None

    def receive(self) -> list[CanFrame]:
        """All frames of others that have arrived since the last call, oldest first."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._care_ns:
            self._care_ns = now_ns + CARE_NS
            self._care(now_ns)
        arrivals, refusal = self._port.receive()
        if refusal:
            self.refused_polls += 1
            self._monitor.refused(refusal, now_ns)
            # SocketCAN reports an error ahead of the frames that came before it; a second error says that there are none.
            arrivals += self._port.receive()[0]
        frames = self._sort(arrivals, now_ns)
        if frames and not refusal:
            self._monitor.came_up(now_ns)
        if self._monitor.state in SILENT_STATES:
            self._confirmation.clear()
        return frames

    def _sort(self, arrivals: list[Arrival], now_ns: int) -> list[CanFrame]:
        """Frames for the caller; own ones, error frames and those that are none of his go where they belong."""
        frames: list[CanFrame] = []
        for identifier, data, is_own in arrivals:
            if identifier > MAX_STANDARD_ID:
                if identifier & ERROR_FLAG:
                    self._monitor.error_frame(identifier & ERROR_CLASS_MASK, data, now_ns)
                else:
                    self.ignored["no classical data frame"] += 1
                continue
            if self._is_node:
                self._meter.add(identifier, data)
            if is_own:
                self._confirmation.seen(identifier, data)
            else:
                frames.append(CanFrame(identifier, data, now_ns))
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames to the bus; what it does not take is counted and dropped, because a later frame supersedes it."""
        now_ns = time.monotonic_ns()
        for arbitration_id, data, _ in frames:
            if self._is_silent:
                self.unsent["bus-off or down"] += 1
            elif not self._confirmation.has_room(arbitration_id):
                self.unsent["earlier ones still on their way"] += 1
            elif refusal := self._port.send(arbitration_id, data):
                self.unsent["refused"] += 1
                self._monitor.refused(refusal, now_ns)
                self._refused_since_ns = self._refused_since_ns or now_ns
            else:
                self._refused_since_ns = None
                self._note_sent(arbitration_id, data, now_ns)

    def _note_sent(self, arbitration_id: int, data: bytes, now_ns: int) -> None:
        if self._port.has_echo:
            self._confirmation.sent(arbitration_id, data, now_ns)
        elif self._is_node:
            self._meter.add(arbitration_id, data)

    def health(self) -> LinkHealth:
        """The bus as it is known now."""
        now_ns = time.monotonic_ns()
        # A queue that another program keeps full blocks our frames before they are on their way.
        refused_ns = 0 if self._refused_since_ns is None else now_ns - self._refused_since_ns
        return self._monitor.health(max(self._confirmation.oldest_ns(now_ns), refused_ns), self._has_given_up)

    @property
    def traffic(self) -> Traffic:
        """Load and rates over the last second, as far as `dbc.traffic` says; nothing without `ids`."""
        return self._meter.traffic

    @property
    def lost(self) -> int:
        """Received frames lost in queues that were not read in time: those of the socket, and the controller's reports of such."""
        return self._lost + self._monitor.overflows

    @property
    def bus_errors(self) -> int:
        """Reports of the controller's that a frame was destroyed on the wire or that nobody acknowledged it."""
        return self._monitor.bus_errors

    @property
    def refusal(self) -> str:
        """Why the last attempt to leave bus-off was refused; empty when none was."""
        return self._port.refusal

    def fileno(self) -> int:
        """Descriptor that is readable when something has arrived; -1 when there is none. It changes when the bus is opened again."""
        return self._port.fileno()

    def recover(self) -> None:
        """Allow all attempts to leave bus-off again; for the operator alone to ask for."""
        self._recovery.rearm(self._monitor.state, self._monitor.bus_offs)
        self._reopening.rearm()
        self._confirmation.clear()
        self._refused_since_ns = None

    def disturb(self, arbitration_id: int | None, count: int) -> bool:
        """Destroy the next transmissions of a message on the wire, for a bench; None: of any.

        Returns:
            Whether the bus does such a thing.
        """
        return self._port.disturb(arbitration_id, count)

    def close(self) -> None:
        """Leave the bus."""
        self._opener.abandon()
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def _has_given_up(self) -> bool:
        return self._is_node and self._recovery.has_given_up(self._monitor.bus_offs)

    @property
    def _is_silent(self) -> bool:
        return self._monitor.state in SILENT_STATES or self._has_given_up

    def _care(self, now_ns: int) -> None:
        if self._is_opening and not self._opener.answers.empty():
            self._take(self._opener.answers.get(), now_ns)
            self._is_opening = False
        if (controller := self._port.controller()) is not None:
            self._monitor.told(*controller, now_ns)
        state = self._monitor.state
        if self._is_node and self._recovery.is_due(state, self._monitor.bus_offs, now_ns):
            self._port.restart()
        if self._reopening.is_due(state, now_ns) and not self._is_opening:
            self._is_opening = True
            self._opener.ask()
        self._count_lost()
        self._meter.tick(now_ns)

    def _count_lost(self) -> None:
        lost = self._lost_at_closed_ports + self._port.lost()
        if lost > self._lost:
            # Own frames, seen on the bus, may be among them.
            self._confirmation.clear()
        self._lost = lost

    def _take(self, port: Port | None, now_ns: int) -> None:
        """Go on with a port that was opened anew; None when it did not open."""
        if port is None:
            return
        if self._monitor.state is not BusState.DOWN:
            # The bus has come up by itself meanwhile, and own frames are on their way that only the old port will see.
            port.close()
            return
        self._lost_at_closed_ports += self._port.lost()
        self._port.close()
        self._port = port
        self._monitor.came_up(now_ns)


class _Opener(threading.Thread):
    """Opens a bus again whenever it is asked to. It waits from the set-up on: whoever starts a thread waits until that one runs.

    Attributes:
        answers: what was opened, one for each time that it was asked; None when it did not open.
    """

    def __init__(self, target: tuple[str, str, frozenset[int] | None]) -> None:
        super().__init__(name="xilgate-bus", daemon=True)
        self.answers = SimpleQueue[Port | None]()
        self._target = target
        self._asked = SimpleQueue[bool]()
        self._lock = threading.Lock()
        self._is_abandoned = False
        self.start()

    def ask(self) -> None:
        """Have it opened; the answer comes."""
        self._asked.put(True)

    def run(self) -> None:
        while self._asked.get() and not self._is_abandoned:
            port = None
            with contextlib.suppress(Exception):  # whatever a driver raises, it is tried again
                port = open_port(*self._target)
            with self._lock:
                if self._is_abandoned and port is not None:
                    port.close()
                else:
                    self.answers.put(port)

    def abandon(self) -> None:
        """Nobody waits for it any more."""
        with self._lock:
            self._is_abandoned = True
            while not self.answers.empty():
                if (port := self.answers.get()) is not None:
                    port.close()
        self._asked.put(False)
