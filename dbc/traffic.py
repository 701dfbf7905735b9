"""Bus load, exact to the bit, and the rate of every message, as far as a link hears and sends them.

What its filters keep from a link is not in it: identifiers that are not in the catalogue, remote and extended frames. Neither are
error frames and repeated attempts. On a bus with the car's own messages alone the load is that of the bus; with strangers on it
it is the known part.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from dbc.frame_length import INTERMISSION_BITS, classical_bits

WINDOW_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Traffic:
    """Traffic of one bus over about the last second that has passed completely.

    Args:
        load_norm: share of the time in which known frames, with the intermission after them, occupied the bus.
        rates_hz: frames per second by arbitration id.
    """

    load_norm: float = 0.0
    rates_hz: Mapping[int, float] = field(default_factory=dict)


class TrafficMeter:
    """Counts frames.

    Args:
        bitrate_bps: of the bus [bit/s].

    Attributes:
        traffic: of the last window.
    """

    def __init__(self, bitrate_bps: int) -> None:
        self.traffic = Traffic()
        self._bitrate_bps = bitrate_bps
        self._begin_ns: int | None = None
        self._waiting: list[tuple[int, bytes]] = []
        self._bits = 0
        self._frames: Counter[int] = Counter()

    def add(self, arbitration_id: int, data: bytes) -> None:
        """A classical data frame with an 11-bit identifier was on the bus."""
        # The bits are counted in one go, later: between other work their tables would have left the cache each time.
        self._waiting.append((arbitration_id, data))

    def tick(self, now_ns: int) -> None:
        """Count what has been added, and close the window when it is over; call it a few times in each."""
        for arbitration_id, data in self._waiting:
            self._bits += classical_bits(arbitration_id, data, len(data)) + INTERMISSION_BITS
            self._frames[arbitration_id] += 1
        self._waiting = []
        if self._begin_ns is None:
            self._begin_ns = now_ns
        elapsed_ns = now_ns - self._begin_ns
        if elapsed_ns < WINDOW_NS:
            return
        elapsed_s = elapsed_ns * 1e-9
        self.traffic = Traffic(
            self._bits / (self._bitrate_bps * elapsed_s),
            {arbitration_id: count / elapsed_s for arbitration_id, count in self._frames.items()},
        )
        self._begin_ns, self._bits, self._frames = now_ns, 0, Counter()
