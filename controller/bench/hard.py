"""The hard set: whether a solver's word is true, and how long its longest solve is."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from controller.bench.check import OptimalityCheck
from controller.bench.measure import one_quiet_core, solve
from controller.bench.sets import HARD_KINDS, Instance
from controller.solver import Solver, SolveResult, SolveStatus

REPEATS = 15
"""Times that a solve is repeated that may be the longest one."""


@dataclass
class HardRun:
    """What one solver did from the hard starts.

    Args:
        residuals: of each answer, in units of the tolerance, by `OptimalityCheck`.
    """

    solver: Solver
    results: list[SolveResult] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)

    def row(self, starts: list[Instance], longest_us: float, unit_us: float) -> dict[str, Any]:
        """The figures of this run."""
        converged = np.array([result.status is SolveStatus.CONVERGED for result in self.results])
        is_optimal, kinds = np.array(self.residuals) <= 1.0, np.array([start.kind for start in starts])
        works = [result.effort.work for result in self.results]
        return {
            "solver": self.solver.name,
            "set": "hard",
            "starts": len(starts),
            "finite": float(np.mean([np.isfinite(r.states).all() and np.isfinite(r.inputs).all() for r in self.results])),
            "true_status": float(np.mean(converged == is_optimal)),
            "false_claims": int(np.sum(converged & ~is_optimal)),
            "unclaimed": int(np.sum(~converged & is_optimal)),
            "largest_residual_of_converged": float(np.max(np.array(self.residuals)[converged], initial=0.0)),
            "converged": float(np.mean(converged)),
            "converged_by_kind": {kind: float(np.mean(converged[kinds == kind])) for kind in HARD_KINDS if (kinds == kind).any()},
            "longest_quiet_us": round(longest_us, 1),
            "ratio_longest": round(longest_us / unit_us, 4),
            "work_max": None if any(work is None for work in works) else max(work for work in works if work is not None),
        }


def run_hard(solvers: list[Solver], starts: list[Instance], check: OptimalityCheck, unit_us: float) -> list[dict[str, Any]]:
    """Every solver from every start; solvers take turns at each."""
    runs = [HardRun(solver) for solver in solvers]
    with one_quiet_core():
        for start in starts:
            for run in runs:
                run.results.append(solve(run.solver, start))
                run.residuals.append(check.residual(start, run.solver.answer))
        return [run.row(starts, longest_quiet_us(run, starts), unit_us) for run in runs]


def longest_quiet_us(run: HardRun, starts: list[Instance]) -> float:
    """Largest quiet time over the starts: from the slowest down, each is repeated until no other can be longer."""
    longest_us = 0.0
    for n in sorted(range(len(starts)), key=lambda n: -run.results[n].solve_time_ns):
        first_us = run.results[n].solve_time_ns * 1e-3
        if first_us <= longest_us:
            break
        again_us = (solve(run.solver, starts[n]).solve_time_ns * 1e-3 for _ in range(REPEATS))
        longest_us = max(longest_us, min(first_us, *again_us))
    return longest_us
