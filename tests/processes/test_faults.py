"""Faults of real processes at random phases, judged by the oracle process on the bus: the first safe frame in its time, no limit broken.

A trial during which the machine itself stood still proves nothing: it is repeated three times at most, and never passes.
"""

import numpy as np
import pytest

from tests.support import process_trials as trials
from tests.support.process_bench import ProcessBench

pytestmark = pytest.mark.realtime

TRIALS = 30
OVERRIDES = 100  # B3, E3
QUICK = ("F1 controller killed", "F6 a message missing", "E3 driver overrides")


def check(bench: ProcessBench, way: trials.Way, count: int, figure) -> None:
    outcomes = trials.run(bench, way, count, seed=1)
    failures = [failure for outcome in outcomes for failure in outcome.failures]
    figure(f"{way}: trials that failed, of {count}", sum(bool(outcome.failures) for outcome in outcomes), "", "= 0")
    if latencies_ms := [outcome.latency_ms for outcome in outcomes if outcome.latency_ms is not None]:
        figure(f"{way}: to the first safe frame, median", float(np.median(latencies_ms)), "ms")
        # A gateway that was asleep is held to its first frame, not to a time.
        figure(f"{way}: to the first safe frame, longest", max(latencies_ms), "ms", f"<= {way.within_ms:g}" if way.within_ms else "")
    assert failures == []


@pytest.mark.req("F1", "F6", "E3", "G1")
def test_faults_once(bench, figure):
    """One test, so that no two processes of a parallel run have a rig each."""
    for way in trials.WAYS:
        if str(way) in QUICK:
            check(bench, way, 1, figure)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize("way", [pytest.param(way, marks=pytest.mark.req(way.req, "G1"), id=str(way)) for way in trials.WAYS])
def test_a_fault_many_times(bench, way, figure):
    check(bench, way, OVERRIDES if way.req == "E3" else TRIALS, figure)
