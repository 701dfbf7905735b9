"""Another optimal control problem than the product's: a kinematic bicycle that parks, with four states."""

import casadi as ca

from controller.integrator import Expression
from controller.problem import Model, OcpOptions
from dbc.vehicle import ModelParameters

KINEMATIC = Model(
    "kinematic",
    "tests.support.kinematic:kinematic",
    states=("v_x", "X", "Y", "psi"),
    inputs=("delta", "a_x"),
    bounded=("v_x",),
)


def kinematic(x: Expression, u: Expression, car: ModelParameters) -> Expression:
    """Time derivative of (v_x, X, Y, psi) under road-wheel angle and acceleration [m/s2], wheels without slip."""
    v_x, psi, delta, a_x = x[0], x[3], u[0], u[1]
    wheelbase_m = car.cog_to_front_m + car.cog_to_rear_m
    return ca.vertcat(a_x, v_x * ca.cos(psi), v_x * ca.sin(psi), v_x * ca.sin(delta) / (ca.cos(delta) * wheelbase_m))


def kinematic_options(horizon_steps: int = 20) -> OcpOptions:
    """Forwards and backwards at walking speed."""
    return OcpOptions(
        model=KINEMATIC,
        horizon_steps=horizon_steps,
        sample_time_s=0.1,
        integrator_steps=2,
        state_weights=(1.0, 5.0, 5.0, 10.0),
        terminal_weights=(10.0, 50.0, 50.0, 100.0),
        input_weights=(1.0, 0.1),
        input_difference_weights=(10.0, 1.0),
        state_bounds=((-2.0, 3.0),),
        input_bounds=((-0.5, 0.5), (-3.0, 2.0)),
        terminal_box=(2.0, 3.0, 3.0, 0.8),
    )
