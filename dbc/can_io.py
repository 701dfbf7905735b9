"""A CAN interface as a port: frames in, frames out, errors as numbers; nothing waits and nothing raises once it is open.

SocketCAN is spoken directly: python-can tells neither our own frames from those of another program on this machine, nor how many
frames were lost, and fetches each with two or three system calls where one fetches all. Every other interface is python-can's.
"""

import contextlib
import ctypes
import errno
import socket
import struct
from collections.abc import Iterator
from itertools import islice
from typing import Protocol, runtime_checkable

import can

from dbc.rtnetlink import Controller, LinkWatch, text_of

MAX_FRAMES_PER_RECEIVE = 512
"""Bound on one call, so that a flood of frames cannot hold the caller's loop."""
MAX_STANDARD_ID = 0x7FF
# Flags of an identifier (linux/can.h).
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x8000_0000, 0x4000_0000, 0x2000_0000
ERROR_CLASS_MASK = 0x1FFF_FFFF

INTERFACES = tuple(sorted(can.VALID_INTERFACES))
"""Names of the interfaces that there are: python-can's, and those of packages that extend it."""

OPENING_ERRORS = (can.CanError, OSError, ValueError, ImportError, NotImplementedError, NameError)
"""What goes wrong when an interface is opened. NameError: python-can's Kvaser interface where the maker's library is not installed."""
_REFUSALS = (can.CanError, OSError, ValueError)
"""ValueError: a driver that has lost its file descriptor."""

Arrival = tuple[int, bytes, bool]
"""A frame that has arrived: its identifier, its data, and whether this port has sent it. Only the identifier of a classical data frame
with 11 bits is no greater than `MAX_STANDARD_ID`; that of an error frame has its flag, and the class of the error where it is known."""


class Port(Protocol):
    """An open interface.

    Attributes:
        has_echo: whether it hears the frames that it has sent, when they have been on the bus.
    """

    has_echo: bool

    @property
    def refusal(self) -> str:
        """Why an attempt to leave bus-off was refused; empty when none was."""

    def receive(self) -> tuple[list[Arrival], int]:
        """What has arrived since the last call, oldest first, and an error number; 0 when all is well."""

    def send(self, arbitration_id: int, data: bytes) -> int:
        """Hand a data frame over; 0, or the number of the error for which it was not taken."""

    def controller(self) -> Controller | None:
        """What the driver says of its controller, when something about it has changed."""

    def restart(self) -> None:
        """Ask the controller to leave bus-off."""

    def fileno(self) -> int:
        """Descriptor that is readable when something has arrived; -1 when there is none."""

    def lost(self) -> int:
        """Frames lost since it was opened because they were not fetched in time."""

    def disturb(self, arbitration_id: int | None, count: int) -> bool:
        """Destroy transmissions, for a bench; whether the bus does such a thing."""

    def close(self) -> None:
        """End it."""


@runtime_checkable
class Disturbable(Protocol):
    """A bus on which errors can be made, as the emulated one is."""

    def disturb(self, arbitration_id: int | None, count: int) -> None:
        """Destroy the next transmissions of a message on the wire; None: of any. Replaces an earlier call for it; 0 takes back."""


@runtime_checkable
class Direct(Protocol):
    """A bus that gives frames as they are: python-can's message takes longer to make than a frame to decode."""

    def arrivals(self) -> Iterator[Arrival]:
        """What has arrived and was not received yet, oldest first; it waits for nothing, and raises what `recv` does."""


@runtime_checkable
class Restartable(Protocol):
    """A bus whose controller leaves bus-off when asked to."""

    def restart(self) -> None:
        """Leave bus-off."""


def open_port(interface: str, channel: str, ids: frozenset[int] | None) -> Port:
    """Open an interface.

    Args:
        interface, channel: as python-can names them.
        ids: 11-bit identifiers of the data frames to hear, own ones included where the interface marks them; error frames are heard
            as well, and bus-off is left by `Port.restart`. None: everything but own frames, and bus-off as the interface is set up.

    Raises:
        one of `OPENING_ERRORS`.
    """
    if interface == "socketcan":
        return SocketCanPort(channel, ids)
    return PythonCanPort(interface, channel, ids)


# linux/can.h and linux/can/raw.h; Python's socket module has these only where it was built with them.
_SOL_CAN_RAW = 101
_CAN_RAW_FILTER, _CAN_RAW_ERR_FILTER, _CAN_RAW_RECV_OWN_MSGS = 1, 2, 4
_FRAME = struct.Struct("=IB3x8s")
_FILTER = struct.Struct("=II")
_MAX_FILTERS = 512
# asm-generic/socket.h; the ninth number is that of the datagrams for which there was no room.
_SO_MEMINFO = 55
_MEMINFO = struct.Struct("=9I")
_BATCH = 64
_RECEIVE_BUFFER_BYTES = 212_992
"""What an unprivileged process may ask of a Linux with default settings; the kernel doubles it, to room for 555 frames."""
_SEND_BUFFER_BYTES = 8_192
"""Doubled by the kernel to some twenty frames: what waits in front of a bus that is blocked is out of date when it is free."""
# struct mmsghdr and struct iovec: name, its length, spans, their number, control data, its length, flags; length received.
_MESSAGE = struct.Struct("@PIPNPNi0PI0P")
_SPAN = struct.Struct("@PN")
_FLAGS_AT = struct.calcsize("@PIPNPN")
_FLAGS = struct.Struct(f"={_FLAGS_AT}xi{_MESSAGE.size - _FLAGS_AT - 4}x")


class SocketCanPort:
    """A raw socket of the kernel's, filtered in the kernel and read in batches. Methods: see `Port`."""

    def __init__(self, interface: str, ids: frozenset[int] | None) -> None:
        self.has_echo = ids is not None
        self._receive_batch = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._frames = bytearray(_FRAME.size * _BATCH)
        self._messages = bytearray(_MESSAGE.size * _BATCH)
        self._spans = bytearray(_SPAN.size * _BATCH)
        self._lay_out()
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            self._set_options(ids)
            self._socket.bind((interface,))
            self._watch = LinkWatch(interface)
        except OSError:
            self._socket.close()
            raise
        self._descriptor = self._socket.fileno()

    @property
    def refusal(self) -> str:  # noqa: D102
        return text_of(self._watch.refusal) if self._watch.refusal else ""

    def receive(self) -> tuple[list[Arrival], int]:  # noqa: D102
        arrivals: list[Arrival] = []
        while len(arrivals) < MAX_FRAMES_PER_RECEIVE:
            count = self._receive_batch(self._descriptor, self._first_message, _BATCH, socket.MSG_DONTWAIT, None)
            if count < 0:
                number = ctypes.get_errno()
                return arrivals, 0 if number == errno.EAGAIN else number
            flags = _FLAGS.iter_unpack(memoryview(self._messages)[: count * _MESSAGE.size])
            frames = _FRAME.iter_unpack(memoryview(self._frames)[: count * _FRAME.size])
            arrivals += [
                # The kernel confirms with this flag what this very socket has sent.
                (identifier, data[:length], bool(flag & socket.MSG_CONFIRM))
                for (flag,), (identifier, length, data) in zip(flags, frames, strict=True)
            ]
            if count < _BATCH:
                break
        return arrivals, 0

    def send(self, arbitration_id: int, data: bytes) -> int:  # noqa: D102
        try:
            self._socket.send(_FRAME.pack(arbitration_id, len(data), data))
        except OSError as error:
            return error.errno or errno.EIO
        return 0

    def controller(self) -> Controller | None:  # noqa: D102
        return self._watch.read()

    def restart(self) -> None:  # noqa: D102
        self._watch.restart()

    def fileno(self) -> int:  # noqa: D102
        return self._socket.fileno()

    def lost(self) -> int:  # noqa: D102
        return int(_MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))[-1])

    def disturb(self, arbitration_id: int | None, count: int) -> bool:  # noqa: D102
        return False

    def close(self) -> None:  # noqa: D102
        self._watch.close()
        self._socket.close()

    def _lay_out(self) -> None:
        """Tell the kernel where the frames of a batch go."""
        frames, spans = _address_of(self._frames), _address_of(self._spans)
        for number in range(_BATCH):
            _SPAN.pack_into(self._spans, number * _SPAN.size, frames + number * _FRAME.size, _FRAME.size)
            _MESSAGE.pack_into(self._messages, number * _MESSAGE.size, 0, 0, spans + number * _SPAN.size, 1, 0, 0, 0, 0)
        self._first_message = ctypes.c_void_p(_address_of(self._messages))

    def _set_options(self, ids: frozenset[int] | None) -> None:
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, ERROR_CLASS_MASK)
        if ids is None:
            return
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_RECV_OWN_MSGS, 1)
        # Where there are more than the kernel takes, the caller hears everything and has to sort it out.
        if len(ids) <= _MAX_FILTERS:
            mask = MAX_STANDARD_ID | EXTENDED_FLAG | REMOTE_FLAG
            filters = b"".join(_FILTER.pack(arbitration_id, mask) for arbitration_id in sorted(ids))
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, filters)


def _address_of(buffer: bytearray) -> int:
    """Of a buffer whose size never changes."""
    return ctypes.addressof(ctypes.c_char.from_buffer(buffer))


_LIKE_SOCKETCAN: dict[str, dict[str, object]] = {
    "xilgate": {"receive_own_messages": True, "restart_ms": 0},
    "virtual": {"receive_own_messages": True},
}
"""Interfaces whose `is_rx` is False of own frames alone and whose error frames are laid out as SocketCAN's, and how they are opened."""


class PythonCanPort:
    """An interface of python-can. Methods: see `Port`."""

    def __init__(self, interface: str, channel: str, ids: frozenset[int] | None) -> None:
        self.refusal = ""
        self._is_like_socketcan = interface in _LIKE_SOCKETCAN
        self.has_echo = ids is not None and self._is_like_socketcan
        settings: dict[str, object] = {}
        if ids is not None:
            settings = {
                **_LIKE_SOCKETCAN.get(interface, {}),
                "can_filters": [{"can_id": one, "can_mask": MAX_STANDARD_ID, "extended": False} for one in sorted(ids)],
            }
        # A python-can configuration file of the user's must not change what was asked for.
        self._bus = can.Bus(channel=channel, interface=interface, ignore_config=True, **settings)  # type: ignore[arg-type]
        self._arrivals = self._bus.arrivals if isinstance(self._bus, Direct) else self._messages

    def receive(self) -> tuple[list[Arrival], int]:  # noqa: D102
        arrivals: list[Arrival] = []
        try:
            for arrival in islice(self._arrivals(), MAX_FRAMES_PER_RECEIVE):
                arrivals.append(arrival)  # noqa: PERF402 - what came before an error counts
        except _REFUSALS as error:
            return arrivals, _number_of(error, errno.EIO)
        return arrivals, 0

    def send(self, arbitration_id: int, data: bytes) -> int:  # noqa: D102
        try:
            self._bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
        except _REFUSALS as error:
            return _number_of(error, errno.ENOBUFS)
        return 0

    def controller(self) -> Controller | None:  # noqa: D102
        return None

    def restart(self) -> None:  # noqa: D102
        if not isinstance(self._bus, Restartable):
            self.refusal = "this interface cannot"
            return
        try:
            self._bus.restart()
        except _REFUSALS as error:
            self.refusal = str(error)

    def fileno(self) -> int:  # noqa: D102
        try:
            return self._bus.fileno()
        except (*_REFUSALS, NotImplementedError):
            return -1

    def lost(self) -> int:  # noqa: D102
        return 0

    def disturb(self, arbitration_id: int | None, count: int) -> bool:  # noqa: D102
        if not isinstance(self._bus, Disturbable):
            return False
        with contextlib.suppress(*_REFUSALS):  # the hub has gone: `receive` says so as well
            self._bus.disturb(arbitration_id, count)
        return True

    def close(self) -> None:  # noqa: D102
        with contextlib.suppress(*_REFUSALS):
            self._bus.shutdown()

    def _messages(self) -> Iterator[Arrival]:
        while (message := self._bus.recv(timeout=0)) is not None:
            yield self._identifier(message), bytes(message.data), not message.is_rx

    def _identifier(self, message: can.Message) -> int:
        if message.is_error_frame:
            return ERROR_FLAG | (message.arbitration_id if self._is_like_socketcan else 0)
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return EXTENDED_FLAG | message.arbitration_id
        return message.arbitration_id


def _number_of(error: Exception, default: int) -> int:
    """Error number of a refusal; the default where it has none."""
    number = error.error_code if isinstance(error, can.CanError) else getattr(error, "errno", None)
    return number or default
