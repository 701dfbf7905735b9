"""One end of a connection between hub and node: whole packets, in order, never waiting."""

import contextlib
import socket
import struct
from typing import Protocol

from vehicle_emulator.bus.wire import MAX_PACKET_BYTES, WireError

# What an unprivileged process may ask of a Linux with default settings. Measured: 555 frames, twice the receive queue of a
# SocketCAN socket. More would not help: who sleeps for longer is better served with gaps than with old frames.
_BUFFER_BYTES = 212_992
_LENGTH = struct.Struct("<H")


class Connection(Protocol):
    """A connection of either kind."""

    def fileno(self) -> int:
        """File descriptor, which is readable when there is a packet or the other end has gone."""

    def receive(self) -> bytes:
        """The next packet; empty when the other end has gone.

        Raises:
            BlockingIOError: there is none yet.
            WireError: what comes is no packet; the connection is of no further use.
        """

    def send(self, packet: bytes) -> None:
        """Hand a packet over.

        Raises:
            BlockingIOError: no room; nothing of it was sent.
            OSError: the other end has gone.
        """

    def flush(self) -> bool:
        """Go on with a packet that was handed over in part; whether nothing is left of it."""

    def close(self) -> None:
        """End the connection; wakes whoever waits for it."""


def connection_of(connected: socket.socket) -> Connection:
    """Connection on a connected socket."""
    connected.setblocking(False)
    if connected.type is socket.SOCK_STREAM:
        for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            connected.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return StreamConnection(connected)
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
    return PacketConnection(connected)


class PacketConnection:
    """On a Unix sequenced-packet socket, which keeps packets whole by itself. Methods: see `Connection`."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self.fileno = connected.fileno

    def send(self, packet: bytes) -> None:  # noqa: D102
        self._socket.send(packet)

    def receive(self) -> bytes:  # noqa: D102
        try:
            return self._socket.recv(MAX_PACKET_BYTES)
        except ConnectionResetError:
            # The other end left packets unread when it closed; what it sent before is still to come.
            return self._socket.recv(MAX_PACKET_BYTES)

    def flush(self) -> bool:  # noqa: D102
        return True

    def close(self) -> None:  # noqa: D102
        _close(self._socket)


class StreamConnection:
    """On a TCP socket: each packet behind its length, 16 bits. Methods: see `Connection`.

    It never reads beyond a packet, so that the socket is readable while there is another.
    """

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._received = b""
        self._unsent = b""
        self.fileno = connected.fileno

    def receive(self) -> bytes:  # noqa: D102
        while (missing := self._missing()) > 0:
            chunk = self._socket.recv(missing)
            if not chunk:
                return b""
            self._received += chunk
        packet, self._received = self._received[_LENGTH.size :], b""
        return packet

    def send(self, packet: bytes) -> None:  # noqa: D102
        if not self.flush():
            raise BlockingIOError
        framed = _LENGTH.pack(len(packet)) + packet
        self._unsent = framed[self._socket.send(framed) :]

    def flush(self) -> bool:  # noqa: D102
        if self._unsent:
            with contextlib.suppress(BlockingIOError):
                self._unsent = self._unsent[self._socket.send(self._unsent) :]
        return not self._unsent

    def close(self) -> None:  # noqa: D102
        _close(self._socket)

    def _missing(self) -> int:
        """Bytes that are to be read before anything else is known."""
        if len(self._received) < _LENGTH.size:
            return _LENGTH.size - len(self._received)
        (length_bytes,) = _LENGTH.unpack_from(self._received)
        if not 1 <= length_bytes <= MAX_PACKET_BYTES:
            raise WireError(f"packet of {length_bytes} bytes, expected 1 to {MAX_PACKET_BYTES}")
        return _LENGTH.size + int(length_bytes) - len(self._received)


def _close(connected: socket.socket) -> None:
    # Closing alone would leave another thread waiting.
    with contextlib.suppress(OSError):
        connected.shutdown(socket.SHUT_RDWR)
    connected.close()
