"""The periodic loop, on a clock of our own."""

import pytest

from gateway import loop as loop_module
from gateway.loop import PeriodicLoop

MS = 1_000_000


class Clock:
    """Stands in for the module `time`; sleeping takes as long as it is told, plus `oversleep_ns` once."""

    def __init__(self):
        self.now_ns = 5 * MS
        self.oversleep_ns = 0

    def monotonic_ns(self):
        return self.now_ns

    def sleep(self, seconds):
        self.now_ns += round(seconds * 1e9) + self.oversleep_ns
        self.oversleep_ns = 0


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(loop_module, "time", clock)
    return clock


def test_deadlines_are_absolute(clock):
    loop = PeriodicLoop(10 * MS)
    wakes = []
    for _ in range(5):
        wakes.append(loop.wait())
        clock.now_ns += 3 * MS  # the work of a cycle does not shift the next
    assert wakes == [15 * MS, 25 * MS, 35 * MS, 45 * MS, 55 * MS]
    assert loop.overruns == 0


def test_a_late_wake_does_not_shift_the_grid(clock):
    loop = PeriodicLoop(10 * MS)
    clock.oversleep_ns = 4 * MS
    assert loop.wait() == 19 * MS
    assert loop.wait() == 25 * MS
    assert loop.overruns == 0


def test_a_stall_is_skipped_and_counted_not_caught_up_with(clock):
    loop = PeriodicLoop(10 * MS)
    loop.wait()
    clock.now_ns += 37 * MS
    assert loop.wait() == 52 * MS
    assert loop.overruns == 2
    assert loop.wait() == 55 * MS
