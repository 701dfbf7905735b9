"""Solver `ipopt`: the interior-point method that ships with CasADi, on the soft programme with its slacks written out.

It is there to be believed, not to be fast: another algorithm, from other hands, that solves to 1e-9 what `riccati` solves with its
slacks eliminated. It starts from the guess of the variables alone; an interior-point method has no use for that of multipliers.
"""

from collections.abc import Callable
from typing import Any

import casadi as ca

from controller.integrator import Expression
from controller.interpreted import InterpretedBackEnd
from controller.ocp import OcpFunctions, advance_function, kkt_function, transcribe
from controller.problem import OcpOptions
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC, SoftSolver
from controller.solver import Effort
from dbc.vehicle import ModelParameters

_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.max_iter": 500,
    "ipopt.mu_strategy": "adaptive",
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.nlp_scaling_method": "none",
}


def make_ipopt(car: ModelParameters, options: OcpOptions, clock: Callable[[], int]) -> SoftSolver:
    """The solver for a car and a problem."""
    functions = build_functions(car, options)
    return SoftSolver("ipopt", options, lambda buffers: IpoptBackEnd(functions, buffers), clock)


class IpoptBackEnd(InterpretedBackEnd):
    """The functions of `build_functions` on the shared buffers."""

    def solve(self) -> Effort:
        """Solve the programme; the iterations are of another kind than those of an SQP method."""
        self._solve()
        return Effort()


def build_functions(car: ModelParameters, options: OcpOptions) -> OcpFunctions:
    """As `ocp.build_functions`, with a solver of the soft programme."""
    nlp = transcribe(car, options)
    return OcpFunctions(_soft_solver(nlp, options), kkt_function(nlp), advance_function(car, options), ())


def _soft_solver(nlp: dict[str, Any], options: OcpOptions) -> ca.Function:
    """A solver of the soft programme with the inputs and outputs that `casadi.nlpsol` has for the hard one.

    A soft row is lower <= v + s and v - s <= upper with s >= 0; its multiplier is the sum of those of its two sides.
    """
    layout = options.layout
    in_w = [*layout.state_index[1:-1, options.model.bounded_index].ravel().tolist(), *layout.state_index[-1].tolist()]
    n_gaps, n_soft = layout.n_gaps, len(in_w) + layout.horizon_steps
    w, p, g, s = nlp["x"], nlp["p"], nlp["g"], ca.MX.sym("s", n_soft)
    gaps, v = g[:n_gaps], ca.vertcat(w[in_w], g[n_gaps:])
    cost = nlp["f"] + PENALTY_LINEAR * ca.sum1(s) + PENALTY_QUADRATIC / 2 * ca.sumsqr(s)
    soft = {"x": ca.vertcat(w, s), "p": p, "f": cost, "g": ca.vertcat(gaps, v + s, v - s)}
    solver = ca.nlpsol("ipopt", "ipopt", soft, _OPTIONS)

    x0, lbx, ubx, lam_x0 = (ca.MX.sym(name, w.numel()) for name in ("x0", "lbx", "ubx", "lam_x0"))
    lbg, ubg, lam_g0 = (ca.MX.sym(name, g.numel()) for name in ("lbg", "ubg", "lam_g0"))
    no_slack, unbounded = ca.MX.zeros(n_soft), ca.MX.inf(n_soft)
    answer = solver(
        x0=ca.vertcat(x0, no_slack),
        p=p,
        lbx=ca.vertcat(_replaced(lbx, in_w, -ca.inf), no_slack),
        ubx=ca.vertcat(_replaced(ubx, in_w, ca.inf), unbounded),
        lbg=ca.vertcat(lbg[:n_gaps], lbx[in_w], lbg[n_gaps:], -unbounded),
        ubg=ca.vertcat(ubg[:n_gaps], unbounded, ubx[in_w], ubg[n_gaps:]),
    )
    lam_gaps, lam_lower, lam_upper = ca.vertsplit(answer["lam_g"], [0, n_gaps, n_gaps + n_soft, n_gaps + 2 * n_soft])
    lam_in_w, lam_corridor = ca.vertsplit(lam_lower + lam_upper, [0, len(in_w), n_soft])
    lam_x = _replaced(answer["lam_x"][: w.numel()], in_w, lam_in_w)
    results = {"x": answer["x"][: w.numel()], "lam_x": lam_x, "lam_g": ca.vertcat(lam_gaps, lam_corridor)}
    arguments = [x0, p, lbx, ubx, lbg, ubg, lam_x0, lam_g0]
    return ca.Function("nmpc", arguments, list(results.values()), [a.name() for a in arguments], list(results))


def _replaced(values: Expression, places: list[int], by: Expression) -> Expression:
    changed = ca.MX(values)
    changed[places] = by
    return changed
