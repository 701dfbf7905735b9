"""The targets of the solver bench beside what was measured."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Result = dict[str, Any]


@dataclass(frozen=True)
class Target:
    """One line of the table of targets.

    Args:
        find: the figure in the result of a run, or None when that run has not measured it.
        limit: the largest that meets the target; the smallest where `is_at_least`.
    """

    what: str
    find: Callable[[Result], float | None]
    limit: float
    is_at_least: bool = False

    def judged(self, result: Result) -> dict[str, Any]:
        """This target, the figure, and whether it is met; None where nothing was measured."""
        measured = self.find(result)
        met = None if measured is None else (measured >= self.limit if self.is_at_least else measured <= self.limit)
        return {"what": self.what, "target": f"{'>=' if self.is_at_least else '<='} {self.limit:g}", "measured": measured, "met": met}


def _row(solver: str, set_name: str, key: str, lanes: int | None = None) -> Callable[[Result], float | None]:
    """Figure of a row; None without that row, or when the library evaluates another number of stages at once."""

    def find(result: Result) -> float | None:
        if lanes is not None and next((s["lanes"] for s in result["solvers"] if s["solver"] == solver), None) != lanes:
            return None
        rows = (row for part in ("rows", "hard") for row in result[part] if (row["solver"], row["set"]) == (solver, set_name))
        return next((row[key] for row in rows), None)

    return find


def _agreement(with_solver: str, key: str) -> Callable[[Result], float | None]:
    return lambda result: next((row[key] for row in result["agreement"] if row["with"] == with_solver), None)


def _memory(solver: str) -> Callable[[Result], float | None]:
    return lambda result: next((row["memory_bytes"] for row in result["solvers"] if row["solver"] == solver), None)


def _hard(solver: str) -> tuple[Target, ...]:
    return (
        Target(f"{solver}, hard starts: finite, share", _row(solver, "hard", "finite"), 1.0, True),
        Target(f"{solver}, hard starts: status true to recomputed residuals, share", _row(solver, "hard", "true_status"), 1.0, True),
        Target(f"{solver}, hard starts: converged, share", _row(solver, "hard", "converged"), 0.99, True),
        Target(f"{solver}, hard starts: longest quiet solve", _row(solver, "hard", "ratio_longest"), 2.5),
    )


TARGETS = (
    Target("qrqp, nominal: mean", _row("qrqp", "nominal", "ratio_mean"), 0.65),
    Target("riccati with 4 lanes, nominal: mean", _row("riccati", "nominal", "ratio_mean", 4), 0.06),
    Target("riccati with 4 lanes, nominal: p99", _row("riccati", "nominal", "ratio_p99", 4), 0.08),
    Target("riccati-scalar, nominal: mean", _row("riccati-scalar", "nominal", "ratio_mean", 1), 0.16),
    Target("riccati with 4 lanes, active: p99", _row("riccati", "active", "ratio_p99", 4), 0.35),
    Target("riccati with 4 lanes, active: max", _row("riccati", "active", "ratio_max", 4), 0.60),
    Target("riccati-scalar, active: p99", _row("riccati-scalar", "active", "ratio_p99", 1), 0.80),
    Target("riccati-scalar, active: max", _row("riccati-scalar", "active", "ratio_max", 1), 1.0),
    *_hard("riccati"),
    *_hard("riccati-scalar"),
    Target("riccati against ipopt, same minimum: first input", _agreement("ipopt", "first_input"), 1e-5),
    Target("riccati against ipopt, same minimum: plan, scaled", _agreement("ipopt", "plan"), 1e-4),
    Target("riccati against qrqp, feasible: first input", _agreement("qrqp", "first_input"), 1e-5),
    Target("riccati against qrqp, feasible: plan, scaled", _agreement("qrqp", "plan"), 1e-5),
    Target("qrqp, nominal: SQP iterations at p95", _row("qrqp", "nominal", "sqp_iterations_p95"), 2.0),
    Target("riccati, static memory, bytes", _memory("riccati"), 1e6),
    Target("riccati-scalar, static memory, bytes", _memory("riccati-scalar"), 1e6),
)
"""Times are in the unit of the bench: the quiet mean of `casadi-c` on the nominal set of the same run."""


def judged(result: Result) -> list[dict[str, Any]]:
    """All targets with what a run has measured of them."""
    return [target.judged(result) for target in TARGETS]
