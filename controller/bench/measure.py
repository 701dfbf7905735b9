"""Timing: solvers take turns at each problem in one process on one core; the quiet time of a problem is the smallest of its rounds."""

import gc
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from controller.bench.sets import Instance
from controller.problem import Array
from controller.profile import profile_rows
from controller.solver import Solver, SolveResult, SolveStatus

UNIT_SOLVER = "casadi-c"
"""Its quiet mean on the nominal set is the unit of every time."""
SOFT_SOLVERS = ("riccati", "riccati-scalar", "ipopt")
"""Those that may violate a state bound or the corridor at a cost. The others are only given problems that are feasible."""
UNCOMPILED_ROUNDS = 2
"""Most rounds of `casadi-vm`, which takes ten times as long as all others together."""


@dataclass(frozen=True)
class Measurement:
    """What one solver did on one set; results by round, then by instance."""

    solver: str
    set_name: str
    instances: list[Instance]
    results: list[list[SolveResult]]

    @property
    def times_us(self) -> Array:
        """Shape (rounds, instances)."""
        return np.array([[result.solve_time_ns * 1e-3 for result in row] for row in self.results])

    @property
    def quiet_us(self) -> Array:
        """Smallest time of each instance, shape (instances,)."""
        smallest: Array = self.times_us.min(axis=0)
        return smallest

    @property
    def quiet_results(self) -> list[SolveResult]:
        """Of each instance the result of its fastest round."""
        return [self.results[number][n] for n, number in enumerate(self.times_us.argmin(axis=0))]

    def profile(self) -> list[dict[str, Any]]:
        """Mean times of the solver's parts in its quiet solves, beside the paper's; empty where it does not tell."""
        return [{"solver": self.solver} | asdict(row) for row in profile_rows(self.quiet_results)]

    def feasible(self) -> "Measurement":
        """The part that solvers with hard constraints can solve."""
        places = [n for n, instance in enumerate(self.instances) if instance.is_feasible]
        results = [[row[n] for n in places] for row in self.results]
        return Measurement(self.solver, f"{self.set_name}-feasible", [self.instances[n] for n in places], results)

    def row(self, unit_us: float) -> dict[str, Any]:
        """The figures of this measurement; iterations and work are the same in every round."""
        quiet_us, times_us, answers = self.quiet_us, self.times_us, self.results[0]
        sqp = [result.effort.sqp_iterations for result in answers]
        qp = [result.effort.qp_iterations for result in answers]
        work = [result.effort.work for result in answers]
        return {
            "solver": self.solver,
            "set": self.set_name,
            "instances": len(answers),
            "rounds": len(self.results),
            "ratio_mean": _rounded(quiet_us.mean() / unit_us, 4),
            "ratio_p99": _rounded(np.percentile(quiet_us, 99) / unit_us, 4),
            "ratio_max": _rounded(quiet_us.max() / unit_us, 4),
            "quiet_mean_us": _rounded(quiet_us.mean(), 1),
            "quiet_p99_us": _rounded(np.percentile(quiet_us, 99), 1),
            "quiet_max_us": _rounded(quiet_us.max(), 1),
            "raw_p99_us": _rounded(np.percentile(times_us, 99), 1),
            "raw_max_us": _rounded(times_us.max(), 1),
            "sqp_iterations_mean": _known(sqp, np.mean),
            "sqp_iterations_p95": _known(sqp, lambda counts: np.percentile(counts, 95)),
            "qp_iterations_mean": _known(qp, np.mean),
            "work_mean": _known(work, np.mean),
            "work_max": _known(work, np.max),
            "converged": _rounded(np.mean([result.status is SolveStatus.CONVERGED for result in answers]), 4),
        }


def interleaved(solvers: list[Solver], instances: list[Instance], rounds: int, set_name: str) -> list[Measurement]:
    """Let the solvers take turns at each instance, so that noise meets them alike, each from the recorded warm start."""
    results: dict[str, list[list[SolveResult]]] = {solver.name: [] for solver in solvers}
    with one_quiet_core():
        for number in range(rounds):
            taking_part = [s for s in solvers if s.name != "casadi-vm" or number < UNCOMPILED_ROUNDS]
            for solver in taking_part:
                results[solver.name].append([])
            for instance in instances:
                for solver in taking_part:
                    if _can_solve(solver, instance):
                        results[solver.name][-1].append(solve(solver, instance))
    measurements = []
    for solver in solvers:
        asked = [i for i in instances if _can_solve(solver, i)]
        name = set_name if len(asked) == len(instances) else f"{set_name}-feasible"
        measurements.append(Measurement(solver.name, name, asked, results[solver.name]))
    return [m for m in measurements if m.instances]


def solve(solver: Solver, instance: Instance) -> SolveResult:
    """One problem, from its recorded warm start."""
    solver.warm_start = instance.warm_start
    return solver.solve(instance.state, instance.previous_input, instance.horizon)


@contextmanager
def one_quiet_core() -> Iterator[None]:
    """Hold this process on one of its cores, where the system can do that, and Python's collector out of the way."""
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    if allowed:
        os.sched_setaffinity(0, {max(allowed)})
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        if allowed:
            os.sched_setaffinity(0, allowed)


def _can_solve(solver: Solver, instance: Instance) -> bool:
    return solver.name in SOFT_SOLVERS or instance.is_feasible is not False


def _known(counts: Sequence[float | None], statistic: Callable[[Sequence[float]], np.floating[Any] | float]) -> float | None:
    """The statistic, or None where the solver does not tell."""
    known = [count for count in counts if count is not None]
    return _rounded(statistic(known), 3) if len(known) == len(counts) else None


def _rounded(value: np.floating[Any] | float, digits: int) -> float:
    return round(float(value), digits)
