"""The recorded problems: what each set promises, and that a recording is the same every time."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from controller.bench import sets as bench_sets
from controller.bench.scenarios import Case, Obstacle, active_cases, nominal_cases
from controller.bench.sets import HARD_KINDS, count_active
from controller.problem import OcpOptions
from controller.solvers import make_solver

LONG_ENOUGH_S = {"dlc80": 0.6, "lane60": 0.6, "park10": 0.6, "cutin60": 1.8, "saturated": 1.0, "tight": 4.4, "cut-in": 2.8, "violated": 0.6}
"""Of each case."""


def shortened(cases):
    """The first case of each name, for as long as is needed."""
    first = {case.name: case for case in reversed(cases)}
    return tuple(replace(case, scenario=replace(case.scenario, duration_s=LONG_ENOUGH_S[name])) for name, case in first.items())


@pytest.fixture(scope="module", autouse=True)
def _short_cases():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_sets, "nominal_cases", lambda: shortened(nominal_cases()))
        patch.setattr(bench_sets, "active_cases", lambda: shortened(active_cases()))
        yield


@pytest.fixture(scope="module")
def nominal(vehicle, _short_cases):
    return bench_sets.nominal(vehicle, 40, lambda text: None)


@pytest.fixture(scope="module")
def active(vehicle, _short_cases):
    return bench_sets.active(vehicle, 32, lambda text: None)


@pytest.fixture(scope="module")
def answered(vehicle):
    """Solves an instance with a solver of this name: (converged, active bounds, violation)."""
    solvers = {name: make_solver(name, vehicle.model, OcpOptions(), print) for name in ("casadi-c", "riccati")}

    def answer(name, instance):
        solvers[name].warm_start = instance.warm_start
        result = solvers[name].solve(instance.state, instance.previous_input, instance.horizon)
        return result.status.value == "converged", *count_active(instance.state, instance.horizon, result, OcpOptions())

    return answer


def content(instances):
    """All numbers of the problems, to the last bit."""
    parts = []
    for i in instances:
        warm = (i.warm_start.w, i.warm_start.lam_w, i.warm_start.lam_g) if i.warm_start else ()
        horizon = (i.horizon.reference, i.horizon.path_yaw_rad, i.horizon.left_m, i.horizon.right_m)
        parts += [i.kind.encode(), i.state.tobytes(), i.previous_input.tobytes(), *(a.tobytes() for a in (*horizon, *warm))]
    return parts


def test_nominal_problems_come_evenly_from_four_scenarios_and_meet_no_bound(nominal, answered):
    assert Counter(i.kind for i in nominal) == dict.fromkeys(("dlc80", "lane60", "park10", "cutin60"), 10)
    for instance in nominal:
        assert answered("casadi-c", instance) == (True, 0, 0.0)


def test_a_nominal_problem_that_meets_a_bound_is_left_out(vehicle, monkeypatch, answered):
    saturated = tuple(case for case in shortened(active_cases()) if case.name == "saturated")
    longer = tuple(replace(case, scenario=replace(case.scenario, duration_s=1.6)) for case in saturated)
    monkeypatch.setattr(bench_sets, "nominal_cases", lambda: longer)
    kept = bench_sets.nominal(vehicle, 1000, lambda text: None)
    assert 0 < len(kept) < 40
    assert all(answered("casadi-c", instance)[1] == 0 for instance in kept)


def test_active_problems_come_evenly_and_meet_a_bound(active, answered):
    assert Counter(i.kind for i in active) == dict.fromkeys(("saturated", "tight", "cut-in", "violated"), 8)
    for instance in active:
        has_converged, bounds, _ = answered("riccati", instance)
        assert has_converged
        assert bounds >= 1


def test_feasible_problems_are_those_that_hard_constraints_allow(active, answered):
    assert {i.is_feasible for i in active} == {True, False}
    assert all(i.is_feasible for i in active if i.kind == "saturated")
    assert not any(i.is_feasible for i in active if i.kind == "violated" and abs(i.state[4]) > 1.0)
    for instance in active:
        if instance.is_feasible:
            assert answered("casadi-c", instance)[0]
        else:
            assert answered("riccati", instance)[2] > 1e-5


def test_recording_twice_gives_the_same_problems(vehicle, nominal, active):
    assert content(bench_sets.nominal(vehicle, 40, lambda text: None)) == content(nominal)
    assert content(bench_sets.active(vehicle, 32, lambda text: None)) == content(active)


def test_hard_starts_are_seeded_and_balanced(nominal):
    starts = bench_sets.hard(nominal, 400)
    assert Counter(start.kind for start in starts) == dict.fromkeys(HARD_KINDS, 100)
    assert content(starts) == content(bench_sets.hard(nominal, 400))
    assert content(starts) != content(bench_sets.hard(nominal, 400, seed=2))


def test_hard_starts_are_what_their_kind_says(nominal):
    by_kind = {kind: [s for s in bench_sets.hard(nominal, 400) if s.kind == kind] for kind in HARD_KINDS}
    base_of = {id(i.horizon): i for i in nominal}
    assert all(s.warm_start is None for kind in ("cold", "infeasible") for s in by_kind[kind])
    assert all(s.warm_start is base_of[id(s.horizon)].warm_start for s in by_kind["kicked"])
    assert 0 < sum(s.warm_start is None for s in by_kind["wild"]) < 100
    for s in by_kind["infeasible"]:
        lateral_m = s.horizon.normals()[0] @ (s.state[3:5] - s.horizon.reference[0, 3:5])
        assert 0.9 <= max(lateral_m - s.horizon.left_m[0], -lateral_m - s.horizon.right_m[0]) <= 2.0
    pushes = np.array([s.state - base_of[id(s.horizon)].state for s in by_kind["wild"]])
    assert np.all(np.abs(pushes) <= (3.0, 1.0, 0.6, 1.5, 1.5, 0.4))
    assert np.all(np.abs(pushes).max(axis=0) > (2.4, 0.8, 0.48, 1.2, 1.2, 0.32))
    inputs = np.array([s.previous_input for s in by_kind["wild"]])
    assert np.all(np.abs(inputs) <= (0.55, 1.0))
    assert np.all(np.ptp(inputs, axis=0) > (0.8, 1.5))


def test_an_obstacle_is_there_when_it_is_reported(problem):
    state, _, horizon = problem
    first, last = horizon.reference[10, 3], horizon.reference[20, 3]
    obstacle = Obstacle(first, last, edge_m=0.4, shift_m=1.5, reported_m=first - state[3] + 0.01)
    case = Case("x", nominal_cases()[0].scenario, obstacle)
    assert case.edited(state - (0, 0, 0, 1.0, 0, 0), horizon) is horizon
    edited = case.edited(state, horizon)
    moved = np.sum((edited.reference[:, 3:5] - horizon.reference[:, 3:5]) * horizon.normals(), axis=1)
    np.testing.assert_allclose(moved, [1.5 if 10 <= k <= 20 else 0.0 for k in range(31)], atol=1e-12)
    np.testing.assert_allclose(edited.right_m[10:21], 1.1)  # from the shifted reference to the edge
    np.testing.assert_allclose(edited.left_m[10:21] + 1.5, horizon.left_m[10:21])
    np.testing.assert_array_equal(edited.right_m[21:], horizon.right_m[21:])


def test_a_case_may_narrow_the_corridor(problem):
    state, _, horizon = problem
    edited = Case("x", nominal_cases()[0].scenario, half_width_m=0.25).edited(state, horizon)
    assert (set(edited.left_m), set(edited.right_m)) == ({0.25}, {0.25})
    np.testing.assert_array_equal(edited.reference, horizon.reference)
