"""Judgement on an answer to the soft programme by functions that CasADi makes from the programme as `ocp` writes it down."""

import casadi as ca
import numpy as np

from controller.ocp import transcribe
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC


def conditions_of(car, options):
    """(w, p, lam_g) to the constraints and the gradient of f + lam_g' g."""
    nlp = transcribe(car, options)
    lam_g = ca.MX.sym("lam_g", nlp["g"].numel())
    gradient = ca.gradient(nlp["f"] + ca.dot(lam_g, nlp["g"]), nlp["x"])
    return ca.Function("kkt", [nlp["x"], nlp["p"], lam_g], [nlp["g"], gradient])


def is_optimal(solver, conditions):
    """Whether the last answer meets the conditions of the soft programme.

    A soft row's value is where its penalty moves value + multiplier to (its proximal map).
    """
    b, layout = solver._buffers, solver.options.layout
    g, gradient = (np.array(value).ravel() for value in conditions(b.w, b.p, b.lam_g))
    rows = slice(layout.n_gaps, None)
    values, multipliers = np.concatenate((b.w, g[rows])), np.concatenate((b.lam_w, b.lam_g[rows]))
    lower, upper = np.concatenate((b.lower_w, b.lower_g[rows])), np.concatenate((b.upper_w, b.upper_g[rows]))
    is_soft = np.ones(values.size, dtype=bool)
    is_soft[layout.input_index], is_soft[layout.state_index[0]] = False, False
    clipped = np.clip(values + multipliers, lower, upper)
    beyond = values + multipliers - clipped
    rest = np.where(is_soft, np.maximum(np.abs(beyond) - PENALTY_LINEAR, 0.0) / (1.0 + PENALTY_QUADRATIC), 0.0)
    row_error = np.max(np.abs(values - clipped - np.sign(beyond) * rest))
    gap, slope = np.max(np.abs(g[: layout.n_gaps])), np.max(np.abs(gradient + b.lam_w))
    return bool(max(gap / 1e-6, slope / 1e-4, row_error / 1e-4) <= 1.0)
