"""The optimal control problem (5) of the paper as a nonlinear programme, by direct multiple shooting.

The dynamics hold for k = 0 to N-1 (the paper's index runs to N, one too far). The corridor binds nodes 1 to N: node 0 is
pinned to the measurement, which no constraint can move.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import casadi as ca

from controller.integrator import Expression, rk4_step
from controller.problem import Model, OcpOptions
from dbc.vehicle import ModelParameters

SOLVER_OPTIONS: dict[str, Any] = {
    "qpsol": "qrqp",
    "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False, "max_iter": 100, "error_on_fail": False},
    "hessian_approximation": "exact",
    "max_iter": 50,
    "tol_pr": 1e-6,
    "tol_du": 1e-4,
    "print_header": False,
    "print_iteration": False,
    "print_status": False,
    "print_time": False,
    "error_on_fail": False,
}
"""The paper's solver: SQP with QRQP, exact Hessian, at most 50 and 100 iterations, thresholds 1e-6 and 1e-4."""

SQPMETHOD_PARTS = ("qp", "line search", "cost and constraints", "gradient", "hessian", "jacobian")
"""What the paper's solver spends its time on: the rows of its table."""


@dataclass(frozen=True)
class OcpFunctions:
    """The three CasADi functions that a controller calls; `Layout` says what lies where.

    Args:
        nmpc: the solver, with the inputs and outputs of `casadi.nlpsol`.
        kkt: (w, p, lam_g) to (g, gradient of f + lam_g' g), both dense.
        advance: (x, u, duration_s) to the state after that time.
        parts: what a profile of the solver tells apart, names of `solver.PROFILE_PARTS`.
    """

    nmpc: Any
    kkt: Any
    advance: Any
    parts: tuple[str, ...]


def equations(model: Model) -> Callable[[Expression, Expression, ModelParameters], Expression]:
    """The function (x, u, car) to dx/dt of a model."""
    module, _, name = model.equations.partition(":")
    found: Callable[[Expression, Expression, ModelParameters], Expression] = getattr(importlib.import_module(module), name)
    return found


def stage_function(car: ModelParameters, options: OcpOptions) -> Expression:
    """f_d of the paper: one sample of the model, (x, u) to the next x.

    Model, step and stage are functions that call each other, so that the model's code, and that of its derivatives, is there
    once and not sixteen times: the C compiler needs a quarter of the time, and the solver no more.
    """
    called = {"never_inline": True}
    n_states, n_inputs = options.model.n_states, options.model.n_inputs
    x_sx, u_sx = ca.SX.sym("x", n_states), ca.SX.sym("u", n_inputs)
    model = ca.Function("model", [x_sx, u_sx], [equations(options.model)(x_sx, u_sx, car)], ["x", "u"], ["dx"], called)
    x, u = ca.MX.sym("x", n_states), ca.MX.sym("u", n_inputs)
    x_next = rk4_step(model, x, u, options.sample_time_s / options.integrator_steps)
    step = ca.Function("step", [x, u], [x_next], ["x", "u"], ["x_next"], called)
    x_next = x
    for _ in range(options.integrator_steps):
        x_next = step(x_next, u)
    return ca.Function("stage", [x, u], [x_next], ["x", "u"], ["x_next"])


def advance_function(car: ModelParameters, options: OcpOptions) -> Expression:
    """The same for a duration [s] that is an argument, (x, u, duration_s) to the x after it."""
    x, u, duration = ca.SX.sym("x", options.model.n_states), ca.SX.sym("u", options.model.n_inputs), ca.SX.sym("duration_s")
    derivative = equations(options.model)
    x_after = x
    for _ in range(options.integrator_steps):
        x_after = rk4_step(lambda x, u: derivative(x, u, car), x_after, u, duration / options.integrator_steps)
    return ca.Function("advance", [x, u, duration], [x_after], ["x", "u", "duration_s"], ["x_after"])


def build_functions(car: ModelParameters, options: OcpOptions) -> OcpFunctions:
    """Write the programme down and make its functions, all derivatives by CasADi."""
    nlp = transcribe(car, options)
    nmpc = ca.nlpsol("nmpc", "sqpmethod", nlp, SOLVER_OPTIONS)
    return OcpFunctions(nmpc, kkt_function(nlp), advance_function(car, options), SQPMETHOD_PARTS)


def kkt_function(nlp: dict[str, Any]) -> Expression:
    """(w, p, lam_g) to the constraints and the gradient of f + lam_g' g, both dense."""
    lam_g = ca.MX.sym("lam_g", nlp["g"].numel())
    gradient = ca.densify(ca.gradient(nlp["f"] + ca.dot(lam_g, nlp["g"]), nlp["x"]))
    return ca.Function("kkt", [nlp["x"], nlp["p"], lam_g], [nlp["g"], gradient], ["w", "p", "lam_g"], ["g", "gradient"])


def transcribe(car: ModelParameters, options: OcpOptions) -> dict[str, Any]:
    """The programme: decision variables `x`, parameters `p`, objective `f`, constraints `g`."""
    layout, N = options.layout, options.horizon_steps
    n_states, n_inputs = layout.n_states, layout.n_inputs
    w = ca.MX.sym("w", layout.n_variables)
    p = ca.MX.sym("p", layout.n_parameters)
    nodes = ca.reshape(w[:-n_states], n_states + n_inputs, N)
    x = ca.horzcat(nodes[:n_states, :], w[-n_states:])
    u = nodes[n_states:, :]

    ends = [0, *accumulate(layout.parameter_sizes)]
    x_ref, normals, u_previous, Q, Q_N, R, S = ca.vertsplit(p, ends)
    x_ref, normals = ca.reshape(x_ref, n_states, N + 1), ca.reshape(normals, 2, N)

    error = x - x_ref
    du = u - ca.horzcat(u_previous, u[:, :-1])
    stage_cost = ca.dot(Q, ca.sum2(error[:, :-1] ** 2)) + ca.dot(R, ca.sum2(u**2)) + ca.dot(S, ca.sum2(du**2))
    terminal_cost = ca.dot(Q_N, error[:, -1] ** 2)

    gaps = stage_function(car, options).map(N)(x[:, :-1], u) - x[:, 1:]
    lateral = ca.sum1(normals * error[options.model.position_index, 1:])
    return {"x": w, "p": p, "f": stage_cost + terminal_cost, "g": ca.vertcat(ca.vec(gaps), ca.vec(lateral))}
