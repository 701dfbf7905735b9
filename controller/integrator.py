"""Classical Runge-Kutta method of fourth order."""

from collections.abc import Callable
from typing import Any

Expression = Any
"""A CasADi expression, which has no types, or an array."""


def rk4_step(derivative: Callable[[Expression, Expression], Expression], x: Expression, u: Expression, h: Expression) -> Expression:
    """State after one step of length `h` [s], the input held constant.

    Args:
        derivative: f(x, u), time derivative of the state.
        x: state at the start; anything that can be added and scaled.
        u: input.
    """
    k1 = derivative(x, u)
    k2 = derivative(x + h / 2 * k1, u)
    k3 = derivative(x + h / 2 * k2, u)
    k4 = derivative(x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
