"""Length of a frame on the wire, stuff bits included (ISO 11898-1:2015).

The level of the bus and how long it has lasted are the state of an automaton that is stepped a byte at a time through tables;
so is the CRC, whose bits are stuffed as well in a classical frame. The part in front of the data depends on identifier, format
and length alone and is kept.
"""

from functools import lru_cache

from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

INTERMISSION_BITS = 3
"""Recessive bits after a frame or an error frame before the next may begin."""
CLASSICAL_TAIL_BITS = 10
"""CRC delimiter, acknowledge slot and delimiter, 7 bits end of frame: what follows the CRC sequence, never stuffed."""
FD_TAIL_BITS = 9
"""The same in a CAN FD frame at the nominal bit rate; its CRC delimiter belongs to the data phase."""
AFTER_ACKNOWLEDGE_BITS = 8
"""Acknowledge delimiter and end of frame."""

_CRC15_POLYNOMIAL = 0x4599
# ISO 11898-1:2015, 10.4.2.6: stuff count of 4 bits, CRC of 17 bits for up to 16 bytes, else 21, and a fixed stuff bit in front and
# after every fourth of these bits.
_SHORT_FD_BYTES = 16
_CRC17_FIELD_BITS = 4 + 17 + 6
_CRC21_FIELD_BITS = 4 + 21 + 7
_FD_DLC = {12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}

# State of stuffing: 4 * level + length of the run - 1. A run of five never lasts: its stuff bit begins a run of the other level.
_IDLE = 4
"""Recessive; the dominant start of frame begins a run of its own whatever the length of this one."""


def frame_bits(frame: BusFrame) -> tuple[int, int]:
    """Bits from start of frame to end of frame, without the intermission.

    Returns:
        Bits at the nominal bit rate, and at that of the data phase. The bit in which the rate switches, BRS, is counted nominal
        and the one in which it switches back, the CRC delimiter, to the data phase: each is cut at its sample point, and the
        two halves that the one lacks are those that the other has too much.
    """
    if frame.flags & FD:
        return _fd_bits(frame)
    fixed, stuffed, state, crc = _classical_head(frame.arbitration_id, frame.flags & (EXTENDED | REMOTE), frame.length_bytes)
    for byte in frame.data:
        crc = ((crc << 8) & 0x7FFF) ^ _CRC15[(crc >> 7) ^ byte]
        step = _STUFF[state | byte]
        state = step & (7 << 8)
        stuffed += step >> 11
    step = _STUFF_7_BITS[state >> 1 | crc >> 8]
    stuffed += (step >> 11) + (_STUFF[step & (7 << 8) | crc & 0xFF] >> 11)
    return fixed + 8 * len(frame.data) + stuffed, 0


def _fd_bits(frame: BusFrame) -> tuple[int, int]:
    nominal, in_data_phase, state, level = _fd_head(frame.arbitration_id, frame.flags, frame.length_bytes)
    stuffed = 0
    for byte in frame.data:
        step = _STUFF[state | byte]
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


def classical_bounds(length_bytes: int, *, is_extended: bool = False) -> tuple[int, int]:
    """Fewest and most bits of any classical data frame of a length, with the intermission.

    Source: Davis, Burns, Bril, Lukkien 2007, equations 1 and 2: one stuff bit at most for every 4 bits after the first.
    """
    exposed = (54 if is_extended else 34) + 8 * length_bytes
    fewest = exposed + CLASSICAL_TAIL_BITS + INTERMISSION_BITS
    return fewest, fewest + (exposed - 1) // 4


def _identifier(arbitration_id: int, flags: int, remote: int) -> list[int]:
    """Start of frame, the arbitration field, and IDE of a standard frame."""
    if flags & EXTENDED:
        return [0, *_bits(arbitration_id >> 18, 11), 1, 1, *_bits(arbitration_id & 0x3FFFF, 18), remote]
    return [0, *_bits(arbitration_id, 11), remote, 0]


@lru_cache(maxsize=8192)
def _classical_head(arbitration_id: int, flags: int, length_bytes: int) -> tuple[int, int, int, int]:
    """Bits that are never stuffed and those of head and CRC, stuff bits in the head, state of stuffing and CRC after it."""
    head = _identifier(arbitration_id, flags, 1 if flags & REMOTE else 0)
    head += [0, 0] if flags & EXTENDED else [0]
    head += _bits(length_bytes, 4)
    crc = 0
    for bit in head:
        crc = ((crc << 1) & 0x7FFF) ^ (_CRC15_POLYNOMIAL if bit ^ (crc >> 14) else 0)
    stuffed, state = _stuff(head, _IDLE)
    return len(head) + 15 + CLASSICAL_TAIL_BITS, stuffed, state << 8, crc


@lru_cache(maxsize=8192)
def _fd_head(arbitration_id: int, flags: int, length_bytes: int) -> tuple[int, int, int, int]:
    """Bits up to BRS, bits from there to the data, both with stuff bits; state of stuffing and level at the end."""
    switch = 1 if flags & BITRATE_SWITCH else 0
    # RRS, FDF, the reserved bit, BRS; then ESI and DLC.
    to_switch = [*_identifier(arbitration_id, flags, 0), 1, 0, switch]
    after = [1 if flags & ERROR_STATE_INDICATOR else 0, *_bits(_FD_DLC.get(length_bytes, length_bytes), 4)]
    # No run of five ends with a recessive BRS, which the reserved bit before it is not: its stuff bits are those before it.
    stuffed_before, state = _stuff(to_switch, _IDLE)
    stuffed_after, state = _stuff(after, state)
    return len(to_switch) + stuffed_before, len(after) + stuffed_after, state << 8, after[-1]


def _bits(value: int, width: int) -> list[int]:
    return [value >> shift & 1 for shift in range(width - 1, -1, -1)]


def _stuff(bits: list[int], state: int) -> tuple[int, int]:
    """Stuff bits that a sequence calls for, and the state after it."""
    stuffed = 0
    for bit in bits:
        if bit != state >> 2:
            state = bit << 2
        elif state & 3 == 3:
            state, stuffed = (1 - bit) << 2, stuffed + 1
        else:
            state += 1
    return stuffed, state


def _stuff_table(width: int) -> list[int]:
    """For every state and `width` bits, at state * 2**width + bits: stuff bits * 2048 + next state * 256."""
    entries = (_stuff(_bits(value, width), state) for state in range(8) for value in range(1 << width))
    return [stuffed << 11 | state << 8 for stuffed, state in entries]


def _crc15_of(byte: int) -> int:
    crc = byte << 7
    for _ in range(8):
        crc = (crc << 1) ^ (_CRC15_POLYNOMIAL if crc & 0x4000 else 0)
        crc &= 0x7FFF
    return crc


_STUFF = _stuff_table(8)
_STUFF_7_BITS = _stuff_table(7)
_CRC15 = [_crc15_of(byte) for byte in range(256)]
