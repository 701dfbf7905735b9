"""The periodic loop, on a clock of our own."""

import socket
import time
import tracemalloc
from itertools import pairwise
from types import SimpleNamespace

import pytest

from gateway import loop as loop_module
from gateway.loop import BUCKETS_NS, EARLY_NS, LONGEST_NS, SHORTEST_NS, SPACING_NS, ArrivalWait, CpuLoad, Histogram, PeriodicLoop

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


def test_lateness_is_counted_in_its_bucket(clock):
    loop = PeriodicLoop(10 * MS)
    loop.wait()
    clock.oversleep_ns = 4 * MS
    loop.wait()
    late = dict(zip([*BUCKETS_NS, None], loop.lateness.counts, strict=True))
    assert late.pop(20_000) == 1
    assert late.pop(5 * MS) == 1
    assert set(late.values()) == {0}
    assert (loop.lateness.sum_ns, loop.lateness.max_ns) == (4 * MS, 4 * MS)


def test_a_sleep_that_ends_early_makes_no_second_tick(clock):
    loop = PeriodicLoop(10 * MS)
    clock.oversleep_ns = -1
    assert loop.wait() == 15 * MS - 1
    assert loop.wait() == 25 * MS
    assert loop.overruns == 0


def test_histogram_counts_every_duration_once():
    histogram = Histogram()
    durations = [0, 1, 20_000, 20_001, BUCKETS_NS[-1], BUCKETS_NS[-1] + 1, 10**12]
    for duration_ns in durations:
        histogram.observe(duration_ns)
    assert sum(histogram.counts) == len(durations)
    assert (histogram.counts[0], histogram.counts[1], histogram.counts[-2], histogram.counts[-1]) == (3, 1, 1, 2)
    assert histogram.max_ns == 10**12


def test_histogram_takes_no_memory_while_it_counts():
    histogram = Histogram()
    histogram.observe(3 * MS)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(10_000):
            histogram.observe(3 * MS)
        assert tracemalloc.get_traced_memory()[0] - before < 500
    finally:
        tracemalloc.stop()


FRAMES, COMMAND = 3, 4
DUE_NS = 3 * MS


@pytest.fixture
def arrivals_ns(clock, monkeypatch):
    """Stands in for the kernel: from when on each descriptor is readable [ns]."""
    arrivals_ns = {}

    def select(descriptors, _writable, _exceptional, timeout_s):
        until_ns = clock.now_ns + round(timeout_s * 1e9)
        awaited_ns = [arrivals_ns[one] for one in descriptors if one in arrivals_ns]
        clock.now_ns = max(clock.now_ns, min([*awaited_ns, until_ns]))
        return [one for one in descriptors if arrivals_ns.get(one, until_ns + 1) <= clock.now_ns], [], []

    monkeypatch.setattr(loop_module, "select", SimpleNamespace(select=select))
    return arrivals_ns


@pytest.mark.parametrize(
    ("arrival", "deadline_ns", "woken_ns"),
    [
        ({}, 2 * MS, 2 * MS),  # neither before the deadline nor after it
        ({}, SHORTEST_NS // 2, SHORTEST_NS // 2),
        ({}, 60_000 * MS, LONGEST_NS),
        ({FRAMES: 1 * MS}, 2 * MS, 1 * MS),
        ({COMMAND: 1 * MS}, 2 * MS, 1 * MS),
        ({FRAMES: 300_000}, 2 * MS, SPACING_NS),  # frames wait for each other
        ({COMMAND: 300_000}, 2 * MS, 300_000),  # a command for nobody
        ({COMMAND: 0}, 2 * MS, 0),
    ],
)
def test_it_wakes_up_when_something_is_there_and_at_the_deadline_at_the_latest(clock, arrivals_ns, arrival, deadline_ns, woken_ns):
    arrivals, start_ns = ArrivalWait(lambda: [FRAMES], COMMAND), clock.now_ns
    arrivals_ns |= {descriptor: start_ns + after_ns for descriptor, after_ns in arrival.items()}
    assert arrivals.wait(start_ns + deadline_ns) == start_ns + woken_ns


@pytest.mark.parametrize(
    ("arrival", "deadline_ns", "woken_ns"),
    [
        ({FRAMES: 1 * MS}, 4 * MS, DUE_NS - EARLY_NS),  # those before it wait for the one that is due
        ({FRAMES: DUE_NS - 10_000}, 4 * MS, DUE_NS - 10_000),
        ({FRAMES: DUE_NS + 2 * EARLY_NS}, 4 * MS, DUE_NS + 2 * EARLY_NS),
        ({FRAMES: 1 * MS}, 2 * MS, 2 * MS),
        ({FRAMES: 1 * MS, COMMAND: 2 * MS}, 4 * MS, 2 * MS),
    ],
)
def test_until_shortly_before_a_frame_is_due_it_sleeps(clock, arrivals_ns, arrival, deadline_ns, woken_ns):
    arrivals, start_ns = ArrivalWait(lambda: [FRAMES], COMMAND), clock.now_ns
    arrivals_ns |= {descriptor: start_ns + after_ns for descriptor, after_ns in arrival.items()}
    assert arrivals.wait(start_ns + deadline_ns, start_ns + DUE_NS) == start_ns + woken_ns


def test_only_about_the_time_when_it_is_due_it_looks_often(clock, arrivals_ns):
    arrivals, start_ns = ArrivalWait(lambda: [FRAMES], COMMAND), clock.now_ns
    arrivals_ns[FRAMES] = start_ns  # others come without end, and it does not
    wakes_ns = [arrivals.wait(start_ns + 60_000 * MS, start_ns + DUE_NS) for _ in range(8)]
    spacings_ns = [after - before for before, after in pairwise(wakes_ns)]
    assert wakes_ns[0] == start_ns + DUE_NS - EARLY_NS
    often = [before for before, spacing_ns in zip(wakes_ns, spacings_ns, strict=False) if spacing_ns == SHORTEST_NS]
    assert often == [one for one in wakes_ns if one < start_ns + DUE_NS + EARLY_NS]
    assert set(spacings_ns) == {SHORTEST_NS, SPACING_NS}


def test_a_command_after_another_waits_a_little(clock, arrivals_ns):
    arrivals, start_ns = ArrivalWait(lambda: [FRAMES], COMMAND), clock.now_ns
    arrivals_ns[COMMAND] = start_ns  # nobody reads: it stays readable
    assert [arrivals.wait(start_ns + 60_000 * MS) - start_ns for _ in range(3)] == [0, SHORTEST_NS, 2 * SHORTEST_NS]


def test_it_wakes_up_for_frames_or_at_the_deadline_and_not_too_often():
    ours, theirs = socket.socketpair()
    command, _controller = socket.socketpair()
    with ours, theirs, command, _controller:
        arrivals = ArrivalWait(lambda: [ours.fileno()], command.fileno())
        start_ns = time.monotonic_ns()
        assert arrivals.wait(start_ns + 2 * MS) >= start_ns + 2 * MS
        theirs.send(b"x")
        deadline_ns = time.monotonic_ns() + 60_000 * MS
        wakes_ns = [arrivals.wait(deadline_ns) for _ in range(5)]  # nobody reads: it stays readable
        assert wakes_ns[-1] < deadline_ns
        assert min(after - before for before, after in pairwise(wakes_ns)) >= SPACING_NS


def test_it_looks_now_and_then_at_what_it_does_not_wait_for():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        arrivals = ArrivalWait(list, ours.fileno())
        wakes_ns = [arrivals.wait(time.monotonic_ns() + 60_000 * MS) for _ in range(4)]
        assert min(after - before for before, after in pairwise(wakes_ns)) >= LONGEST_NS


def test_a_command_does_not_wait_for_the_spacing_of_frames():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.send(b"x")
        for _ in range(20):
            arrivals = ArrivalWait(list, ours.fileno())
            before_ns = arrivals.wait(time.monotonic_ns() + 60_000 * MS)
            if arrivals.wait(time.monotonic_ns() + 60_000 * MS) < before_ns + SPACING_NS:
                break
        else:
            pytest.fail("never at once")
        arrivals = ArrivalWait(list, ours.fileno())
        wakes_ns = [arrivals.wait(time.monotonic_ns() + 60_000 * MS) for _ in range(50)]  # nobody reads: it stays readable
        assert min(after - before for before, after in pairwise(wakes_ns)) >= SHORTEST_NS


def test_a_descriptor_that_has_gone_is_no_reason_to_fail_or_to_spin():
    ours, theirs = socket.socketpair()
    theirs.close()
    gone = ours.fileno()
    ours.close()
    command, controller = socket.socketpair()
    with command, controller:
        for unusable in (gone, -1):
            arrivals = ArrivalWait(lambda unusable=unusable: [unusable], command.fileno())
            start_ns = time.monotonic_ns()
            for _ in range(4):
                arrivals.wait(start_ns + 1_000 * MS)
            assert start_ns + 4 * SPACING_NS <= time.monotonic_ns() < start_ns + 1_000 * MS


def test_the_load_of_a_thread_is_that_of_the_last_second():
    load, s = CpuLoad(), 1_000_000_000
    assert [load.update(5 * s, 2 * s), load.update(6 * s - 1, 3 * s)] == [0.0, 0.0]
    assert load.update(6 * s, 2 * s + s // 4) == 0.25
    assert load.update(7 * s - 1, 3 * s) == 0.25
    assert load.update(7 * s, 3 * s - s // 4) == 0.5
