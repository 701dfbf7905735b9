"""One sample of the model with its derivatives, as CasADi functions for `emit`.

The model does not know north: turning the ground frame turns position and heading of the answer and nothing else. So the
Runge-Kutta steps start from position and heading zero (the stage frame), their derivatives are taken with respect to v_x, v_y,
omega, delta and t_r alone, and the rotation by psi is put around the result by hand. The map is the same, rounding apart.
"""

from dataclasses import dataclass

import casadi as ca

from controller.integrator import Expression
from controller.model import single_track
from controller.problem import SINGLE_TRACK, OcpOptions
from dbc.vehicle import ModelParameters

N_STATES, N_INPUTS = SINGLE_TRACK.n_states, SINGLE_TRACK.n_inputs
_VELOCITIES, _X, _Y, _PSI, _INPUTS = (0, 1, 2), 3, 4, 5, (6, 7)
_INNER = (*_VELOCITIES, *_INPUTS)  # what the map in the stage frame depends on, by component of (x, u)
_N_STAGE = N_STATES + N_INPUTS


@dataclass(frozen=True)
class _Evaluation:
    """One evaluation of the model in the Runge-Kutta method, f at x_i = x + offset * (the evaluation before).

    Args:
        point: x_i.
        sensitivity: derivative of (x_i, u) with respect to the inner variables, shape (8, 5).
        jacobian: of f with respect to (x, u), shape (6, 8).
        offset: how much of the evaluation before is in x_i [s].
        weight: how much of this one is in the step [s].
    """

    point: Expression
    sensitivity: Expression
    jacobian: Expression
    offset: float
    weight: float


def stage_functions(car: ModelParameters, options: OcpOptions) -> list[ca.Function]:
    """What the solver evaluates at each stage, SX functions of z = (x, u) and of the multiplier lam of the next state.

    Returns:
        `stage_adjoint`: (z, lam) to x_next and J' lam, where J is the Jacobian of x_next.
        `stage_derivatives`: (z, lam) to x_next, the nonzeros of J and those of the lower triangle of the Hessian of lam' x_next.
    """
    z, lam = ca.SX.sym("z", _N_STAGE), ca.SX.sym("lam", N_STATES)
    c, s = ca.cos(z[_PSI]), ca.sin(z[_PSI])
    lam_stage = ca.vertcat(lam[:3], c * lam[_X] + s * lam[_Y], c * lam[_Y] - s * lam[_X], lam[_PSI])
    at_stage = ca.vertcat(*(z[i] for i in _INNER))

    y_at, jacobian_at, gradient_at, hessian_at = _in_stage_frame(at_stage, lam_stage, car, options)
    along, across = c * y_at[_X] - s * y_at[_Y], s * y_at[_X] + c * y_at[_Y]
    x_next = ca.vertcat(y_at[:3], z[_X] + along, z[_Y] + across, z[_PSI] + y_at[_PSI])
    jacobian = _jacobian(jacobian_at, c, s, along, across)
    hessian = _hessian(hessian_at, jacobian, lam, along, across)
    adjoint = ca.SX.zeros(_N_STAGE)
    for i, component in enumerate(_INNER):
        adjoint[component] = gradient_at[i]
    adjoint[_X], adjoint[_Y], adjoint[_PSI] = lam[_X], lam[_Y], lam[_PSI] - lam[_X] * across + lam[_Y] * along
    return [
        _simplified("stage_adjoint", {"z": z, "lam": lam}, {"x_next": x_next, "adjoint": adjoint}),
        _simplified("stage_derivatives", {"z": z, "lam": lam}, {"x_next": x_next, "jacobian": jacobian, "hessian": ca.tril(hessian)}),
    ]


def _in_stage_frame(inner: Expression, lam: Expression, car: ModelParameters, options: OcpOptions) -> tuple[Expression, ...]:
    """State y after one sample from position and heading zero, with its derivatives with respect to `inner`.

    A Runge-Kutta method is linear but for its evaluations k_i = f(x_i, u). So the second derivative of lam' y is the sum over i of
    V_i' B_i V_i, where V_i is the sensitivity of (x_i, u), and B_i the Hessian of f weighted with the adjoint of k_i. That is half
    the work of differentiating the whole map twice.

    Returns:
        y, its Jacobian, gradient of lam' y, Hessian of lam' y.
    """
    h = options.sample_time_s / options.integrator_steps
    f, linearised, curvature = _model_functions(car)
    x, u = ca.vertcat(inner[:3], ca.SX(3, 1)), inner[3:]
    dx, du = ca.SX.eye(len(_INNER))[:3, :], ca.SX.eye(len(_INNER))[3:, :]
    dx = ca.vertcat(dx, ca.SX(3, len(_INNER)))
    evaluations: list[_Evaluation] = []
    for _ in range(options.integrator_steps):
        k, dk = ca.SX(N_STATES, 1), ca.SX(N_STATES, len(_INNER))
        step, d_step = k, dk
        for offset, weight in zip((0.0, h / 2, h / 2, h), (h / 6, h / 3, h / 3, h / 6), strict=True):
            point, sensitivity = x + offset * k, ca.vertcat(dx + offset * dk, du)
            evaluations.append(_Evaluation(point, sensitivity, linearised(point, u), offset, weight))
            k, dk = f(point, u), evaluations[-1].jacobian @ sensitivity
            step, d_step = step + weight * k, d_step + weight * dk
        x, dx = x + step, dx + d_step
    return x, dx, *_backwards(evaluations, lam, u, curvature)


def _backwards(evaluations: list[_Evaluation], lam: Expression, u: Expression, curvature: ca.Function) -> tuple[Expression, Expression]:
    """Gradient and Hessian of lam' y, by going back through the evaluations with the adjoint of each."""
    hessian = ca.SX(len(_INNER), len(_INNER))
    x_bar, u_bar = lam, ca.SX(N_INPUTS, 1)
    for first in range(len(evaluations) - 4, -1, -4):  # of each step
        start_bar, later_bar, later_offset = x_bar, ca.SX(N_STATES, 1), 0.0
        for evaluation in reversed(evaluations[first : first + 4]):
            k_bar = evaluation.weight * x_bar + later_offset * later_bar
            bar = evaluation.jacobian.T @ k_bar
            later_bar, later_offset = bar[:N_STATES], evaluation.offset
            start_bar, u_bar = start_bar + later_bar, u_bar + bar[N_STATES:]
            hessian += evaluation.sensitivity.T @ (curvature(evaluation.point, u, k_bar) @ evaluation.sensitivity)
        x_bar = start_bar
    return ca.vertcat(x_bar[:3], u_bar), hessian


def _model_functions(car: ModelParameters) -> tuple[ca.Function, ca.Function, ca.Function]:
    """The model f(x, u), its Jacobian with respect to (x, u), and the Hessian of w' f."""
    z, w = ca.SX.sym("z", _N_STAGE), ca.SX.sym("w", N_STATES)
    x, u = z[:N_STATES], z[N_STATES:]
    dx = single_track(x, u, car)
    linearised = ca.Function("linearised", [x, u], [ca.jacobian(dx, z)])
    curvature = ca.Function("curvature", [x, u, w], [ca.hessian(ca.dot(w, dx), z)[0]])
    return ca.Function("f", [x, u], [dx]), linearised, curvature


def _jacobian(inner: Expression, c: Expression, s: Expression, along: Expression, across: Expression) -> Expression:
    """Jacobian of x_next, shape (6, 8), from that in the stage frame, shape (6, 5)."""
    jacobian = ca.SX(N_STATES, _N_STAGE)
    for i, component in enumerate(_INNER):
        column = inner[:, i]
        jacobian[:3, component] = column[:3]
        jacobian[_X, component] = c * column[_X] - s * column[_Y]
        jacobian[_Y, component] = s * column[_X] + c * column[_Y]
        jacobian[_PSI, component] = column[_PSI]
    for component in (_X, _Y, _PSI):
        jacobian[component, component] = 1
    jacobian[_X, _PSI], jacobian[_Y, _PSI] = -across, along
    return jacobian


def _hessian(inner: Expression, jacobian: Expression, lam: Expression, along: Expression, across: Expression) -> Expression:
    """Hessian of lam' x_next, shape (8, 8), from that in the stage frame, shape (5, 5), and the Jacobian in the ground frame."""
    hessian = ca.SX(_N_STAGE, _N_STAGE)
    for i, row in enumerate(_INNER):
        for j, column in enumerate(_INNER):
            hessian[row, column] = inner[i, j]
        turned = lam[_Y] * jacobian[_X, row] - lam[_X] * jacobian[_Y, row]
        hessian[row, _PSI] = hessian[_PSI, row] = turned
    hessian[_PSI, _PSI] = -lam[_X] * along - lam[_Y] * across
    return hessian


def _simplified(name: str, inputs: dict[str, Expression], outputs: dict[str, Expression]) -> ca.Function:
    """A function whose common subexpressions are computed once."""
    simple = ca.cse(list(outputs.values()))
    return ca.Function(name, list(inputs.values()), simple, list(inputs), list(outputs))
