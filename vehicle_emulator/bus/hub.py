"""Hub of the emulated bus: one small process that passes frames between its nodes.

It runs without privilege and without the network. The socket buffer of a node is its receive queue: a node that does not
read loses frames, which are counted, and holds nobody up.
"""

import contextlib
import fcntl
import itertools
import logging
import os
import selectors
import socket
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from vehicle_emulator.bus.channel import BusError, is_served, socket_path
from vehicle_emulator.bus.core import BusCore
from vehicle_emulator.bus.wire import HELLO, PACKET_BYTES, WireError, pack, unpack

MAX_NODES = 64
MAX_FRAMES_PER_TURN = 64
"""Frames taken from one node before the next has its turn."""

_POLL_S = 0.1
# What an unprivileged process may ask of a Linux with default settings. Measured: 555 frames, twice the receive queue of a
# SocketCAN socket. More would not help: who sleeps for longer is better served with gaps than with old frames.
_NODE_BUFFER_BYTES = 212_992
_LOG = logging.getLogger(__name__)


def run(channel: str, stop: threading.Event) -> None:
    """Serve a channel until `stop` is set.

    Raises:
        BusError: another hub serves it, or its socket cannot be made.
    """
    with Hub(channel) as hub:
        while not stop.is_set():
            hub.turn(_POLL_S)


class Hub:
    """The nodes of one channel and their sockets.

    Raises:
        BusError: another hub serves the channel, or its socket cannot be made.
    """

    def __init__(self, channel: str) -> None:
        self.channel = channel
        self.core = BusCore()
        self.malformed = 0
        self._path = socket_path(channel)
        self._listener = _listen(channel, self._path)
        self._nodes: dict[int, socket.socket] = {}
        self._numbers = itertools.count(1)
        # Time stamps must not jump when the wall clock is set, so the epoch is looked up once.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def turn(self, timeout_s: float) -> None:
        """Wait for frames, joining and leaving nodes, and serve what there is.

        Args:
            timeout_s: longest wait [s].
        """
        for key, _ in self._selector.select(timeout_s):
            if key.fileobj is self._listener:
                self._join()
            else:
                self._serve(key.data)

    def close(self) -> None:
        """End the channel: its nodes see it go."""
        # Removed before the listener closes: afterwards the name may already belong to the next hub.
        self._path.unlink(missing_ok=True)
        self._listener.close()
        for node in list(self._nodes):
            self._leave(node)
        self._selector.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _join(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the caller gave up meanwhile
            return
        if len(self._nodes) >= MAX_NODES:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _NODE_BUFFER_BYTES)
        node = next(self._numbers)
        self.core.join(node)
        self._nodes[node] = connection
        self._selector.register(connection, selectors.EVENT_READ, node)
        # A node that has this greeting hears every frame that is sent from then on.
        with contextlib.suppress(ConnectionError):
            connection.send(HELLO)

    def _leave(self, node: int) -> None:
        connection = self._nodes.pop(node)
        self._selector.unregister(connection)
        connection.close()
        counted = self.core.leave(node)
        if counted.lost:
            _LOG.warning("bus %s: node %d was too slow: %d frames lost, %d received", self.channel, node, counted.lost, counted.received)

    def _serve(self, node: int) -> None:
        connection = self._nodes[node]
        for _ in range(MAX_FRAMES_PER_TURN):
            try:
                packet = connection.recv(PACKET_BYTES + 1)  # one more, to notice a packet that is too long
            except BlockingIOError:
                return
            except ConnectionResetError:
                # The node left frames unread when it closed; what it sent before is still to come.
                continue
            if not packet:
                self._leave(node)
                return
            self._forward(node, packet)

    def _forward(self, node: int, packet: bytes) -> None:
        try:
            frame, _ = unpack(packet)
        except WireError:
            self.malformed += 1
            return
        for delivery in self.core.transmit(node, frame, time.monotonic_ns()):
            stamped = pack(delivery.frame, delivery.t_ns + self._epoch_ns)
            for receiver in delivery.receivers:
                self._send(receiver, stamped)

    def _send(self, node: int, packet: bytes) -> None:
        try:
            self._nodes[node].send(packet)
        except ConnectionError:  # it has gone, which its own turn will show
            return
        except OSError:
            self.core.record_loss(node)


def _listen(channel: str, path: Path) -> socket.socket:
    """Listening socket of a channel, in place of one that a dead hub left behind."""
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        # Two hubs that start together must not both find the name free.
        fcntl.flock(directory, fcntl.LOCK_EX)
        if is_served(channel):
            raise BusError(f"channel {channel!r} is already served by another hub ({path})")
        path.unlink(missing_ok=True)
        listener.bind(str(path))
        listener.listen(MAX_NODES)
        listener.setblocking(False)
    except (OSError, BusError) as error:
        listener.close()
        raise error if isinstance(error, BusError) else BusError(f"{path}: {error.strerror or error}") from error
    finally:
        os.close(directory)
    return listener
