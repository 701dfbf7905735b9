"""Single-track (bicycle) model of the car: equations (1) to (4) of the paper, as CasADi expressions.

State: v_x, v_y [m/s] in the body frame, yaw rate omega [rad/s], X, Y [m] and heading psi [rad] in the ground frame.
Input: road-wheel angle delta [rad], left positive, and normalised throttle t_r, -1 to 1.
"""

import casadi as ca

from controller.integrator import Expression
from dbc.vehicle import ModelParameters

SLIP_SPEED_FLOOR_MPS = 1.0
"""Speed below which the slip angles are computed as if the car moved this fast.

Equation (3) divides by v_x. The fastest pole of the lateral dynamics is about -140/v_x 1/s, so that explicit RK4 with 10 ms
steps (stable to -278 1/s) needs a floor above 0.5 m/s.
"""
_SLIP_SPEED_SMOOTHING_MPS = 0.1


def slip_speed(v_x: Expression) -> Expression:
    """Smooth maximum of v_x and the floor; never below the floor, 0.05 % above v_x at 10 km/h."""
    floor = SLIP_SPEED_FLOOR_MPS
    return 0.5 * (v_x + floor + ca.sqrt((v_x - floor) ** 2 + _SLIP_SPEED_SMOOTHING_MPS**2))


def single_track(x: Expression, u: Expression, car: ModelParameters) -> Expression:
    """Time derivative of the state.

    Args:
        x: state, shape (6,).
        u: input, shape (2,).
        car: parameters of the model.
    """
    v_x, v_y, omega, psi = (x[i] for i in (0, 1, 2, 5))
    delta, t_r = u[0], u[1]
    M, I_z = car.mass_kg, car.yaw_inertia_kgm2
    L_f, L_r = car.cog_to_front_m, car.cog_to_rear_m

    # Slip angles, equation (3).
    v_slip = slip_speed(v_x)
    alpha_f = -ca.atan((omega * L_f + v_y) / v_slip) + delta
    alpha_r = ca.atan((omega * L_r - v_y) / v_slip)

    # Forces, equations (2) and (4); the drive force is the same on both axles.
    F_x = 0.5 * t_r * car.max_wheel_torque_nm / car.wheel_radius_m
    F_yf = car.front_cornering_stiffness_nprad * alpha_f
    F_yr = car.rear_cornering_stiffness_nprad * alpha_r
    F_res = car.rolling_resistance_n + car.air_drag_nps2pm2 * v_x**2

    # Equation (1).
    cos_delta, sin_delta = ca.cos(delta), ca.sin(delta)
    cos_psi, sin_psi = ca.cos(psi), ca.sin(psi)
    return ca.vertcat(
        (F_x * cos_delta + F_x - F_yf * sin_delta - F_res) / M + omega * v_y,
        (F_x * sin_delta + F_yr + F_yf * cos_delta) / M - omega * v_x,
        (L_f * (F_yf * cos_delta + F_x * sin_delta) - L_r * F_yr) / I_z,
        v_x * cos_psi - v_y * sin_psi,
        v_x * sin_psi + v_y * cos_psi,
        omega,
    )


def single_track_lag(x: Expression, u: Expression, car: ModelParameters) -> Expression:
    """Time derivative of the state behind actuators that follow their commands as lags of first order.

    Args:
        x: state, shape (8,): that of `single_track`, road-wheel angle delta_a [rad], drive t_a.
        u: commanded delta and t_r, shape (2,).
    """
    actuators = x[6:]
    lags_s = ca.vertcat(car.steer_lag_s, car.drive_lag_s)
    return ca.vertcat(single_track(x[:6], actuators, car), (u - actuators) / lags_s)
