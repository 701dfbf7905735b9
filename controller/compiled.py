"""Back end of `casadi-c` and `qrqp`: functions generated to C, compiled by `build`, and called without any CasADi.

All memory is allocated once and every address is kept: a call costs less than a microsecond and allocates nothing.
"""

import ctypes
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from controller.problem import Array
from controller.solver import Effort, NlpBuffers, SolverError, SubFunction

_Real = ctypes.c_double
_Integer = ctypes.c_longlong  # casadi_int
_RealPointer = ctypes.POINTER(_Real)


class CompiledFunction:
    """One function of a generated library, on fixed memory.

    Args:
        arguments, results: memory of each input and output in the order of the function, None where it is not given or wanted.

    Raises:
        SolverError: the library has no such function, other shapes, or too many users in this process.
    """

    def __init__(self, library: ctypes.CDLL, name: str, arguments: Sequence[Array | None], results: Sequence[Array | None]) -> None:
        try:
            self._function, checkout, release = library[name], library[f"{name}_checkout"], library[f"{name}_release"]
        except AttributeError as error:
            raise SolverError(f"{library._name}: no function {name}") from error
        for side, memory in (("in", arguments), ("out", results)):
            _check_shapes(library, name, side, memory)
        self._memory = checkout()
        if self._memory < 0:
            raise SolverError(f"{library._name}: too many solvers in one process")
        weakref.finalize(self, release, self._memory)
        sizes = [_Integer() for _ in range(4)]
        library[f"{name}_work"](*map(ctypes.byref, sizes))
        sz_arg, sz_res, sz_iw, sz_w = (size.value for size in sizes)
        self._kept = (arguments, results)  # the memory behind the addresses
        self._arguments = _addresses(sz_arg, arguments)
        self._results = _addresses(sz_res, results)
        self._integers, self._reals = (_Integer * max(sz_iw, 1))(), (_Real * max(sz_w, 1))()

    def __call__(self) -> None:
        """Evaluate; the return value says nothing and is not read, see `solver`."""
        self._function(self._arguments, self._results, self._integers, self._reals, self._memory)


class CompiledBackEnd:
    """The functions of `ocp.OcpFunctions` in a library made by `build`, on the shared buffers."""

    def __init__(self, library_path: Path, buffers: NlpBuffers) -> None:
        try:
            library = ctypes.CDLL(str(library_path))
            measurements, parts = library["xilgate_measurements"], library["xilgate_parts"]
        except (OSError, AttributeError) as error:
            raise SolverError(f"{library_path}: not a solver library: {error}") from error
        b = buffers
        layout = b.layout
        self._state, self._after = np.zeros(layout.n_states), np.zeros(layout.n_states)
        self._inputs, self._duration = np.zeros(layout.n_inputs), np.zeros(1)
        self._solve = CompiledFunction(
            library, "nmpc", (b.w0, b.p, b.lower_w, b.upper_w, b.lower_g, b.upper_g, b.lam_w0, b.lam_g0),
            (b.w, None, None, b.lam_w, b.lam_g, None),
        )  # fmt: skip
        self._check = CompiledFunction(library, "kkt", (b.w, b.p, b.lam_g), (b.g, b.gradient))
        self._advance = CompiledFunction(library, "advance", (self._state, self._inputs, self._duration), (self._after,))
        parts.restype = ctypes.c_char_p
        self._parts = parts().decode().split(",")
        measurements.restype = ctypes.POINTER(_Integer * (2 + 2 * len(self._parts)))
        self._measurements = measurements

    def solve(self) -> Effort:
        """Solve the programme; iterations and profile as measured in the generated code."""
        measured = self._measurements().contents
        before = list(measured)
        self._solve()
        sqp, qp, *spent = (now - then for now, then in zip(measured, before, strict=True))
        profile = {part: SubFunction(spent[2 * i], spent[2 * i + 1]) for i, part in enumerate(self._parts)}
        return Effort(sqp, qp, profile=profile)

    def check(self) -> None:
        """Compute constraints and gradient of the Lagrangian at the answer."""
        self._check()

    def advance(self, state: Array, inputs: Array, duration_s: float) -> Array:
        """State of the model after `duration_s` of constant input."""
        self._state[:], self._inputs[:], self._duration[0] = state, inputs, duration_s
        self._advance()
        return self._after.copy()


def _addresses(size: int, memory: Sequence[Array | None]) -> "ctypes.Array[ctypes._Pointer[ctypes.c_double]]":
    addresses = (_RealPointer * size)()  # null: not given, not wanted
    for i, values in enumerate(memory):
        if values is not None:
            addresses[i] = values.ctypes.data_as(_RealPointer)
    return addresses


def _check_shapes(library: ctypes.CDLL, name: str, side: str, memory: Sequence[Array | None]) -> None:
    sparsity = library[f"{name}_sparsity_{side}"]
    sparsity.argtypes, sparsity.restype = (_Integer,), ctypes.POINTER(_Integer)
    count = library[f"{name}_n_{side}"]
    count.restype = _Integer
    expected = [sparsity(i)[0] * sparsity(i)[1] for i in range(count())]
    if len(expected) != len(memory) or any(m is not None and m.size != size for m, size in zip(memory, expected, strict=True)):
        raise SolverError(f"{library._name}: {name} has {side}puts of sizes {expected}, this program expects others")
