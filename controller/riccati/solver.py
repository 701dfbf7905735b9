"""Solver `riccati`: the library made by `build` behind the common shell, and the check that knows its soft constraints."""

import ctypes
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from controller.problem import Array, OcpOptions
from controller.solver import DUAL_TOLERANCE, PRIMAL_TOLERANCE, Effort, NlpBuffers, SolverError, SqpSolver, SubFunction

PENALTY_LINEAR = 500.0
PENALTY_QUADRATIC = 400.0
"""Cost of a violation s of a soft bound: 500 s + 400 s^2 / 2, in the unit of the objective. A soft bound is obeyed as long as its
multiplier stays below 500. With the default weights that is so for an object that closes half the lane 20 m ahead, where 250 is
too little; much stiffer penalties make multipliers of 1e5 on the inputs when a corridor cannot be met."""

_Real = ctypes.c_double
_RealPointer = ctypes.POINTER(_Real)


class _Problem(ctypes.Structure):
    """`nmpc_problem` of nmpc.h."""

    _fields_: ClassVar = [
        *((name, _RealPointer) for name in ("w_guess", "lam_w_guess", "lam_g_guess", "parameters")),
        *((name, _RealPointer) for name in ("w_lower", "w_upper", "g_lower", "g_upper")),
        ("penalty_linear", _Real),
        ("penalty_quadratic", _Real),
    ]


class _Part(ctypes.Structure):
    """`nmpc_part` of nmpc.h."""

    _fields_: ClassVar = [("time_ns", ctypes.c_int64), ("calls", ctypes.c_int)]


PARTS = {"stage_sweep": "stage sweep", "adjoint_sweep": "gradient", "qp": "qp"}
"""Fields of `nmpc_statistics`, and their names in `controller.solver.PROFILE_PARTS`."""


class _Statistics(ctypes.Structure):
    """`nmpc_statistics` of nmpc.h."""

    _fields_: ClassVar = [
        *((name, ctypes.c_int) for name in ("status", "sqp_iterations", "qp_iterations", "factorizations")),
        *((name, _Real) for name in ("work", "primal_residual", "dual_residual")),
        *((name, _Part) for name in PARTS),
    ]


class RiccatiBackEnd:
    """The library's functions on the shared buffers; `address` is that of the solver's memory.

    Raises:
        SolverError: the file is no library of this solver, or one for another problem.
    """

    def __init__(self, library_path: Path, buffers: NlpBuffers) -> None:
        try:
            library = ctypes.CDLL(str(library_path))
            self._solve, self._evaluate, self._advance = library.nmpc_solve, library.nmpc_evaluate, library.nmpc_advance
            sizes = [library[f"nmpc_{name}"]() for name in ("variables", "constraints", "parameters")]
        except (OSError, AttributeError) as error:
            raise SolverError(f"{library_path}: not a solver library: {error}") from error
        b = buffers
        if sizes != [b.w.size, b.g.size, b.p.size]:
            raise SolverError(f"{library_path}: for {sizes} variables, constraints and parameters, not {[b.w.size, b.g.size, b.p.size]}")
        library.nmpc_solver_bytes.restype = library.nmpc_solver_alignment.restype = ctypes.c_size_t
        self._memory, memory = _aligned(library.nmpc_solver_bytes(), library.nmpc_solver_alignment())
        self.address = memory
        problem = _Problem(
            *map(_address, (b.w0, b.lam_w0, b.lam_g0, b.p, b.lower_w, b.upper_w, b.lower_g, b.upper_g)), PENALTY_LINEAR, PENALTY_QUADRATIC
        )
        self.statistics = _Statistics()
        layout = b.layout
        self._state, self._inputs, self._after = np.zeros(layout.n_states), np.zeros(layout.n_inputs), np.zeros(layout.n_states)
        self._solve.restype = _Statistics
        self._solve_arguments = (memory, ctypes.byref(problem), *map(_address, (b.w, b.lam_w, b.lam_g)))
        self._evaluate_arguments = (memory, *map(_address, (b.p, b.w, b.lam_g, b.g, b.gradient)))
        self._state_address, self._inputs_address, self._after_address = map(_address, (self._state, self._inputs, self._after))
        self._kept = (buffers, problem)  # the memory behind the addresses

    def solve(self) -> Effort:
        """Solve the programme; SQP iterations, and Newton steps of all its quadratic programmes."""
        self.statistics = self._solve(*self._solve_arguments)
        s = self.statistics
        parts = ((part, getattr(s, field)) for field, part in PARTS.items())
        profile = {part: SubFunction(share.time_ns, share.calls) for part, share in parts}
        return Effort(s.sqp_iterations, s.qp_iterations, s.work, profile)

    def check(self) -> None:
        """Compute constraints and gradient of the Lagrangian at the answer."""
        self._evaluate(*self._evaluate_arguments)

    def advance(self, state: Array, inputs: Array, duration_s: float) -> Array:
        """State of the model after `duration_s` of constant input."""
        self._state[:], self._inputs[:] = state, inputs
        self._advance(self._state_address, self._inputs_address, _Real(duration_s), self._after_address)
        return self._after.copy()


class RiccatiSolver(SqpSolver):
    """The shell with a check for soft constraints.

    Bounds on the inputs are hard. Bounds on states, the terminal box and the corridor may be violated at a cost, so that there is
    an answer from wherever the car is; `CONVERGED` means optimal in that sense, and the plan may then leave the corridor.
    """

    def __init__(self, library: Path, options: OcpOptions, clock: Callable[[], int] = time.perf_counter_ns, name: str = "riccati") -> None:
        super().__init__(name, options, lambda buffers: RiccatiBackEnd(library, buffers), clock)
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


def _address(values: Array) -> "ctypes._Pointer[ctypes.c_double]":
    return values.ctypes.data_as(_RealPointer)


def _aligned(size: int, alignment: int) -> tuple["ctypes.Array[ctypes.c_char]", ctypes.c_void_p]:
    """Memory for a solver, and the address in it to begin from."""
    memory = ctypes.create_string_buffer(size + alignment)
    return memory, ctypes.c_void_p(-(-ctypes.addressof(memory) // alignment) * alignment)
