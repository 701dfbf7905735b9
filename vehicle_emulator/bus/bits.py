"""Length of a frame on the wire, stuff bits included (ISO 11898-1:2015): classical as `dbc.frame_length` has it, and CAN FD."""

from functools import lru_cache

from dbc.frame_length import IDLE, STUFF_BYTE, arbitration_field, bits_of, classical_bits, stuff
from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

FD_TAIL_BITS = 9
"""What follows the CRC of a CAN FD frame at the nominal bit rate; its CRC delimiter belongs to the data phase."""
AFTER_ACKNOWLEDGE_BITS = 8
"""Acknowledge delimiter and end of frame."""

# ISO 11898-1:2015, 10.4.2.6: stuff count of 4 bits, CRC of 17 bits for up to 16 bytes, else 21, and a fixed stuff bit in front and
# after every fourth of these bits.
_SHORT_FD_BYTES = 16
_CRC17_FIELD_BITS = 4 + 17 + 6
_CRC21_FIELD_BITS = 4 + 21 + 7
_FD_DLC = {12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}


def frame_bits(frame: BusFrame) -> tuple[int, int]:
    """Bits from start of frame to end of frame, without the intermission.

    Returns:
        Bits at the nominal bit rate, and at that of the data phase. The bit in which the rate switches, BRS, is counted nominal
        and the one in which it switches back, the CRC delimiter, to the data phase: each is cut at its sample point, and the
        two halves that the one lacks are those that the other has too much.
    """
    arbitration_id, data, flags, length_bytes = frame
    if flags & FD:
        return _fd_bits(frame)
    return classical_bits(arbitration_id, data, length_bytes, bool(flags & EXTENDED), bool(flags & REMOTE)), 0


def _fd_bits(frame: BusFrame) -> tuple[int, int]:
    nominal, in_data_phase, state, level = _fd_head(frame.arbitration_id, frame.flags, frame.length_bytes)
    stuffed = 0
    for byte in frame.data:
        step = STUFF_BYTE[state | byte]
        state = step & (7 << 8)
        stuffed += step >> 11
    if frame.data:
        level = frame.data[-1] & 1
    # A run of five that ends with the data is broken by the fixed stuff bit of the CRC field, not by one more.
    if state >> 10 != level:
        stuffed -= 1
    crc_field = _CRC17_FIELD_BITS if frame.length_bytes <= _SHORT_FD_BYTES else _CRC21_FIELD_BITS
    in_data_phase += 8 * frame.length_bytes + stuffed + crc_field + 1
    if frame.flags & BITRATE_SWITCH:
        return nominal + FD_TAIL_BITS, in_data_phase
    return nominal + in_data_phase + FD_TAIL_BITS, 0


@lru_cache(maxsize=8192)
def _fd_head(arbitration_id: int, flags: int, length_bytes: int) -> tuple[int, int, int, int]:
    """Bits up to BRS, bits from there to the data, both with stuff bits; state of stuffing and level at the end."""
    switch = 1 if flags & BITRATE_SWITCH else 0
    # RRS, FDF, the reserved bit, BRS; then ESI and DLC.
    to_switch = [*arbitration_field(arbitration_id, 0, bool(flags & EXTENDED)), 1, 0, switch]
    after = [1 if flags & ERROR_STATE_INDICATOR else 0, *bits_of(_FD_DLC.get(length_bytes, length_bytes), 4)]
    # No run of five ends with a recessive BRS, which the reserved bit before it is not: its stuff bits are those before it.
    stuffed_before, state = stuff(to_switch, IDLE)
    stuffed_after, state = stuff(after, state)
    return len(to_switch) + stuffed_before, len(after) + stuffed_after, state << 8, after[-1]
