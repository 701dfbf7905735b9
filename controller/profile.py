"""Times of a solver's parts beside those of the paper's table "Profiling optimization sub-functions' evaluation time".

What the parts of the SQP method hold: `jacobian` is one call for the Jacobian of the constraints, the gradient of the cost, and
both their values. `line search` holds its calls of `cost and constraints`, as in CasADi's statistics, which the paper's table shows;
so the parts add up to more than the solver's own work. `gradient` is the multiplier of the parameters, which only `casadi-c` computes;
in `riccati` it is the sweeps for the gradient of the Lagrangian alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from controller.solver import PROFILE_PARTS, SolveResult, SubFunction

TOTAL = "total"


@dataclass(frozen=True)
class PaperTimes:
    """A row of the paper's table, on its host PC.

    Args:
        uncompiled_ms: of one solve, run by CasADi [ms].
        generated_ms: of one solve, generated to C [ms].
        generated_call_ms: of one evaluation, generated to C [ms].
    """

    uncompiled_ms: float
    generated_ms: float
    generated_call_ms: float


PAPER_PROFILE = {
    TOTAL: PaperTimes(22.0, 2.4, 2.4),
    "qp": PaperTimes(2.0, 0.218, 0.109),
    "line search": PaperTimes(2.0, 0.218, 0.109),
    "cost and constraints": PaperTimes(2.0, 0.218, 0.109),
    "gradient": PaperTimes(1.0, 0.109, 0.109),
    "hessian": PaperTimes(8.0, 0.87, 0.436),
    "jacobian": PaperTimes(5.0, 0.545, 0.27),
}
"""The paper's table of sub-functions, section "MiL in a virtual environment"."""


@dataclass(frozen=True)
class ProfileRow:
    """Mean times of one part of a solver.

    Args:
        calls: of one solve.
        solve_ms: in one solve [ms].
        call_ms: of one evaluation [ms]; None where it was never called.
        paper: None where the paper has no such part.
    """

    part: str
    calls: float
    solve_ms: float
    call_ms: float | None
    paper: PaperTimes | None


def profile_rows(results: Sequence[SolveResult]) -> list[ProfileRow]:
    """Mean profile of one solver's results, the whole first; empty when the solver does not tell."""
    profiles = [result.effort.profile for result in results if result.effort.profile is not None]
    if not profiles or len(profiles) < len(results):
        return []
    rows = [_row(TOTAL, [SubFunction(result.solve_time_ns, 1) for result in results])]
    return rows + [_row(part, [profile[part] for profile in profiles]) for part in PROFILE_PARTS if part in profiles[0]]


def _row(part: str, shares: list[SubFunction]) -> ProfileRow:
    time_ms, calls = 1e-6 * sum(share.time_ns for share in shares), sum(share.calls for share in shares)
    return ProfileRow(part, calls / len(shares), time_ms / len(shares), time_ms / calls if calls else None, PAPER_PROFILE.get(part))
