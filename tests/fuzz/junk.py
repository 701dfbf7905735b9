"""Frames that nobody should send: random ones, good ones that were garbled, repeated or held back."""

import random
from collections import deque

from dbc.catalogue import Catalogue
from dbc.frame import CanFrame

KEPT = 512
MAX_DATA_BYTES = 64
"""What a CAN FD frame carries; the gateway's buses have none."""


class Junk:
    """Makes malformed frames out of what was heard.

    Args:
        only_unknown: whether the identifiers are such as the DBC does not know.
    """

    def __init__(self, catalogue: Catalogue, seed: int, *, only_unknown: bool = False) -> None:
        self._rng = random.Random(seed)
        known = sorted(catalogue.by_id)
        self._ids = [number for number in range(0x800) if number not in catalogue.by_id] if only_unknown else known
        self._makers = (self._random,) if only_unknown else (self._random, self._known, self._flipped, self._cut, self._old)
        self._heard: deque[CanFrame] = deque(maxlen=KEPT)

    def hear(self, frames: list[CanFrame]) -> None:
        """Good frames, to be garbled later."""
        self._heard += frames

    def frames(self, count: int, now_ns: int) -> list[CanFrame]:
        """Malformed frames that arrive now."""
        return [self._rng.choice(self._makers)()._replace(t_ns=now_ns) for _ in range(count)]

    def among(self, good: list[CanFrame], count: int, now_ns: int) -> list[CanFrame]:
        """Good frames in a wrong order, with malformed ones in between."""
        mixed = good + self.frames(count, now_ns)
        self._rng.shuffle(mixed)
        return mixed

    def _random(self) -> CanFrame:
        rng = self._rng
        identifier = rng.choice((rng.choice(self._ids), rng.choice(self._ids) | rng.randrange(1, 1 << 18) << 11))
        return CanFrame(identifier, rng.randbytes(rng.choice((0, 1, 7, 8, 8, 8, 9, MAX_DATA_BYTES))), 0)

    def _known(self) -> CanFrame:
        return CanFrame(self._rng.choice(self._ids), self._rng.randbytes(8), 0)

    def _flipped(self) -> CanFrame:
        frame = self._old()
        data = bytearray(frame.data)
        for _ in range(self._rng.randrange(1, 5)):
            if data:
                data[self._rng.randrange(len(data))] ^= 1 << self._rng.randrange(8)
        return frame._replace(data=bytes(data))

    def _cut(self) -> CanFrame:
        frame = self._old()
        return frame._replace(data=(frame.data + bytes(8))[: self._rng.randrange(16)])

    def _old(self) -> CanFrame:
        return self._rng.choice(self._heard) if self._heard else self._known()
