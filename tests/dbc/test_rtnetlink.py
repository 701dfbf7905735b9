"""What the kernel says of an interface, from messages put together by hand, and from the interface that every machine has."""

import random
import struct

import pytest

from dbc.health import BusState
from dbc.rtnetlink import Controller, LinkWatch, read_message

NEW_LINK, DELETE_LINK = 16, 17
UP, LOWER_UP = 0x1, 0x10000
INDEX = 4


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def link(*can: bytes, flags=UP | LOWER_UP, index=INDEX, kind=b"can\0") -> bytes:
    """A message about an interface: its name, and below its kind what the CAN driver tells."""
    info = attribute(1, kind) + attribute(0x8000 | 2, b"".join(can))
    return struct.pack("=BxHiII", 0, 280, index, flags, 0) + attribute(3, b"can0\0") + attribute(0x8000 | 18, info)


def can_state(number: int) -> bytes:
    return attribute(4, struct.pack("=I", number))


def counters(tx: int, rx: int) -> bytes:
    return attribute(8, struct.pack("=HH", tx, rx))


@pytest.mark.parametrize(
    ("kind", "body", "expected"),
    [
        (NEW_LINK, link(can_state(0), counters(3, 5)), Controller(BusState.ERROR_ACTIVE, 3, 5)),
        (NEW_LINK, link(can_state(1)), Controller(BusState.ERROR_WARNING)),
        (NEW_LINK, link(can_state(2), counters(128, 0)), Controller(BusState.ERROR_PASSIVE, 128, 0)),
        (NEW_LINK, link(can_state(3), counters(248, 0)), Controller(BusState.BUS_OFF, 248, 0)),
        (NEW_LINK, link(can_state(4)), Controller(BusState.DOWN)),
        (NEW_LINK, link(can_state(5)), Controller(BusState.DOWN)),
        (NEW_LINK, link(can_state(9)), Controller(BusState.DOWN)),
        (NEW_LINK, link(can_state(0), flags=0), Controller(BusState.DOWN)),
        (NEW_LINK, link(can_state(0), flags=UP), Controller(BusState.BUS_OFF)),
        (DELETE_LINK, link(can_state(0)), Controller(BusState.DOWN)),
        (NEW_LINK, link(kind=b"vcan\0"), Controller(BusState.ERROR_ACTIVE)),
        (NEW_LINK, link(can_state(3), kind=b"other\0"), Controller(BusState.ERROR_ACTIVE)),
        (NEW_LINK, link(can_state(3), index=INDEX + 1), None),
        (24, link(can_state(3)), None),
        (NEW_LINK, b"short", None),
    ],
)
def test_a_message_is_read(kind, body, expected):
    assert read_message(kind, body, INDEX) == expected


def test_no_message_raises():
    rng = random.Random(3)
    good = link(can_state(2), counters(128, 0))
    for _ in range(20_000):
        body = bytearray(good[: rng.randrange(len(good) + 1)])
        for _ in range(rng.randrange(4)):
            if body:
                body[rng.randrange(len(body))] = rng.randrange(256)
        told = read_message(NEW_LINK, bytes(body), INDEX)
        assert told is None or isinstance(told.state, BusState)


def test_an_interface_is_told_of_once_and_again_when_it_changes():
    watch = LinkWatch("lo")
    assert watch.read() in {Controller(BusState.ERROR_ACTIVE), Controller(BusState.DOWN)}
    assert watch.read() is None
    watch.close()


def test_a_refused_restart_is_remembered():
    watch = LinkWatch("lo")
    watch.restart()
    watch.read()
    assert watch.refusal != 0
    watch.close()


def test_no_such_interface():
    with pytest.raises(OSError, match=r"no interface with this name|No such device"):
        LinkWatch("nosuch0")
