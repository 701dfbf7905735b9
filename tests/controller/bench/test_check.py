"""The independent judgement on answers: it passes true ones, finds lies, and knows the objective."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from controller.bench import hard as hard_bench
from controller.bench.agreement import compare
from controller.bench.check import OptimalityCheck, bound_residuals, soft_objective
from controller.bench.hard import HardRun, longest_quiet_us, run_hard
from controller.bench.sets import Instance, hard
from controller.ocp import transcribe
from controller.problem import OcpOptions, pack_parameters
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC
from controller.solver import Effort, SolveResult, SolveStatus, WarmStart
from controller.solvers import make_solver


@pytest.fixture(scope="module")
def riccati(vehicle):
    return make_solver("riccati", vehicle.model, OcpOptions(), print)


@pytest.fixture
def check(library):
    return OptimalityCheck(library, OcpOptions())


@pytest.fixture
def instance(problem):
    """With a corridor that cannot be met at first."""
    state, previous_input, horizon = problem
    return Instance(state, previous_input, replace(horizon, left_m=np.full(31, 0.1), right_m=np.full(31, 0.1)), None)


def answered(solver, instance):
    solver.warm_start = instance.warm_start
    return solver.solve(instance.state, instance.previous_input, instance.horizon)


def test_a_true_answer_passes(riccati, check, instance):
    assert answered(riccati, instance).status is SolveStatus.CONVERGED
    assert check.residual(instance, riccati.answer) <= 1.0


@pytest.mark.parametrize(
    ("name", "index", "change"),
    [("w", 0, 1e-5), ("w", 6, 1e-3), ("w", 14, 1e-3), ("w", 6, 2.0), ("lam_w", 30, 1.0), ("lam_g", 20, 1.0), ("lam_g", 185, 1.0)],
)
def test_a_changed_answer_does_not(riccati, check, instance, name, index, change):
    answered(riccati, instance)
    parts = {part: getattr(riccati.answer, part).copy() for part in ("w", "lam_w", "lam_g")}
    parts[name][index] += change
    assert check.residual(instance, WarmStart(**parts)) > 1.0


def test_what_is_not_finite_is_infinitely_wrong(riccati, check, instance):
    answered(riccati, instance)
    w = riccati.answer.w.copy()
    w[40] = np.nan
    assert check.residual(instance, WarmStart(w, riccati.answer.lam_w, riccati.answer.lam_g)) == np.inf


SLOPE = PENALTY_LINEAR + 0.5 * PENALTY_QUADRATIC
"""Of the penalty half a unit beyond a bound."""


@pytest.mark.parametrize(
    ("value", "multiplier", "is_hard", "expected"),
    [
        (0.5, 0.0, False, 0.0),
        (1.0, 20.0, False, 0.0),
        (-1.0, -PENALTY_LINEAR, False, 0.0),
        (1.5, SLOPE, False, 0.0),
        (-1.5, -SLOPE, False, 0.0),
        (1.5, SLOPE + 1e-3, False, 1e-3 / PENALTY_QUADRATIC / 1e-6),
        (1.5, SLOPE, True, 0.5 / 1e-6),
        (1.5, 0.0, False, 0.5 / 1e-6),
        (1.0, 1e6, True, 0.0),
        (0.0, 1e-3, False, 1e-3 / 1e-4),
        (1.0 - 1e-7, 20.0, False, 0.1),
        (1.0 + 5e-7, -1e-9, False, 0.5),  # a little beyond one bound, a little multiplier of the other
        (-1.5, 70.0, False, 70.0 / 1e-4),  # beyond one bound with the multiplier of the other
        (-1.0, 20.0, False, 20.0 / 1e-4),
    ],
)
def test_the_residual_of_a_bound(value, multiplier, is_hard, expected):
    one = np.ones(1)
    found = bound_residuals(value * one, multiplier * one, -one, one, np.array([is_hard]))[0]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_the_objective_is_that_of_the_programme_plus_the_penalties(riccati, vehicle, instance):
    result = answered(riccati, instance)
    nlp, p = transcribe(vehicle.model, OcpOptions()), np.zeros(OcpOptions().layout.n_parameters)
    pack_parameters(p, instance.horizon, instance.previous_input, OcpOptions())
    cost = float(ca.Function("f", [nlp["x"], nlp["p"]], [nlp["f"]])(riccati.answer.w, p))
    reference = instance.horizon.reference
    lateral = np.sum(instance.horizon.normals() * (result.states[:, 3:5] - reference[:, 3:5]), axis=1)[1:]
    beyond = np.maximum(np.abs(lateral) - 0.1, 0.0)
    assert beyond.max() > 0.05
    penalty = np.sum(PENALTY_LINEAR * beyond + 0.5 * PENALTY_QUADRATIC * beyond**2)
    assert soft_objective(instance, result, OcpOptions()) == pytest.approx(cost + penalty, rel=1e-7)


class LyingSolver:
    """Claims success, whatever it was asked, and answers with something near."""

    name = "liar"
    options = OcpOptions()

    def __init__(self, solver):
        self._solver = solver
        self.warm_start = None

    def solve(self, state, previous_input, horizon):
        self._solver.warm_start = self.warm_start
        return replace(self._solver.solve(state, previous_input, horizon), status=SolveStatus.CONVERGED)

    @property
    def answer(self):
        true = self._solver.answer
        return WarmStart(true.w + 1e-3, true.lam_w, true.lam_g)


def test_a_lying_solver_is_found_out(riccati, check, instance):
    starts = hard([replace(instance, warm_start=riccati.warm_start)], 8)
    truthful, liar = run_hard([riccati, LyingSolver(riccati)], starts, check, unit_us=1000.0)
    assert (truthful["starts"], truthful["finite"], truthful["true_status"], truthful["false_claims"]) == (8, 1.0, 1.0, 0)
    assert (liar["converged"], liar["true_status"], liar["false_claims"]) == (1.0, 0.0, 8)
    assert liar["largest_residual_of_converged"] > 1.0
    assert truthful["ratio_longest"] == pytest.approx(truthful["longest_quiet_us"] / 1000.0, abs=1e-4)


class ScriptedSolver:
    """Takes as long as the test says, one time after the other [us]."""

    name = "scripted"

    def __init__(self, times_us):
        self._times_us = {key: iter(times) for key, times in times_us.items()}

    def solve(self, state, previous_input, horizon):
        return SolveResult(SolveStatus.CONVERGED, None, None, 0.0, 0.0, Effort(), next(self._times_us[state]) * 1000)


def test_the_longest_quiet_solve_is_repeated_until_no_other_can_be_longer(monkeypatch):
    monkeypatch.setattr(hard_bench, "REPEATS", 5)
    starts = [Instance(n, None, None, None) for n in range(4)]
    # Of five repetitions; start 3 is never repeated: even its first time is shorter than the longest quiet one.
    times_us = {0: [900, 800, 120, 700, 700, 700], 1: [230, 225, 220, 224, 226, 229], 2: [225, 100, 90, 95, 99, 98], 3: [219]}
    solver = ScriptedSolver(times_us)
    run = HardRun(solver, [solver.solve(start.state, None, None) for start in starts])
    assert longest_quiet_us(run, starts) == 220.0


def test_agreement_with_a_solver_of_hard_constraints_is_asked_where_it_can_answer(riccati, solver, instance, problem):
    feasible = Instance(*problem, None)
    row = compare(riccati, solver, [feasible, instance])
    assert (row["solver"], row["with"], row["instances"], row["both_converged"], row["same_minimum"]) == ("riccati", "casadi-c", 1, 1, 1)
    assert row["first_input"] <= row["plan"] <= 1e-5


@pytest.mark.parametrize(("error", "same_minimum"), [(2e-5, 1), (0.1, 0)])
def test_a_wrong_plan_does_not_agree_and_that_of_another_minimum_is_not_compared(riccati, solver, problem, error, same_minimum):
    class Wrong:
        name, options, warm_start = "wrong", riccati.options, None

        def solve(self, *asked):
            result = riccati.solve(*asked)
            return replace(result, inputs=result.inputs + error)

    row = compare(Wrong(), solver, [Instance(*problem, None)])
    assert (row["both_converged"], row["same_minimum"]) == (1, same_minimum)
    assert row["first_input"] == (pytest.approx(error, rel=0.1) if same_minimum else None)
