"""Age at actuation: ids, ages, histogram, and when the lag is a reason to stop."""

from itertools import pairwise

import pytest

from gateway.causes import Cause, Finding
from gateway.latency import BUCKETS_NS, MAX_AGE_NS, MEASUREMENT_IDS, LatencyChain, ValidityClock

MS = 1_000_000
CYCLE = 40 * MS


def measured(*ages_ms, chain=None):
    """A chain that has measured these ages, one command after the other; and the time after the last echo."""
    chain, t_ns = chain or LatencyChain(), 1_000 * MS
    for age_ms in ages_ms:
        echo = chain.answered(t_ns)
        chain.echoed(echo, t_ns + round(age_ms * MS))
        t_ns += CYCLE
    return chain


def ages_ms(*data):
    """Ages on arrival of data that arrive at these times with these times of validity, both in milliseconds."""
    clock = ValidityClock()
    valid = [clock.arrived(round(arrival_ms * MS), validity_ms) for arrival_ms, validity_ms in data]
    return [None if ns is None else arrival_ms - ns / MS for (arrival_ms, _), ns in zip(data, valid, strict=True)]


def test_data_are_as_old_as_they_are_later_than_the_soonest():
    assert ages_ms((5_000, 70), (5_010, 80), (5_023, 90), (5_029, 100), (5_040, 110)) == pytest.approx([0, 0, 3, 0, 1], abs=0.02)


def test_a_validity_that_was_there_already_is_not_new():
    assert ages_ms((5_000, 70), (5_010, 70), (5_020, 69), (5_030, 71)) == [0, None, None, pytest.approx(29, abs=0.02)]


def test_clocks_may_drift_apart_slowly():
    assert ages_ms((0, 0), (100_000, 99_950)) == [0, 0]
    assert ages_ms((0, 0), (100_000, 99_949)) == [0, pytest.approx(1)]
    assert ages_ms((0, 0), (50_000, 49_975), (100_000, 99_949)) == [0, 0, pytest.approx(1)]


@pytest.mark.parametrize("ahead_ms", [21, 70, 10_000])
def test_one_time_far_ahead_is_none_and_two_are_another_clock(ahead_ms):
    assert ages_ms((1_000, 0), (1_010, 10 + ahead_ms), (1_020, 20)) == [0, None, pytest.approx(0, abs=0.03)]
    steady = [(1_000, 0), (1_010, 10)]
    assert ages_ms(*steady, (1_020, 20 + ahead_ms), (1_030, 30), (1_040, 40 + ahead_ms), (1_050, 50)) == (
        pytest.approx([0, 0, None, 0, None, 0], abs=0.03)
    )
    ahead = [(1_020, 20 + ahead_ms), (1_030, 30 + ahead_ms), (1_040, 40 + ahead_ms), (1_050, 50 + ahead_ms - 5)]
    assert ages_ms(*steady, *ahead) == pytest.approx([0, 0, None, 0, 0, 5], abs=0.03)


def test_data_that_come_a_little_sooner_than_ever_are_taken_at_once():
    assert ages_ms((1_000, 0), (1_010, 29), (1_020, 39), (1_030, 44)) == pytest.approx([0, 0, 0, 5], abs=0.03)


def test_the_exact_time_ahead():
    for arrival_ns, is_taken in ((1_010_005_003, True), (1_010_005_002, False)):  # 20 ms sooner, and 5.003 us of drift in 10.005 ms
        clock = ValidityClock()
        clock.arrived(1_000 * MS, 0)
        assert (clock.arrived(arrival_ns, 30) is not None) is is_taken


def test_how_far_clocks_are_apart_can_be_learnt_anew():
    clock = ValidityClock()
    assert clock.arrived(1_000 * MS, 50) == 1_000 * MS
    clock.restart()
    assert clock.arrived(1_500 * MS, 20) == 1_500 * MS


def test_ids_count_up_and_come_round():
    chain = LatencyChain()
    ids = [chain.answered(k) for k in range(40)]
    assert ids[:3] == [1, 2, 3]
    assert ids[14:18] == [15, 0, 1, 2]
    assert all((b - a) % MEASUREMENT_IDS == 1 for a, b in pairwise(ids))
    assert MEASUREMENT_IDS == 16


def test_nothing_is_known_before_the_first_echo():
    chain = LatencyChain()
    assert chain.newest_ns == 0
    assert chain.max_ns == 0
    assert sum(chain.histogram) == 0
    assert chain.findings(10**12) == []


def test_age_is_from_the_state_to_the_first_echo():
    chain = LatencyChain()
    echo = chain.answered(1_000 * MS)
    assert chain.newest_ns == 0
    chain.echoed(echo, 1_037 * MS)
    chain.echoed(echo, 1_047 * MS)  # told again with every status: not new
    assert (chain.newest_ns, chain.max_ns) == (37 * MS, 37 * MS)
    assert sum(chain.histogram) == 1


def test_the_largest_age_is_kept_since_the_engagement_the_histogram_for_ever():
    chain = measured(37, 90, 40)
    assert (chain.newest_ns, chain.max_ns) == (40 * MS, 90 * MS)
    chain.restart()
    assert (chain.newest_ns, chain.max_ns) == (40 * MS, 0)
    assert sum(chain.histogram) == 3
    measured(20, chain=chain)
    assert (chain.newest_ns, chain.max_ns) == (20 * MS, 20 * MS)


def test_an_id_nobody_waits_for_says_nothing():
    chain = LatencyChain()
    chain.echoed(5, 1_000 * MS)
    assert chain.newest_ns == 0
    echo = chain.answered(1_000 * MS)
    chain.restart()
    chain.echoed(echo, 1_010 * MS)  # answers what was before the engagement
    assert chain.newest_ns == 0
    assert sum(chain.histogram) == 0


def test_commands_that_the_robots_passed_over_are_not_waited_for():
    chain = LatencyChain()
    first, second, third = (chain.answered(k * CYCLE) for k in range(3))
    chain.echoed(second, 80 * MS)
    assert chain.newest_ns == 40 * MS
    chain.echoed(first, 90 * MS)
    assert chain.newest_ns == 40 * MS
    chain.echoed(third, 130 * MS)
    assert chain.newest_ns == 50 * MS
    assert sum(chain.histogram) == 2


def test_an_id_that_comes_round_means_the_newer_command():
    chain = LatencyChain()
    ids = [chain.answered(k * CYCLE) for k in range(MEASUREMENT_IDS + 1)]
    assert ids[0] == ids[-1]
    chain.echoed(ids[1], 17 * CYCLE)  # the oldest that is still waited for: the one with the same id is the newest
    assert chain.newest_ns == 16 * CYCLE
    chain.echoed(ids[-1], 17 * CYCLE)
    assert chain.newest_ns == CYCLE
    assert sum(chain.histogram) == 2


@pytest.mark.parametrize("k", range(len(BUCKETS_NS)))
def test_buckets_end_with_their_figure(k):
    end_ms = BUCKETS_NS[k] / MS
    chain = measured(end_ms, end_ms + 1e-6)
    assert chain.histogram[k] == 1
    assert chain.histogram[k + 1] == 1
    assert sum(chain.histogram) == 2


def test_the_buckets():
    assert [end // MS for end in BUCKETS_NS] == [10, 20, 30, 40, 50, 60, 80, 100, 120, 150, 200, 300]
    assert len(LatencyChain().histogram) == 13


@pytest.mark.parametrize(
    ("ages_ms", "is_found"),
    [
        ((151, 151, 151), True),
        ((151, 151), False),
        ((150, 150, 150, 150), False),
        ((150.000001, 150.000001, 150.000001), True),
        ((151, 151, 150, 151, 151), False),
        ((40, 151, 151, 151), True),
        ((151, 151, 151, 40), False),
        ((151,) * 9, True),
    ],
)
@pytest.mark.req("F9")
def test_three_late_measurements_in_a_row(ages_ms, is_found):
    chain = measured(*ages_ms)
    assert bool(chain.findings(0)) is is_found


def test_what_is_found():
    assert measured(151, 160, 155).findings(0) == [Finding(Cause.LATENCY, pytest.approx(155.0), pytest.approx(150.0), "robots")]
    assert MAX_AGE_NS == 150 * MS


def test_an_engagement_begins_without_the_lag_of_the_last_one():
    chain = measured(151, 151, 151)
    chain.restart()
    assert chain.findings(0) == []
    assert measured(151, 151, chain=chain).findings(0) == []
    assert measured(151, chain=chain).findings(0)


def test_echoes_that_do_not_come_are_late_as_well():
    chain = LatencyChain()
    for k in range(3):
        chain.answered(k * CYCLE)
    assert chain.findings(2 * CYCLE + 150 * MS) == []  # the third is not overdue yet
    (finding,) = chain.findings(2 * CYCLE + 150 * MS + 1)
    assert finding.value == pytest.approx(230.0, abs=1e-5)
    assert finding.cause is Cause.LATENCY


def test_late_and_overdue_together_make_three():
    chain = measured(151, 151)
    assert chain.findings(10**12) == []
    chain.answered(5_000 * MS)
    assert chain.findings(5_150 * MS) == []
    assert chain.findings(5_151 * MS) == [Finding(Cause.LATENCY, pytest.approx(151.0), pytest.approx(150.0), "robots")]
