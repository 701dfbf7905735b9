"""Both back ends through one set of tests, and the checks that no back end can talk its way round."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from controller.compiled import CompiledBackEnd
from controller.planner import Planner, PlannerOptions
from controller.problem import Horizon, OcpOptions
from controller.solver import Effort, NlpBuffers, SolverError, SolveStatus, SqpSolver
from controller.solvers import make_solver
from dbc.errors import UserMistake


@pytest.fixture(params=["casadi-c", "casadi-vm"])
def any_solver(request):
    return request.getfixturevalue({"casadi-c": "solver", "casadi-vm": "interpreted"}[request.param])


def test_an_ordinary_problem_converges(any_solver, problem):
    state, previous_input, horizon = problem
    result = any_solver.solve(state, previous_input, horizon)
    assert result.status is SolveStatus.CONVERGED
    assert result.primal_residual <= 1e-6
    assert result.dual_residual <= 1e-4
    np.testing.assert_allclose(result.states[0], state, atol=1e-9)
    assert result.states.shape == (31, 6)
    assert result.inputs.shape == (30, 2)
    np.testing.assert_array_equal(result.first_input, result.inputs[0])
    assert 1 <= result.effort.sqp_iterations <= 10
    assert result.solve_time_ns > 0
    for k in range(30):  # the plan obeys the model, step by step
        np.testing.assert_allclose(any_solver.advance(result.states[k], result.inputs[k], 0.04), result.states[k + 1], atol=2e-6)


def test_the_compiled_solver_is_the_same_algorithm(solver, interpreted, problem):
    state, previous_input, horizon = problem
    for _ in range(4):  # from cold, then warm
        compiled, uncompiled = (s.solve(state, previous_input, horizon) for s in (solver, interpreted))
        np.testing.assert_allclose(compiled.states, uncompiled.states, rtol=0, atol=1e-8)
        np.testing.assert_allclose(compiled.inputs, uncompiled.inputs, rtol=0, atol=1e-8)
        assert compiled.effort.sqp_iterations == uncompiled.effort.sqp_iterations
        previous_input, state = compiled.first_input, compiled.states[1]


def test_the_compiled_solver_tells_its_iterations(solver, problem):
    cold = solver.solve(*problem)
    assert cold.effort.qp_iterations >= cold.effort.sqp_iterations >= 1
    again = solver.solve(*problem)
    assert again.effort.qp_iterations < 100  # of this solve, not summed up


def test_the_uncompiled_solver_does_not_invent_qp_iterations(interpreted, problem):
    assert interpreted.solve(*problem).effort.qp_iterations is None


def test_active_bounds_and_corridor(any_solver, problem):
    """Far too slow, and a corridor that forbids the reference: the answer lies on both limits and still passes the check."""
    state, previous_input, horizon = problem
    state[0] -= 6.0
    narrow = replace(horizon, right_m=np.concatenate((np.full(12, 1.5), np.full(19, -0.1))))
    result = any_solver.solve(state, previous_input, narrow)
    assert result.status is SolveStatus.CONVERGED
    assert result.inputs[:, 1].max() == pytest.approx(1.0, abs=1e-6)
    lateral = np.sum(narrow.normals() * (result.states[:, 3:5] - narrow.reference[:, 3:5]), axis=1)
    assert lateral[12:].min() == pytest.approx(0.1, abs=1e-5)


def test_an_infeasible_problem_is_never_called_converged(any_solver, problem):
    """The car is 3 m to the side, and one sample later is to be within a hand's breadth."""
    state, previous_input, horizon = problem
    state[4] += 3.0
    result = any_solver.solve(state, previous_input, replace(horizon, left_m=np.full(31, 0.1), right_m=np.full(31, 0.1)))
    assert result.status is not SolveStatus.CONVERGED
    assert not result.primal_residual <= 1e-6


def test_a_corridor_that_crosses_itself_is_no_problem_to_solve(any_solver, problem):
    state, previous_input, horizon = problem
    result = any_solver.solve(state, previous_input, replace(horizon, left_m=np.full(31, -1.0), right_m=np.full(31, 0.5)))
    assert result.status is SolveStatus.NOT_CONVERGED
    assert result.effort.sqp_iterations is None


@pytest.mark.parametrize("where", ["state", "input", "reference", "corridor"])
def test_nan_is_found_and_forgotten(any_solver, problem, where):
    state, previous_input, horizon = (problem[0].copy(), problem[1].copy(), problem[2])
    reference, left_m = horizon.reference.copy(), horizon.left_m.copy()
    {"state": state, "input": previous_input, "reference": reference[7], "corridor": left_m[3:]}[where][0] = np.nan
    result = any_solver.solve(state, previous_input, replace(horizon, reference=reference, left_m=left_m))
    assert result.status is SolveStatus.NOT_FINITE
    assert any_solver.warm_start is None
    assert any_solver.solve(*problem).status is SolveStatus.CONVERGED


def test_the_warm_start_is_the_answer_one_sample_on(solver, problem):
    state, previous_input, horizon = problem
    first = solver.solve(state, previous_input, horizon)
    w = solver.warm_start.w.copy()
    np.testing.assert_array_equal(w[:6], first.states[1])
    np.testing.assert_array_equal(w[6:8], first.inputs[1])
    np.testing.assert_array_equal(w[-14:-8], first.states[30])
    np.testing.assert_array_equal(w[-8:-6], first.inputs[29])
    np.testing.assert_allclose(w[-6:], solver.advance(first.states[30], first.inputs[29], 0.04))


def test_the_shifted_multipliers_fit_the_next_problem(solver, problem, vehicle, wavy_path):
    """One sample on, gradient and shifted multipliers nearly cancel: a wrong shift would leave a residual a hundred times larger."""
    first = solver.solve(*problem)
    planner = Planner(wavy_path, vehicle.model, OcpOptions(), PlannerOptions())
    warm = solver.warm_start
    second = solver.solve(first.states[1], first.first_input, planner.horizon(first.states[1], 0.04))
    exact = solver._buffers.lam_g
    assert second.status is SolveStatus.CONVERGED
    assert np.max(np.abs(warm.lam_g[:150] - exact[:150])) < 0.1 * np.max(np.abs(exact))


def test_reset_forgets_the_warm_start(solver, problem):
    cold = solver.solve(*problem)
    solver.reset()
    assert solver.warm_start is None
    again = solver.solve(*problem)
    np.testing.assert_array_equal(cold.states, again.states)


def test_solving_is_deterministic(library, problem):
    answers = [SqpSolver("x", OcpOptions(), lambda b: CompiledBackEnd(library, b)).solve(*problem) for _ in range(2)]
    np.testing.assert_array_equal(answers[0].states, answers[1].states)
    np.testing.assert_array_equal(answers[0].inputs, answers[1].inputs)


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


def test_a_horizon_of_another_length_is_refused(solver, problem):
    state, previous_input, horizon = problem
    shorter = Horizon(*(getattr(horizon, name)[:-1] for name in ("reference", "path_yaw_rad", "left_m", "right_m")))
    with pytest.raises(ValueError, match="30 steps"):
        solver.solve(state, previous_input, shorter)


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


def test_the_compiled_solver_runs_without_casadi(library):
    """What the control loop loads on a cache hit."""
    program = (
        "import sys\n"
        "from controller.solvers import make_solver\n"
        "import controller.app\n"
        "from controller.problem import OcpOptions\n"
        "from dbc.vehicle import load_vehicle\n"
        "make_solver('casadi-c', load_vehicle().model, OcpOptions(), print)\n"
        "sys.exit('casadi' in sys.modules)\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
