"""`xilgate bench solver`: every solver on the same recorded problems, side by side in one process on one core."""

import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from controller.bench_loop import drive, nominal_scenarios
from controller.nmpc import Nmpc
from controller.problem import Array, Horizon, OcpOptions
from controller.solver import Solver, SolveResult, SolveStatus, WarmStart
from controller.solvers import DEFAULT_SOLVER, SOLVERS, make_solver
from dbc.vehicle import FOCUS, load_vehicle

_SEED = 1


@dataclass(frozen=True)
class Instance:
    """One recorded problem: what a solver was asked, and from where it began."""

    state: Array
    previous_input: Array
    horizon: Horizon
    warm_start: WarmStart | None


class RecordingSolver:
    """A solver that keeps what it is asked."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.name, self.options = solver.name, solver.options
        self.advance, self.reset = solver.advance, solver.reset
        self.instances: list[Instance] = []

    @property
    def warm_start(self) -> WarmStart | None:
        """Of the solver inside."""
        return self._solver.warm_start

    @warm_start.setter
    def warm_start(self, value: WarmStart | None) -> None:
        self._solver.warm_start = value

    def solve(self, state: Array, previous_input: Array, horizon: Horizon) -> SolveResult:
        """Keep the problem, and solve it."""
        self.instances.append(Instance(state.copy(), previous_input.copy(), horizon, self.warm_start))
        return self._solver.solve(state, previous_input, horizon)


def bench_solver(instances: int, rounds: int, progress: Callable[[str], None], vehicle_path: Path = FOCUS) -> dict[str, Any]:
    """Measure all solvers on the nominal set.

    Args:
        instances: problems to take, spread evenly over the scenarios.
        rounds: times that each solver solves each problem. The quiet time of a problem is the smallest of its rounds: what the
            solver needs when the machine leaves it alone.
        progress: told in one line each what takes time.

    Returns:
        `{"machine": ..., "rows": [...]}`, one row for each solver.

    Raises:
        SetupFailure: no compiler.
    """
    vehicle = load_vehicle(vehicle_path)
    solvers = [make_solver(name, vehicle.model, OcpOptions(), progress) for name in SOLVERS]
    recorder = RecordingSolver(next(solver for solver in solvers if solver.name == DEFAULT_SOLVER))
    for scenario in nominal_scenarios():
        progress(f"recording problems: {scenario.name}")
        recorder.reset()
        drive(Nmpc(recorder, scenario.path, vehicle, boot_id=1), vehicle, scenario, _SEED)
    recorded = recorder.instances
    chosen = [recorded[round(i)] for i in np.linspace(0, len(recorded) - 1, min(instances, len(recorded)))]
    progress(f"solving {len(chosen)} problems {rounds} times with {', '.join(SOLVERS)}")
    with _on_one_core():
        results = _interleaved(solvers, chosen, rounds)
    return {"machine": _machine(), "rows": [_row(solver.name, results[solver.name]) for solver in solvers]}


def _interleaved(solvers: list[Solver], instances: list[Instance], rounds: int) -> dict[str, list[list[SolveResult]]]:
    """Results by solver, round and instance; the solvers take turns at each instance, so that noise meets them alike."""
    results: dict[str, list[list[SolveResult]]] = {solver.name: [] for solver in solvers}
    for _ in range(rounds):
        for rows in results.values():
            rows.append([])
        for instance in instances:
            for solver in solvers:
                solver.warm_start = instance.warm_start
                results[solver.name][-1].append(solver.solve(instance.state, instance.previous_input, instance.horizon))
    return results


def _row(solver: str, results: list[list[SolveResult]]) -> dict[str, Any]:
    times_us = np.array([[result.solve_time_ns * 1e-3 for result in row] for row in results])
    quiet_us, every = times_us.min(axis=0), [result for row in results for result in row]
    return {
        "solver": solver,
        "set": "nominal",
        "instances": times_us.shape[1],
        "rounds": times_us.shape[0],
        "quiet_mean_us": round(float(quiet_us.mean()), 1),
        "quiet_p99_us": round(float(np.percentile(quiet_us, 99)), 1),
        "raw_p99_us": round(float(np.percentile(times_us, 99)), 1),
        "raw_max_us": round(float(times_us.max()), 1),
        "sqp_iterations_mean": _mean([result.effort.sqp_iterations for result in every]),
        "qp_iterations_mean": _mean([result.effort.qp_iterations for result in every]),
        "converged": sum(result.status is SolveStatus.CONVERGED for result in every) / len(every),
    }


def _mean(counts: list[int | None]) -> float | None:
    """Mean, or None where the solver does not tell."""
    known = [count for count in counts if count is not None]
    return round(float(np.mean(known)), 3) if len(known) == len(counts) else None


def to_table(result: dict[str, Any]) -> Table:
    """The result for people."""
    rows = result["rows"]
    counts = f"{rows[0]['instances']} problems, quiet: smallest of {rows[0]['rounds']} rounds"
    table = Table(title="Solve time", caption=f"{counts}\n{result['machine']}")
    for heading in ("solver", "set"):
        table.add_column(heading, no_wrap=True)
    for heading in ("quiet\nmean us", "quiet\np99 us", "raw\np99 us", "raw\nmax us", "SQP\nits", "QP\nits", "con-\nverged", "of\nVM"):
        table.add_column(heading, justify="right", no_wrap=True)
    uncompiled = next(row["quiet_mean_us"] for row in rows if row["solver"] == "casadi-vm")
    for row in rows:
        times = (f"{row[key]:.0f}" for key in ("quiet_mean_us", "quiet_p99_us", "raw_p99_us", "raw_max_us"))
        its = ("-" if row[key] is None else f"{row[key]:.2f}" for key in ("sqp_iterations_mean", "qp_iterations_mean"))
        ratio = f"1/{uncompiled / row['quiet_mean_us']:.1f}"
        table.add_row(row["solver"], row["set"], *times, *its, f"{row['converged']:.0%}", ratio)
    return table


@contextmanager
def _on_one_core() -> Iterator[None]:
    """Hold this process on one of its cores, where the system can do that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _machine() -> str:
    model = platform.processor() or platform.machine()
    for line in _lines(Path("/proc/cpuinfo")):
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{model}, {os.cpu_count()} cores, {platform.system()} {platform.release()}, Python {platform.python_version()}"


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []
