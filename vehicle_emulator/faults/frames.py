"""What the faults of the bus do to frames.

Every effect takes the frames that its fault hits, one by one, and gives what goes on in their place; what it keeps for later it
lets go in `release`. The frames of each direction have an effect of their own. A frame of the wrong length, which another fault or
another node has made, has neither counter nor CRC and goes on as it is where these are wanted.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from heapq import heappop, heappush
from itertools import count
from random import Random

from dbc.catalogue import MessageSpec
from dbc.e2e import CRC_BYTE, alive_counter, seal
from dbc.frame import CanFrame
from vehicle_emulator.faults.spec import FaultSpec

_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000
_STEP_NS = 1_000_000
"""Of the emulator, which calls once in each."""

Messages = Mapping[int, MessageSpec]
"""Messages by their arbitration ids."""


class Picker:
    """Which of the frames that a fault is about it hits.

    Attributes:
        hits: frames hit so far.
        is_exhausted: whether there will be no more.
    """

    def __init__(self, spec: FaultSpec, random: Random) -> None:
        values = spec.values
        self._after_count = int(spec.number("after_count")) if "after_count" in values else 0
        self._every = int(spec.number("every")) if "every" in values else 1
        self._probability = spec.number("probability") if "probability" in values else 1.0
        self._count = int(spec.number("count")) if "count" in values else None
        self._random = random
        self._seen = 0
        self.hits = 0
        self.is_exhausted = False

    def picks(self) -> bool:
        """Whether the next frame is hit."""
        place = self._seen - self._after_count
        self._seen += 1
        if self.is_exhausted or place < 0 or place % self._every:
            return False
        if self._probability < 1.0 and self._random.random() >= self._probability:
            return False
        self.hits += 1
        self.is_exhausted = self._count is not None and self.hits >= self._count
        return True


class Effect:
    """An effect that does nothing; the others differ in what they need.

    Attributes:
        needs_all: whether it wants to see the frames of its messages while its fault is not active, too.
    """

    needs_all = False

    def begin(self, now_ns: int) -> None:
        """Its fault becomes active, for the first time or again."""

    def see(self, now_ns: int, frame: CanFrame) -> None:
        """Take note of a frame, hit or not."""

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """What goes on in the place of a frame that is hit."""
        return [frame]

    def skip(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """What goes on in the place of a frame of its messages that is not hit."""
        return [frame]

    def release(self, now_ns: int, is_active: bool) -> list[CanFrame]:
        """What it lets go now."""
        return []

    @property
    def is_holding(self) -> bool:
        """Whether it keeps frames."""
        return False


class Change(Effect):
    """Another frame, or none, in the place of each."""

    def __init__(self, change: Callable[[CanFrame], CanFrame | None]) -> None:
        self._change = change

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        changed = self._change(frame)
        return [] if changed is None else [changed]


class Copies(Effect):
    """The same frame several times."""

    def __init__(self, number: int) -> None:
        self._number = number

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        return [frame] * self._number


class Hold(Effect):
    """Frames come late, each by a time of its own; those of one message that are hit stay in order."""

    def __init__(self, delay_ns: Callable[[], int]) -> None:
        self._delay_ns = delay_ns
        self._kept: list[tuple[int, int, CanFrame]] = []
        self._places = count()
        self._last_due_ns: dict[int, int] = {}

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        self._keep(max(now_ns + self._delay_ns(), self._last_due_ns.get(frame.arbitration_id, 0)), frame)
        return []

    def release(self, now_ns: int, is_active: bool) -> list[CanFrame]:
        """See `Effect`."""
        due: list[CanFrame] = []
        while self._kept and self._kept[0][0] <= now_ns:
            due.append(heappop(self._kept)[2]._replace(t_ns=now_ns))
        return due

    @property
    def is_holding(self) -> bool:
        """See `Effect`."""
        return bool(self._kept)

    def _keep(self, due_ns: int, frame: CanFrame) -> None:
        self._last_due_ns[frame.arbitration_id] = due_ns
        heappush(self._kept, (due_ns, next(self._places), frame))


class HoldInOrder(Hold):
    """The same, and no frame of a message overtakes one of it that is held, hit or not."""

    def skip(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        due_ns = self._last_due_ns.get(frame.arbitration_id, 0)
        if due_ns <= now_ns:
            return [frame]
        self._keep(due_ns, frame)
        return []


class Reorder(Effect):
    """Frames are collected and come in reverse order; what is left at the end comes as it was."""

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._kept: list[CanFrame] = []

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        self._kept.append(frame)
        if len(self._kept) < self._depth:
            return []
        collected, self._kept = self._kept, []
        return [one._replace(t_ns=now_ns) for one in reversed(collected)]

    def release(self, now_ns: int, is_active: bool) -> list[CanFrame]:
        """See `Effect`."""
        if is_active:
            return []
        collected, self._kept = self._kept, []
        return [one._replace(t_ns=now_ns) for one in collected]

    @property
    def is_holding(self) -> bool:
        """See `Effect`."""
        return bool(self._kept)


class Replay(Effect):
    """Payloads of an earlier time; a frame before which there was none that early goes on as it is."""

    needs_all = True

    def __init__(self, age_ns: int) -> None:
        self._age_ns = age_ns
        self._seen: dict[int, deque[tuple[int, bytes]]] = {}

    def see(self, now_ns: int, frame: CanFrame) -> None:
        """See `Effect`."""
        seen = self._seen.setdefault(frame.arbitration_id, deque())
        seen.append((now_ns, frame.data))
        while len(seen) > 1 and seen[1][0] <= now_ns - self._age_ns:
            seen.popleft()

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        seen_ns, data = self._seen[frame.arbitration_id][0]
        return [frame._replace(data=data) if seen_ns <= now_ns - self._age_ns else frame]


class Babble(Effect):
    """Frames of nobody, at a rate; after a pause of the emulator, those that were due meanwhile are left out."""

    def __init__(self, frame: CanFrame, rate_hz: float) -> None:
        self._frame = frame
        self._rate_hz = rate_hz
        self._most = math.ceil(rate_hz * _STEP_NS / _NS_PER_S)
        self._since_ns = 0
        self._sent = 0

    def begin(self, now_ns: int) -> None:
        """See `Effect`."""
        self._since_ns, self._sent = now_ns, 0

    def release(self, now_ns: int, is_active: bool) -> list[CanFrame]:
        """See `Effect`."""
        due = 1 + int((now_ns - self._since_ns) * self._rate_hz / _NS_PER_S)
        new, self._sent = due - self._sent, due
        return [self._frame._replace(t_ns=now_ns)] * min(new, self._most)


class Stuck(Effect):
    """Something of each message stays as it was in the first frame that was hit since the fault became active.

    Args:
        mix: the payload, given message, first payload and live payload.
    """

    def __init__(self, messages: Messages, mix: Callable[[MessageSpec, bytes, bytes], bytes]) -> None:
        self._messages = messages
        self._mix = mix
        self._first: dict[int, bytes] = {}

    def begin(self, now_ns: int) -> None:
        """See `Effect`."""
        self._first.clear()

    def take(self, now_ns: int, frame: CanFrame) -> list[CanFrame]:
        """See `Effect`."""
        message = self._messages[frame.arbitration_id]
        if len(frame.data) != message.length_bytes:
            return [frame]
        return [frame._replace(data=self._mix(message, self._first.setdefault(frame.arbitration_id, frame.data), frame.data))]


Maker = Callable[[FaultSpec, Messages, Random], Effect]


def _corrupt(spec: FaultSpec, _: Messages, random: Random) -> Effect:
    bits = int(spec.number("bits"))

    def change(frame: CanFrame) -> CanFrame:
        data, places = bytearray(frame.data), range(8 * len(frame.data))
        for place in random.sample(places, min(bits, len(places))):
            data[place // 8] ^= 1 << place % 8
        return frame._replace(data=bytes(data))

    return Change(change)


def _cut(spec: FaultSpec, _: Messages, __: Random) -> Effect:
    length = int(spec.number("length"))
    return Change(lambda frame: frame._replace(data=frame.data[:length].ljust(length, b"\0")))


def _bad_crc(_: FaultSpec, __: Messages, ___: Random) -> Effect:
    def change(frame: CanFrame) -> CanFrame:
        return frame._replace(data=bytes(byte ^ 0xFF if place == CRC_BYTE else byte for place, byte in enumerate(frame.data)))

    return Change(change)


def _bad_counter(_: FaultSpec, messages: Messages, __: Random) -> Effect:
    return Stuck(messages, lambda message, first, live: _sealed(message, live, first))


def _freeze(_: FaultSpec, messages: Messages, __: Random) -> Effect:
    def mix(message: MessageSpec, first: bytes, live: bytes) -> bytes:
        return first if message.e2e_data_id is None else _sealed(message, first, live)

    return Stuck(messages, mix)


def _sealed(message: MessageSpec, payload: bytes, counted: bytes) -> bytes:
    """The payload with the counter of another one and the CRC that fits."""
    assert message.e2e_data_id is not None
    return seal(payload, message.e2e_data_id, alive_counter(counted))


def _jitter(spec: FaultSpec, _: Messages, random: Random) -> Effect:
    longest_ns = spec.number("jitter_ms") * _NS_PER_MS
    return HoldInOrder(lambda: round(random.uniform(0.0, longest_ns)))


def _delay(spec: FaultSpec, _: Messages, __: Random) -> Effect:
    delay_ns = round(spec.number("delay_ms") * _NS_PER_MS)
    return Hold(lambda: delay_ns)


def _babble(spec: FaultSpec, _: Messages, __: Random) -> Effect:
    return Babble(CanFrame(int(spec.number("id")), bytes(int(spec.number("length"))), 0), spec.number("rate_hz"))


def _lose(_: FaultSpec, __: Messages, ___: Random) -> Effect:
    return Change(lambda frame: None)


FRAME_EFFECTS: Mapping[str, Maker] = {
    "drop": _lose,
    "silence": _lose,
    "corrupt_bits": _corrupt,
    "wrong_length": _cut,
    "bad_crc": _bad_crc,
    "bad_counter": _bad_counter,
    "freeze_payload": _freeze,
    "replay": lambda spec, _, __: Replay(round(spec.number("age_ms") * _NS_PER_MS)),
    "delay": _delay,
    "jitter": _jitter,
    "duplicate": lambda spec, _, __: Copies(1 + int(spec.number("copies"))),
    "reorder": lambda spec, _, __: Reorder(int(spec.number("depth"))),
    "babble": _babble,
}
"""What a kind of fault does to frames."""
