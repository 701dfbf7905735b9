"""TOML that is well formed, or nearly, and that nobody means: one line each, and never all memory."""

import os
import re

import pytest

from dbc.errors import UserMistake
from dbc.section import read_toml


class Mistake(UserMistake):
    """What the reader of the file wants to raise."""


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[car]\ndbc = ["a\\u0000.dbc"]', r"car.dbc.0 = 'a\x00.dbc': allowed: text without zero bytes"),
        ("a = " + "[" * 3000 + "]" * 3000, "not usable TOML: sections and lists in each other: allowed: up to 50"),
        (".".join("a" * 3000) + " = 1", "sections and lists in each other: allowed: up to 50"),
        ("a = " + "1" * 5000, "not usable TOML: Exceeds the limit (4300 digits) for integer string conversion"),
        ("[a]\nb = 0x" + "f" * 5000, "a.b: 20000 bits: allowed: whole numbers of up to 63"),
        ('["\\n"]\nb = 0xffffffffffffffff', r"'\n'.b: 64 bits: allowed: whole numbers of up to 63"),
    ],
    ids=["zero byte", "lists", "sections", "digits", "bits", "name"],
)
def test_what_a_later_step_would_stumble_over_is_refused(tmp_path, text, told):
    path = tmp_path / "odd.toml"
    path.write_text(text)
    with pytest.raises(Mistake, match=f"^{re.escape(f'{path}: {told}')}") as caught:
        read_toml(path, Mistake)
    assert "\n" not in str(caught.value)


@pytest.mark.timeout(20)
def test_only_regular_files_of_a_bounded_size_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    for path, told in (("/dev/zero", "not a regular file"), (tmp_path / "pipe", "not a regular file"), (tmp_path, "Is a directory"),
                       (tmp_path / "large", "1099511627776 bytes: allowed: up to 16777216")):  # fmt: skip
        with pytest.raises(Mistake, match=f"^{path}: {told}$"):
            read_toml(tmp_path / path, Mistake)
