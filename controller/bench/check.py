"""Judgement on answers that shares no code with the solvers that gave them: residuals and objective of the soft programme.

Constraints and gradient come from the code that CasADi generates for `ocp`, bounds and parameters from `problem`; the rest is here.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controller.bench.sets import Instance, beyond_bounds, pack_instance
from controller.compiled import CompiledBackEnd
from controller.problem import Array, OcpOptions, full_reference
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC
from controller.solver import DUAL_TOLERANCE, PRIMAL_TOLERANCE, NlpBuffers, SolveResult, WarmStart


class OptimalityCheck:
    """Residuals of the soft programme.

    Args:
        library: of `casadi-c` for these options.
    """

    def __init__(self, library: Path, options: OcpOptions) -> None:
        layout = options.layout
        self._options = options
        self._buffers = NlpBuffers(layout)
        self._functions = CompiledBackEnd(library, self._buffers)
        self._is_hard = np.zeros(layout.n_variables + layout.n_constraints, dtype=np.bool_)
        self._is_hard[layout.state_index[0]] = self._is_hard[layout.input_index] = True
        self._is_hard[layout.n_variables : layout.n_variables + layout.n_gaps] = True

    def residual(self, instance: Instance, answer: WarmStart) -> float:
        """Largest residual in units of its tolerance: up to 1 is converged; infinite when anything is not finite."""
        b = self._buffers
        b.w[:], b.lam_w[:], b.lam_g[:] = answer.w, answer.lam_w, answer.lam_g
        pack_instance(b, instance, self._options)
        self._functions.check()
        if not all(np.isfinite(part).all() for part in (b.w, b.lam_w, b.lam_g, b.g, b.gradient)):
            return np.inf
        stationarity = float(np.max(np.abs(b.gradient + b.lam_w))) / DUAL_TOLERANCE
        values, multipliers = np.concatenate((b.w, b.g)), np.concatenate((b.lam_w, b.lam_g))
        lower, upper = np.concatenate((b.lower_w, b.lower_g)), np.concatenate((b.upper_w, b.upper_g))
        return max(stationarity, float(np.max(bound_residuals(values, multipliers, lower, upper, self._is_hard))))


def bound_residuals(values: Array, multipliers: Array, lower: Array, upper: Array, is_hard: NDArray[np.bool_]) -> Array:
    """Distance of each (value, multiplier) from what its bounds allow, in units of the tolerances; shape of `values`.

    A multiplier allows one value where it is not zero: its bound, or the violation at which the penalty's slope
    `PENALTY_LINEAR + PENALTY_QUADRATIC s` equals it. A value allows one multiplier away from its bounds: zero between them, the
    penalty's slope beyond them. Whichever distance is smaller counts; or both together, from the value without multiplier.
    """
    bound = np.where(multipliers > 0.0, upper, lower)
    excess = np.where(is_hard, 0.0, np.maximum(np.abs(multipliers) - PENALTY_LINEAR, 0.0)) / PENALTY_QUADRATIC
    outside = np.maximum(np.maximum(lower - values, values - upper), 0.0)
    value_error = np.where(multipliers == 0.0, outside, np.abs(values - bound - np.sign(multipliers) * excess))
    slope = np.where(values > upper, 1.0, -1.0) * (PENALTY_LINEAR + PENALTY_QUADRATIC * outside)
    is_beyond = outside > 0.0
    multiplier_error = np.where(is_beyond, np.where(is_hard, np.inf, np.abs(multipliers - slope)), np.abs(multipliers))
    without = np.maximum(outside / PRIMAL_TOLERANCE, np.abs(multipliers) / DUAL_TOLERANCE)
    least: Array = np.minimum(np.minimum(value_error / PRIMAL_TOLERANCE, multiplier_error / DUAL_TOLERANCE), without)
    return least


def soft_objective(instance: Instance, result: SolveResult, options: OcpOptions) -> float:
    """Cost of a plan with the penalties of its violations."""
    reference = full_reference(instance.horizon, options.model.n_states)
    error, u = result.states - reference, result.inputs
    du = np.diff(u, axis=0, prepend=instance.previous_input[None, :])
    n = options.model.n_states
    Q, Q_N = (np.pad(weights, (0, n - len(weights))) for weights in (options.state_weights, options.terminal_weights))
    cost = np.sum(error[:-1] ** 2 @ Q) + error[-1] ** 2 @ Q_N
    cost += np.sum(u**2 @ np.array(options.input_weights)) + np.sum(du**2 @ np.array(options.input_difference_weights))
    beyond, _ = beyond_bounds(instance.state, instance.horizon, result, options)
    violations = np.maximum(beyond, 0.0)
    return float(cost + np.sum(PENALTY_LINEAR * violations + 0.5 * PENALTY_QUADRATIC * violations**2))
