"""Solver `riccati`: the library made by `build` behind the shell for soft constraints."""

import ctypes
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np

from controller.problem import Array, OcpOptions
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC, SoftSolver
from controller.solver import Effort, NlpBuffers, SolverError, SubFunction

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


class RiccatiSolver(SoftSolver):
    """This library behind the shell for soft constraints."""

    def __init__(self, library: Path, options: OcpOptions, clock: Callable[[], int] = time.perf_counter_ns, name: str = "riccati") -> None:
        super().__init__(name, options, lambda buffers: RiccatiBackEnd(library, buffers), clock)


def _address(values: Array) -> "ctypes._Pointer[ctypes.c_double]":
    return values.ctypes.data_as(_RealPointer)


def _aligned(size: int, alignment: int) -> tuple["ctypes.Array[ctypes.c_char]", ctypes.c_void_p]:
    """Memory for a solver, and the address in it to begin from."""
    memory = ctypes.create_string_buffer(size + alignment)
    return memory, ctypes.c_void_p(-(-ctypes.addressof(memory) // alignment) * alignment)
