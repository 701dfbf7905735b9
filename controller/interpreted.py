"""Back end `casadi-vm`: the functions run by CasADi's virtual machine, as the modelling environment would run them."""

from typing import Any

import casadi as ca
import numpy as np

from controller.ocp import OcpFunctions
from controller.problem import Array
from controller.solver import Effort, NlpBuffers, SubFunction

_STATISTICS = {
    "qp": "QP",
    "line search": "linesearch",
    "cost and constraints": "nlp_fg",
    "gradient": "nlp_grad",
    "hessian": "nlp_hess_l",
    "jacobian": "nlp_jac_fg",
}
"""CasADi's name for each part of its SQP method. `jacobian` is one call for the Jacobian of the constraints, the gradient of the
cost, and both their values; `line search` holds its calls of `cost and constraints`."""


class InterpretedBackEnd:
    """CasADi functions on the shared buffers, without conversion to CasADi's matrices."""

    def __init__(self, functions: OcpFunctions, buffers: NlpBuffers) -> None:
        b = buffers
        self._advance = functions.advance
        arguments = {"x0": b.w0, "p": b.p, "lbx": b.lower_w, "ubx": b.upper_w, "lbg": b.lower_g, "ubg": b.upper_g,
                     "lam_x0": b.lam_w0, "lam_g0": b.lam_g0}  # fmt: skip
        self._solve = BoundFunction(functions.nmpc, arguments, {"x": b.w, "lam_x": b.lam_w, "lam_g": b.lam_g})
        self._spent = dict.fromkeys(_STATISTICS, (0.0, 0))  # so far: CasADi's statistics only ever grow
        self._check = BoundFunction(functions.kkt, {"w": b.w, "p": b.p, "lam_g": b.lam_g}, {"g": b.g, "gradient": b.gradient})

    def solve(self) -> Effort:
        """Solve the programme; CasADi tells the SQP iterations and the time of each part, not the iterations of its QP solver."""
        self._solve()
        stats, before = self._solve.stats(), self._spent
        self._spent = {part: (stats[f"t_wall_{name}"], stats[f"n_call_{name}"]) for part, name in _STATISTICS.items()}
        profile = {
            part: SubFunction(round((time_s - before[part][0]) * 1e9), calls - before[part][1])
            for part, (time_s, calls) in self._spent.items()
        }
        return Effort(sqp_iterations=int(stats["iter_count"]), profile=profile)

    def check(self) -> None:
        """Compute constraints and gradient of the Lagrangian at the answer."""
        self._check()

    def advance(self, state: Array, inputs: Array, duration_s: float) -> Array:
        """State of the model after `duration_s` of constant input."""
        return np.array(self._advance(state, inputs, duration_s), dtype=np.float64).ravel()


class BoundFunction:
    """A CasADi function on fixed memory, by the names of its inputs and outputs."""

    def __init__(self, function: ca.Function, arguments: dict[str, Array], results: dict[str, Array]) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._kept = (arguments, results)
        for name, memory in arguments.items():
            self._buffer.set_arg(function.index_in(name), memory.data)  # type: ignore[call-arg]  # the stubs do not know that a buffer has a size
        for name, memory in results.items():
            self._buffer.set_res(function.index_out(name), memory.data)  # type: ignore[call-arg]  # the stubs do not know that a buffer has a size

    def __call__(self) -> None:
        """Evaluate."""
        self._evaluate()

    def stats(self) -> dict[str, Any]:
        """What CasADi tells of the last evaluation."""
        stats: dict[str, Any] = self._buffer.stats()
        return stats
