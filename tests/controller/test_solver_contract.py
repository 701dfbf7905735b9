"""What every solver promises, one suite for all entries of `SOLVERS`.

Optimality is judged here by functions that CasADi makes from the programme, not by those of the solver under test.
"""

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

from controller.ocp import transcribe
from controller.planning.planner import Planner, PlannerOptions
from controller.problem import Horizon, OcpOptions, pack_constraint_bounds, pack_parameters, pack_variable_bounds
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC
from controller.solver import PROFILE_PARTS, SolveStatus
from controller.solvers import LIBRARIES, SOLVERS, make_solver
from tests.support.kinematic import kinematic_options

ALL_HARD = {"casadi-vm", "casadi-c", "qrqp"}
"""Solvers of the programme as the paper has it: every bound is hard, and the algorithm the same."""
SQP = set(SOLVERS) - {"ipopt"}

N_STATES, N_INPUTS, N = 6, 2, 30


@pytest.fixture(scope="session")
def made(vehicle):
    """Solver by name and problem, made once."""
    solvers = {}

    def make(name, options):
        key = (name, str(options.generated()))
        if key not in solvers:
            solvers[key] = make_solver(name, vehicle.model, options, print)
        solvers[key].options = options
        solvers[key].reset()
        return solvers[key]

    return make


@pytest.fixture(params=list(SOLVERS))
def name(request):
    return request.param


@pytest.fixture
def solver(made, name):
    return made(name, OcpOptions())


@pytest.fixture(scope="session")
def conditions(vehicle):
    """Largest violation of an optimality condition by the last answer, in units of its tolerance."""
    functions = {}

    def judge(solver, state, previous_input, horizon):
        options = solver.options
        key = str(options.generated())
        if key not in functions:
            nlp = transcribe(vehicle.model, options)
            lam_g = ca.MX.sym("lam_g", nlp["g"].numel())
            gradient = ca.gradient(nlp["f"] + ca.dot(lam_g, nlp["g"]), nlp["x"])
            functions[key] = ca.Function("kkt", [nlp["x"], nlp["p"], lam_g], [nlp["g"], gradient])
        return _worst_condition(functions[key], solver, state, previous_input, horizon)

    return judge


def _worst_condition(kkt, solver, state, previous_input, horizon):
    """A row is optimal when it is where its cost moves value + multiplier to (the proximal map): a hard one is clipped there."""
    options, answer = solver.options, solver.answer
    layout = options.layout
    p, (lower, upper) = np.empty(layout.n_parameters), np.empty((2, layout.n_variables))
    lower_g, upper_g = np.empty((2, layout.n_constraints))
    pack_parameters(p, horizon, previous_input, options)
    pack_variable_bounds(lower, upper, state, horizon, options)
    pack_constraint_bounds(lower_g, upper_g, horizon, layout)
    g, gradient = (value.full().ravel() for value in kkt(answer.w, p, answer.lam_g))
    rows = slice(layout.n_gaps, None)
    moved = np.concatenate((answer.w + answer.lam_w, g[rows] + answer.lam_g[rows]))
    clipped = np.clip(moved, np.concatenate((lower, lower_g[rows])), np.concatenate((upper, upper_g[rows])))
    is_soft = np.full(moved.size, solver.name not in ALL_HARD)
    is_soft[layout.input_index], is_soft[layout.state_index[0]] = False, False
    beyond = np.where(is_soft, np.maximum(np.abs(moved - clipped) - PENALTY_LINEAR, 0.0) / (1.0 + PENALTY_QUADRATIC), 0.0)
    optimal = clipped + np.sign(moved - clipped) * beyond
    row_error = np.max(np.abs(np.concatenate((answer.w, g[rows])) - optimal))
    return max(np.max(np.abs(g[: layout.n_gaps])) / 1e-6, np.max(np.abs(gradient + answer.lam_w)) / 1e-4, row_error / 1e-4)


def lateral(result, horizon):
    return np.sum(horizon.normals() * (result.states[:, 3:5] - horizon.reference[:, 3:5]), axis=1)


def saturated(problem):
    """Far too slow, and a corridor that forbids the reference."""
    state, previous_input, horizon = problem
    slower = state - (6.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return slower, previous_input, replace(horizon, right_m=np.concatenate((np.full(12, 1.5), np.full(19, -0.1))))


def test_an_ordinary_problem_converges(solver, problem, conditions):
    state, _, _ = problem
    result = solver.solve(*problem)
    assert result.status is SolveStatus.CONVERGED
    assert (result.primal_residual <= 1e-6, result.dual_residual <= 1e-4) == (True, True)
    assert conditions(solver, *problem) <= 1.0
    np.testing.assert_allclose(result.states[0], state, atol=1e-9)
    assert (result.states.shape, result.inputs.shape) == ((N + 1, N_STATES), (N, N_INPUTS))
    np.testing.assert_array_equal(result.first_input, result.inputs[0])
    assert result.solve_time_ns > 0
    for (x, x_next), u in zip(pairwise(result.states), result.inputs, strict=True):  # the plan obeys the model
        np.testing.assert_allclose(solver.advance(x, u, 0.04), x_next, atol=2e-6)


def test_a_solver_tells_its_effort_of_this_solve_alone(solver, name, problem):
    effort = solver.solve(*problem).effort
    solver.reset()
    again = solver.solve(*problem).effort
    assert (again.sqp_iterations, again.qp_iterations, again.work) == (effort.sqp_iterations, effort.qp_iterations, effort.work)
    if name in SQP:
        assert 1 <= effort.sqp_iterations <= 10
    if name in SQP - {"casadi-vm"}:
        assert effort.sqp_iterations <= effort.qp_iterations < 100


def test_the_profile_is_part_of_the_solve_time(solver, name, problem):
    for _ in range(2):  # not summed up
        result = solver.solve(*problem)
        profile = result.effort.profile
        if profile is None:
            assert name not in ALL_HARD
            continue
        assert set(profile) <= set(PROFILE_PARTS)
        within = sum(share.time_ns for part, share in profile.items() if part != "line search")
        assert 0 < within <= result.solve_time_ns
        assert all((share.time_ns > 0) == (share.calls > 0) for share in profile.values())


@pytest.mark.parametrize("name", sorted(ALL_HARD), indirect=True)
def test_the_profile_counts_what_the_algorithm_does(solver, name, problem):
    effort = solver.solve(*problem).effort
    calls = {part: share.calls for part, share in effort.profile.items()}
    its = effort.sqp_iterations
    assert (calls["qp"], calls["line search"], calls["hessian"], calls["jacobian"]) == (its, its, its, its + 1)
    assert calls["cost and constraints"] >= its
    assert calls.get("gradient") == {"casadi-c": 1, "casadi-vm": 0, "qrqp": None}[name]
    assert effort.profile["line search"].time_ns >= effort.profile["cost and constraints"].time_ns


def test_the_warm_start_is_the_answer_one_sample_on(solver, problem):
    first = solver.solve(*problem)
    w = solver.warm_start.w
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
    exact = solver.answer.lam_g
    assert second.status is SolveStatus.CONVERGED
    assert np.max(np.abs(warm.lam_g[:150] - exact[:150])) < 0.1 * np.max(np.abs(exact))


def test_after_a_reset_nothing_is_left_of_what_was_before(solver, problem):
    first = solver.solve(*problem)
    solver.solve(*saturated(problem))
    solver.reset()
    assert solver.warm_start is None
    again = solver.solve(*problem)
    np.testing.assert_array_equal(first.states, again.states)
    np.testing.assert_array_equal(first.inputs, again.inputs)


@pytest.mark.parametrize("name", list(LIBRARIES), indirect=True)
def test_two_solvers_in_one_process_do_not_meet(solver, name, vehicle, problem):
    other = make_solver(name, vehicle.model, OcpOptions(), print)
    alone = [solver.solve(*problem).inputs for _ in range(2)]
    solver.reset()
    for expected in alone:
        np.testing.assert_array_equal(solver.solve(*problem).inputs, expected)
        other.solve(*saturated(problem))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["state", "input", "reference", "path_yaw", "left", "right"])
def test_what_is_not_finite_is_found_and_forgotten(solver, problem, where, bad):
    if bad == np.inf and where in {"left", "right"}:
        bad = -np.inf  # a corridor may be open, not the other way round
    state, previous_input, horizon = problem[0].copy(), problem[1].copy(), problem[2]
    reference, yaw_rad, left_m, right_m = (v.copy() for v in (horizon.reference, horizon.path_yaw_rad, horizon.left_m, horizon.right_m))
    spoilt = {"state": state, "input": previous_input, "reference": reference[7], "path_yaw": yaw_rad[4:], "left": left_m[3:],
              "right": right_m[9:]}  # fmt: skip
    spoilt[where][0] = bad
    with np.errstate(invalid="ignore"):
        result = solver.solve(state, previous_input, Horizon(reference, yaw_rad, left_m, right_m))
    assert result.status is (SolveStatus.NOT_CONVERGED if bad == -np.inf else SolveStatus.NOT_FINITE)
    assert solver.warm_start is None
    assert solver.solve(*problem).status is SolveStatus.CONVERGED


def test_a_corridor_may_be_open(solver, problem, conditions):
    state, previous_input, horizon = problem
    open_ended = replace(horizon, left_m=np.full(31, np.inf), right_m=np.full(31, np.inf))
    assert solver.solve(state, previous_input, open_ended).status is SolveStatus.CONVERGED
    assert conditions(solver, state, previous_input, open_ended) <= 1.0


def test_a_corridor_that_crosses_itself_is_no_problem_to_solve(solver, problem):
    state, previous_input, horizon = problem
    result = solver.solve(state, previous_input, replace(horizon, left_m=np.full(31, -1.0), right_m=np.full(31, 0.5)))
    assert result.status is SolveStatus.NOT_CONVERGED
    assert result.effort.sqp_iterations is None
    assert solver.warm_start is None


@pytest.mark.parametrize(
    "change",
    [
        lambda state, u, h: (state[:5], u, h),
        lambda state, u, h: (state, u[:1], h),
        lambda state, u, h: (state, np.zeros(3), h),
        lambda state, u, h: (state, u, Horizon(h.reference[:-1], h.path_yaw_rad[:-1], h.left_m[:-1], h.right_m[:-1])),
        lambda state, u, h: (state, u, replace(h, reference=np.zeros((31, 7)))),
        lambda state, u, h: (state, u, replace(h, path_yaw_rad=h.path_yaw_rad[:-1])),
        lambda state, u, h: (state, u, replace(h, left_m=h.left_m[:-2])),
    ],
)  # fmt: skip
def test_other_shapes_are_refused(solver, problem, change):
    with pytest.raises(ValueError, match=r".+"):
        solver.solve(*change(*problem))
    assert solver.solve(*problem).status is SolveStatus.CONVERGED


def test_options_can_be_replaced_between_two_solves(solver, problem, conditions):
    before = solver.solve(*problem)
    widest = np.max(np.abs(before.inputs[:, 0]))
    narrower = ((-0.5 * widest, 0.5 * widest), (-0.3, 0.3))
    for options in (OcpOptions(input_weights=(500.0, 50.0)), OcpOptions(input_bounds=narrower), OcpOptions(lateral_acceleration_mps2=0.8)):
        solver.options = options
        result = solver.solve(*problem)
        assert result.status is SolveStatus.CONVERGED
        assert conditions(solver, *problem) <= 1.0
        assert np.max(np.abs(result.inputs - before.inputs)) > 1e-4
        assert (np.max(np.abs(result.inputs), axis=0) <= [bounds[1] + 1e-6 for bounds in options.input_bounds]).all()
    solver.options = OcpOptions()
    solver.reset()
    np.testing.assert_array_equal(solver.solve(*problem).inputs, before.inputs)


@pytest.mark.parametrize("options", [OcpOptions(horizon_steps=20), OcpOptions(sample_time_s=0.05), kinematic_options(30)])
def test_options_of_other_code_are_refused(solver, problem, options):
    with pytest.raises(ValueError, match="written into"):
        solver.options = options
    assert solver.options == OcpOptions()


def test_active_bounds_and_corridor(solver, problem, conditions):
    result = solver.solve(*saturated(problem))
    assert result.status is SolveStatus.CONVERGED
    assert conditions(solver, *saturated(problem)) <= 1.0
    assert result.inputs[:, 1].max() == pytest.approx(1.0, abs=1e-6)
    assert lateral(result, saturated(problem)[2])[12:].min() == pytest.approx(0.1, abs=1e-5)


def test_a_corridor_that_cannot_be_met(solver, name, problem, conditions):
    """The car is 3 m to the side, and one sample later is to be within a hand's breadth: never a plan that claims to be there."""
    state, previous_input, horizon = problem
    state[4] += 3.0
    narrow = replace(horizon, left_m=np.full(31, 0.1), right_m=np.full(31, 0.1))
    result = solver.solve(state, previous_input, narrow)
    if name in ALL_HARD:
        assert result.status is not SolveStatus.CONVERGED
        assert not result.primal_residual <= 1e-6
    else:
        assert result.status is SolveStatus.CONVERGED
        assert conditions(solver, state, previous_input, narrow) <= 1.0
        assert lateral(result, narrow)[1] > 2.0
        assert abs(lateral(result, narrow)[30]) <= 0.1 + 1e-6


@pytest.mark.parametrize("make", [lambda problem: problem, saturated])
def test_solvers_agree(solver, name, made, problem, make):
    """In the paper's algorithm to rounding and in every iteration, else to the tolerance; from cold, then warm."""
    reference = made("casadi-c", OcpOptions())
    reference.reset(), solver.reset()
    state, previous_input, horizon = make(problem)
    inputs, states = (1e-9, 1e-9) if name in ALL_HARD else (1e-5, 1e-4)
    for _ in range(3):
        theirs = reference.solve(state, previous_input, horizon)
        ours = theirs if solver is reference else solver.solve(state, previous_input, horizon)
        assert ours.status is theirs.status is SolveStatus.CONVERGED
        np.testing.assert_allclose(ours.first_input, theirs.first_input, rtol=0, atol=inputs)
        np.testing.assert_allclose(ours.states, theirs.states, rtol=0, atol=states)
        np.testing.assert_allclose(ours.inputs, theirs.inputs, rtol=0, atol=states)
        if name in ALL_HARD:
            assert ours.effort.sqp_iterations == theirs.effort.sqp_iterations
        state, previous_input = theirs.states[1], theirs.first_input


def parking(steps):
    """A kinematic car that is to move 2 m on and half a metre to the side, with a road of 1 m beside its path."""
    reference = np.zeros((steps + 1, 4))
    reference[:, 0], reference[:, 1] = 1.0, 0.1 * np.arange(steps + 1)
    horizon = Horizon(reference, np.zeros(steps + 1), np.full(steps + 1, 1.0), np.full(steps + 1, 1.0))
    return np.array((0.5, 0.0, -0.5, 0.1)), np.zeros(2), horizon


@pytest.mark.parametrize("steps", [10, 60])
@pytest.mark.parametrize("name", ["qrqp", "riccati", "ipopt"], indirect=True)
def test_another_model_over_other_horizons(name, made, conditions, steps):
    solver, reference = (made(each, kinematic_options(steps)) for each in (name, "casadi-vm"))
    ours, theirs = (each.solve(*parking(steps)) for each in (solver, reference))
    assert ours.status is theirs.status is SolveStatus.CONVERGED
    assert ours.states.shape == (steps + 1, 4)
    assert conditions(solver, *parking(steps)) <= 1.0
    np.testing.assert_allclose(ours.first_input, theirs.first_input, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours.states, theirs.states, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", list(LIBRARIES))
def test_a_compiled_solver_runs_without_casadi(name, made):
    """What the control loop loads on a cache hit."""
    made(name, OcpOptions())
    program = (
        "import sys\n"
        "from controller.solvers import make_solver\n"
        "import controller.app\n"
        "from controller.problem import OcpOptions\n"
        "from dbc.vehicle import load_vehicle\n"
        f"make_solver({name!r}, load_vehicle().model, OcpOptions(), print)\n"
        "sys.exit('casadi' in sys.modules)\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
