"""The model against a second one written by hand, and the integrator against its order."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.integrator import rk4_step
from controller.model import single_track, slip_speed
from controller.ocp import advance_function, stage_function
from controller.problem import SINGLE_TRACK, SINGLE_TRACK_LAG, OcpOptions
from dbc.vehicle import load_vehicle

CAR = load_vehicle().model
_X, _U = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
_MODEL = ca.Function("f", [_X, _U], [single_track(_X, _U, CAR)])
_STAGE = stage_function(CAR, OcpOptions())
_ADVANCE = advance_function(CAR, OcpOptions())

states = st.tuples(*(st.floats(-limit, limit) for limit in (3.0, 1.0, 500.0, 500.0, 7.0))).flatmap(
    lambda rest: st.floats(0.0, 40.0).map(lambda v_x: np.array((v_x, *rest)))
)
inputs = st.tuples(st.floats(-0.5, 0.5), st.floats(-1.0, 1.0)).map(np.array)


def by_hand(x, u):
    """Equations (1) to (4) in plain numbers, in another order of writing."""
    v_x, v_y, r, _, _, psi = x
    delta, t_r = u
    v = (v_x + 1 + np.sqrt((v_x - 1) ** 2 + 0.01)) / 2
    lateral_front = 1e5 * (delta - np.arctan((v_y + 1.1 * r) / v))
    lateral_rear = 1.1e5 * np.arctan((1.548 * r - v_y) / v)
    drive = t_r * 1500.0 / 0.31 / 2
    front_x = drive * np.cos(delta) - lateral_front * np.sin(delta)
    front_y = drive * np.sin(delta) + lateral_front * np.cos(delta)
    return np.array((
        (front_x + drive - 200.0 - 0.4 * v_x**2) / 1500.0 + r * v_y,
        (front_y + lateral_rear) / 1500.0 - r * v_x,
        (1.1 * front_y - 1.548 * lateral_rear) / 2500.0,
        np.cos(psi) * v_x - np.sin(psi) * v_y,
        np.sin(psi) * v_x + np.cos(psi) * v_y,
        r,
    ))  # fmt: skip


@given(states, inputs)
def test_the_model_is_the_papers(x, u):
    np.testing.assert_allclose(np.array(_MODEL(x, u)).ravel(), by_hand(x, u), rtol=1e-10, atol=1e-10)


@given(st.floats(-5.0, 60.0))
def test_slip_angles_never_divide_by_less_than_the_floor(v_x):
    v = float(slip_speed(ca.DM(v_x)))
    assert v >= 1.0
    assert v >= v_x
    if v_x > 2.7:
        assert v == pytest.approx(v_x, rel=1e-3)


@given(states, inputs)
def test_derivatives_agree_with_finite_differences(x, u):
    jacobian = ca.Function("j", [_X, _U], [ca.jacobian(single_track(_X, _U, CAR), ca.vertcat(_X, _U))])
    h, z = 1e-6, np.concatenate((x, u))
    numeric = np.column_stack([(by_hand(*np.split(z + h * e, [6])) - by_hand(*np.split(z - h * e, [6]))) / (2 * h) for e in np.eye(8)])
    np.testing.assert_allclose(np.array(jacobian(x, u)), numeric, rtol=1e-4, atol=1e-3)


@given(states, inputs, st.floats(-3.0, 3.0), st.floats(-100.0, 100.0))
def test_the_stage_does_not_know_where_north_is(x, u, turn, shift):
    """Turning and moving the start turns and moves the end."""
    c, s = np.cos(turn), np.sin(turn)

    def moved(state):
        return np.array((*state[:3], shift + c * state[3] - s * state[4], s * state[3] + c * state[4], state[5] + turn))

    np.testing.assert_allclose(_stage(moved(x), u), moved(_stage(x, u)), rtol=1e-9, atol=1e-9)


def test_the_stage_is_four_steps_of_ten_milliseconds_and_advance_is_the_same():
    x, u = np.array((16.0, 0.3, 0.2, 3.0, 4.0, 0.5)), np.array((0.04, 0.3))
    by_steps = x
    for _ in range(4):
        by_steps = rk4_step(by_hand, by_steps, u, 0.01)
    np.testing.assert_allclose(_stage(x, u), by_steps, rtol=1e-12)
    np.testing.assert_allclose(np.array(_ADVANCE(x, u, 0.04)).ravel(), by_steps, rtol=1e-12)


def test_runge_kutta_is_of_fourth_order():
    def end(steps):
        x = np.array((10.0, 0.2, 0.3, 0.0, 0.0, 0.0))
        for _ in range(steps):
            x = rk4_step(by_hand, x, np.array((0.05, 0.2)), 0.32 / steps)
        return x

    exact = end(2048)
    errors = [np.max(np.abs(end(steps) - exact)) for steps in (16, 32, 64)]
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(16.0, rel=0.3)


@pytest.mark.parametrize("v_x", [-1.0, 0.0, 0.3, 1.0, 2.0])
def test_the_stage_is_stable_down_to_standstill(v_x):
    """Small sideways motion dies out at any speed; explicit steps would amplify it without the floor of the slip angles."""
    x = np.array((v_x, 0.1, 0.1, 0.0, 0.0, 0.0))
    hold = (200.0 + 0.4 * v_x**2) / (1500.0 / 0.31)
    for _ in range(50):
        x = _stage(x, np.array((0.0, hold)))
    assert abs(x[1]) < 1e-3
    assert abs(x[2]) < 1e-3
    assert x[0] == pytest.approx(v_x, abs=0.05)


def _stage(x, u):
    return np.array(_STAGE(x, u)).ravel()


VARIANTS = {model.name: model for model in (SINGLE_TRACK, SINGLE_TRACK_LAG)}


@pytest.fixture(scope="module", params=VARIANTS)
def sampled(request):
    """One sample of a model with its Jacobian, and the Hessian of the sum of all states after it."""
    model = VARIANTS[request.param]
    stage = stage_function(CAR, OcpOptions(model=model))
    x, u = ca.MX.sym("x", model.n_states), ca.MX.sym("u", model.n_inputs)
    after = stage(x, u)
    hessian = ca.hessian(ca.sum1(after), x)[0]
    return model, ca.Function("sampled", [x, u], [after, ca.jacobian(after, x), hessian])


@pytest.mark.parametrize("v_x", [0.0, 0.1, 0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 28.0, 36.0])
def test_the_sampled_map_is_stable_from_standstill_to_130_kmh(sampled, v_x):
    """Where continuous motion dies out, so does the sampled one: every lateral and actuator mode, from any angle of the wheels."""
    model, evaluate = sampled
    for delta in (0.0, 0.1 if v_x < 10.0 else 0.02):
        hold = (200.0 + 0.4 * v_x**2) / (1500.0 / 0.31)
        x = np.zeros(model.n_states)
        x[0], x[6:] = v_x, (delta, hold)[: model.n_states - 6]
        jacobian = np.array(evaluate(x, (delta, hold))[1])
        moving = [k for k, name in enumerate(model.states) if name not in ("X", "Y", "psi")]
        radius = np.abs(np.linalg.eigvals(jacobian[np.ix_(moving, moving)])).max()
        assert radius < 1.01  # v_x by itself hardly decays: air drag


@given(data=st.data())
def test_gradients_are_finite_at_any_speed(sampled, data):
    model, evaluate = sampled
    x, u = data.draw(states), data.draw(inputs)
    actuators = np.array((*data.draw(inputs),))[: model.n_states - 6]
    x[0] = data.draw(st.floats(-1.0, 36.0))
    for value in evaluate(np.concatenate((x, actuators)), u):
        assert np.isfinite(np.array(value)).all()


def test_actuators_follow_their_commands_as_lags_of_first_order():
    advance = advance_function(CAR, OcpOptions(model=SINGLE_TRACK_LAG))
    x = np.array((20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(5):
        x = np.array(advance(x, (0.02, 0.5), 0.04)).ravel()
    assert x[6:] == pytest.approx((0.02 * (1 - np.exp(-0.2 / CAR.steer_lag_s)), 0.5 * (1 - np.exp(-0.2 / CAR.drive_lag_s))), rel=1e-3)


def test_behind_actuators_at_rest_the_car_is_the_same():
    """With actuators where their commands are, both models move alike."""
    x, u = np.array((16.0, 0.3, 0.2, 3.0, 4.0, 0.5)), np.array((0.04, 0.3))
    advance = advance_function(CAR, OcpOptions(model=SINGLE_TRACK_LAG))
    np.testing.assert_allclose(np.array(advance(np.concatenate((x, u)), u, 0.04)).ravel()[:6], _stage(x, u), rtol=1e-12)
