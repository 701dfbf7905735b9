"""What a solver of the optimal control problem answers, and the shell around the back ends that solve the very same programme.

A back end may claim success whatever happened: the code that CasADi generates always does. So every answer is checked here
for finite numbers and for the Karush-Kuhn-Tucker conditions, recomputed from the answer itself.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np

from controller.problem import (
    Array,
    Horizon,
    Layout,
    OcpOptions,
    full_reference,
    pack_constraint_bounds,
    pack_parameters,
    pack_variable_bounds,
)
from dbc.errors import SetupFailure

PRIMAL_TOLERANCE = 1e-6
DUAL_TOLERANCE = 1e-4
"""The paper's thresholds on primal and dual infeasibility."""


class SolverError(SetupFailure):
    """A solver library cannot be used; one line that says why."""


class SolveStatus(Enum):
    """Judgement on one solve."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged"
    NOT_FINITE = "not finite"


@dataclass(frozen=True)
class SubFunction:
    """Share of one part of a solver in a solve, measured inside its C code."""

    time_ns: int
    calls: int


@dataclass(frozen=True)
class Effort:
    """What a solve took; None where the back end cannot tell.

    Args:
        work: in Riccati factorizations, the unit in which a bounded solver counts.
        profile: by part, named as in `PROFILE_PARTS`.
    """

    sqp_iterations: int | None = None
    qp_iterations: int | None = None
    work: float | None = None
    profile: dict[str, SubFunction] | None = None


PROFILE_PARTS = ("qp", "line search", "cost and constraints", "gradient", "hessian", "jacobian", "stage sweep")
"""Parts of a solver: the rows of the paper's table, and `stage sweep` where a solver computes dynamics, Jacobian and Hessian in one."""


@dataclass(frozen=True)
class SolveResult:
    """Answer of a solver.

    Args:
        states: predicted states, shape (N+1, n_states).
        inputs: planned inputs, shape (N, n_inputs).
        primal_residual: largest violation of a gap, a bound or a corridor row; NaN when the plan is not finite.
        dual_residual: largest entry of the gradient of the Lagrangian, or violation of complementarity.
        solve_time_ns: time that the numerical solver took [ns], without packing and checking.
    """

    status: SolveStatus
    states: Array
    inputs: Array
    primal_residual: float
    dual_residual: float
    effort: Effort
    solve_time_ns: int

    @property
    def first_input(self) -> Array:
        """The input to apply now, shape (n_inputs,)."""
        first: Array = self.inputs[0]
        return first


@dataclass(frozen=True)
class WarmStart:
    """Guess of decision variables and multipliers, in the order of `Layout`."""

    w: Array
    lam_w: Array
    lam_g: Array


class Solver(Protocol):
    """Solves the problem from one measured state after the other, each from the shifted answer before.

    Between two solves `options` can be replaced by others of the same model, horizon and sample time.
    """

    name: str
    options: OcpOptions
    warm_start: WarmStart | None

    @property
    def answer(self) -> WarmStart:
        """Decision variables and multipliers of the last answer; valid until the next solve."""

    def solve(self, state: Array, previous_input: Array, horizon: Horizon) -> SolveResult:
        """Plan from `state`, shape (n_states,), when `previous_input`, shape (n_inputs,), is what acts before."""

    def advance(self, state: Array, inputs: Array, duration_s: float) -> Array:
        """State of the model after `duration_s` of constant input; up to one sample time."""

    def reset(self) -> None:
        """Forget the warm start: the next solve begins from its reference."""


@dataclass(frozen=True)
class NlpBuffers:
    """Memory that shell and back end share; a back end keeps the addresses, so nothing here is ever replaced."""

    layout: Layout
    # What the programme takes.
    w0: Array = field(init=False)
    p: Array = field(init=False)
    lower_w: Array = field(init=False)
    upper_w: Array = field(init=False)
    lower_g: Array = field(init=False)
    upper_g: Array = field(init=False)
    lam_w0: Array = field(init=False)
    lam_g0: Array = field(init=False)
    # What it gives.
    w: Array = field(init=False)
    lam_w: Array = field(init=False)
    lam_g: Array = field(init=False)
    # What the check recomputes from that.
    g: Array = field(init=False)
    gradient: Array = field(init=False)

    def __post_init__(self) -> None:
        sizes = {"p": self.layout.n_parameters} | dict.fromkeys(("lower_g", "upper_g", "lam_g0", "lam_g", "g"), self.layout.n_constraints)
        for name in self.__dataclass_fields__:
            if name != "layout":
                object.__setattr__(self, name, np.zeros(sizes.get(name, self.layout.n_variables)))


class NlpBackEnd(Protocol):
    """Evaluates the functions of `ocp.OcpFunctions` on the shared buffers."""

    def solve(self) -> Effort:
        """Solve the programme."""

    def check(self) -> None:
        """Compute `g` and `gradient` at `w`, `p`, `lam_g`."""

    def advance(self, state: Array, inputs: Array, duration_s: float) -> Array:
        """State of the model after `duration_s` of constant input."""


class SqpSolver:
    """The paper's solver on some back end: packs, solves, checks, and keeps the warm start.

    Args:
        name: how people choose it.
        make_back_end: makes the back end on the buffers it is given.
        clock: nanoseconds; the solve time is measured with it and decides nothing.
    """

    def __init__(
        self,
        name: str,
        options: OcpOptions,
        make_back_end: Callable[[NlpBuffers], NlpBackEnd],
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.name = name
        self._options = options
        self.warm_start: WarmStart | None = None
        self._layout = options.layout
        self._buffers = NlpBuffers(self._layout)
        self._back_end = make_back_end(self._buffers)
        self._clock = clock

    @property
    def options(self) -> OcpOptions:
        """The problem's numbers."""
        return self._options

    @options.setter
    def options(self, options: OcpOptions) -> None:
        if options.generated() != self._options.generated():
            raise ValueError("model, horizon and sample time are written into the solver's code")
        self._options = options

    @property
    def answer(self) -> WarmStart:
        """Decision variables and multipliers of the last answer; see `Solver`."""
        return WarmStart(self._buffers.w, self._buffers.lam_w, self._buffers.lam_g)

    def solve(self, state: Array, previous_input: Array, horizon: Horizon) -> SolveResult:
        """Plan from `state`; see `Solver`."""
        self._pack(state, previous_input, horizon)
        if (refusal := self._refusal()) is not None:
            self.warm_start = None
            self._buffers.w[:] = math.nan
            return self._result(refusal, (math.nan, math.nan), Effort(), 0)
        start_ns = self._clock()
        effort = self._back_end.solve()
        solve_time_ns = self._clock() - start_ns
        primal, dual = self._residuals()
        if math.isnan(primal):
            status = SolveStatus.NOT_FINITE
        elif primal <= PRIMAL_TOLERANCE and dual <= DUAL_TOLERANCE:
            status = SolveStatus.CONVERGED
        else:
            status = SolveStatus.NOT_CONVERGED
        self.warm_start = None if status is SolveStatus.NOT_FINITE else self._shifted()
        return self._result(status, (primal, dual), effort, solve_time_ns)

    def advance(self, state: Array, inputs: Array, duration_s: float) -> Array:
        """State of the model after `duration_s` of constant input; see `Solver`."""
        return self._back_end.advance(state, inputs, duration_s)

    def reset(self) -> None:
        """Forget the warm start."""
        self.warm_start = None

    def _result(self, status: SolveStatus, residuals: tuple[float, float], effort: Effort, solve_time_ns: int) -> SolveResult:
        w, layout = self._buffers.w, self._layout
        return SolveResult(status, w[layout.state_index], w[layout.input_index], *residuals, effort, solve_time_ns)

    def _refusal(self) -> SolveStatus | None:
        """Why the packed problem is none: numbers that are not finite, or bounds that cross."""
        b = self._buffers
        if not (np.isfinite(b.p).all() and np.isfinite(b.w0).all()) or np.isnan(b.lower_g).any() or np.isnan(b.upper_g).any():
            return SolveStatus.NOT_FINITE
        if (b.lower_w > b.upper_w).any() or (b.lower_g > b.upper_g).any():
            return SolveStatus.NOT_CONVERGED
        return None

    def _pack(self, state: Array, previous_input: Array, horizon: Horizon) -> None:
        b = self._buffers
        steps, n_states = self._layout.horizon_steps, self._layout.n_states
        rows, columns = horizon.reference.shape
        if rows != steps + 1 or columns > n_states or state.shape != (n_states,):
            shapes = f"reference of shape {(rows, columns)}, state of shape {state.shape}"
            raise ValueError(f"{shapes}: this solver plans {steps} steps of {n_states} states")
        pack_parameters(b.p, horizon, previous_input, self.options)
        pack_variable_bounds(b.lower_w, b.upper_w, state, horizon, self.options)
        pack_constraint_bounds(b.lower_g, b.upper_g, horizon, self._layout)
        guess = self.warm_start or self._cold(horizon, previous_input)
        b.w0[:], b.lam_w0[:], b.lam_g0[:] = guess.w, guess.lam_w, guess.lam_g
        b.w0[self._layout.state_index[0]] = state

    def _cold(self, horizon: Horizon, previous_input: Array) -> WarmStart:
        w = np.empty(self._layout.n_variables)
        w[self._layout.state_index] = full_reference(horizon, self._layout.n_states)
        w[self._layout.input_index] = previous_input
        return WarmStart(w, np.zeros(self._layout.n_variables), np.zeros(self._layout.n_constraints))

    def _shifted(self) -> WarmStart:
        """The answer moved one sample on; the last stage is repeated, with the model's own step for its state."""
        b, layout = self._buffers, self._layout
        stage = int(layout.state_index[1, 0])
        w, lam_w = np.concatenate((b.w[stage:], b.w[-stage:])), np.concatenate((b.lam_w[stage:], b.lam_w[-stage:]))
        w[layout.state_index[-1]] = self.advance(b.w[layout.state_index[-1]], b.w[layout.input_index[-1]], self.options.sample_time_s)
        n = layout.n_states
        gaps, corridor = b.lam_g[: layout.n_gaps], b.lam_g[layout.n_gaps :]
        lam_g = np.concatenate((gaps[n:], gaps[-n:], corridor[1:], corridor[-1:]))
        return WarmStart(w, lam_w, lam_g)

    def _residuals(self) -> tuple[float, float]:
        """Primal and dual residual of the answer; NaN when any number in it is not finite."""
        b = self._buffers
        self._back_end.check()
        if not all(np.isfinite(part).all() for part in (b.w, b.lam_w, b.lam_g, b.g, b.gradient)):
            return math.nan, math.nan
        values, multipliers = np.concatenate((b.w, b.g)), np.concatenate((b.lam_w, b.lam_g))
        lower, upper = np.concatenate((b.lower_w, b.lower_g)), np.concatenate((b.upper_w, b.upper_g))
        primal, dual = self._row_residuals(values, multipliers, lower, upper)
        return primal, max(dual, float(np.max(np.abs(b.gradient + b.lam_w))))

    def _row_residuals(self, values: Array, multipliers: Array, lower: Array, upper: Array) -> tuple[float, float]:
        """Largest violation, and largest violation of complementarity, of variables and constraints under their bounds."""
        violation = float(np.max(np.maximum(lower - values, values - upper)))
        # A multiplier above zero belongs to the upper bound, below zero to the lower: it must be zero away from its bound.
        distance = np.where(multipliers > 0.0, upper - values, values - lower)
        return max(violation, 0.0), float(np.max(np.minimum(np.abs(multipliers), np.abs(distance))))
