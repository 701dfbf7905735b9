"""Hub of the emulated bus: one small process that puts the core into real time and its nodes onto sockets.

It runs without privilege and does not leave the machine. A frame is delivered when it has ended on the wire, never before. The
socket buffer of a node is its receive queue: a node that does not read loses frames, which are counted, and holds nobody up. A node
that sends more than the bus carries is not read from, so that its own transmit buffer fills.
"""

import contextlib
import ctypes
import fcntl
import itertools
import logging
import os
import select
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from vehicle_emulator.bus import wire
from vehicle_emulator.bus.channel import LOOPBACK, BusError, is_served, socket_path
from vehicle_emulator.bus.connection import connection_of
from vehicle_emulator.bus.core import DEFAULT_BITRATE_BPS, DEFAULT_DATA_BITRATE_BPS, QUEUE_FRAMES, BusCore, Delivery
from vehicle_emulator.bus.frame import ERROR, BusFrame
from vehicle_emulator.bus.peer import Peer, Stage
from vehicle_emulator.bus.wire import Control, Disturb, Hello, Restart, Settings, pack, pack_control

MAX_NODES = 64
DEFAULT_RESTART_MS = 100
"""Time after which a node leaves bus-off by itself; SocketCAN's default is never, but a bench has nobody at hand [ms]."""

_POLL_S = 0.1
# A node whose queue was full is read again when there is room for many frames, not for each of them alone.
_RESUME_FRAMES = QUEUE_FRAMES // 2
# How often a hub looks after what is no event: callers that say nothing, nodes that go, and the vain attempts of a node that nobody
# acknowledges, which are to be worked off all the same.
_LOOK_NS = 100_000_000
_MAX_DISTURBED_IDS = 4096
_PR_SET_TIMERSLACK = 29
# The kernel lets timers be 50 us late by default, to join wake-ups.
_TIMER_SLACK_NS = 1_000
# Of an alarm: it forgets slowly how little late the kernel has been.
_LEAD_STEPS = 32
_MAX_LEAD_NS = 60_000
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class HubOptions:
    """What a hub serves, and how.

    Args:
        bitrate_bps: nominal bit rate [bit/s].
        data_bitrate_bps: bit rate of the data phase of CAN FD frames [bit/s].
        tcp_port: port on loopback to serve as well; 0: any, see `Hub.tcp_port`; None: none.
        restart_ms: time after which a node leaves bus-off by itself [ms]; 0: only when asked to.
    """

    bitrate_bps: int = DEFAULT_BITRATE_BPS
    data_bitrate_bps: int = DEFAULT_DATA_BITRATE_BPS
    tcp_port: int | None = None
    restart_ms: int = DEFAULT_RESTART_MS


def run(channels: Mapping[str, HubOptions], stop: threading.Event) -> None:
    """Serve channels from one thread until `stop` is set.

    Args:
        channels: options of every channel, by its name.
        stop: ends it.

    Raises:
        BusError: another hub serves one of them, or a socket cannot be made.
    """
    with contextlib.ExitStack() as opened:
        hubs = [opened.enter_context(Hub(channel, options)) for channel, options in channels.items()]
        # Where the kernel refuses, deliveries are some 50 us later, and nothing else.
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _TIMER_SLACK_NS, 0, 0, 0)
        alarm = Alarm()
        while not stop.is_set():
            for hub in alarm.wait(hubs, _POLL_S):
                hub.serve()


class Alarm:
    """Waits for sockets until a time, as exactly as can be without turning in a circle.

    A timer of the kernel rings late, by 25 to 70 us on a virtual machine. So it is set ahead by what it has been late at least.
    """

    def __init__(self) -> None:
        self._lead_ns = 0

    def wait(self, hubs: Sequence["Hub"], timeout_s: float) -> list["Hub"]:
        """Wait until a hub has something to do.

        Args:
            hubs: the hubs.
            timeout_s: longest wait [s].

        Returns:
            Those that have.
        """
        now_ns = time.monotonic_ns()
        dues_ns = [hub.due_ns for hub in hubs]
        pause_ns = max(0, min(*dues_ns, now_ns + round(timeout_s * 1e9)) - now_ns)
        if pause_ns > 2 * self._lead_ns:
            pause_ns -= self._lead_ns
        # epoll alone would wait in whole milliseconds.
        ready, _, _ = select.select(hubs, [], [], pause_ns * 1e-9)
        woken_ns = time.monotonic_ns()
        if pause_ns and not ready:
            late_ns = woken_ns - now_ns - pause_ns
            self._lead_ns = min(late_ns, self._lead_ns + (late_ns - self._lead_ns) // _LEAD_STEPS, _MAX_LEAD_NS)
        return [hub for hub, due_ns in zip(hubs, dues_ns, strict=True) if due_ns <= woken_ns or hub in ready]


class Hub:
    """The nodes of one channel and their sockets.

    Args:
        channel: name of the channel.
        options: see there.

    Attributes:
        core: the bus.
        malformed: packets that were refused.

    Raises:
        BusError: another hub serves the channel, or a socket cannot be made.
    """

    def __init__(self, channel: str, options: HubOptions = HubOptions()) -> None:
        self.channel = channel
        self.core = BusCore(options.bitrate_bps, options.data_bitrate_bps, restart_ms=options.restart_ms or None)
        self.malformed = 0
        self._default_restart_ms = options.restart_ms
        self._path = socket_path(channel)
        self._listeners = {listener.fileno(): listener for listener in _listen(channel, options.tcp_port)}
        self._peers: dict[int, Peer] = {}
        self._cared_for: list[Peer] = []
        self._nodes: dict[int, Peer] = {}
        self._numbers = itertools.count(1)
        # Time stamps must not jump when the wall clock is set, so the epoch is looked up once.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._alarm = Alarm()
        self._look_ns = 0
        self._epoll = select.epoll()
        for descriptor in self._listeners:
            self._epoll.register(descriptor, select.EPOLLIN)

    @property
    def tcp_port(self) -> int | None:
        """The port on loopback that is served."""
        names = [listener.getsockname() for listener in self._listeners.values() if listener.family == socket.AF_INET]
        return int(names[0][1]) if names else None

    def fileno(self) -> int:
        """File descriptor that is readable when a node has something to say."""
        return self._epoll.fileno()

    def turn(self, timeout_s: float) -> None:
        """Wait until there is something to do, and do it.

        Args:
            timeout_s: longest wait [s].
        """
        self._alarm.wait([self], timeout_s)
        self.serve()

    @property
    def due_ns(self) -> int:
        """When it has something to do even if no node says anything [ns]."""
        event_ns = self.core.next_event_ns()
        return self._look_ns if event_ns is None else min(event_ns, self._look_ns)

    def serve(self) -> None:
        """Do all that is to be done now: packets, frames that have ended, joining and leaving nodes."""
        events = self._epoll.poll(0)
        now_ns = time.monotonic_ns()
        self._look_ns = now_ns + _LOOK_NS
        ready = [peer for peer in self._cared_for if peer.stage is Stage.CLOSING]
        for descriptor, event in events:
            peer = self._peers.get(descriptor)
            if peer is None:
                self._accept(descriptor, now_ns)
                continue
            if event & ~select.EPOLLIN:
                peer.hang_up(now_ns)
            ready.append(peer)
        if ready:
            self._take(ready, now_ns)
        event_ns = self.core.next_event_ns()
        # Time does not pass for the core without need: a node's request may have been made before this turn.
        if (event_ns is not None and event_ns <= now_ns) or now_ns - self.core.now_ns >= _LOOK_NS:
            self._pass_on(now_ns)
        if ready or self._cared_for:
            self._care(ready, now_ns)

    def close(self) -> None:
        """End the channel: its nodes see it go."""
        # Removed before the listener closes: afterwards the name may already belong to the next hub.
        self._path.unlink(missing_ok=True)
        for listener in self._listeners.values():
            listener.close()
        for peer in list(self._peers.values()):
            self._drop(peer)
        self._epoll.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _accept(self, descriptor: int, now_ns: int) -> None:
        try:
            connected, _ = self._listeners[descriptor].accept()
        except OSError:  # the caller gave up meanwhile
            return
        if len(self._peers) >= MAX_NODES:
            connected.close()
            return
        peer = Peer(connection_of(connected), self._epoll, now_ns, is_local=connected.family == socket.AF_UNIX)
        self._peers[peer.descriptor] = peer
        self._cared_for.append(peer)

    def _take(self, ready: list[Peer], now_ns: int) -> None:
        """Take what the nodes have sent, in the order in which they sent it, however late this process has woken up."""
        requests: list[tuple[int, Peer, BusFrame | Control]] = []
        for peer in ready:
            contents, malformed = peer.receive(self._room(peer), now_ns)
            requests += [(t_ns, peer, content) for t_ns, content in contents]
            if malformed:
                self._refuse(peer, malformed)
        requests.sort(key=_time_of)
        for t_ns, peer, content in requests:
            if not isinstance(content, BusFrame):
                self._obey(peer, content, now_ns)
            elif peer.node is not None:
                self.core.transmit(peer.node, content, min(max(t_ns, self.core.now_ns), now_ns))
            else:
                self._refuse(peer, 1)

    def _refuse(self, peer: Peer, count: int) -> None:
        """Packets that are none; who has not even joined gets no second chance."""
        self.malformed += count
        if peer.node is None:
            peer.hang_up(0)
            peer.stage = Stage.GONE

    def _room(self, peer: Peer) -> int:
        return 1 if peer.node is None else self.core.room(peer.node)

    def _obey(self, peer: Peer, control: Control, now_ns: int) -> None:
        match control:
            case Hello(wire.VERSION) if peer.node is None:
                self._join(peer, now_ns)
            case Settings() if peer.node is not None:
                peer.set(control)
                self.core.report_bus_errors(peer.node, control.bus_errors)
                restart_ms = self._default_restart_ms if control.restart_ms is None else control.restart_ms
                self.core.set_restart(peer.node, restart_ms or None)
            case Restart() if peer.node is not None:
                self.core.restart(peer.node, max(now_ns, self.core.now_ns))
            case Disturb(arbitration_id, count) if peer.node is not None and (not count or self.core.disturbed_ids < _MAX_DISTURBED_IDS):
                self.core.disturb(arbitration_id, count)
            case _:
                self._refuse(peer, 1)

    def _join(self, peer: Peer, now_ns: int) -> None:
        """A node that has the greeting hears every frame that begins from then on."""
        self._pass_on(now_ns)
        peer.node = next(self._numbers)
        self.core.join(peer.node)
        self._nodes[peer.node] = peer
        peer.send(pack_control(Hello(wire.VERSION)))

    def _pass_on(self, now_ns: int) -> None:
        for delivery in self.core.advance(max(now_ns, self.core.now_ns)):
            self._deliver(delivery)

    def _deliver(self, delivery: Delivery) -> None:
        frame, t_ns, receivers, senders = delivery
        packet = pack(frame, t_ns + self._epoch_ns)
        for node in receivers:
            peer = self._nodes.get(node)
            if peer is not None and peer.wants(frame) and not peer.send(packet) and not frame.flags & ERROR:
                self.core.record_loss(node)
        for node in senders:
            peer = self._nodes.get(node)
            if peer is not None and peer.settings.own_frames and peer.wants(frame):
                peer.send(pack(frame, t_ns + self._epoch_ns, is_own=True))

    def _care(self, served: list[Peer], now_ns: int) -> None:
        """Read again from nodes whose queue has room again, and part with those that have gone."""
        is_alone = not any(peer.stage is Stage.OPEN for peer in self._nodes.values())
        self._cared_for, peers = [], dict.fromkeys((*self._cared_for, *served))
        for peer in peers:
            pending = 0 if peer.node is None else self.core.pending(peer.node)
            if peer.is_over(now_ns, pending, is_alone=is_alone):
                self._drop(peer)
                continue
            has_room = peer.node is None or pending <= _RESUME_FRAMES or (peer.is_listening and pending < QUEUE_FRAMES)
            peer.listen(has_room=has_room)
            if peer.needs_care(has_room=has_room):
                self._cared_for.append(peer)

    def _drop(self, peer: Peer) -> None:
        del self._peers[peer.descriptor]
        peer.close()
        if peer.node is None:
            return
        del self._nodes[peer.node]
        counted = self.core.leave(peer.node)
        if counted.lost:
            text = "bus %s: node %d was too slow: %d frames lost, %d received"
            _LOG.warning(text, self.channel, peer.node, counted.lost, counted.received)


def _time_of(request: tuple[int, Peer, BusFrame | Control]) -> int:
    return request[0]


def _listen(channel: str, tcp_port: int | None) -> list[socket.socket]:
    """Listening sockets of a channel: the Unix one, in place of one that a dead hub left behind, and TCP if asked for."""
    path = socket_path(channel)
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    listeners = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)]
    place = str(path)
    try:
        # Two hubs that start together must not both find the name free.
        fcntl.flock(directory, fcntl.LOCK_EX)
        if is_served(channel):
            raise BusError(f"channel {channel!r} is already served by another hub ({path})")
        if tcp_port is not None:
            place = f"{LOOPBACK}:{tcp_port}"
            listeners.append(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
            listeners[1].setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listeners[1].bind((LOOPBACK, tcp_port))
        place = str(path)
        path.unlink(missing_ok=True)
        listeners[0].bind(place)
        for listener in listeners:
            listener.listen(MAX_NODES)
            listener.setblocking(False)
    except (OSError, BusError) as error:
        for listener in listeners:
            listener.close()
        raise error if isinstance(error, BusError) else BusError(f"{place}: {error.strerror or error}") from error
    finally:
        os.close(directory)
    return listeners
