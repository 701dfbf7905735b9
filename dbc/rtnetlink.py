"""What the kernel tells of one CAN interface over rtnetlink(7): up, down, removed, and the state of its controller.

The kernel is asked once, and again whenever it says that something about the interface has changed; nothing here waits. What it
sends is read with a bound, and whatever is not as linux/if_link.h and linux/can/netlink.h have it is passed over.
"""

import contextlib
import errno
import os
import socket
import struct
from collections.abc import Iterator
from typing import NamedTuple

from dbc.health import BusState

_ERROR, _NEW_LINK, _DELETE_LINK, _GET_LINK = 2, 16, 17, 18
_REQUEST, _ACKNOWLEDGE = 0x1, 0x4
_GROUP_OF_LINKS = 1
_IFF_UP, _IFF_LOWER_UP = 0x1, 0x1_0000
# Attributes: of a link, of its kind, of a CAN interface.
_LINK_INFO, _KIND, _DATA = 18, 1, 2
_CAN_STATE, _CAN_RESTART, _CAN_ERROR_COUNTERS = 4, 7, 8
_TYPE_MASK = 0x3FFF

_HEADER = struct.Struct("=IHHII")
_INTERFACE = struct.Struct("=BxHiII")
_ATTRIBUTE = struct.Struct("=HH")
_COUNTERS = struct.Struct("=HH")
_WORD = struct.Struct("=i")

_DATAGRAM_BYTES = 32_768
_MAX_DATAGRAMS = 64
_STATE_OF_CAN_STATE = (BusState.ERROR_ACTIVE, BusState.ERROR_WARNING, BusState.ERROR_PASSIVE, BusState.BUS_OFF)
"""By the value of `enum can_state`; stopped and sleeping, which follow, carry no traffic."""


class Controller(NamedTuple):
    """An interface and its controller as the driver has them; error counters -1 where it does not tell them."""

    state: BusState
    tx_error_count: int = -1
    rx_error_count: int = -1


class LinkWatch:
    """Watches one interface.

    Args:
        interface: its name; it is there.

    Attributes:
        refusal: error number of the last restart that the kernel refused: EPERM without the capability CAP_NET_ADMIN; 0 for none.

    Raises:
        OSError: no such interface, or no netlink.
    """

    def __init__(self, interface: str) -> None:
        self.refusal = 0
        self._index = socket.if_nametoindex(interface)
        self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE)
        self._socket.setblocking(False)
        try:
            self._socket.bind((0, _GROUP_OF_LINKS))
            self._ask()
        except OSError:
            self._socket.close()
            raise

    def read(self) -> Controller | None:
        """The interface as it is now; None when nothing has changed since the last call."""
        has_changed, controller = self._drain()
        if has_changed and (controller is None or controller.state is not BusState.DOWN):
            # What was sent with the change may be older by now than the error frames that were read meanwhile.
            with contextlib.suppress(OSError):
                self._ask()
            controller = self._drain()[1] or controller
        return controller

    def restart(self) -> None:
        """Ask the driver to leave bus-off, as `ip link set ... type can restart` does; a refusal comes with a later `read`."""
        restart = _packed(_CAN_RESTART, _WORD.pack(1))
        info = _packed(_LINK_INFO, _packed(_KIND, b"can\0") + _packed(_DATA, restart))
        with contextlib.suppress(OSError):
            self._send(_NEW_LINK, _REQUEST | _ACKNOWLEDGE, info)

    def close(self) -> None:
        """End it."""
        self._socket.close()

    def _ask(self) -> None:
        self._send(_GET_LINK, _REQUEST, b"")

    def _send(self, kind: int, flags: int, attributes: bytes) -> None:
        body = _INTERFACE.pack(socket.AF_UNSPEC, 0, self._index, 0, 0) + attributes
        self._socket.sendto(_HEADER.pack(_HEADER.size + len(body), kind, flags, 0, 0) + body, (0, 0))

    def _drain(self) -> tuple[bool, Controller | None]:
        """All that has been sent: whether the kernel has announced a change by itself, and the newest that it says of the interface."""
        has_changed, newest = False, None
        for _ in range(_MAX_DATAGRAMS):
            try:
                datagram, (_, groups) = self._socket.recvfrom(_DATAGRAM_BYTES)
            except OSError as error:
                # Some of what it sent was lost, because there was too much of it.
                has_changed |= error.errno == errno.ENOBUFS
                break
            for kind, body in _messages(datagram):
                if kind == _ERROR:
                    self._take_answer(body)
                elif (controller := read_message(kind, body, self._index)) is not None:
                    newest = controller
                    has_changed |= groups != 0
        return has_changed, newest

    def _take_answer(self, body: bytes) -> None:
        if len(body) >= _WORD.size and (code := -_WORD.unpack_from(body)[0]):
            self.refusal = code


def text_of(refusal: int) -> str:
    """What a refusal means, for people."""
    return os.strerror(refusal)


def _packed(kind: int, value: bytes) -> bytes:
    return (_ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value).ljust(_aligned(_ATTRIBUTE.size + len(value)), b"\0")


def _aligned(length: int) -> int:
    return (length + 3) & ~3


def _messages(datagram: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and body of every message of a datagram."""
    at = 0
    while at + _HEADER.size <= len(datagram):
        length, kind, *_ = _HEADER.unpack_from(datagram, at)
        if not _HEADER.size <= length <= len(datagram) - at:
            return
        yield kind, datagram[at + _HEADER.size : at + length]
        at += _aligned(length)


def _attributes(data: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if not _ATTRIBUTE.size <= length <= len(data) - at:
            break
        found[kind & _TYPE_MASK] = data[at + _ATTRIBUTE.size : at + length]
        at += _aligned(length)
    return found


def read_message(kind: int, body: bytes, index: int) -> Controller | None:
    """What a message says of an interface; None when it is about something else."""
    if kind not in {_NEW_LINK, _DELETE_LINK} or len(body) < _INTERFACE.size:
        return None
    _, _, its_index, flags, _ = _INTERFACE.unpack_from(body)
    if its_index != index:
        return None
    if kind == _DELETE_LINK or not flags & _IFF_UP:
        return Controller(BusState.DOWN)
    info = _attributes(_attributes(body[_INTERFACE.size :]).get(_LINK_INFO, b""))
    told = _attributes(info.get(_DATA, b"")) if info.get(_KIND) == b"can\0" else {}
    tx = rx = -1
    if len(counters := told.get(_CAN_ERROR_COUNTERS, b"")) == _COUNTERS.size:
        tx, rx = _COUNTERS.unpack(counters)
    # The kernel takes the carrier off at bus-off and gives it back at a restart.
    state = BusState.ERROR_ACTIVE if flags & _IFF_LOWER_UP else BusState.BUS_OFF
    if state is not BusState.BUS_OFF and len(value := told.get(_CAN_STATE, b"")) == _WORD.size:
        (number,) = _WORD.unpack(value)
        state = _STATE_OF_CAN_STATE[number] if 0 <= number < len(_STATE_OF_CAN_STATE) else BusState.DOWN
    return Controller(state, tx, rx)
