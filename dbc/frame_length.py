"""Length of a classical frame on the wire, stuff bits included (ISO 11898-1:2015).

The level of the bus and how long it has lasted are the state of an automaton that is stepped a byte at a time through tables;
so is the CRC, whose bits are stuffed as well. The part in front of the data depends on identifier, kind and length alone and
is kept.
"""

from functools import lru_cache

INTERMISSION_BITS = 3
"""Recessive bits after a frame or an error frame before the next may begin."""
CLASSICAL_TAIL_BITS = 10
"""CRC delimiter, acknowledge slot and delimiter, 7 bits end of frame: what follows the CRC sequence, never stuffed."""
IDLE = 4
"""State of stuffing: 4 * level + length of the run - 1; a run of five never lasts, because its stuff bit begins a run of the other
level. This one is recessive: the dominant start of frame begins a run of its own, whatever the length of this one."""

_CRC15_POLYNOMIAL = 0x4599


def classical_bits(arbitration_id: int, data: bytes, length_bytes: int, is_extended: bool = False, is_remote: bool = False) -> int:
    """Bits from start of frame to end of frame, without the intermission.

    Args:
        data: empty in a remote frame.
        length_bytes: payload length; in a remote frame the length asked for.
    """
    fixed, stuffed, state, crc = _head(arbitration_id, length_bytes, is_extended, is_remote)
    for byte in data:
        crc = ((crc << 8) & 0x7FFF) ^ _CRC15[(crc >> 7) ^ byte]
        step = STUFF_BYTE[state | byte]
        state = step & (7 << 8)
        stuffed += step >> 11
    step = _STUFF_7_BITS[state >> 1 | crc >> 8]
    stuffed += (step >> 11) + (STUFF_BYTE[step & (7 << 8) | crc & 0xFF] >> 11)
    return fixed + 8 * len(data) + stuffed


def classical_bounds(length_bytes: int, *, is_extended: bool = False) -> tuple[int, int]:
    """Fewest and most bits of any classical data frame of a length, with the intermission.

    Source: Davis, Burns, Bril, Lukkien 2007, equations 1 and 2: one stuff bit at most for every 4 bits after the first.
    """
    exposed = (54 if is_extended else 34) + 8 * length_bytes
    fewest = exposed + CLASSICAL_TAIL_BITS + INTERMISSION_BITS
    return fewest, fewest + (exposed - 1) // 4


def arbitration_field(arbitration_id: int, remote: int, is_extended: bool) -> list[int]:
    """Start of frame, the arbitration field with `remote` as its last bit, and IDE of a standard frame."""
    if is_extended:
        return [0, *bits_of(arbitration_id >> 18, 11), 1, 1, *bits_of(arbitration_id & 0x3FFFF, 18), remote]
    return [0, *bits_of(arbitration_id, 11), remote, 0]


def bits_of(value: int, width: int) -> list[int]:
    """The lowest bits of a number, the most significant first."""
    return [value >> shift & 1 for shift in range(width - 1, -1, -1)]


def stuff(bits: list[int], state: int) -> tuple[int, int]:
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


@lru_cache(maxsize=8192)
def _head(arbitration_id: int, length_bytes: int, is_extended: bool, is_remote: bool) -> tuple[int, int, int, int]:
    """Bits that are never stuffed and those of head and CRC, stuff bits in the head, state of stuffing and CRC after it."""
    head = arbitration_field(arbitration_id, int(is_remote), is_extended)
    head += [0, 0] if is_extended else [0]
    head += bits_of(length_bytes, 4)
    crc = 0
    for bit in head:
        crc = ((crc << 1) & 0x7FFF) ^ (_CRC15_POLYNOMIAL if bit ^ (crc >> 14) else 0)
    stuffed, state = stuff(head, IDLE)
    return len(head) + 15 + CLASSICAL_TAIL_BITS, stuffed, state << 8, crc


def _stuff_table(width: int) -> list[int]:
    entries = (stuff(bits_of(value, width), state) for state in range(8) for value in range(1 << width))
    return [stuffed << 11 | state << 8 for stuffed, state in entries]


def _crc15_of(byte: int) -> int:
    crc = byte << 7
    for _ in range(8):
        crc = (crc << 1) ^ (_CRC15_POLYNOMIAL if crc & 0x4000 else 0)
        crc &= 0x7FFF
    return crc


STUFF_BYTE = _stuff_table(8)
"""For every state and eight bits, at state * 256 + bits: stuff bits * 2048 + next state * 256."""
_STUFF_7_BITS = _stuff_table(7)
_CRC15 = [_crc15_of(byte) for byte in range(256)]
