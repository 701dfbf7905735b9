"""F18: all pairs of the faults F1 to F15, begun together or within 150 ms: the severer reaction in its own time, and no limit broken."""

import itertools
import random

import pytest

from tests.support import trials
from tests.support.trials import FAULTS

PAIRS_EACH, PAIRS_EACH_LONG = 3, 100
ROWS = [f"F{k}" for k in range(1, 16) if k != 2]  # F2 is F1 for the gateway
PAIRS = list(itertools.combinations_with_replacement(ROWS, 2))


def run(pairs_each: int) -> list[trials.Trial]:
    done = []
    for first, second in PAIRS:
        for seed in range(pairs_each):
            rng = random.Random(f"{first}+{second}/{seed}")
            one = rng.choice([fault for fault in FAULTS if fault.req == first])
            ways = [fault for fault in FAULTS if fault.req == second and (not fault.lies_about or fault.lies_about != one.lies_about)]
            other = rng.choice(ways)
            done.append(trials.run_pair(*rng.sample([one, other], 2), seed))
    return done


def check(done: list[trials.Trial], figure) -> None:
    failed = [trial for trial in done if trial.violations]
    figure(f"F18: {len(PAIRS)} pairs, {len(done)} trials, {len(failed)} with a violation")
    assert not failed, f"{len(failed)} of {len(done)} trials; the first: {failed[0]}"


@pytest.mark.req("F18", "G1")
def test_all_pairs_of_faults(figure):
    assert len(PAIRS) == 105
    check(run(PAIRS_EACH), figure)


@pytest.mark.long
@pytest.mark.timeout(3_600)
@pytest.mark.req("F18", "G1")
def test_all_pairs_of_faults_many_times(figure):
    check(run(PAIRS_EACH_LONG), figure)
