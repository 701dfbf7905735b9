"""The solver as a whole: the same answers as the paper's solver, optimal by CasADi's account, and truthful on hard starts."""

import ctypes
import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from controller.compiled import CompiledBackEnd
from controller.ocp import transcribe
from controller.planner import Planner, PlannerOptions
from controller.problem import Horizon, OcpOptions
from controller.riccati.build import C_SOURCES, FLAGS, build_riccati, host_flags
from controller.riccati.solver import PENALTY_LINEAR, PENALTY_QUADRATIC, RiccatiBackEnd, RiccatiSolver, row_residuals
from controller.solver import NlpBuffers, SolverError, SolveStatus, SqpSolver

LARGEST_WORK = 400.0 + 30.0 + 90 * 0.7 + 3 * 4 + 2.5 + 8.0  # the limit, and what one more iteration may add


@pytest.fixture(scope="module")
def kkt(vehicle):
    """(w, p, lam_g) to the constraints and the gradient of f + lam_g' g, by CasADi from the programme as `ocp` writes it down."""
    nlp = transcribe(vehicle.model, OcpOptions())
    lam_g = ca.MX.sym("lam_g", nlp["g"].numel())
    gradient = ca.gradient(nlp["f"] + ca.dot(lam_g, nlp["g"]), nlp["x"])
    return ca.Function("kkt", [nlp["x"], nlp["p"], lam_g], [nlp["g"], gradient])


def is_optimal(solver, kkt):
    """Whether the last answer meets the conditions of the soft programme.

    Written anew: a soft row's value is where its penalty moves value + multiplier to (its proximal map).
    """
    b, layout = solver._buffers, OcpOptions().layout
    g, gradient = (np.array(value).ravel() for value in kkt(b.w, b.p, b.lam_g))
    values, multipliers = np.concatenate((b.w, g[180:])), np.concatenate((b.lam_w, b.lam_g[180:]))
    lower, upper = np.concatenate((b.lower_w, b.lower_g[180:])), np.concatenate((b.upper_w, b.upper_g[180:]))
    is_soft = np.ones(values.size, dtype=bool)
    is_soft[layout.input_index], is_soft[layout.state_index[0]] = False, False
    clipped = np.clip(values + multipliers, lower, upper)
    beyond = values + multipliers - clipped
    rest = np.where(is_soft, np.maximum(np.abs(beyond) - PENALTY_LINEAR, 0.0) / (1.0 + PENALTY_QUADRATIC), 0.0)
    row_error = np.max(np.abs(values - clipped - np.sign(beyond) * rest))
    return max(np.max(np.abs(g[:180])) / 1e-6, np.max(np.abs(gradient + b.lam_w)) / 1e-4, row_error / 1e-4) <= 1.0


def test_the_first_input_is_that_of_the_papers_solver(riccati, library, recorded):
    reference = SqpSolver("casadi-c", OcpOptions(), lambda buffers: CompiledBackEnd(library, buffers))
    for i in recorded:
        riccati.warm_start = reference.warm_start = i.warm_start
        ours, theirs = (s.solve(i.state, i.previous_input, i.horizon) for s in (riccati, reference))
        assert ours.status is theirs.status is SolveStatus.CONVERGED
        np.testing.assert_allclose(ours.first_input, theirs.first_input, rtol=0, atol=1e-5)
        np.testing.assert_allclose(ours.states, theirs.states, rtol=0, atol=1e-4)
        assert ours.effort.sqp_iterations <= theirs.effort.sqp_iterations + 2


def test_from_its_own_warm_start_it_converges_in_few_iterations(riccati, problem, vehicle, wavy_path):
    state, previous_input, horizon = problem
    planner = Planner(wavy_path, vehicle.model, OcpOptions(), PlannerOptions())
    iterations = []
    for step in range(10):
        result = riccati.solve(state, previous_input, horizon)
        assert result.status is SolveStatus.CONVERGED
        for k in range(30):
            np.testing.assert_allclose(riccati.advance(result.states[k], result.inputs[k], 0.04), result.states[k + 1], atol=2e-6)
        iterations.append(result.effort.sqp_iterations)
        state, previous_input = result.states[1], result.first_input
        horizon = planner.horizon(state, 0.04 * (step + 1))
    assert max(iterations[1:]) <= 3


def saturated(problem):
    """Far too slow, and a corridor that forbids the reference."""
    state, previous_input, horizon = problem
    state = state - (6.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return state, previous_input, replace(horizon, right_m=np.concatenate((np.full(12, 1.5), np.full(19, -0.1))))


def test_active_bounds_agree_with_the_papers_solver(riccati, library, problem, kkt):
    reference = SqpSolver("casadi-c", OcpOptions(), lambda buffers: CompiledBackEnd(library, buffers))
    ours, theirs = (s.solve(*saturated(problem)) for s in (riccati, reference))
    assert ours.status is theirs.status is SolveStatus.CONVERGED
    assert ours.inputs[:, 1].max() == 1.0
    np.testing.assert_allclose(ours.inputs, theirs.inputs, rtol=0, atol=1e-5)
    assert is_optimal(riccati, kkt)


def test_a_corridor_that_cannot_be_met_is_met_as_well_as_it_pays(riccati, problem, kkt):
    """3 m to the side with a hand's breadth of room: infeasible when hard."""
    state, previous_input, horizon = problem
    state[4] += 3.0
    narrow = replace(horizon, left_m=np.full(31, 0.1), right_m=np.full(31, 0.1))
    result = riccati.solve(state, previous_input, narrow)
    assert result.status is SolveStatus.CONVERGED
    assert is_optimal(riccati, kkt)
    lateral = np.sum(narrow.normals() * (result.states[:, 3:5] - narrow.reference[:, 3:5]), axis=1)
    assert lateral[1] > 2.0
    assert abs(lateral[30]) <= 0.1 + 1e-6


def test_bounds_without_room(riccati, problem, kkt):
    """The terminal set and the corridor at two nodes have the same bounds on both sides."""
    state, previous_input, horizon = problem
    left_m, right_m = horizon.left_m.copy(), horizon.right_m.copy()
    left_m[[12, 20]], right_m[[12, 20]] = 0.05, -0.05
    riccati.options = OcpOptions(terminal_box=(0.0,) * 6)
    result = riccati.solve(state, previous_input, replace(horizon, left_m=left_m, right_m=right_m))
    assert result.status is SolveStatus.CONVERGED
    assert is_optimal(riccati, kkt)
    np.testing.assert_allclose(result.states[-1, :2], horizon.reference[-1, :2], atol=1e-6)
    lateral = np.sum(horizon.normals() * (result.states[:, 3:5] - horizon.reference[:, 3:5]), axis=1)
    np.testing.assert_allclose(lateral[[12, 20]], 0.05, atol=1e-6)


def test_an_input_that_is_given_is_obeyed(riccati_library, riccati, problem):
    riccati.solve(*problem)
    prepared = riccati._buffers
    buffers = NlpBuffers(OcpOptions().layout)
    for name in ("w0", "p", "lower_w", "upper_w", "lower_g", "upper_g", "lam_w0", "lam_g0"):
        getattr(buffers, name)[:] = getattr(prepared, name)
    for k in (0, 3, 29):
        buffers.lower_w[8 * k + 6] = buffers.upper_w[8 * k + 6] = 0.02
    back_end = RiccatiBackEnd(riccati_library, buffers)
    back_end.solve()
    assert back_end.statistics.status == 0
    np.testing.assert_array_equal(buffers.w[[6, 30, 238]], 0.02)


def test_hard_starts_are_finite_and_truthful(riccati, hard_starts, kkt):
    converged = 0
    for state, previous_input, horizon, warm_start in hard_starts:
        riccati.warm_start = warm_start
        result = riccati.solve(state, previous_input, horizon)
        statistics = riccati._back_end.statistics
        assert np.isfinite(result.states).all()
        assert np.isfinite(result.inputs).all()
        assert np.all(np.abs(result.inputs) <= (0.55, 1.0))
        assert (result.status is SolveStatus.CONVERGED) == (statistics.status == 0)
        assert (result.primal_residual, result.dual_residual) == pytest.approx(
            (statistics.primal_residual, statistics.dual_residual), 1e-5, 1e-9
        )
        assert statistics.work <= LARGEST_WORK
        if result.status is SolveStatus.CONVERGED:
            converged += 1
            assert is_optimal(riccati, kkt)
    assert converged >= 0.99 * len(hard_starts)


@pytest.mark.parametrize(
    ("name", "index", "change"), [("w", 14, 1e-3), ("w", 6, 1e-3), ("lam_g", 20, 1.0), ("lam_g", 200, 1.0), ("lam_w", 30, 1.0)]
)
def test_the_independent_check_can_fail(riccati, problem, kkt, name, index, change):
    riccati.solve(*problem)
    assert is_optimal(riccati, kkt)
    getattr(riccati._buffers, name)[index] += change
    assert not is_optimal(riccati, kkt)
    primal, dual = riccati._residuals()
    assert primal > 1e-6 or dual > 1e-4


@pytest.mark.parametrize("where", ["state", "input", "reference", "corridor"])
def test_nan_is_found_and_forgotten(riccati, problem, where):
    state, previous_input, horizon = (problem[0].copy(), problem[1].copy(), problem[2])
    reference, left_m = horizon.reference.copy(), horizon.left_m.copy()
    {"state": state, "input": previous_input, "reference": reference[7], "corridor": left_m[3:]}[where][0] = np.nan
    result = riccati.solve(state, previous_input, replace(horizon, reference=reference, left_m=left_m))
    assert result.status is SolveStatus.NOT_FINITE
    assert riccati.warm_start is None
    assert riccati.solve(*problem).status is SolveStatus.CONVERGED


def test_numbers_that_overflow_are_no_success(riccati, problem):
    state, previous_input, horizon = problem
    huge = replace(horizon, reference=horizon.reference + 1e200)
    result = riccati.solve(state, previous_input, huge)
    assert result.status is not SolveStatus.CONVERGED
    assert riccati.solve(*problem).status in {SolveStatus.CONVERGED, SolveStatus.NOT_CONVERGED}
    riccati.reset()
    assert riccati.solve(*problem).status is SolveStatus.CONVERGED


def test_solvers_share_nothing(riccati_library, recorded):
    """Two that take turns give the very answers of one alone."""
    alone, first, second = (RiccatiSolver(riccati_library, OcpOptions()) for _ in range(3))
    for before, after in pairwise(recorded[:10]):
        alone.warm_start = first.warm_start = after.warm_start
        second.solve(before.state, before.previous_input, before.horizon)
        expected, answer = (s.solve(after.state, after.previous_input, after.horizon) for s in (alone, first))
        np.testing.assert_array_equal(answer.inputs, expected.inputs)


def test_nothing_is_taken_from_memory_that_was_not_set(riccati, problem):
    """All bytes of the solver's memory set: NaN in every number."""
    expected = riccati.solve(*problem)
    memory = riccati._back_end._memory
    ctypes.memset(memory, 0xFF, len(memory))
    riccati.reset()
    np.testing.assert_array_equal(riccati.solve(*problem).inputs, expected.inputs)


def test_another_horizon_and_weights_of_zero(vehicle, wavy_path, problem):
    options = OcpOptions(horizon_steps=12, input_weights=(0.0, 0.0), state_weights=(1.0, 0.0, 0.0, 5.0, 5.0, 0.0))
    solver = RiccatiSolver(build_riccati(vehicle.model, options, print).library, options)
    horizon = Planner(wavy_path, vehicle.model, options, PlannerOptions()).horizon(problem[0], 0.0)
    result = solver.solve(problem[0], problem[1], horizon)
    assert result.status is SolveStatus.CONVERGED
    assert result.states.shape == (13, 6)


def test_a_horizon_of_another_length_is_refused(riccati, riccati_library, problem):
    state, previous_input, horizon = problem
    shorter = Horizon(*(getattr(horizon, name)[:-1] for name in ("reference", "path_yaw_rad", "left_m", "right_m")))
    with pytest.raises(ValueError, match="30 steps"):
        riccati.solve(state, previous_input, shorter)
    with pytest.raises(SolverError, match=r"nmpc\.so"):
        RiccatiSolver(riccati_library, OcpOptions(horizon_steps=20))


def test_something_else_is_not_loaded_as_a_library(library):
    with pytest.raises(SolverError, match="not a solver library"):
        RiccatiSolver(library, OcpOptions())  # that of CasADi


@pytest.mark.parametrize(
    ("value", "multiplier", "is_hard", "expected"),
    [
        (0.5, 0.0, False, (0.0, 0.0)),
        (1.0, 20.0, False, (0.0, 0.0)),
        (-1.0, -500.0, False, (0.0, 0.0)),
        (1.5, 700.0, False, (0.0, 0.0)),  # half a unit beyond costs 500 + 400 / 2
        (-1.5, -700.0, False, (0.0, 0.0)),
        (1.5, 701.0, False, (1.0 / 400.0, 0.0)),
        (1.5, 700.0, True, (0.5, 0.0)),
        (1.0, 1e6, True, (0.0, 0.0)),
        (0.0, 1e-3, False, (0.0, 1e-3)),
        (1.0 - 1e-7, 20.0, False, (1e-7, 0.0)),
        (-1.5, 70.0, False, (0.5, 70.0)),  # beyond one bound with the multiplier of the other
    ],
)
def test_the_distance_of_a_row_from_optimality(value, multiplier, is_hard, expected):
    one = np.ones(1)
    assert row_residuals(value * one, multiplier * one, -one, one, np.array([is_hard])) == pytest.approx(expected, abs=1e-12)


def test_the_c_code_has_no_warnings_and_no_undefined_behaviour(riccati, sources, compile_c, tmp_path, hard_starts):
    """Under the sanitizers of the compiler, through the public header alone, on problems with active and violated bounds."""
    program = compile_c(
        tmp_path / "solve", [Path(__file__).parent / "solve_file.c", *sorted(sources.glob("*.c"))],
        f"-I{sources}", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all",
    )  # fmt: skip
    b, expected = riccati._buffers, []
    with (tmp_path / "problems").open("wb") as file:
        for state, previous_input, horizon, warm_start in hard_starts[:8]:
            riccati.warm_start = warm_start
            result = riccati.solve(state, previous_input, horizon)
            expected.append((result.status, b.w.copy()))
            np.concatenate((b.w0, b.lam_w0, b.lam_g0, b.p, b.lower_w, b.upper_w, b.lower_g, b.upper_g)).tofile(file)
    subprocess.run([program, tmp_path / "problems", tmp_path / "answers"], check=True, timeout=60)
    answers = np.fromfile(tmp_path / "answers").reshape(len(expected), -1)
    for answer, (status, w) in zip(answers, expected, strict=True):
        assert (answer[0] == 0.0) == (status is SolveStatus.CONVERGED)
        np.testing.assert_allclose(answer[1:], w, rtol=0, atol=1e-4)


def test_no_function_keeps_state_or_allocates(riccati_library):
    symbols = subprocess.run(["nm", riccati_library], capture_output=True, text=True, check=True).stdout
    assert not {"malloc", "calloc", "realloc", "free"} & {line.split()[-1].partition("@")[0] for line in symbols.splitlines()}
    kept = [line.split()[-1] for line in symbols.splitlines() if line.split()[-2] in {"b", "B", "d", "D"}]
    assert [name for name in kept if not name.startswith(("_", "completed"))] == []


def test_flags_follow_the_processor(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    for features, expected in (("fpu sse2 avx2 fma", ("-mavx2", "-mfma")), ("fpu sse2 avx2", ()), ("fpu sse2", ())):
        cpuinfo.write_text(f"processor : 0\nflags : {features}\n")
        assert host_flags(cpuinfo) == expected
    assert host_flags(tmp_path / "none") == ()
    assert not {"-ffast-math", "-Ofast"} & set(FLAGS)


def test_every_source_is_in_the_key_of_the_cache(vehicle, monkeypatch):
    recipes = []
    monkeypatch.setattr("controller.riccati.build.build_from", lambda recipe, progress: recipes.append(recipe))
    build_riccati(vehicle.model, OcpOptions(), print)
    build_riccati(vehicle.model, OcpOptions(), print, ("-DLANES=1",))
    assert recipes[0].flags != recipes[1].flags
    keyed = set(recipes[0].keyed_sources)
    assert {f"riccati/c/{path.name}" for path in C_SOURCES.iterdir()} <= keyed
    package = C_SOURCES.parent.parent
    for name in keyed:
        for line in (package / name).read_text().splitlines():
            if line.startswith("from controller.") and name != "riccati/build.py":
                assert line.split()[1].removeprefix("controller.").replace(".", "/") + ".py" in keyed
