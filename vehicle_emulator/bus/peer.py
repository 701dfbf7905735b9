"""A node as the hub sees it: its connection, what it wants to hear, and how far it has come or gone."""

import contextlib
import select
from enum import Enum

from vehicle_emulator.bus.connection import Connection
from vehicle_emulator.bus.frame import ERROR, EXTENDED, BusFrame
from vehicle_emulator.bus.wire import Control, Settings, WireError, named_ids, unpack

PATIENCE_NS = 1_000_000_000
"""For a caller that does not say what it wants, and for the pending frames of a node that has closed its connection [ns]."""
MAX_PACKETS_PER_TURN = 128
"""Taken from one node before the next has its turn."""

_WITH_ROOM = select.EPOLLIN | select.EPOLLRDHUP
_FULL = select.EPOLLRDHUP


class Stage(Enum):
    """Whether the other end is there."""

    OPEN = 1
    CLOSING = 2
    """It has closed; what it sent before is still to be read."""
    GONE = 3
    """All is read."""


class Peer:
    """One connection to the hub; it becomes a node when it says hello.

    Args:
        connection: the connection.
        epoll: the hub's, which watches it.
        now_ns: when the connection was made [ns].
        is_local: on a socket that keeps packets whole and whose other end has the same monotonic clock.

    Attributes:
        descriptor: file descriptor of the connection.
        node: number of its node; None before it has joined.
        settings: what it wants to hear.
        stage: whether it is there.
    """

    def __init__(self, connection: Connection, epoll: select.epoll, now_ns: int, *, is_local: bool) -> None:
        self.descriptor = connection.fileno()
        self.node: int | None = None
        self.settings = Settings()
        self._named_ids: frozenset[int] = frozenset()
        self.stage = Stage.OPEN
        self._connection = connection
        self._epoll = epoll
        self._events = _WITH_ROOM
        self._deadline_ns = now_ns + PATIENCE_NS
        self._is_local = is_local
        epoll.register(self.descriptor, self._events)

    def receive(self, room: int, now_ns: int) -> tuple[list[tuple[int, BusFrame | Control]], int]:
        """What it has sent.

        Args:
            room: frames that may be taken.
            now_ns: time for those that tell none [ns].

        Returns:
            Each content with the time of its request, never decreasing [ns]; and the number of malformed packets.
        """
        contents: list[tuple[int, BusFrame | Control]] = []
        t_ns = malformed = 0
        for _ in range(MAX_PACKETS_PER_TURN):
            if room <= 0 or self.stage is Stage.GONE:
                break
            content = None
            try:
                packet = self._connection.receive()
            except BlockingIOError:
                break
            except OSError:
                packet = b""
            except WireError:  # a stream that has lost its packets
                packet = b""
                malformed += 1
            if packet:
                try:
                    content = unpack(packet)
                except WireError:
                    malformed += 1
                    continue
            if content is None:
                self.hang_up(now_ns)
                self.stage = Stage.GONE
            elif not isinstance(content, tuple):
                contents.append((t_ns, content))
                # Whether it may say more is decided by the answer to its hello.
                room -= self.node is None
            elif content[0].flags & ERROR:
                malformed += 1
            else:
                t_ns = max(t_ns, content[1] if self._is_local and content[1] else now_ns)
                contents.append((t_ns, content[0]))
                room -= 1
        return contents, malformed

    def set(self, settings: Settings) -> None:
        """It says what it wants to hear."""
        self.settings = settings
        self._named_ids = named_ids(settings.filters or ())

    def wants(self, frame: BusFrame) -> bool:
        """Whether a frame passes its filters; error frames always do, as with SocketCAN."""
        filters = self.settings.filters
        if filters is None or frame.flags & ERROR:
            return True
        is_extended = bool(frame.flags & EXTENDED)
        if not is_extended and frame.arbitration_id in self._named_ids:
            return True
        return any((one.can_id ^ frame.arbitration_id) & one.can_mask == 0 and one.extended in (None, is_extended) for one in filters)

    def send(self, packet: bytes) -> bool:
        """Whether it could take a packet; one that has gone misses nothing."""
        try:
            self._connection.send(packet)
        except ConnectionError:
            return True
        except OSError:
            return False
        return True

    @property
    def is_listening(self) -> bool:
        """Whether its packets are watched."""
        return self._events == _WITH_ROOM

    def listen(self, *, has_room: bool) -> None:
        """Watch its packets or not: while its queue is full they stay in the socket, so that its own sending comes to a halt."""
        events = _WITH_ROOM if has_room else _FULL
        if self.stage is Stage.OPEN and events != self._events:
            self._events = events
            self._epoll.modify(self.descriptor, events)

    def hang_up(self, now_ns: int) -> None:
        """Its end is closed: what it has sent is read as there is room, without being woken for it."""
        if self.stage is Stage.OPEN:
            self.stage = Stage.CLOSING
            self._deadline_ns = now_ns + PATIENCE_NS
            self._epoll.unregister(self.descriptor)

    def needs_care(self, *, has_room: bool) -> bool:
        """Whether it has to be looked after in every turn: no node yet, full, going, or on TCP, where a packet may be sent in part."""
        return not (self._is_local and has_room and self.node is not None and self.stage is Stage.OPEN)

    def is_over(self, now_ns: int, pending: int, *, is_alone: bool) -> bool:
        """Whether to part with it.

        Args:
            now_ns: now [ns].
            pending: frames of its node that are still to be sent.
            is_alone: whether nobody is there to hear them.
        """
        with contextlib.suppress(OSError):
            self._connection.flush()
        if self.stage is Stage.OPEN:
            return self.node is None and now_ns >= self._deadline_ns
        return is_alone or now_ns >= self._deadline_ns or (self.stage is Stage.GONE and not pending)

    def close(self) -> None:
        """End the connection."""
        if self.stage is Stage.OPEN:
            self._epoll.unregister(self.descriptor)
        self._connection.close()
