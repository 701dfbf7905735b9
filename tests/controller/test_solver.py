"""The shell around the back ends: the checks that none of them can talk its way round, and libraries that are none."""

import numpy as np
import pytest

from controller.compiled import CompiledBackEnd
from controller.problem import OcpOptions
from controller.solver import Effort, NlpBuffers, SolverError, SolveStatus, SqpSolver
from controller.solvers import make_solver
from dbc.errors import UserMistake


class LyingBackEnd:
    """Claims to have solved the problem; the answer is what the test put into the buffers."""

    def __init__(self, buffers: NlpBuffers) -> None:
        self.buffers = buffers

    def solve(self):
        return Effort(1, 1)

    def check(self):
        self.buffers.g[:] = 0.0
        self.buffers.gradient[:] = -self.buffers.lam_w

    def advance(self, state, inputs, duration_s):
        return state


def _lying(problem, spoil):
    back_ends = []

    def make(buffers):
        back_ends.append(LyingBackEnd(buffers))
        return back_ends[-1]

    solver = SqpSolver("lying", OcpOptions(), make, clock=lambda: 0)
    solver.solve(*problem)  # fills the bounds
    buffers = back_ends[0].buffers
    buffers.w[:] = np.clip(0.0, buffers.lower_w, buffers.upper_w)
    spoil(buffers)
    return solver.solve(*problem)


def test_an_answer_within_all_conditions_is_accepted(problem):
    assert _lying(problem, lambda buffers: None).status is SolveStatus.CONVERGED


@pytest.mark.parametrize(
    ("spoil", "status"),
    [
        (lambda b: b.w.__setitem__(100, np.inf), SolveStatus.NOT_FINITE),
        (lambda b: b.lam_g.__setitem__(3, np.nan), SolveStatus.NOT_FINITE),
        (lambda b: b.w.__setitem__(6, 0.6), SolveStatus.NOT_CONVERGED),  # steering beyond its bound
        (lambda b: b.lam_w.__setitem__(6, 1.0), SolveStatus.NOT_CONVERGED),  # a multiplier on a bound that does not hold
        (lambda b: b.lam_w.__setitem__(11, -1.0), SolveStatus.NOT_CONVERGED),  # on a bound that there is not
    ],
)
def test_a_wrong_answer_is_found_out(problem, spoil, status):
    assert _lying(problem, spoil).status is status


def test_an_unknown_solver_is_named(vehicle):
    with pytest.raises(UserMistake, match="solver 'magic': there are casadi-vm, casadi-c"):
        make_solver("magic", vehicle.model, OcpOptions(), print)


def test_a_library_for_another_horizon_is_refused(library):
    with pytest.raises(SolverError, match="nmpc"):
        SqpSolver("x", OcpOptions(horizon_steps=20), lambda b: CompiledBackEnd(library, b))


def test_something_else_is_not_loaded_as_a_library(tmp_path):
    path = tmp_path / "nmpc.so"
    path.write_bytes(b"not a library")
    with pytest.raises(SolverError, match=r"nmpc\.so"):
        SqpSolver("x", OcpOptions(), lambda b: CompiledBackEnd(path, b))
