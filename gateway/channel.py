"""Datagram sockets between gateway, controller and operator on one host: non-blocking, newest value wins."""

import contextlib
import socket
from pathlib import Path
from typing import Self, TypeVar

from dbc.errors import SetupFailure
from gateway.messages import Datagram, pack, unpack

MAX_DATAGRAM_BYTES = 2048
MAX_DATAGRAMS_PER_POLL = 256
"""Bound on one poll, so that a flood cannot hold the caller's loop."""

T = TypeVar("T", bound=Datagram)


class ChannelError(SetupFailure):
    """A socket cannot be opened; one line that says which."""


class Channel:
    """One end of the control path.

    Args:
        bind: path of the Unix-domain socket to receive on, or None for an end that only sends.
        peer: path of the socket to send to, or None for an end that only receives. The peer need not exist yet.

    Attributes:
        rejected: datagrams received that were no message of ours.
        unsent: datagrams that nobody took.
    """

    def __init__(self, bind: str | None, peer: str | None) -> None:
        self._bind = bind
        self._peer = peer
        self._newest: dict[type, Datagram] = {}
        self.rejected = 0
        self.unsent = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if bind is not None:
            if _is_served(bind):
                self._socket.close()
                raise ChannelError(f"control socket {bind} is in use by another process; stop it, or choose another socket")
            try:
                Path(bind).unlink(missing_ok=True)
                self._socket.bind(bind)
            except OSError as error:
                self._socket.close()
                raise ChannelError(f"control socket {bind}: {error.strerror or error}") from error

    def send(self, message: Datagram) -> None:
        """Send a message, or count it when the peer is absent or does not keep up."""
        if self._peer is None:
            raise ValueError("this end of the channel has no peer")
        try:
            self._socket.sendto(pack(message), self._peer)
        except OSError:
            self.unsent += 1

    def newest(self, kind: type[T]) -> T | None:
        """The newest message of a kind that has arrived since it was last asked for, or None."""
        self._poll()
        message = self._newest.pop(kind, None)
        return message if isinstance(message, kind) else None

    def _poll(self) -> None:
        for _ in range(MAX_DATAGRAMS_PER_POLL):
            try:
                datagram = self._socket.recv(MAX_DATAGRAM_BYTES)
            except OSError:
                return
            message = unpack(datagram)
            if message is None:
                self.rejected += 1
            else:
                self._newest[type(message)] = message

    def close(self) -> None:
        """Close the socket and remove its path."""
        self._socket.close()
        if self._bind is not None:
            with contextlib.suppress(OSError):
                Path(self._bind).unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _is_served(path: str) -> bool:
    """Whether a living process listens on a socket; what a dead one left behind refuses the connection."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(path)
        except OSError:
            return False
    return True
