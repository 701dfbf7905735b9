"""Packets between hub and node: exact round trip, and a value or a `WireError` for anything else."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_emulator.bus.core import ERROR, EXTENDED, FD, REMOTE, BusFrame
from vehicle_emulator.bus.wire import PACKET_BYTES, WireError, pack, unpack


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


@given(frames(), st.integers(0, 2**62))
def test_round_trip(frame, t_ns):
    packet = pack(frame, t_ns)
    assert len(packet) == PACKET_BYTES
    assert unpack(packet) == (frame, t_ns)


@given(st.binary(min_size=PACKET_BYTES, max_size=PACKET_BYTES))
def test_any_packet_is_a_frame_that_packs_again_or_a_wire_error(packet):
    try:
        frame, t_ns = unpack(packet)
    except WireError:
        return
    assert unpack(pack(frame, t_ns)) == (frame, t_ns)


@pytest.mark.parametrize("size", [0, PACKET_BYTES - 1, PACKET_BYTES + 1])
def test_packet_of_another_size_is_refused(size):
    with pytest.raises(WireError, match=f"packet of {size} bytes, expected {PACKET_BYTES}"):
        unpack(bytes(size))


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
    ],
)
def test_frames_that_no_bus_carries_are_refused(frame, cause):
    with pytest.raises(WireError, match=cause):
        pack(frame, 0)


def test_error_frames_may_carry_a_class_beyond_11_bits():
    frame = BusFrame(0x20000 - 1, bytes(8), ERROR, 8)
    assert unpack(pack(frame, 5)) == (frame, 5)
