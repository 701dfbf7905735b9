"""Key files: what is accepted, and one line for each thing that is not."""

import grp
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dbc.errors import SetupFailure
from gateway import keys
from gateway.keys import KeyMistake, load_key, load_or_make_key, make_key

pytestmark = pytest.mark.req("S1")


@pytest.fixture
def key_file(tmp_path):
    make_key(tmp_path / "key")
    return tmp_path / "key"


def refused(path, *words):
    with pytest.raises(KeyMistake) as caught:
        load_key(path)
    text = str(caught.value)
    assert "\n" not in text
    for word in (str(path), *words):
        assert word in text


def test_a_new_key_is_the_users_alone_and_never_the_same(tmp_path):
    for name in ("a", "b"):
        make_key(tmp_path / name)
        assert stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o600
    assert load_key(tmp_path / "a") != load_key(tmp_path / "b")
    assert load_key(tmp_path / "a") == load_key(tmp_path / "a")
    assert len(load_key(tmp_path / "a")) == 32
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]


def test_a_loose_umask_makes_no_loose_key(tmp_path):
    before = os.umask(0)
    try:
        make_key(tmp_path / "key")
    finally:
        os.umask(before)
    load_key(tmp_path / "key")


def test_a_key_is_never_replaced(key_file):
    before = key_file.read_bytes()
    with pytest.raises(KeyMistake, match="there is a key already"):
        make_key(key_file)
    assert key_file.read_bytes() == before
    assert os.listdir(key_file.parent) == ["key"]


def test_raw_and_hexadecimal_keys_are_the_same_key(key_file, tmp_path):
    raw = tmp_path / "raw"
    raw.write_bytes(bytes.fromhex(key_file.read_text()))
    raw.chmod(0o400)
    assert load_key(raw) == load_key(key_file)


@pytest.mark.parametrize("content", [b"", b"x" * 31, b"x" * 33, b"g" * 64, b"a" * 63, b"a" * 66, b"a" * 128, "é".encode() * 32, bytes(64)])
def test_what_is_no_key(key_file, content):
    key_file.write_bytes(content)
    refused(key_file, "holds no key", "32 bytes", "64 hexadecimal digits")


@pytest.mark.parametrize("mode", [0o601, 0o602, 0o604, 0o606, 0o620, 0o660, 0o610, 0o700, 0o777, 0o4600])
def test_modes_that_let_others_in(key_file, mode):
    key_file.chmod(mode)
    refused(key_file, f"mode {mode:04o}", "allowed: 0600")


def found(mode, uid, gid):
    """What the kernel says of a file."""
    return os.stat_result((stat.S_IFREG | mode, 0, 0, 1, uid, gid, 65, 0, 0, 0))


def test_a_group_may_read_it_only_if_it_is_the_rigs(monkeypatch):
    me, theirs = os.getuid(), 12345
    with pytest.raises(KeyMistake, match=r"^f: mode 0640 with group 12345; allowed: 0600$"):
        keys._check(Path("f"), found(0o640, me, theirs))
    monkeypatch.setattr(keys, "KEY_GROUP", "daemon")
    daemon = grp.getgrnam("daemon").gr_gid
    with pytest.raises(KeyMistake, match="allowed: 0600, or 0640 with group daemon"):
        keys._check(Path("f"), found(0o640, me, theirs))
    keys._check(Path("f"), found(0o640, me, daemon))
    keys._check(Path("f"), found(0o440, 0, daemon))
    for mode in (0o660, 0o644, 0o650):
        with pytest.raises(KeyMistake, match=f"mode {mode:04o}"):
            keys._check(Path("f"), found(mode, me, daemon))


def test_a_key_that_somebody_else_made_is_refused():
    keys._check(Path("f"), found(0o600, 0, 0))
    keys._check(Path("f"), found(0o600, os.getuid(), 0))
    with pytest.raises(KeyMistake, match=f"^f: belongs to user 12345; allowed: user {os.getuid()}, who runs this, or root$"):
        keys._check(Path("f"), found(0o600, 12345, 0))


def test_only_a_regular_file_is_a_key(key_file, tmp_path):
    (tmp_path / "link").symlink_to(key_file)
    refused(tmp_path / "link", "symbolic link")
    os.mkfifo(tmp_path / "pipe", 0o600)
    refused(tmp_path / "pipe", "no regular file")
    refused(tmp_path, "no regular file")
    refused(tmp_path / "nobody", "no such file", "xilgate make-key")
    refused(key_file / "below", "Not a directory")
    refused(tmp_path / "nowhere" / "key", f"there is no directory {tmp_path}/nowhere")


def test_keys_that_cannot_be_made(tmp_path):
    with pytest.raises(KeyMistake, match=f"{tmp_path}/nowhere/key: No such file"):
        make_key(tmp_path / "nowhere" / "key")


def test_a_bench_makes_its_key_once_whoever_comes_first(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(load_or_make_key, [tmp_path / "key"] * 32))
    assert len(set(found)) == 1
    assert os.listdir(tmp_path) == ["key"]


def test_a_dangling_link_is_not_followed_to_make_a_key(tmp_path):
    (tmp_path / "key").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(KeyMistake, match="symbolic link"):
        load_or_make_key(tmp_path / "key")
    assert os.listdir(tmp_path) == ["key"]


def test_a_datagram_of_another_boot_of_the_machine_has_another_key(key_file, tmp_path, monkeypatch):
    """Monotonic times begin again at a boot, and what was recorded before must not fit after it."""
    (tmp_path / "boot_id").write_text("0f0e0d0c-0000-0000-0000-000000000000\n")
    before = load_key(key_file)
    monkeypatch.setattr(keys, "_BOOT_ID", tmp_path / "boot_id")
    assert load_key(key_file) != before
    monkeypatch.setattr(keys, "_BOOT_ID", Path("/nowhere/boot_id"))
    with pytest.raises(SetupFailure, match="ProcSubset"):
        load_key(key_file)
