"""The shell of solvers that take state bounds, terminal box and corridor as soft: it checks the conditions of the soft programme."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from controller.problem import Array, OcpOptions
from controller.solver import DUAL_TOLERANCE, PRIMAL_TOLERANCE, NlpBackEnd, NlpBuffers, SqpSolver

PENALTY_LINEAR = 500.0
PENALTY_QUADRATIC = 400.0
"""Cost of a violation s of a soft bound: 500 s + 400 s^2 / 2, in the unit of the objective. A soft bound is obeyed as long as its
multiplier stays below 500. With the default weights that is so for an object that closes half the lane 20 m ahead, where 250 is
too little; much stiffer penalties make multipliers of 1e5 on the inputs when a corridor cannot be met."""


class SoftSolver(SqpSolver):
    """The shell with a check for soft constraints.

    Bounds on the inputs are hard. Bounds on states, the terminal box and the corridor may be violated at a cost, so that there is
    an answer from wherever the car is; `CONVERGED` means optimal in that sense, and the plan may then leave the corridor.
    """

    def __init__(
        self,
        name: str,
        options: OcpOptions,
        make_back_end: Callable[[NlpBuffers], NlpBackEnd],
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        super().__init__(name, options, make_back_end, clock)
        layout = options.layout
        self._is_hard = np.zeros(layout.n_variables + layout.n_constraints, dtype=np.bool_)
        self._is_hard[layout.state_index[0]] = self._is_hard[layout.input_index] = True
        self._is_hard[layout.n_variables : layout.n_variables + layout.n_gaps] = True

    def _row_residuals(self, values: Array, multipliers: Array, lower: Array, upper: Array) -> tuple[float, float]:
        return row_residuals(values, multipliers, lower, upper, self._is_hard)


def row_residuals(values: Array, multipliers: Array, lower: Array, upper: Array, is_hard: NDArray[np.bool_]) -> tuple[float, float]:
    """Largest distances of (value, multiplier) from the graph of the penalty's subdifferential.

    The multiplier of a soft row is 0 between its bounds, 0 to `PENALTY_LINEAR` at the upper one, `PENALTY_LINEAR` +
    `PENALTY_QUADRATIC` times the violation beyond, and mirrored at the lower one; a hard row has no beyond. The distance along
    the value counts as primal, that along the multiplier as dual: whichever is smaller in units of its tolerance.
    """
    is_upper = (multipliers > 0.0) | ((multipliers == 0.0) & (values > upper))
    beyond = np.where(is_upper, values - upper, lower - values)
    beyond_other = np.where(is_upper, lower - values, values - upper)
    size = np.abs(multipliers)
    excess = np.where(is_hard, 0.0, np.maximum(size - PENALTY_LINEAR, 0.0))
    along_value = np.abs(beyond - excess / PENALTY_QUADRATIC)
    along_multiplier = np.where(is_hard, np.inf, np.abs(size - PENALTY_LINEAR - PENALTY_QUADRATIC * beyond))
    along_multiplier = np.where(beyond <= 0.0, np.where(lower == upper, np.inf, size), along_multiplier)
    is_primal = along_value / PRIMAL_TOLERANCE < along_multiplier / DUAL_TOLERANCE
    # A small multiplier of one bound and a value beyond the other: the nearest point is that other bound, without multiplier.
    primal = np.where(is_primal, along_value, np.maximum(beyond_other, 0.0))
    dual = np.where(is_primal, 0.0, along_multiplier)
    return float(np.max(primal)), float(np.max(dual))
