"""Solver `qrqp`: the paper's SQP method with QRQP on the very programme of `ocp`, with derivatives assembled from its stages.

CasADi differentiates the programme as a whole. Here Jacobian and Hessian come from one function of a stage, evaluated for each,
with its derivatives taken in the stage frame (see `riccati.stage`); what is linear or quadratic is left to CasADi. The answers are the
same, rounding apart. The multiplier of the parameters, which nobody reads, is not computed.
"""

from typing import Any

import casadi as ca

from controller.integrator import Expression
from controller.ocp import SOLVER_OPTIONS, SQPMETHOD_PARTS, OcpFunctions, advance_function, kkt_function, transcribe
from controller.problem import OcpOptions
from controller.riccati.stage import stage_functions
from dbc.vehicle import ModelParameters


def build_functions(car: ModelParameters, options: OcpOptions) -> OcpFunctions:
    """As `ocp.build_functions`, with the derivatives of this module."""
    nlp = transcribe(car, options)
    jacobian, hessian = derivatives(nlp, car, options)
    nmpc = ca.nlpsol("nmpc", "sqpmethod", nlp, SOLVER_OPTIONS | {"jac_fg": jacobian, "hess_lag": hessian, "calc_lam_p": False})
    parts = tuple(part for part in SQPMETHOD_PARTS if part != "gradient")
    return OcpFunctions(nmpc, kkt_function(nlp), advance_function(car, options), parts)


def derivatives(nlp: dict[str, Any], car: ModelParameters, options: OcpOptions) -> tuple[ca.Function, ca.Function]:
    """The functions that CasADi's SQP method calls for derivatives of the programme.

    Args:
        nlp: made by `ocp.transcribe`.

    Returns:
        `nlp_jac_fg`: (x, p) to the objective, its gradient, the constraints and their Jacobian.
        `nlp_hess_l`: (x, p, lam_f, lam_g) to the Hessian of lam_f f + lam_g' g, both triangles.
    """
    layout, N, n_states = options.layout, options.horizon_steps, options.model.n_states
    w, p, f = nlp["x"], nlp["p"], nlp["f"]
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", layout.n_constraints)
    stages = ca.reshape(w[:-n_states], n_states + options.model.n_inputs, N)
    next_states = w[layout.state_index[1:].ravel().tolist()]
    linearise, curve = _stage_derivatives(car, options)

    x_next, stage_jacobians = linearise.map(N)(stages)
    rows = nlp["g"][layout.n_gaps :]  # of the corridor
    gap_jacobian = ca.horzcat(_block_diagonal(stage_jacobians, linearise.sparsity_out(1), N), ca.MX(layout.n_gaps, n_states))
    jacobian = ca.vertcat(gap_jacobian - ca.jacobian(next_states, w), ca.jacobian(rows, w))
    outputs = [f, ca.densify(ca.gradient(f, w)), ca.vertcat(ca.vec(x_next) - next_states, rows), jacobian]
    jac_fg = ca.Function("nlp_jac_fg", [w, p], outputs, ["x", "p"], ["f", "grad:f:x", "g", "jac:g:x"])

    stage_hessians = curve.map(N)(stages, ca.reshape(lam_g[: layout.n_gaps], n_states, N))
    dynamics = ca.diagcat(_block_diagonal(stage_hessians, curve.sparsity_out(0), N), ca.MX(n_states, n_states))
    hessian = ca.hessian(lam_f * f, w)[0] + dynamics
    hess_lag = ca.Function("nlp_hess_l", [w, p, lam_f, lam_g], [hessian], ["x", "p", "lam:f", "lam:g"], ["hess:gamma:x:x"])
    return jac_fg, hess_lag


def _stage_derivatives(car: ModelParameters, options: OcpOptions) -> tuple[ca.Function, ca.Function]:
    """Functions of one stage z = (x, u): z to the next x and its Jacobian; (z, lam) to the Hessian of lam' x_next, both triangles."""
    derivatives = {function.name(): function for function in stage_functions(car, options)}["stage_derivatives"]
    z, lam = ca.SX.sym("z", derivatives.size1_in("z")), ca.SX.sym("lam", derivatives.size1_in("lam"))
    all_of = derivatives.call({"z": z, "lam": lam})
    linearise = ca.Function("stage_jacobian", [z], [all_of["x_next"], all_of["jacobian"]])
    curve = ca.Function("stage_hessian", [z, lam], [ca.tril2symm(all_of["hessian"])])
    return linearise, curve


def _block_diagonal(blocks: Expression, sparsity: ca.Sparsity, count: int) -> Expression:
    """Matrix with the blocks on its diagonal that the mapped function has beside each other."""
    return ca.MX(ca.diagcat(*[sparsity] * count), blocks.nz[:])
