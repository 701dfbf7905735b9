"""The solver as a whole: the same answers as the paper's solver, optimal by CasADi's account, and truthful on hard starts."""

import ctypes
import subprocess
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from controller.compiled import CompiledBackEnd
from controller.planning.planner import Planner, PlannerOptions
from controller.problem import Horizon, OcpOptions
from controller.riccati.build import C_SOURCES, FLAGS, SCALAR, build_riccati, host_flags
from controller.riccati.solver import PARTS, RiccatiBackEnd, RiccatiSolver
from controller.soft import row_residuals
from controller.solver import PROFILE_PARTS, NlpBuffers, SolverError, SolveStatus, SqpSolver
from tests.support.soft_optimality import conditions_of, is_optimal

LARGEST_WORK = 800.0 + 30 + 4 + 90 + 4 + 10  # the limit, and what one more iteration may add


@pytest.fixture(scope="module")
def kkt(vehicle):
    return conditions_of(vehicle.model, OcpOptions())


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
    assert ours.inputs[:, 1].max() == pytest.approx(1.0, abs=1e-8)
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


def test_the_profile_holds_nearly_all_of_the_time(riccati, problem):
    for _ in range(3):
        result = riccati.solve(*problem)
    profile, effort = result.effort.profile, result.effort
    assert set(profile) == set(PARTS.values()) <= set(PROFILE_PARTS)
    assert profile["qp"].calls == effort.sqp_iterations
    assert profile["stage sweep"].calls + profile["gradient"].calls >= effort.sqp_iterations + 1
    assert all((part.time_ns > 0) == (part.calls > 0) for part in profile.values())
    assert sum(part.time_ns for part in profile.values()) <= result.solve_time_ns


def test_the_parts_can_be_run_alone_and_change_no_answer(riccati, riccati_library, problem):
    """For the bench, which measures them."""
    expected = riccati.solve(*problem)
    library = ctypes.CDLL(str(riccati_library))
    riccati.reset()
    again = RiccatiSolver(riccati_library, OcpOptions())
    again.solve(*problem)
    for part in ("stage_sweep", "adjoint_sweep", "riccati"):
        library[f"nmpc_run_{part}"](again._back_end.address)
    again.reset()
    np.testing.assert_allclose(again.solve(*problem).inputs, expected.inputs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("width_m", [0.0, 1e-3])
def test_a_corridor_without_room_all_along(riccati, problem, kkt, width_m):
    """More rows than inputs can serve: what cannot be met costs, and the answer is still optimal."""
    state, previous_input, horizon = problem
    narrow = replace(horizon, left_m=np.full(31, width_m), right_m=np.full(31, width_m))
    assert riccati.solve(state, previous_input, narrow).status is SolveStatus.CONVERGED
    assert is_optimal(riccati, kkt)


def test_from_standstill_and_backwards(riccati, problem, kkt):
    _, _, horizon = problem
    reference = np.tile(horizon.reference[0], (31, 1))
    reference[:, :3] = 0.0
    for v_x in (0.0, -0.5, 1e-9):
        state = reference[0] + (v_x, 0.0, 0.0, 0.2, 0.1, 0.05)
        assert riccati.solve(state, np.zeros(2), replace(horizon, reference=reference)).status is SolveStatus.CONVERGED
        assert is_optimal(riccati, kkt)
        riccati.reset()


def test_without_any_cost_there_is_no_descent_and_no_claim(riccati, problem):
    nothing = (0.0, 0.0)
    riccati.options = OcpOptions(
        state_weights=(0.0,), terminal_weights=(0.0,), input_weights=nothing, input_difference_weights=nothing, terminal_box=()
    )
    result = riccati.solve(problem[0], problem[1], problem[2])
    assert riccati._back_end.statistics.status == 2
    assert result.status is SolveStatus.NOT_CONVERGED
    assert np.isfinite(result.states).all()


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


def test_the_c_code_has_no_warnings_and_no_undefined_behaviour(riccati, form, sources, same_under_sanitizers, hard_starts):
    """On problems with active and violated bounds."""
    flags = {"vector": host_flags(), "scalar": SCALAR}[form]
    same_under_sanitizers(riccati, sources, flags, hard_starts[:8])


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
    monkeypatch.setattr("controller.riccati.build.build_from", lambda recipe, *_: recipes.append(recipe))
    build_riccati(vehicle.model, OcpOptions(), print)
    build_riccati(vehicle.model, OcpOptions(), print, ("-DLANES=1",))
    assert recipes[0].flags != recipes[1].flags
    keyed = set(recipes[0].ingredients["sources"])
    assert {f"riccati/c/{path.name}" for path in C_SOURCES.iterdir()} <= keyed
    package = C_SOURCES.parent.parent
    for name in keyed:
        for line in (package / name).read_text().splitlines():
            if line.startswith("from controller.") and name != "riccati/build.py":
                assert line.split()[1].removeprefix("controller.").replace(".", "/") + ".py" in keyed
