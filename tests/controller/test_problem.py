"""The optimal control problem: its sizes, where things lie, its cost and constraints recomputed by hand."""

import casadi as ca
import numpy as np
import pytest

from controller.ocp import SOLVER_OPTIONS, build_functions, stage_function, transcribe
from controller.problem import (
    Horizon,
    OcpOptions,
    ProblemError,
    pack_constraint_bounds,
    pack_parameters,
    pack_variable_bounds,
)


def test_the_papers_numbers():
    options = OcpOptions()
    assert (options.horizon_steps, options.sample_time_s, options.integrator_steps) == (30, 0.04, 4)
    assert options.input_bounds[1] == (-1.0, 1.0)
    assert all(terminal > stage for terminal, stage in zip(options.terminal_weights, options.state_weights, strict=True))
    assert (SOLVER_OPTIONS["max_iter"], SOLVER_OPTIONS["qpsol_options"]["max_iter"]) == (50, 100)
    assert (SOLVER_OPTIONS["tol_pr"], SOLVER_OPTIONS["tol_du"]) == (1e-6, 1e-4)
    assert (SOLVER_OPTIONS["qpsol"], SOLVER_OPTIONS["hessian_approximation"]) == ("qrqp", "exact")


def test_sizes(vehicle):
    nlp = transcribe(vehicle.model, OcpOptions())
    assert (nlp["x"].numel(), nlp["g"].numel()) == (246, 210)
    layout = OcpOptions().layout
    assert (layout.n_variables, layout.n_constraints, layout.n_parameters) == (246, 210, nlp["p"].numel())
    together = np.concatenate((layout.state_index.ravel(), layout.input_index.ravel()))
    assert sorted(together) == list(range(246))


def test_cost_and_constraints_are_those_of_the_paper(vehicle, problem):
    _, previous_input, horizon = problem
    options, layout = OcpOptions(), OcpOptions().layout
    rng = np.random.default_rng(3)
    states = horizon.reference + 0.1 * rng.standard_normal((31, 6))
    inputs = 0.1 * rng.standard_normal((30, 2))
    w = np.empty(246)
    w[layout.state_index], w[layout.input_index] = states, inputs
    p = np.empty(layout.n_parameters)
    pack_parameters(p, horizon, previous_input, options)
    nlp = transcribe(vehicle.model, options)
    f, g = (np.array(part) for part in ca.Function("nlp", [nlp["x"], nlp["p"]], [nlp["f"], nlp["g"]])(w, p))

    error, du = states - horizon.reference, np.diff(np.vstack((previous_input, inputs)), axis=0)
    expected = (
        np.sum(error[:-1] ** 2 @ options.state_weights) + error[-1] ** 2 @ options.terminal_weights
        + np.sum(inputs**2 @ options.input_weights) + np.sum(du**2 @ options.input_difference_weights)
    )  # fmt: skip
    assert f.item() == pytest.approx(expected, rel=1e-12)
    stage = stage_function(vehicle.model, options)
    gaps = [np.array(stage(x, u)).ravel() - x_next for x, u, x_next in zip(states[:-1], inputs, states[1:], strict=True)]
    lateral = np.sum(horizon.normals()[1:] * error[1:, 3:5], axis=1)
    np.testing.assert_allclose(g.ravel(), np.concatenate((*gaps, lateral)), rtol=1e-10, atol=1e-10)


def test_the_check_functions_gradient_agrees_with_finite_differences(vehicle, problem):
    _, previous_input, horizon = problem
    options, layout = OcpOptions(), OcpOptions().layout
    kkt = build_functions(vehicle.model, options).kkt
    nlp = transcribe(vehicle.model, options)
    terms = ca.Function("nlp", [nlp["x"], nlp["p"]], [nlp["f"], nlp["g"]])
    rng = np.random.default_rng(4)
    w, lam_g, p = np.zeros(246), rng.standard_normal(210), np.empty(layout.n_parameters)
    w[layout.state_index] = horizon.reference
    pack_parameters(p, horizon, previous_input, options)
    gradient = np.array(kkt(w, p, lam_g)[1]).ravel()
    for direction in rng.standard_normal((5, 246)):
        ends = [terms(w + h * direction, p) for h in (1e-6, -1e-6)]
        values = [float(f) + float(lam_g @ np.array(g).ravel()) for f, g in ends]
        assert (values[0] - values[1]) / 2e-6 == pytest.approx(gradient @ direction, rel=1e-5)


def test_bounds(problem):
    state, _, horizon = problem
    options, layout = OcpOptions(), OcpOptions().layout
    lower, upper = np.full(246, np.nan), np.full(246, np.nan)
    pack_variable_bounds(lower, upper, state, horizon, options)
    assert not np.isnan(lower).any()
    assert not np.isnan(upper).any()
    first, middle, last = layout.state_index[[0, 7, 30]]
    np.testing.assert_array_equal(lower[first], state)
    np.testing.assert_array_equal(upper[first], state)
    grip = 8.5 / horizon.reference[7, 0]
    np.testing.assert_allclose(upper[middle], (45.0, 4.0, grip, np.inf, np.inf, np.inf))
    np.testing.assert_allclose(lower[middle], (-1.0, -4.0, -grip, -np.inf, -np.inf, -np.inf))
    np.testing.assert_allclose(upper[last] - horizon.reference[-1], options.terminal_box)
    np.testing.assert_allclose(horizon.reference[-1] - lower[last], options.terminal_box)
    np.testing.assert_array_equal(lower[layout.input_index[29]], (-0.55, -1.0))

    wider = Horizon(horizon.reference, horizon.path_yaw_rad, np.arange(31.0), np.arange(31.0) + 100.0)
    lower_g, upper_g = np.full(210, np.nan), np.full(210, np.nan)
    pack_constraint_bounds(lower_g, upper_g, wider, layout)
    assert not lower_g[:180].any()
    assert not upper_g[:180].any()
    np.testing.assert_array_equal(upper_g[180:], np.arange(1.0, 31.0))
    np.testing.assert_array_equal(lower_g[180:], -np.arange(101.0, 131.0))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"horizon_steps": 1}, "horizon_steps"),
        ({"sample_time_s": 0.0}, "sample_time_s"),
        ({"state_weights": (1.0,) * 7}, "state_weights"),
        ({"terminal_box": (1.0,) * 5 + (float("nan"),)}, "terminal_box"),
        ({"input_weights": (-1.0, 1.0)}, "input_weights"),
        ({"input_bounds": ((0.5, -0.5), (-1.0, 1.0))}, "input_bounds"),
        ({"state_bounds": ((-1.0, 45.0),)}, "state_bounds"),
        ({"lateral_acceleration_mps2": 0.0}, "lateral_acceleration_mps2"),
    ],
)
def test_numbers_that_make_no_problem_are_named(changes, named):
    with pytest.raises(ProblemError, match=named):
        OcpOptions(**changes)
