"""Bus load: the share of time in which the bus is not idle, exact to the bit."""

from collections import deque


class LoadMeter:
    """Busy time of a bus, in total and over a sliding window.

    Args:
        window_ns: length of the window [ns].
    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._spans: deque[tuple[int, int]] = deque()
        self._in_spans_ns = 0
        self._total_ns = 0

    def add(self, start_ns: int, end_ns: int) -> None:
        """Note that the bus is busy from start to end [ns], as it begins; spans do not overlap and come in order."""
        self._spans.append((start_ns, end_ns))
        self._in_spans_ns += end_ns - start_ns
        self._total_ns += end_ns - start_ns
        self._drop_before(start_ns - self._window_ns)

    def cut(self, end_ns: int) -> None:
        """The span that was added last ends at another time than expected [ns]."""
        start_ns, expected_ns = self._spans.pop()
        self._spans.append((start_ns, end_ns))
        self._in_spans_ns += end_ns - expected_ns
        self._total_ns += end_ns - expected_ns

    def window(self, now_ns: int) -> float:
        """Share of the window before `now_ns` in which the bus was busy, 0 to 1."""
        begin_ns = now_ns - self._window_ns
        self._drop_before(begin_ns)
        return (self._in_spans_ns - self._before(begin_ns) - self._after(now_ns)) / self._window_ns

    def busy_ns(self, now_ns: int) -> int:
        """Time in which the bus has been busy up to `now_ns` [ns]."""
        return self._total_ns - self._after(now_ns)

    def _drop_before(self, t_ns: int) -> None:
        while self._spans and self._spans[0][1] <= t_ns:
            start_ns, end_ns = self._spans.popleft()
            self._in_spans_ns -= end_ns - start_ns

    def _before(self, t_ns: int) -> int:
        return max(0, t_ns - self._spans[0][0]) if self._spans else 0

    def _after(self, t_ns: int) -> int:
        # The last span may still be going on; spans are added when they begin.
        return max(0, self._spans[-1][1] - t_ns) if self._spans else 0
