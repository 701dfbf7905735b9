"""Files that people give and that are read as a whole: regular ones, of a bounded size."""

import errno
import os
import stat
from pathlib import Path


def read_whole(path: Path, max_bytes: int) -> bytes:
    """What a file holds. A device or a pipe could go on for ever, or never begin.

    Raises:
        OSError: it cannot be read, is no regular file, or holds more than `max_bytes`.
    """
    with open(path, "rb", opener=_without_waiting) as file:
        if not stat.S_ISREG((found := os.fstat(file.fileno())).st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, f"{found.st_size} bytes: allowed: up to {max_bytes}")
    return content


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)
