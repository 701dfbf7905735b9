"""Lets a test of a parallel run have the machine for itself."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_TURN, _MACHINE = 0, 1
"""Bytes of the file that stand for two locks."""


@contextmanager
def machine(lock: Path, *, is_alone: bool) -> Iterator[None]:
    """Run with whoever else shares the machine, or alone: then wait for all others, and let them wait.

    Args:
        lock: a file that all processes of the run name.
    """
    kind = fcntl.LOCK_EX if is_alone else fcntl.LOCK_SH
    with lock.open("ab+") as file:
        # Nobody else gets a turn while one waits to be alone, or it would wait for ever.
        fcntl.lockf(file, kind, 1, _TURN)
        fcntl.lockf(file, kind, 1, _MACHINE)
        fcntl.lockf(file, fcntl.LOCK_UN, 1, _TURN)
        yield
