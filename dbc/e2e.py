"""End-to-end protection of CAN payloads: AUTOSAR E2E profile 2.

CRC-8 with polynomial 0x2F in byte 0 and a 4-bit alive counter in the low nibble of byte 1. Profile 2 detects every
pattern of up to three bit errors in a payload of this length, which profile 1 (polynomial 0x1D) does not.
The receiver's counter rules follow AUTOSAR's "Specification of SW-C End-to-End Communication Protection Library".
It detects faults, not attackers.
"""

from enum import Enum
from functools import cache

from e2e.p02 import e2e_p02_check, e2e_p02_protect

PROFILE = "P02"
CRC_START_BIT = 0
CRC_BYTE = CRC_START_BIT // 8
COUNTER_START_BIT = 8
COUNTER_MODULUS = 16
_COUNTER_BYTE = COUNTER_START_BIT // 8
_COUNTER_MASK = COUNTER_MODULUS - 1
MAX_DELTA_COUNTER = 3
"""Largest counter step that is still a continuous stream: two frames in a row may be lost."""


class E2EStatus(Enum):
    """Judgement on one received frame."""

    INITIAL = "initial"
    OK = "ok"
    SOME_LOST = "some lost"
    REPEATED = "repeated"
    WRONG_SEQUENCE = "wrong sequence"
    WRONG_CRC = "wrong crc"

    @property
    def is_usable(self) -> bool:
        """Whether the payload may be used."""
        return self in _USABLE


_USABLE = (E2EStatus.INITIAL, E2EStatus.OK, E2EStatus.SOME_LOST)


@cache
def data_id_list(data_id: int) -> bytes:
    """The sixteen data ids of one message, one for each counter value: the same for all of them.

    A list that varies with the counter, as AUTOSAR allows, turns one wrong bit in the counter into a wrong data id as
    well and so loses the guaranteed detection of two- and three-bit errors. A payload sent under another message's
    identifier fails the CRC either way.
    """
    return bytes([data_id]) * COUNTER_MODULUS


def seal(payload: bytes, data_id: int, counter: int) -> bytes:
    """The payload with this alive counter (0 to 15) and the CRC that fits."""
    buffer = bytearray(payload)
    buffer[_COUNTER_BYTE] = (buffer[_COUNTER_BYTE] & ~_COUNTER_MASK) | counter
    e2e_p02_protect(buffer, data_id_list(data_id), increment_counter=False)
    return bytes(buffer)


def alive_counter(payload: bytes) -> int:
    """The alive counter in a payload."""
    return payload[_COUNTER_BYTE] & _COUNTER_MASK


class E2EProtector:
    """Sender side of one message: writes the next counter and the CRC."""

    def __init__(self, data_id: int) -> None:
        self._data_id = data_id
        self._counter = COUNTER_MODULUS - 1

    def protect(self, payload: bytes) -> bytes:
        """The payload with alive counter and CRC filled in."""
        self._counter = (self._counter + 1) % COUNTER_MODULUS
        return seal(payload, self._data_id, self._counter)


class E2EReceiver:
    """Receiver side of one message: CRC first, then the step of the alive counter."""

    def __init__(self, data_id: int, max_delta_counter: int = MAX_DELTA_COUNTER) -> None:
        self._data_ids = data_id_list(data_id)
        self._max_delta_counter = max_delta_counter
        self._last_counter: int | None = None

    def check(self, payload: bytes) -> E2EStatus:
        """Judge a payload of at least two bytes."""
        if not e2e_p02_check(payload, self._data_ids, length=0):
            return E2EStatus.WRONG_CRC
        counter = alive_counter(payload)
        previous, self._last_counter = self._last_counter, counter
        if previous is None:
            return E2EStatus.INITIAL
        delta = (counter - previous) % COUNTER_MODULUS
        if delta == 0:
            return E2EStatus.REPEATED
        if delta == 1:
            return E2EStatus.OK
        if delta <= self._max_delta_counter:
            return E2EStatus.SOME_LOST
        return E2EStatus.WRONG_SEQUENCE
