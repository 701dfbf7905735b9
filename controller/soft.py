"""The shell of solvers that take state bounds, terminal box and corridor as soft: it checks the conditions of the soft programme."""

import math
import time
from collections.abc import Callable

import numpy as np

from controller.problem import OcpOptions
from controller.riccati.solver import row_residuals
from controller.solver import NlpBackEnd, NlpBuffers, SqpSolver


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

    def _residuals(self) -> tuple[float, float]:
        """Primal and dual residual of the answer to the soft programme; NaN when any number in it is not finite."""
        b = self._buffers
        self._back_end.check()
        if not all(np.isfinite(part).all() for part in (b.w, b.lam_w, b.lam_g, b.g, b.gradient)):
            return math.nan, math.nan
        values, multipliers = np.concatenate((b.w, b.g)), np.concatenate((b.lam_w, b.lam_g))
        lower, upper = np.concatenate((b.lower_w, b.lower_g)), np.concatenate((b.upper_w, b.upper_g))
        primal, dual = row_residuals(values, multipliers, lower, upper, self._is_hard)
        return primal, max(dual, float(np.max(np.abs(b.gradient + b.lam_w))))
