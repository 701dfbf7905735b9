"""What is commanded when a solve fails."""

import numpy as np
import pytest

from controller.fallback import MAX_DEGRADED_CYCLES, Fallback, Plan
from controller.problem import Layout
from controller.solver import WarmStart
from gateway.messages import CommandStatus

PERIOD_NS = 40_000_000
LAYOUT = Layout(30, 6, 2)
NOTHING = Plan(0, np.zeros((31, 6)), np.zeros((30, 2)))


def plan(t_ns=0):
    return Plan(t_ns, np.arange(31.0)[:, None] * np.ones(6), np.arange(30.0)[:, None] * np.ones(2))


def test_a_good_plan_is_commanded_as_it_is():
    good = plan()
    assert Fallback(PERIOD_NS, LAYOUT).accept(good) == (CommandStatus.OK, good)


def test_without_any_plan_a_failure_is_final():
    status, commanded = Fallback(PERIOD_NS, LAYOUT).substitute(0, NOTHING)
    assert (status, commanded) == (CommandStatus.FAILED, NOTHING)


def test_three_cycles_degraded_then_failed_each_time_the_plan_moves_on():
    fallback = Fallback(PERIOD_NS, LAYOUT)
    fallback.accept(plan(t_ns=PERIOD_NS))
    answers = [fallback.substitute((2 + k) * PERIOD_NS, NOTHING) for k in range(5)]
    assert [status for status, _ in answers] == [CommandStatus.DEGRADED] * MAX_DEGRADED_CYCLES + [CommandStatus.FAILED] * 2
    assert [commanded.inputs[0, 0] for _, commanded in answers] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert MAX_DEGRADED_CYCLES == 3


def test_a_good_plan_ends_the_count():
    fallback = Fallback(PERIOD_NS, LAYOUT)
    for _ in range(4):
        fallback.accept(plan())
        for k in range(3):
            assert fallback.substitute(k * PERIOD_NS, NOTHING)[0] is CommandStatus.DEGRADED


@pytest.mark.parametrize(("passed_ns", "index"), [(0, 0), (19_000_000, 0), (21_000_000, 1), (80_000_000, 2), (-5, 0)])
def test_the_shift_goes_by_time(passed_ns, index):
    shifted = plan(1_000).from_time(1_000 + passed_ns, PERIOD_NS)
    assert shifted.inputs[0, 0] == index
    assert shifted.t_ns == 1_000 + passed_ns


def test_the_end_of_a_plan_is_held():
    shifted = plan().from_time(28 * PERIOD_NS, PERIOD_NS)
    np.testing.assert_array_equal(shifted.inputs[:, 0], [28.0] + [29.0] * 29)
    assert shifted.states[-1, 0] == 30.0
    assert shifted.inputs.shape == (30, 2)


def guess():
    """Every number says at which stage it stands; the multipliers also which part they are of."""
    w = np.empty(LAYOUT.n_variables)
    w[LAYOUT.state_index] = np.arange(31.0)[:, None]
    w[LAYOUT.input_index] = np.arange(30.0)[:, None] + 100.0
    gaps, corridor = np.repeat(np.arange(30.0), 6), np.arange(1.0, 31.0) + 200.0
    return WarmStart(w, -w, np.concatenate((gaps, corridor)))


def test_what_comes_right_after_a_good_answer_begins_from_it_as_it_is():
    fallback, good = Fallback(PERIOD_NS, LAYOUT), guess()
    assert fallback.guess(0) is None
    fallback.prime(0, good)
    assert fallback.guess(PERIOD_NS) is good


@pytest.mark.parametrize("missed", [1, 2, MAX_DEGRADED_CYCLES])
def test_after_missed_cycles_the_last_good_answer_moves_on(missed):
    fallback = Fallback(PERIOD_NS, LAYOUT)
    fallback.prime(0, guess())
    moved = fallback.guess((1 + missed) * PERIOD_NS)
    np.testing.assert_array_equal(moved.w[LAYOUT.state_index[:, 0]], np.minimum(np.arange(31.0) + missed, 30.0))
    np.testing.assert_array_equal(moved.w[LAYOUT.input_index[:, 1]], np.minimum(np.arange(30.0) + missed, 29.0) + 100.0)
    np.testing.assert_array_equal(moved.lam_w, -moved.w)
    np.testing.assert_array_equal(moved.lam_g[: LAYOUT.n_gaps : 6], np.minimum(np.arange(30.0) + missed, 29.0))
    np.testing.assert_array_equal(moved.lam_g[LAYOUT.n_gaps :], np.minimum(np.arange(1.0, 31.0) + missed, 30.0) + 200.0)


def test_an_answer_older_than_a_plan_may_be_is_no_beginning():
    fallback = Fallback(PERIOD_NS, LAYOUT)
    fallback.prime(0, guess())
    assert fallback.guess((2 + MAX_DEGRADED_CYCLES) * PERIOD_NS) is None
