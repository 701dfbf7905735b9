"""What is commanded when a solve fails."""

import numpy as np
import pytest

from controller.fallback import MAX_DEGRADED_CYCLES, Fallback, Plan
from gateway.messages import CommandStatus

PERIOD_NS = 40_000_000
NOTHING = Plan(0, np.zeros((31, 6)), np.zeros((30, 2)))


def plan(t_ns=0):
    return Plan(t_ns, np.arange(31.0)[:, None] * np.ones(6), np.arange(30.0)[:, None] * np.ones(2))


def test_a_good_plan_is_commanded_as_it_is():
    good = plan()
    assert Fallback(PERIOD_NS).accept(good) == (CommandStatus.OK, good)


def test_without_any_plan_a_failure_is_final():
    status, commanded = Fallback(PERIOD_NS).substitute(0, NOTHING)
    assert (status, commanded) == (CommandStatus.FAILED, NOTHING)


def test_three_cycles_degraded_then_failed_each_time_the_plan_moves_on():
    fallback = Fallback(PERIOD_NS)
    fallback.accept(plan(t_ns=PERIOD_NS))
    answers = [fallback.substitute((2 + k) * PERIOD_NS, NOTHING) for k in range(5)]
    assert [status for status, _ in answers] == [CommandStatus.DEGRADED] * MAX_DEGRADED_CYCLES + [CommandStatus.FAILED] * 2
    assert [commanded.inputs[0, 0] for _, commanded in answers] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert MAX_DEGRADED_CYCLES == 3


def test_a_good_plan_ends_the_count():
    fallback = Fallback(PERIOD_NS)
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
