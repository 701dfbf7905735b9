"""End-to-end protection of CAN payloads: AUTOSAR E2E profile 2, and the state machine of its receiver.

CRC-8 with polynomial 0x2F in byte 0 and a 4-bit alive counter in the low nibble of byte 1. Profile 2 detects every
pattern of up to three bit errors in a payload of this length, which profile 1 (polynomial 0x1D) does not.
The receiver's counter rules and its window follow AUTOSAR's "Specification of SW-C End-to-End Communication Protection Library",
with one difference: how a stream comes to be trusted again is the window's affair alone, for every kind of bad frame, so that the
profile has no state of its own in which it synchronises again. What has not come at all is not seen here but by its age.
It detects faults, not attackers.
"""

from dataclasses import dataclass
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
"""Largest counter step that is still a continuous stream: two frames in a row may be lost, which is AUTOSAR's MaxDeltaCounterInit of 2."""
COUNTER_BITS = 4
CRC_BITS = 8


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


def tells_stuck_bits(data_id: int, length_bytes: int) -> bool:
    """Whether a payload of zeros alone, and one of ones alone, fails under this data id; under 232 eight bytes of zeros would pass."""
    return all(seal(stuck, data_id, alive_counter(stuck)) != stuck for stuck in (bytes(length_bytes), b"\xff" * length_bytes))


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
        if not e2e_p02_check(payload, self._data_ids):
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


class E2EState(Enum):
    """Whether the stream of one message can be trusted."""

    INIT = "init"
    VALID = "valid"
    INVALID = "invalid"


@dataclass(frozen=True, slots=True)
class WindowRules:
    """When a stream is trusted.

    Args:
        size: frames that are looked at, the newest ones.
        max_bad: of these, bad ones that a stream may have.
        min_good: good frames in a row that make a stream valid.
        clean_ns: time for which an invalid stream must also have been without a bad frame and without a gap to be valid again [ns].
    """

    size: int = 10
    max_bad: int = 2
    min_good: int = 3
    clean_ns: int = 1_000_000_000


class E2EWindow:
    """State machine over the frames of one message, good and bad (E2E_SM of AUTOSAR): Init, Valid, Invalid.

    A bad frame is to be ignored at once, whatever the state is. This is about the frames after it: a stream with more than `max_bad`
    bad frames in its window is invalid, and then its good frames do not count either until it has been clean for `clean_ns`.

    Args:
        timeout_ns: age from which the message is missing [ns]; a stream with such a gap between two good frames is not clean.
    """

    def __init__(self, timeout_ns: int, rules: WindowRules) -> None:
        self._timeout_ns = timeout_ns
        self._rules = rules
        self._mask = (1 << rules.size) - 1
        self._bad = 0  # one bit for each frame of the window, set for a bad one
        self._clean_frames = self._clean_since_ns = self._last_ns = 0  # good ones in a row without a gap, up to the newest of all
        self.state = E2EState.INIT

    def add(self, now_ns: int, is_good: bool) -> E2EState:
        """Judge the stream anew with one more frame.

        Args:
            now_ns: when it arrived [ns].
            is_good: whether length, protection and ranges were as they must be.
        """
        self._bad = (self._bad << 1 | (not is_good)) & self._mask
        if not self._clean_frames or now_ns - self._last_ns > self._timeout_ns:
            self._clean_frames, self._clean_since_ns = 0, now_ns
        self._clean_frames = self._clean_frames + 1 if is_good else 0
        self._last_ns = now_ns
        if self.bad_frames > self._rules.max_bad:
            self.state = E2EState.INVALID
        elif self._is_trusted(now_ns):
            self.state = E2EState.VALID
        return self.state

    @property
    def bad_frames(self) -> int:
        """Bad frames in the window."""
        return self._bad.bit_count()

    def _is_trusted(self, now_ns: int) -> bool:
        wait_ns = self._rules.clean_ns if self.state is E2EState.INVALID else 0
        return self._clean_frames >= self._rules.min_good and now_ns - self._clean_since_ns >= wait_ns
