"""Frame lengths: hand-computed frames, an independent bit stream, the bounds of the literature, and the rank in arbitration."""

import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dbc.frame_length import classical_bounds
from tests.vehicle_emulator.bus import bit_stream
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame, arbitration_key


@st.composite
def frames(draw, is_fd: bool):
    is_extended = draw(st.booleans())
    flags = EXTENDED * is_extended
    if is_fd:
        flags |= FD | BITRATE_SWITCH * draw(st.booleans()) | ERROR_STATE_INDICATOR * draw(st.booleans())
    else:
        flags |= REMOTE * draw(st.booleans())
    length_bytes = draw(st.sampled_from(bit_stream.FD_SIZES if is_fd else range(9)))
    # Runs of equal bits are what stuffing is about.
    byte = st.one_of(st.integers(0, 255), st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0x83, 0x7C]))
    data = b"" if flags & REMOTE else bytes(draw(st.lists(byte, min_size=length_bytes, max_size=length_bytes)))
    arbitration_id = draw(st.integers(0, 0x1FFFFFFF if is_extended else 0x7FF))
    return BusFrame(arbitration_id, data, flags, length_bytes)


def test_the_reference_has_the_catalogued_crc():
    # CRC-15/CAN of the ASCII digits 1 to 9 in the catalogue of parametrised CRC algorithms.
    assert int(bit_stream.crc15("".join(format(byte, "08b") for byte in b"123456789")), 2) == 0x059E


@pytest.mark.parametrize(
    ("frame", "bits"),
    [
        # 19 bits of head and 15 of CRC, all dominant: a stuff bit after each fifth, 6 in all; 10 bits of tail.
        (BusFrame(0, b"", 0, 0), 34 + 6 + 10),
        # The head, 0 10101010101 0 0 0 0000, ends in seven dominant bits: one stuff bit. The CRC, 110011101001100, has no run of five.
        (BusFrame(0x555, b"", 0, 0), 34 + 1 + 10),
    ],
)
def test_frames_counted_by_hand(frame, bits):
    assert frame_bits(frame) == (bits, 0)


@given(frames(is_fd=False))
@example(BusFrame(0, bytes(8), 0, 8))
@example(BusFrame(0x7FF, b"\xff" * 8, 0, 8))
def test_classical_frames_are_as_long_as_their_bit_stream(frame):
    assert frame_bits(frame) == (len(bit_stream.classical(*frame)), 0)


@given(frames(is_fd=True))
@example(BusFrame(0x1F, b"", FD | BITRATE_SWITCH, 0))
@example(BusFrame(0x7FF, b"\x1f", FD | BITRATE_SWITCH, 1))
def test_fd_frames_are_as_long_as_their_bit_stream(frame):
    assert frame_bits(frame) == bit_stream.fd_lengths(frame.arbitration_id, frame.data, frame.flags)


def test_many_random_frames_are_as_long_as_their_bit_stream():
    random_frames = random.Random(4)
    for _ in range(3000):
        size = random_frames.randrange(9)
        frame = BusFrame(random_frames.randrange(0x800), random_frames.randbytes(size), 0, size)
        assert frame_bits(frame)[0] == len(bit_stream.classical(*frame))


def test_a_stuff_bit_after_the_last_bit_of_the_crc_counts():
    random_frames = random.Random(5)
    ends = 0
    for _ in range(3000):
        frame = BusFrame(random_frames.randrange(0x800), random_frames.randbytes(2), 0, 2)
        wire = bit_stream.classical(*frame)[:-10]
        if wire[-6:] in ("000001", "111110"):
            ends += 1
            assert frame_bits(frame) == (len(wire) + 10, 0)
    assert ends > 20


def test_a_run_that_ends_with_the_fd_data_is_broken_once():
    # 00011111 ends in five recessive bits, 00101111 in four: the fixed stuff bit serves for both.
    long, short = (frame_bits(BusFrame(0x2AA, bytes([byte]), FD, 1))[0] for byte in (0b00011111, 0b00101111))
    assert long == short


@pytest.mark.parametrize(("size", "crc_field"), [(16, 27), (20, 32)])
def test_fd_crc_field_grows_beyond_16_bytes(size, crc_field):
    # 0101.. needs no stuff bit beyond the head, which is the same but for the DLC: 1010 and 1011.
    frame = BusFrame(0x2AA, b"\x55" * size, FD | BITRATE_SWITCH, size)
    nominal, in_data_phase = frame_bits(frame)
    assert in_data_phase == 1 + 4 + 8 * size + crc_field + 1
    assert nominal == 17 + 9


@pytest.mark.parametrize(
    ("size", "is_extended", "bounds"),
    [(8, False, (111, 135)), (0, False, (47, 55)), (8, True, (131, 160)), (0, True, (67, 80)), (4, False, (79, 95))],
)
def test_bounds_of_the_literature(size, is_extended, bounds):
    assert classical_bounds(size, is_extended=is_extended) == bounds


@given(frames(is_fd=False).filter(lambda frame: not frame.flags & REMOTE))
def test_no_frame_is_outside_the_bounds(frame):
    fewest, most = classical_bounds(frame.length_bytes, is_extended=bool(frame.flags & EXTENDED))
    assert fewest <= frame_bits(frame)[0] + 3 <= most


@given(frames(is_fd=False), frames(is_fd=False))
def test_arbitration_follows_the_first_bit_that_differs(one, other):
    # RTR, or SRR and IDE, are the last bits of the arbitration field of either format.
    fields = [bit_stream.header(frame.arbitration_id, 0, frame.flags)[0][: 33 if frame.flags & EXTENDED else 14] for frame in (one, other)]
    fields = [field.ljust(33, "0") for field in fields]
    keys = [arbitration_key(frame) for frame in (one, other)]
    assert (keys[0] < keys[1]) == (fields[0] < fields[1])
    assert (keys[0] == keys[1]) == (fields[0] == fields[1])


def test_ranks_that_the_standard_names():
    base = 0x123
    data, remote = BusFrame(base, b"", 0, 0), BusFrame(base, b"", REMOTE, 0)
    extended = BusFrame(base << 18, b"", EXTENDED, 0)
    ranked = [data, remote, extended, extended._replace(flags=EXTENDED | REMOTE), BusFrame(base + 1, b"", 0, 0)]
    assert sorted([ranked[place] for place in (3, 1, 4, 0, 2)], key=arbitration_key) == ranked
    assert arbitration_key(BusFrame(base, b"", FD, 0)) == arbitration_key(data)
