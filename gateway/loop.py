"""How a real-time process waits: for absolute deadlines, skipped rather than caught up with after a stall, and for what arrives."""

import select
import time
from array import array
from bisect import bisect_left
from collections.abc import Callable

BUCKETS_NS = tuple(bound_us * 1_000 for bound_us in (20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000))
"""Upper ends of the buckets of a histogram [ns]; what is longer falls into one more."""

SPACING_NS = 700_000
"""Shortest time from a wake-up to the next one for frames [ns]: 2,000 of them a second, or a flood, must not mean as many wake-ups."""
SHORTEST_NS = 200_000
"""The same for a frame that is due, and for a command after another one [ns]: who sends without end must not take the processor."""
EARLY_NS = 300_000
"""How much earlier or later than its cycle time says a frame that is due usually comes [ns]: the jitter of a bus and of a wake-up."""
LONGEST_NS = 5_000_000
"""Longest sleep [ns]: what is not waited for has a time of arrival that is no more than this late."""

_LOAD_WINDOW_NS = 1_000_000_000


class Histogram:
    """Counts durations in fixed buckets; takes no memory while it counts, and may be read from another thread.

    Attributes:
        counts: for every bucket of `BUCKETS_NS`, and one for what is longer.
        sum_ns, max_ns: of all durations [ns].
    """

    def __init__(self) -> None:
        self.counts = array("Q", bytes(8 * (len(BUCKETS_NS) + 1)))
        self.sum_ns = 0
        self.max_ns = 0

    def observe(self, duration_ns: int) -> None:
        """Count one duration [ns]."""
        self.counts[bisect_left(BUCKETS_NS, duration_ns)] += 1
        self.sum_ns += duration_ns
        self.max_ns = max(self.max_ns, duration_ns)


class CpuLoad:
    """Share of a core that a thread takes, over about the last second."""

    def __init__(self) -> None:
        self._begin: tuple[int, int] | None = None
        self._load_norm = 0.0

    def update(self, now_ns: int, cpu_ns: int) -> float:
        """The share, after `cpu_ns` of the thread's time [ns]; call it a few times a second."""
        if self._begin is None:
            self._begin = now_ns, cpu_ns
        begin_ns, cpu_begin_ns = self._begin
        if now_ns - begin_ns >= _LOAD_WINDOW_NS:
            self._load_norm = (cpu_ns - cpu_begin_ns) / (now_ns - begin_ns)
            self._begin = now_ns, cpu_ns
        return self._load_norm


class ArrivalWait:
    """Sleeps until something has arrived that is urgent, or a deadline has come.

    Args:
        frames: gives the descriptors of what comes many times, each time anew; those that are not usable are left out for that time.
        command: a descriptor of what comes rarely, and must hardly wait.
    """

    def __init__(self, frames: Callable[[], list[int]], command: int) -> None:
        self._frames = frames
        self._command = command
        self._last_ns = time.monotonic_ns()
        self._had_command = False

    def wait(self, deadline_ns: int, due_ns: int = 0) -> int:
        """The monotonic time of the wake-up [ns]: `LONGEST_NS` after the one before at most, for frames `SPACING_NS` at least.

        About the time when a frame is due, `SHORTEST_NS` are enough.

        Args:
            due_ns: when the frame comes for which all others can wait [ns]; one that has not come by then is awaited no more than others.
        """
        last_ns = self._last_ns
        deadline_ns = min(deadline_ns, last_ns + LONGEST_NS)
        spacing_ns = SHORTEST_NS if last_ns < due_ns + EARLY_NS else SPACING_NS
        if self._had_command:
            self._sleep([], min(last_ns + SHORTEST_NS, deadline_ns))
        ready = self._sleep([self._command], min(max(last_ns + spacing_ns, due_ns - EARLY_NS), deadline_ns))
        if not ready:
            ready = self._sleep([*self._frames(), self._command], deadline_ns)
        self._had_command = self._command in ready
        self._last_ns = time.monotonic_ns()
        return self._last_ns

    def _sleep(self, descriptors: list[int], until_ns: int) -> list[int]:
        """Those of the descriptors on which something has arrived; none when the time is over."""
        remaining_s = (until_ns - time.monotonic_ns()) * 1e-9
        if remaining_s <= 0.0:
            return []
        try:
            return select.select(descriptors, [], [], remaining_s)[0]
        except (OSError, ValueError):  # a bus that has just gone
            return []


class PeriodicLoop:
    """Wakes its caller on a fixed grid of the monotonic clock.

    Args:
        lateness: takes how long after its deadline every wake-up came; a new one by default.

    Attributes:
        overruns: periods that were skipped because the caller or the machine was late by a whole period or more.
    """

    def __init__(self, period_ns: int, lateness: Histogram | None = None) -> None:
        self._period_ns = period_ns
        self._deadline_ns = time.monotonic_ns() + period_ns
        self.overruns = 0
        self.lateness = lateness or Histogram()

    def wait(self) -> int:
        """Sleep until the next deadline; the monotonic time of the wake-up [ns]."""
        remaining_ns = self._deadline_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)
        now_ns = time.monotonic_ns()
        late_ns = max(now_ns - self._deadline_ns, 0)  # a sleep may end a nanosecond early
        self.lateness.observe(late_ns)
        skipped = late_ns // self._period_ns
        self.overruns += skipped
        self._deadline_ns += (skipped + 1) * self._period_ns
        return now_ns
