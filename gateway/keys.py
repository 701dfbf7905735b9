"""The key of a rig: who has it can command its gateway. One file, which nobody else may read.

The file holds 32 random bytes, raw or as 64 hexadecimal digits. What signs datagrams is derived from it and from the boot id of
the machine: monotonic times start again with every boot, and what was recorded before must not fit again after it.
"""

import contextlib
import errno
import grp
import os
import secrets
import stat
from hashlib import blake2b
from pathlib import Path

from dbc.errors import SetupFailure, UserMistake
from gateway.messages import KEY_BYTES

KEY_GROUP = "xilgate"
"""The one group whose members may be allowed to read a key."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_HEX_BYTES = 2 * KEY_BYTES


class KeyMistake(UserMistake):
    """A key file is not usable; one line that names it, what is wrong and what is allowed."""


def load_key(path: Path) -> bytes:
    """The key that signs datagrams during this boot of the machine.

    Raises:
        KeyMistake: no such file, or one that others can read or have made, or that holds no key.
        SetupFailure: the machine does not tell its boot id.
    """
    try:
        boot_id = _BOOT_ID.read_bytes()
    except OSError as error:
        raise SetupFailure(f"{_BOOT_ID}: {error.strerror}; the control path needs it, ProcSubset=pid of systemd hides it") from error
    return blake2b(boot_id, key=_read(path), digest_size=KEY_BYTES).digest()


def make_key(path: Path) -> None:
    """Write a new key with mode 0600: the whole of it or nothing, and never over another one.

    Raises:
        KeyMistake: the file is there already, or cannot be made.
    """
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with open(descriptor, "w", encoding="ascii") as file:
                file.write(secrets.token_hex(KEY_BYTES) + "\n")
                file.flush()
                os.fsync(descriptor)
            os.link(unfinished, path)  # unlike a rename, this refuses to replace
        finally:
            unfinished.unlink()
    except FileExistsError as error:
        raise KeyMistake(f"{path}: there is a key already; move it away first, and restart whoever uses it") from error
    except OSError as error:
        raise KeyMistake(f"{path}: {error.strerror}") from error


def load_or_make_key(path: Path) -> bytes:
    """The key in a file, which is made when there is none; several processes may come first at once. See `load_key`."""
    if not os.path.lexists(path):
        with contextlib.suppress(KeyMistake):  # somebody else was faster; whatever else is wrong, loading will say
            make_key(path)
    return load_key(path)


def check_secret(path: Path) -> None:
    """Refuse a file that should be secret and that somebody else has made, or can read.

    Raises:
        KeyMistake: that, or it cannot be opened.
    """
    os.close(_opened(path))


def _opened(path: Path) -> int:
    try:
        # Not blocking: a pipe of this name must not hold the start up.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        if not path.parent.is_dir():
            raise KeyMistake(f"{path}: there is no directory {path.parent}") from error
        raise KeyMistake(f"{path}: no such file; `xilgate make-key FILE` makes a key of the control path") from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise KeyMistake(f"{path}: is a symbolic link; a key is a regular file") from error
        raise KeyMistake(f"{path}: {error.strerror}") from error
    try:
        _check(path, os.fstat(descriptor))
    except KeyMistake:
        os.close(descriptor)
        raise
    return descriptor


def _read(path: Path) -> bytes:
    descriptor = _opened(path)
    try:
        content = os.read(descriptor, _HEX_BYTES + 2)
    finally:
        os.close(descriptor)
    if len(content) == KEY_BYTES:
        return content
    try:
        key = bytes.fromhex(content.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise KeyMistake(f"{path}: holds no key; allowed: {KEY_BYTES} bytes, or {_HEX_BYTES} hexadecimal digits")
    return key


def _check(path: Path, found: os.stat_result) -> None:
    """Refuse a key that somebody else has made, or can read."""
    if not stat.S_ISREG(found.st_mode):
        raise KeyMistake(f"{path}: is no regular file")
    if found.st_uid not in (os.getuid(), 0):
        raise KeyMistake(f"{path}: belongs to user {found.st_uid}; allowed: user {os.getuid()}, who runs this, or root")
    mode = stat.S_IMODE(found.st_mode)
    # Its group may at most read it, others nothing.
    if mode & ~0o640 or (mode & 0o040 and found.st_gid != _key_group()):
        group = "" if _key_group() is None else f", or 0640 with group {KEY_GROUP}"
        raise KeyMistake(f"{path}: mode {mode:04o} with group {found.st_gid}; allowed: 0600{group}")


def _key_group() -> int | None:
    try:
        return grp.getgrnam(KEY_GROUP).gr_gid
    except KeyError:
        return None
