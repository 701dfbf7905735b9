"""The directory of the user's own in which processes of one user find each other: sockets, and the key of a bench."""

import os
import stat
from pathlib import Path

from dbc.errors import SetupFailure


def runtime_directory() -> Path:
    """`$XDG_RUNTIME_DIR/xilgate`, or `/tmp/xilgate-UID` where there is no such run-time directory; made if need be.

    Raises:
        SetupFailure: somebody else could write to it, or it cannot be made.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    directory = Path(runtime, "xilgate") if os.path.isabs(runtime) and os.path.isdir(runtime) else Path(f"/tmp/xilgate-{os.getuid()}")
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise SetupFailure(f"{directory}: {error.strerror}") from error
    # Others can create names in /tmp: whoever owned the directory could stand in for the gateway.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise SetupFailure(f"{directory}: expected a directory of user {os.getuid()} with mode 0700")
    return directory
