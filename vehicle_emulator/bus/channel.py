"""Where the hub of a channel is found: a Unix-domain socket in a directory of the user's own, or a TCP port on loopback."""

import os
import re
import socket
from pathlib import Path

from dbc.errors import SetupFailure
from dbc.runtime_directory import runtime_directory

LOOPBACK = "127.0.0.1"

_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
_TCP = re.compile(r"tcp://(?:127\.0\.0\.1|localhost):([0-9]{1,5})")
# `sun_path` of unix(7) less its terminator; the kernel refuses longer names.
_MAX_PATH_BYTES = 107
_MAX_PORT = 65_535

Address = Path | tuple[str, int]
"""Name of a Unix-domain socket, or host and port."""


class BusError(SetupFailure):
    """An emulated bus cannot be served or found; one line that says why."""


def address_of(channel: str) -> Address:
    """Address of the hub of a channel: a name, or tcp://127.0.0.1:PORT.

    Raises:
        BusError: not a channel, or see `socket_path`.
    """
    if not channel.startswith("tcp:"):
        return socket_path(channel)
    match = _TCP.fullmatch(channel)
    if match is None or not 1 <= int(match[1]) <= _MAX_PORT:
        raise BusError(f"channel {channel!r}: expected tcp://127.0.0.1:PORT, port 1 to {_MAX_PORT}; the bus is on loopback alone")
    return LOOPBACK, int(match[1])


def socket_path(channel: str) -> Path:
    """Socket of a channel; its directory is created if need be.

    Raises:
        BusError: not a channel name, a path that is too long, or a directory that is not safe to use, see `runtime_directory`.
    """
    if not _NAME.fullmatch(channel):
        raise BusError(f"channel {channel!r}: expected 1 to 32 letters, digits, - or _")
    try:
        path = runtime_directory() / f"{channel}.sock"
    except SetupFailure as error:
        raise BusError(str(error)) from error
    if len(os.fsencode(path)) > _MAX_PATH_BYTES:
        raise BusError(f"{path}: longer than the {_MAX_PATH_BYTES} bytes of a socket name; set XDG_RUNTIME_DIR to a shorter path")
    return path


def is_served(channel: str) -> bool:
    """Whether a hub serves the channel; of a TCP port, whether anybody does.

    Raises:
        BusError: see `address_of`.
    """
    address = address_of(channel)
    with open_socket(address) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address if isinstance(address, tuple) else str(address))
        except BlockingIOError:  # its queue of callers is full, so somebody is there; TCP always answers later
            return not isinstance(address, tuple) or _is_connected(probe)
        except OSError:
            return False
    return True


def open_socket(address: Address) -> socket.socket:
    """Socket of the kind that an address needs."""
    if isinstance(address, tuple):
        return socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def _is_connected(probe: socket.socket) -> bool:
    # On loopback the kernel itself has answered by now.
    return probe.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0
