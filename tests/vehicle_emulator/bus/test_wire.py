"""Packets between hub and node: exact round trip, and a value or a `WireError` for anything else."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_emulator.bus.frame import ERROR, EXTENDED, FD, REMOTE, BusFrame
from vehicle_emulator.bus.wire import (
    MAX_FILTERS,
    MAX_PACKET_BYTES,
    Disturb,
    Filter,
    Hello,
    Restart,
    Settings,
    WireError,
    check,
    pack,
    pack_control,
    unpack,
)

CONTROLS = [
    Hello(2),
    Settings(),
    Settings((Filter(0x100, 0x7F0, None), Filter(1, 2, True)), own_frames=True, bus_errors=True, restart_ms=0),
    Settings(tuple(Filter(0x1FFFFFFF, 0x1FFFFFFF, False) for _ in range(MAX_FILTERS))),
    Restart(),
    Disturb(None, 32),
    Disturb(4, 0),
    Disturb(0x1FFFFFFF, 1_000_000),
]


@st.composite
def frames(draw):
    is_extended, is_fd = draw(st.booleans()), draw(st.booleans())
    is_remote = not is_fd and draw(st.booleans())
    length_bytes = draw(st.sampled_from([*range(9), 12, 16, 20, 24, 32, 48, 64] if is_fd else range(9)))
    return BusFrame(
        draw(st.integers(0, 0x1FFFFFFF if is_extended else 0x7FF)),
        b"" if is_remote else draw(st.binary(min_size=length_bytes, max_size=length_bytes)),
        EXTENDED * is_extended | FD * is_fd | REMOTE * is_remote,
        length_bytes,
    )


@given(frames(), st.integers(0, 2**62), st.booleans())
def test_frames_make_the_round_trip(frame, t_ns, is_own):
    packet = pack(frame, t_ns, is_own=is_own)
    assert len(packet) <= MAX_PACKET_BYTES
    assert unpack(packet) == (frame, t_ns, is_own)


@pytest.mark.parametrize("control", CONTROLS, ids=lambda control: type(control).__name__)
def test_controls_make_the_round_trip(control):
    packet = pack_control(control)
    assert len(packet) <= MAX_PACKET_BYTES
    assert unpack(packet) == control


@given(st.binary(max_size=100) | st.binary(max_size=90).map(b"\x01".__add__) | st.binary(max_size=40).map(b"\x02".__add__))
def test_any_packet_is_something_that_packs_again_or_a_wire_error(packet):
    try:
        content = unpack(packet)
    except WireError:
        return
    if isinstance(content, tuple):
        frame, t_ns, is_own = content
        assert unpack(pack(frame, t_ns, is_own=is_own)) == content
    else:
        assert unpack(pack_control(content)) == content


@pytest.mark.parametrize(
    ("packet", "cause"),
    [
        (b"", "packet of 0 bytes, expected 16 or more"),
        (bytes(16), "packet of kind 0"),
        (b"\x01" + bytes(14), "packet of 15 bytes"),
        (pack(BusFrame(1, b"abc", 0, 3), 0) + b"d", "4 bytes of data in a frame of length 3"),
        (pack(BusFrame(1, b"abc", 0, 3), 0)[:-1], "2 bytes of data in a frame of length 3"),
        (b"\x02", "control packet"),
        (b"\x02" + msgspec.msgpack.encode({"type": "Reboot"}), "control packet: Invalid value 'Reboot'"),
        (b"\x02" + msgspec.msgpack.encode({"type": "Hello", "version": "2"}), "Expected `int`, got `str`"),
        (b"\x02" + msgspec.msgpack.encode({"type": "Disturb", "arbitration_id": None, "count": -1}), "Expected `int` >= 0"),
        (b"\x02" + msgspec.msgpack.encode({"type": "Disturb", "arbitration_id": 2**29, "count": 1}), "Expected `int` <= 536870911"),
        (b"\x02" + msgspec.msgpack.encode({"type": "Settings", "filters": [[1, 2, None]] * 65}), "length <= 64"),
        (b"\x02" + msgspec.msgpack.encode({"type": "Restart", "now": True}), "unknown field `now`"),
        (b"\x02\x82\xa1x" + b"\x91" * 4000 + b"\xc0\xa4type\xa7Restart", "control packet: maximum recursion depth"),
    ],
)
def test_what_is_no_packet_is_refused(packet, cause):
    with pytest.raises(WireError, match=cause):
        unpack(packet)


@pytest.mark.parametrize(
    ("frame", "cause"),
    [
        (BusFrame(0x800, b"", 0, 0), r"0x800 outside \[0, 0x7FF\]"),
        (BusFrame(0x20000000, b"", EXTENDED, 0), r"outside \[0, 0x1FFFFFFF\]"),
        (BusFrame(-1, b"", 0, 0), "outside"),
        (BusFrame(1, bytes(9), 0, 9), "CAN frame of 9 bytes"),
        (BusFrame(1, bytes(9), FD, 9), "CAN FD frame of 9 bytes"),
        (BusFrame(1, b"abc", 0, 2), "3 bytes of data in a frame of length 2"),
        (BusFrame(1, b"ab", REMOTE, 2), "2 bytes of data"),
        (BusFrame(1, b"", 0x80, 0), "unknown flags 0x80"),
        (BusFrame(1, b"", FD | REMOTE, 0), "remote frame in CAN FD"),
        (BusFrame(1, b"", 0x10, 0), "bit rate switch or error state indicator in a classical frame"),
    ],
)
def test_frames_that_no_bus_carries_are_refused(frame, cause):
    with pytest.raises(WireError, match=cause):
        check(frame)
    if frame.arbitration_id >= 0:
        with pytest.raises(WireError, match=cause):
            unpack(pack(frame, 0))


def test_error_frames_carry_their_class_in_the_identifier():
    frame = BusFrame(0x3E4, bytes(8), ERROR, 8)
    assert unpack(pack(frame, 5)) == (frame, 5, False)
