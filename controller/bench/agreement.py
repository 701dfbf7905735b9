"""Whether solvers that share no code give the same plan for the same problem."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.bench.check import soft_objective
from controller.bench.measure import SOFT_SOLVERS, solve
from controller.bench.sets import Instance, beyond_bounds
from controller.solver import Solver, SolveResult, SolveStatus

SAME_OBJECTIVE = 1e-4
"""Relative difference up to which two answers are the same minimum; the problem has others.

An answer within the solvers' tolerance of a gap costs up to 1e-5 more or less than one that closes it: a smaller number would leave
out the answers that differ most."""
OBEYED = 1e-6
"""Violation up to which a plan counts as one that obeys its bounds."""


@dataclass(frozen=True)
class Difference:
    """Between two plans of the same minimum: of the first input, and of the whole plan over max(1, size)."""

    first_input: float
    plan: float


def compare(solver: Solver, other: Solver, instances: list[Instance]) -> dict[str, Any]:
    """Largest differences of the answers of `solver` to those of `other`.

    A solver with hard constraints is asked only where the answer of `solver` obeys them all.
    """
    asked = both = 0
    differences: list[Difference] = []
    for instance in instances:
        ours = solve(solver, instance)
        if other.name not in SOFT_SOLVERS and not _obeys(instance, ours, solver):
            continue
        theirs = solve(other, instance)
        asked += 1
        if ours.status is theirs.status is SolveStatus.CONVERGED:
            both += 1
            objectives = [soft_objective(instance, result, solver.options) for result in (ours, theirs)]
            if abs(objectives[0] - objectives[1]) <= SAME_OBJECTIVE * max(1.0, abs(objectives[1])):
                differences.append(_difference(ours, theirs))
    return {
        "solver": solver.name,
        "with": other.name,
        "instances": asked,
        "both_converged": both,
        "same_minimum": len(differences),
        "first_input": max((d.first_input for d in differences), default=None),
        "plan": max((d.plan for d in differences), default=None),
    }


def _obeys(instance: Instance, result: SolveResult, solver: Solver) -> bool:
    beyond, _ = beyond_bounds(instance.state, instance.horizon, result, solver.options)
    return result.status is SolveStatus.CONVERGED and float(beyond.max()) <= OBEYED


def _difference(ours: SolveResult, theirs: SolveResult) -> Difference:
    pairs = ((ours.states, theirs.states), (ours.inputs, theirs.inputs))
    plan = max(float(np.max(np.abs(a - b) / np.maximum(1.0, np.abs(b)))) for a, b in pairs)
    return Difference(float(np.max(np.abs(ours.first_input - theirs.first_input))), plan)
