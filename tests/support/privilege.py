"""Files as a user without privilege meets them, whoever runs the tests."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NOBODY = 65534


@contextmanager
def may_not_enter(directory: Path) -> Iterator[None]:
    """A new directory into which this thread may not look; root is somebody else to file systems for as long."""
    set_user = ctypes.CDLL(None).setfsuid
    directory.mkdir(mode=0o000)
    set_user(_NOBODY if os.geteuid() == 0 else os.geteuid())
    try:
        assert not os.path.exists(f"{directory}/."), "the directory can be entered all the same"
        yield
    finally:
        set_user(os.geteuid())
        directory.chmod(0o700)
