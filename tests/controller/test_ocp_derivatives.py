"""The derivatives that `qrqp` assembles from its stages, against CasADi's own of the whole programme and finite differences."""

import casadi as ca
import numpy as np
import pytest

from controller.ocp import SOLVER_OPTIONS, transcribe
from controller.problem import SINGLE_TRACK_LAG, OcpOptions
from controller.qrqp import build_functions, derivatives
from tests.support.kinematic import kinematic_options

PROBLEMS = {
    "single-track": OcpOptions(),
    "single-track, 10 steps": OcpOptions(horizon_steps=10),
    "single-track with lag": OcpOptions(model=SINGLE_TRACK_LAG, horizon_steps=12),
    "kinematic, 60 steps": kinematic_options(60),
}


@pytest.fixture(scope="module", params=PROBLEMS.values(), ids=PROBLEMS.keys())
def options(request):
    return request.param


@pytest.fixture(scope="module")
def nlp(vehicle, options):
    return transcribe(vehicle.model, options)


@pytest.fixture(scope="module")
def ours(nlp, vehicle, options):
    return derivatives(nlp, vehicle.model, options)


@pytest.fixture(scope="module")
def casadis(nlp):
    """What CasADi's SQP method would use."""
    solver = ca.nlpsol("nmpc", "sqpmethod", nlp, SOLVER_OPTIONS)
    return solver.get_function("nlp_jac_fg"), solver.get_function("nlp_hess_l")


@pytest.fixture
def point(options):
    """Variables, parameters and multipliers without any structure; speeds from rest to 30 m/s, every heading."""
    rng = np.random.default_rng(5)
    layout, names = options.layout, options.model.states
    w = 0.3 * rng.standard_normal(layout.n_variables)
    w[layout.state_index[:, names.index("v_x")]] = rng.uniform(-0.5, 30.0, options.horizon_steps + 1)
    w[layout.state_index[:, names.index("psi")]] = rng.uniform(-4.0, 4.0, options.horizon_steps + 1)
    w[layout.state_index[:, options.model.position_index]] *= 100.0
    return w, rng.standard_normal(layout.n_parameters), rng.standard_normal(), 10.0 * rng.standard_normal(layout.n_constraints)


def test_they_are_those_of_casadi(ours, casadis, point):
    w, p, lam_f, lam_g = point
    for mine, theirs in zip(ours[0](w, p), casadis[0](w, p), strict=True):
        np.testing.assert_allclose(mine.full(), theirs.full(), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours[1](w, p, lam_f, lam_g).full(), casadis[1](w, p, lam_f, lam_g).full(), rtol=1e-9, atol=1e-9)


def test_they_have_the_same_nonzeros(ours, casadis):
    assert ours[0].sparsity_out(3) == casadis[0].sparsity_out(3)
    assert ours[1].sparsity_out(0) == casadis[1].sparsity_out(0)


def test_they_are_finite_differences(ours, nlp, point):
    w, p, lam_f, lam_g = point
    values = ca.Function("values", [nlp["x"], nlp["p"]], [nlp["f"], nlp["g"]])

    def gradient_of_lagrangian(at):
        _, gradient, _, jacobian = ours[0](at, p)
        return lam_f * gradient.full().ravel() + jacobian.full().T @ lam_g

    _, gradient, _, jacobian = ours[0](w, p)
    hessian = ours[1](w, p, lam_f, lam_g)
    for direction in np.random.default_rng(6).standard_normal((4, w.size)):
        h = 1e-6 * direction
        (f_ahead, g_ahead), (f_behind, g_behind) = values(w + h, p), values(w - h, p)
        assert float(f_ahead - f_behind) / 2e-6 == pytest.approx(float(ca.dot(gradient, direction)), rel=1e-5, abs=1e-3)
        np.testing.assert_allclose((g_ahead - g_behind).full() / 2e-6, (jacobian @ direction).full(), rtol=1e-5, atol=1e-5)
        curved = (gradient_of_lagrangian(w + h) - gradient_of_lagrangian(w - h)) / 2e-6
        np.testing.assert_allclose(curved, (hessian @ direction).full().ravel(), rtol=1e-4, atol=1e-3)


def test_the_solver_takes_them(vehicle, options):
    solver = build_functions(vehicle.model, options).nmpc
    assert solver.get_function("nlp_jac_fg").name_out() == ["f", "grad:f:x", "g", "jac:g:x"]
    assert solver.get_function("nlp_hess_l").name_in() == ["x", "p", "lam:f", "lam:g"]
