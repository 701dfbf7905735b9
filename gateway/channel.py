"""Datagram sockets between gateway, controller and operator on one host: non-blocking, signed with the key of the rig.

Gateway and controller have one socket each, connected to the other's: the kernel refuses whoever else sends to them. Operators
come and go; they have a third socket of the gateway's, so that nothing that is sent there delays a command.
"""

import contextlib
import errno
import os
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeVar

from dbc.errors import SetupFailure
from dbc.runtime_directory import runtime_directory
from gateway.keys import load_key, load_or_make_key
from gateway.messages import MAX_DATAGRAM_BYTES, ControlCommand, Operation, OperatorReply, OperatorRequest, VehicleState, pack, unpack

MAX_DATAGRAMS_PER_POLL = 256
"""Bound on one poll, so that a flood cannot hold the caller's loop."""
RECONNECT_NS = 10_000_000
"""How often a peer that is silent is looked for [ns]."""
REPLY_TIMEOUT_S = 1.0
_SOCKET_MODE = 0o660
"""Less the umask of the process: nobody but its user, and its group if that is what the umask says."""

T = TypeVar("T", VehicleState, ControlCommand)


class ChannelError(SetupFailure):
    """A socket cannot be opened, or nobody answers on it; one line that says which."""


@dataclass(frozen=True)
class ControlPath:
    """Where the processes of one rig find each other.

    Args:
        directory: of the three sockets.
        key_file: see `keys`.
        makes_key: whether a key that is not there is made.
    """

    directory: Path
    key_file: Path
    makes_key: bool

    @property
    def gateway_socket(self) -> Path:
        """Takes commands of the controller."""
        return self.directory / "gateway.sock"

    @property
    def controller_socket(self) -> Path:
        """Takes states of the gateway."""
        return self.directory / "controller.sock"

    @property
    def operator_socket(self) -> Path:
        """Takes requests of operators."""
        return self.directory / "operator.sock"

    def key(self) -> bytes:
        """The key that signs datagrams.

        Raises:
            KeyMistake, SetupFailure: see `keys.load_key`.
        """
        return load_or_make_key(self.key_file) if self.makes_key else load_key(self.key_file)


def control_path(directory: Path | None = None, key_file: Path | None = None) -> ControlPath:
    """Where the control path is: by default in the run-time directory of the user, with a key there that is made on first use.

    Raises:
        SetupFailure: see `runtime_directory`.
    """
    directory = directory or runtime_directory()
    return ControlPath(directory, key_file or directory / "key", makes_key=key_file is None)


def operator_client(control: ControlPath) -> "OperatorClient":
    """An operator's end. The gateway is looked for first: where there is none, that its key is missing is no news.

    Raises:
        ChannelError: no gateway is there.
        KeyMistake, SetupFailure: see `keys.load_key`.
    """
    if not _is_served(control.operator_socket):
        raise ChannelError(f"no gateway listens on {control.operator_socket}; `--control` or a rig file names another directory")
    return OperatorClient(control.operator_socket, control.key())


class _Socket:
    """A datagram socket with a key.

    Attributes:
        rejected: datagrams received that were no message of ours.
        unsent: datagrams that nobody took.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._bound: Path | None = None
        self.rejected = 0
        self.unsent = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def _bind(self, path: Path) -> None:
        if _is_served(path):
            self._socket.close()
            raise ChannelError(f"control socket {path} is in use by another process; stop it, or name another directory")
        try:
            path.unlink(missing_ok=True)
            os.fchmod(self._socket.fileno(), _SOCKET_MODE)  # before it has a name: nobody can come in between
            self._socket.bind(str(path))
        except OSError as error:
            self._socket.close()
            raise ChannelError(f"control socket {path}: {error.strerror or error}") from error
        self._bound = path

    def close(self) -> None:
        """Close the socket and remove its path."""
        self._socket.close()
        if self._bound is not None:
            with contextlib.suppress(OSError):
                self._bound.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Channel(_Socket):
    """The gateway's or the controller's end of the path between them: the newest value wins.

    Args:
        bind: path of the socket to receive on.
        peer: path of the socket to send to. The peer need not exist yet, and may come back as another process.

    Raises:
        ChannelError: the socket cannot be opened, or is in use.
    """

    def __init__(self, bind: Path, peer: Path, key: bytes) -> None:
        super().__init__(key)
        self._peer = str(peer)
        self._connect_ns = 0
        self._newest: dict[type, VehicleState | ControlCommand] = {}
        self._bind(bind)
        self._connect()

    def send(self, message: VehicleState | ControlCommand) -> None:
        """Send a message, or count it when the peer is absent or does not keep up."""
        datagram = pack(message, self._key)
        if not self._send(datagram):
            self._connect()
            self.unsent += not self._send(datagram)

    def fileno(self) -> int:
        """Descriptor that is readable when something has arrived."""
        return self._socket.fileno()

    def newest(self, kind: type[T]) -> T | None:
        """The newest message of a kind that has arrived since it was last asked for, or None."""
        self._poll()
        message = self._newest.pop(kind, None)
        if message is None and (now_ns := time.monotonic_ns()) >= self._connect_ns:
            self._connect_ns = now_ns + RECONNECT_NS
            self._connect()
        return message if isinstance(message, kind) else None

    def _connect(self) -> None:
        """Let in whoever has the peer's name now; nothing tells that it has become another process."""
        with contextlib.suppress(OSError):  # not there yet
            self._socket.connect(self._peer)

    def _send(self, datagram: bytes) -> bool:
        try:
            self._socket.send(datagram)
        except OSError:
            return False
        return True

    def _poll(self) -> None:
        for _ in range(MAX_DATAGRAMS_PER_POLL):
            try:
                datagram = self._socket.recv(MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:  # the peer has chosen another one; what came since is still there
                continue
            message = unpack(datagram, self._key)
            if isinstance(message, VehicleState | ControlCommand):
                self._newest[type(message)] = message
            else:
                self.rejected += 1


class OperatorServer(_Socket):
    """The gateway's end for operators: takes a request at a time, and answers it.

    Raises:
        ChannelError: the socket cannot be opened, or is in use.
    """

    def __init__(self, path: Path, key: bytes) -> None:
        super().__init__(key)
        self._asker: str | bytes | None = None
        self._bind(path)

    def next_request(self) -> OperatorRequest | None:
        """The oldest request that waits, or None; the others wait until they are asked for."""
        for _ in range(MAX_DATAGRAMS_PER_POLL):
            try:
                datagram, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
            except OSError:
                return None
            message = unpack(datagram, self._key)
            if isinstance(message, OperatorRequest):
                self._asker = sender
                return message
            self.rejected += 1
        return None

    def reply(self, reply: OperatorReply) -> None:
        """Answer the last request, or count the answer when its sender has gone or has no address."""
        try:
            self._socket.sendto(pack(reply, self._key), self._asker or "")
        except OSError:
            self.unsent += 1


class OperatorClient(_Socket):
    """An operator's end.

    Args:
        path: of the gateway's socket for operators.

    Raises:
        ChannelError: no gateway is there.
    """

    def __init__(self, path: Path, key: bytes) -> None:
        super().__init__(key)
        self._path = path
        self._boot_id = int.from_bytes(os.urandom(4))
        self._seq = 0
        self._socket.bind("")  # the kernel chooses a name, to which the gateway answers
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ChannelError(f"no gateway listens on {path}: {error.strerror or error}") from error

    def send(self, operation: Operation) -> None:
        """Ask for an operation and do not wait; count it when the gateway does not keep up or has gone."""
        self._seq += 1
        try:
            self._socket.send(pack(OperatorRequest(self._boot_id, self._seq, operation, time.monotonic_ns()), self._key))
        except OSError:
            self.unsent += 1

    def reply(self) -> OperatorReply | None:
        """The next answer that has arrived, or None."""
        try:
            message = unpack(self._socket.recv(MAX_DATAGRAM_BYTES), self._key)
        except OSError:
            return None
        return message if isinstance(message, OperatorReply) else None

    def ask(self, operation: Operation, timeout_s: float = REPLY_TIMEOUT_S) -> OperatorReply:
        """Ask for an operation and wait for the answer.

        Raises:
            ChannelError: there is none within the time.
        """
        deadline_s = time.monotonic() + timeout_s
        try:
            self._socket.settimeout(timeout_s)  # also to send: a flood may leave no room for the moment
            self.send(operation)
            while (left_s := deadline_s - time.monotonic()) > 0.0:
                self._socket.settimeout(left_s)
                reply = self.reply()
                if reply is not None and reply.seq == self._seq and reply.boot_id == self._boot_id:
                    return reply
        finally:
            self._socket.setblocking(False)
        raise ChannelError(f"no answer on {self._path} within {timeout_s:g} s: the gateway hangs, or has another key")


def _is_served(path: Path) -> bool:
    """Whether a living process listens on a socket; what a dead one left behind refuses the connection."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(str(path))
        except OSError as error:
            return error.errno == errno.EPERM
    return True
