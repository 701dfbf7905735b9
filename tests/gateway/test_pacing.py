"""When the gateway steps."""

import random
from itertools import pairwise

from gateway.pacing import CREDIT_NS, DRIFT_NS, FLOW_NS, PULL_NS, Pacer

MS = 1_000_000
PERIOD_NS = 10 * MS
POLL_NS = MS // 2


def run(seconds, arrivals_ns, stall=(0, 0)):
    """Times of the steps, and how long each command waited; polled every half millisecond, but not within a stall."""
    pacer, steps, waits, pending = Pacer(0, PERIOD_NS), [], [], []
    arrivals = iter([*arrivals_ns, 1 << 62])
    next_arrival = next(arrivals)
    for now_ns in range(POLL_NS, round(seconds * 1e9), POLL_NS):
        if stall[0] <= now_ns < stall[1]:
            continue
        while next_arrival <= now_ns:
            pacer.command_arrived(now_ns)
            pending.append(next_arrival)
            next_arrival = next(arrivals)
        if pacer.is_due(now_ns):
            waits += [now_ns - arrival for arrival in pending]
            pending.clear()
            steps.append(now_ns)
            pacer.stepped(now_ns)
    return pacer, steps, waits


def gaps(steps):
    return [after - before for before, after in pairwise(steps)]


def test_without_commands_the_grid_is_exact():
    pacer, steps, _ = run(10.0, [])
    assert steps == [PERIOD_NS * k for k in range(1, 1000)]
    assert pacer.overruns == 0


def test_commands_of_any_phase_are_soon_answered_as_they_arrive():
    for phase_ns in range(0, 10 * MS, MS // 4):
        jitter = random.Random(phase_ns)
        arrivals = [500 * MS + phase_ns + 40 * MS * k + jitter.randint(0, 3 * MS // 2) for k in range(200)]
        _, steps, waits = run(8.5, arrivals)
        settled = sorted(waits[20:])
        assert settled[len(settled) // 2] <= POLL_NS
        assert settled[int(0.99 * len(settled))] <= 2 * POLL_NS
        assert min(gaps(steps)) >= PERIOD_NS - PULL_NS
        assert max(gaps(steps)) <= PERIOD_NS + DRIFT_NS + POLL_NS


def test_the_rate_is_never_above_the_nominal_one_whatever_comes():
    jitter = random.Random(1)
    arrivals = sorted(jitter.randint(0, 5_000 * MS) for _ in range(3_000))
    _, steps, _ = run(5.0, arrivals)
    assert min(gaps(steps)) >= PERIOD_NS - PULL_NS
    assert max(gaps(steps)) <= PERIOD_NS + DRIFT_NS + POLL_NS
    for count in (2, 10, 100):
        spans = [after - before for before, after in zip(steps, steps[count:], strict=False)]
        assert min(spans) >= count * PERIOD_NS - CREDIT_NS
    assert len(steps) >= 0.9 * 500


def test_a_stall_is_skipped_and_counted():
    pacer, steps, _ = run(1.0, [], stall=(95 * MS, 345 * MS))
    assert pacer.overruns == 24
    assert [step for step in steps if step >= 90 * MS][:4] == [90 * MS, 345 * MS, 351 * MS, 360 * MS]


def test_a_step_is_due_at_its_deadline():
    pacer = Pacer(5, PERIOD_NS)
    assert [pacer.is_due(5 + PERIOD_NS - 1), pacer.is_due(5 + PERIOD_NS)] == [False, True]


def test_a_command_pulls_a_step_to_itself_as_far_as_it_may_and_the_credit_goes():
    pacer = Pacer(0, PERIOD_NS)
    for credit_ns in (CREDIT_NS, CREDIT_NS - PULL_NS + DRIFT_NS, DRIFT_NS, DRIFT_NS):
        deadline_ns, furthest_ns = pacer.deadline_ns, min(credit_ns, PULL_NS)
        assert not pacer.is_due(deadline_ns - 1)
        pacer.command_arrived(deadline_ns - furthest_ns - 1)
        assert not pacer.is_due(deadline_ns - 1)  # one that is too early does not pull later on either
        pacer.command_arrived(deadline_ns - furthest_ns)
        assert pacer.is_due(deadline_ns - furthest_ns)
        pacer.stepped(deadline_ns - furthest_ns)


def test_the_credit_comes_back_with_the_periods_up_to_its_end():
    for periods, credit_ns in ((1, 2 * DRIFT_NS), (3, 4 * DRIFT_NS), (40, CREDIT_NS)):
        pacer = Pacer(0, PERIOD_NS)
        for pull_ns in (PULL_NS, CREDIT_NS - PULL_NS + DRIFT_NS):
            pacer.command_arrived(pacer.deadline_ns - pull_ns)
            pacer.stepped(pacer.deadline_ns - pull_ns)
        for _ in range(periods):
            pacer.command_arrived(pacer.deadline_ns)
            pacer.stepped(pacer.deadline_ns)
        deadline_ns, furthest_ns = pacer.deadline_ns, min(credit_ns, PULL_NS)
        pacer.command_arrived(deadline_ns - furthest_ns - 1)
        assert not pacer.is_due(deadline_ns - 1)
        pacer.command_arrived(deadline_ns - furthest_ns)
        assert pacer.is_due(deadline_ns - furthest_ns)


def test_the_periods_are_longer_while_commands_come():
    for since_ns, drift_ns in ((FLOW_NS - 1, DRIFT_NS), (FLOW_NS, 0)):
        pacer = Pacer(since_ns, PERIOD_NS)
        pacer.command_arrived(PERIOD_NS)
        pacer.stepped(PERIOD_NS + since_ns)
        assert pacer.deadline_ns == PERIOD_NS + since_ns + PERIOD_NS + drift_ns


def test_a_whole_period_late_is_one_overrun_and_the_grid_stays():
    for late_ns, overruns in ((PERIOD_NS - 1, 0), (PERIOD_NS, 1), (3 * PERIOD_NS - 1, 2)):
        pacer = Pacer(0, PERIOD_NS)
        pacer.stepped(PERIOD_NS + late_ns)
        assert pacer.overruns == overruns
        for _ in range(3):  # by the third step it has been made up for
            pacer.stepped(pacer.deadline_ns)
        assert pacer.deadline_ns == (5 + overruns) * PERIOD_NS


def test_no_step_follows_another_at_once():
    for late_ns, next_ns in ((PULL_NS, 2 * PERIOD_NS), (PULL_NS + 1, 2 * PERIOD_NS + 1), (PERIOD_NS - 1, 3 * PERIOD_NS - PULL_NS - 1)):
        pacer = Pacer(0, PERIOD_NS)
        pacer.stepped(PERIOD_NS + late_ns)
        assert pacer.deadline_ns == next_ns
        earliest_ns = PERIOD_NS + late_ns + PERIOD_NS - PULL_NS
        pacer.command_arrived(earliest_ns - 1)
        assert not pacer.is_due(next_ns - 1)
        pacer.command_arrived(earliest_ns)
        assert pacer.is_due(earliest_ns)


def test_the_first_command_may_pull_the_first_step():
    pacer = Pacer(5, PERIOD_NS)
    pacer.command_arrived(5 + PERIOD_NS - PULL_NS)
    assert pacer.is_due(5 + PERIOD_NS - PULL_NS)
