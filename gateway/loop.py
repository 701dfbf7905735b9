"""The periodic loop of a real-time process: absolute deadlines, skipped rather than caught up with after a stall."""

import time


class PeriodicLoop:
    """Wakes its caller on a fixed grid of the monotonic clock.

    Attributes:
        overruns: periods that were skipped because the caller or the machine was late by a whole period or more.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._deadline_ns = time.monotonic_ns() + period_ns
        self.overruns = 0

    def wait(self) -> int:
        """Sleep until the next deadline; the monotonic time of the wake-up [ns]."""
        remaining_ns = self._deadline_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)
        now_ns = time.monotonic_ns()
        skipped = (now_ns - self._deadline_ns) // self._period_ns
        self.overruns += skipped
        self._deadline_ns += (skipped + 1) * self._period_ns
        return now_ns
