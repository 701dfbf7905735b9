"""Other models and horizons through the same generator and the same C: the answers of an interior-point method, and optimal ones."""

import numpy as np
import pytest

from controller.ipopt import make_ipopt
from controller.problem import SINGLE_TRACK_LAG, Horizon, OcpOptions
from controller.riccati.build import SCALAR, build_riccati, host_flags, write_sources
from controller.riccati.solver import RiccatiSolver
from controller.solver import SolveStatus
from tests.support.kinematic import kinematic_options
from tests.support.soft_optimality import conditions_of, is_optimal

FORMS = {
    "single track, 10 steps": (OcpOptions(horizon_steps=10), None),
    "single track, 60 steps": (OcpOptions(horizon_steps=60), None),
    "single track with lag": (OcpOptions(model=SINGLE_TRACK_LAG), None),
    "single track with lag, 12 steps, scalar": (OcpOptions(model=SINGLE_TRACK_LAG, horizon_steps=12), SCALAR),
    "kinematic": (kinematic_options(), None),
    "kinematic, 19 steps, scalar": (kinematic_options(19), SCALAR),
}


@pytest.fixture(scope="module", params=list(FORMS))
def solvers(request, vehicle):
    options, flags = FORMS[request.param]
    library = build_riccati(vehicle.model, options, print, flags).library
    return RiccatiSolver(library, options), make_ipopt(vehicle.model, options, lambda: 0), conditions_of(vehicle.model, options)


def winding_road(options, side_m, room_m):
    """A road of sine shape at 15 m/s, or of a tenth of that at 1.5 m/s, and a car on one side of it."""
    slow = 0.1 if "v_y" not in options.model.states else 1.0
    x = 15.0 * slow * options.sample_time_s * np.arange(options.horizon_steps + 1)
    columns = {
        "v_x": np.full(x.size, 15.0 * slow),
        "X": x,
        "Y": 2.0 * slow * np.sin(x / 20.0 / slow),
        "psi": np.arctan(0.1 * np.cos(x / 20.0 / slow)),
    }
    reference = np.column_stack([columns.get(name, np.zeros(x.size)) for name in options.model.states])
    state = reference[0].copy()
    state[options.model.states.index("Y")] += side_m * slow
    return state, np.zeros(2), Horizon(reference, columns["psi"], np.full(x.size, room_m * slow), np.full(x.size, room_m * slow))


@pytest.mark.parametrize(("side_m", "room_m"), [(0.1, 3.0), (0.5, 0.3), (-1.5, 0.6)], ids=["free", "outside", "far outside"])
def test_the_answer_is_that_of_an_interior_point_method(solvers, side_m, room_m):
    ours, ipopt, conditions = solvers
    ours.reset(), ipopt.reset()
    problem = winding_road(ours.options, side_m, room_m)
    for _ in range(2):  # cold, then warm
        answer, expected = (solver.solve(*problem) for solver in (ours, ipopt))
        assert answer.status is expected.status is SolveStatus.CONVERGED
        assert is_optimal(ours, conditions)
        np.testing.assert_allclose(answer.first_input, expected.first_input, rtol=0, atol=1e-5)
        np.testing.assert_allclose(answer.inputs, expected.inputs, rtol=0, atol=1e-4)
        np.testing.assert_allclose(answer.states, expected.states, rtol=0, atol=1e-4)
    assert np.count_nonzero(ours.answer.lam_g[ours.options.layout.n_gaps :]) >= (0 if room_m > 1.0 else 1)


def test_input_bounds_are_hard(solvers):
    ours, _, conditions = solvers
    ours.reset()
    lower, upper = np.array(ours.options.input_bounds).T
    state, previous_input, horizon = winding_road(ours.options, 0.1, 3.0)
    state[0] -= 0.8 * abs(state[0])
    answer = ours.solve(state, previous_input, horizon)
    assert answer.status is SolveStatus.CONVERGED
    assert is_optimal(ours, conditions)
    assert ((lower <= answer.inputs) & (answer.inputs <= upper)).all()
    assert answer.inputs[:, 1].max() == pytest.approx(upper[1], abs=1e-8)


def test_no_undefined_behaviour_in_another_form(vehicle, same_under_sanitizers, tmp_path):
    options, flags = FORMS["single track with lag, 12 steps, scalar"]
    write_sources(tmp_path, vehicle.model, options)
    solver = RiccatiSolver(build_riccati(vehicle.model, options, print, flags).library, options)
    problems = [(*winding_road(options, side_m, room_m), None) for side_m, room_m in ((0.1, 3.0), (0.5, 0.3), (-1.5, 0.6))]
    same_under_sanitizers(solver, tmp_path, flags, problems)
    same_under_sanitizers(solver, tmp_path, host_flags(), problems)
