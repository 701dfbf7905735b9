"""Where the hub of a channel is found: one Unix-domain socket for each channel, in a directory of the user's own."""

import os
import re
import socket
import stat
from pathlib import Path

from dbc.errors import SetupFailure

_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
# `sun_path` of unix(7) less its terminator; the kernel refuses longer names.
_MAX_PATH_BYTES = 107


class BusError(SetupFailure):
    """An emulated bus cannot be served or found; one line that says why."""


def socket_path(channel: str) -> Path:
    """Socket of a channel; its directory is created if need be.

    The directory is `$XDG_RUNTIME_DIR/xilgate`, or `/tmp/xilgate-UID` where there is no such run-time directory.

    Raises:
        BusError: not a channel name, or the directory is not safe to use.
    """
    if not _NAME.fullmatch(channel):
        raise BusError(f"channel {channel!r}: expected 1 to 32 letters, digits, - or _")
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    directory = Path(runtime, "xilgate") if os.path.isabs(runtime) and os.path.isdir(runtime) else Path(f"/tmp/xilgate-{os.getuid()}")
    path = directory / f"{channel}.sock"
    if len(os.fsencode(path)) > _MAX_PATH_BYTES:
        raise BusError(f"{path}: longer than the {_MAX_PATH_BYTES} bytes of a socket name; set XDG_RUNTIME_DIR to a shorter path")
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise BusError(f"{directory}: {error.strerror}") from error
    # Others can create names in /tmp: whoever owned the directory could feed frames to the controller.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise BusError(f"{directory}: expected a directory of user {os.getuid()} with mode 0700")
    return path


def is_served(channel: str) -> bool:
    """Whether a hub serves the channel.

    Raises:
        BusError: see `socket_path`.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(socket_path(channel)))
        except BlockingIOError:  # its queue of callers is full, so somebody is there
            return True
        except OSError:
            return False
    return True
