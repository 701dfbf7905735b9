"""The optimal control problem (5) of the paper as data: its numbers, its sizes, and where each thing lies in its vectors.

Whoever solves the problem reads this; only `ocp` turns it into expressions.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dbc.errors import UserMistake
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS

Array = NDArray[np.float64]

STATES = ("v_x", "v_y", "omega", "X", "Y", "psi")
INPUTS = ("delta", "t_r")
N_STATES = len(STATES)
N_INPUTS = len(INPUTS)


class ProblemError(UserMistake):
    """Numbers that make no optimal control problem; one line that names the number and its range."""


@dataclass(frozen=True)
class OcpOptions:
    """Numbers of the optimal control problem. The paper gives the first three and the bounds of t_r; the rest is ours.

    Weights are the diagonals of Q, Q_N (terminal), R and S; the unit of each is 1 over that of its quantity squared.
    Ours are tuned in closed loop on the double lane change at 80 km/h, for accuracy with robots as they are and for a car that
    is not lost with 60 ms of dead time more: weight on the heading buys that margin, weight on the position spends it.
    Bounds are (smallest, largest).

    Args:
        horizon_steps: N.
        sample_time_s: T_s [s].
        integrator_steps: Runge-Kutta steps in one sample.
        state_weights: Q for v_x, v_y, omega, X, Y, psi; X and Y alike, so that the cost does not know north.
        terminal_weights: Q_N, heavier than Q.
        input_weights: R for delta, t_r.
        input_difference_weights: S for the change of delta and t_r from one sample to the next.
        vx_mps: bounds of v_x [m/s]; below zero, so that a car at rest with noise on its speed is feasible.
        vy_mps: bounds of v_y [m/s].
        yaw_rate_radps: bounds of omega [rad/s].
        steer_rad: bounds of delta [rad].
        drive_norm: bounds of t_r.
        terminal_box: largest absolute tracking error at the end of the horizon, for v_x, v_y, omega, X, Y, psi.
            Wide enough for a start 0.5 m beside the path or 5 m/s from its speed.
    """

    horizon_steps: int = HORIZON_STEPS
    sample_time_s: float = PLAN_PERIOD_NS * 1e-9
    integrator_steps: int = 4
    state_weights: tuple[float, ...] = (1.0, 0.02, 0.02, 5.0, 5.0, 100.0)
    terminal_weights: tuple[float, ...] = (10.0, 0.2, 0.2, 50.0, 50.0, 1000.0)
    input_weights: tuple[float, ...] = (1.0, 0.1)
    input_difference_weights: tuple[float, ...] = (1000.0, 200.0)
    vx_mps: tuple[float, float] = (-1.0, 45.0)
    vy_mps: tuple[float, float] = (-4.0, 4.0)
    yaw_rate_radps: tuple[float, float] = (-1.5, 1.5)
    steer_rad: tuple[float, float] = (-0.55, 0.55)
    drive_norm: tuple[float, float] = (-1.0, 1.0)
    terminal_box: tuple[float, ...] = (8.0, 4.0, 1.5, 8.0, 8.0, 0.8)

    def __post_init__(self) -> None:
        for name, smallest in (("horizon_steps", 2), ("integrator_steps", 1)):
            if getattr(self, name) < smallest:
                raise ProblemError(f"{name} = {getattr(self, name)}: at least {smallest}")
        if not 0.0 < self.sample_time_s < 1.0:
            raise ProblemError(f"sample_time_s = {self.sample_time_s}: between 0 and 1 s")
        for name, size in (
            ("state_weights", N_STATES),
            ("terminal_weights", N_STATES),
            ("input_weights", N_INPUTS),
            ("input_difference_weights", N_INPUTS),
            ("terminal_box", N_STATES),
        ):
            values = getattr(self, name)
            if len(values) != size or not all(0.0 <= value < np.inf for value in values):
                raise ProblemError(f"{name} = {values}: {size} finite numbers, none negative")
        for name in ("vx_mps", "vy_mps", "yaw_rate_radps", "steer_rad", "drive_norm"):
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise ProblemError(f"{name} = {(lower, upper)}: the smallest must be below the largest")

    def generated(self) -> dict[str, float]:
        """The numbers that are written into the generated code; all others are given at every solve."""
        return {name: getattr(self, name) for name in ("horizon_steps", "sample_time_s", "integrator_steps")}


@dataclass(frozen=True)
class Horizon:
    """What the car is to follow over the horizon; row k belongs to the shooting node k, N+1 of them.

    Args:
        reference: reference states, shape (N+1, 6).
        path_yaw_rad: direction of the path, across which the corridor is measured, shape (N+1,) [rad].
        left_m: largest distance from the reference position to the left, shape (N+1,) [m].
        right_m: the same to the right, positive, shape (N+1,) [m].
    """

    reference: Array
    path_yaw_rad: Array
    left_m: Array
    right_m: Array

    def normals(self) -> Array:
        """Unit normals of the path, to the left, shape (N+1, 2)."""
        return np.column_stack((-np.sin(self.path_yaw_rad), np.cos(self.path_yaw_rad)))


@dataclass(frozen=True)
class Layout:
    """Where things lie in the vectors of the nonlinear programme, for a horizon of N steps.

    Decision variables: x_0, u_0, x_1, u_1, ..., x_N. Constraints: the N gaps of the shooting nodes, six rows each, then one
    corridor row for each of the nodes 1 to N. Parameters: the references x_ref,0 to x_ref,N, the path's normals at the
    nodes 1 to N, the previous input, then the diagonals of Q, Q_N, R and S.
    """

    horizon_steps: int

    @property
    def n_variables(self) -> int:
        """Decision variables."""
        return self.horizon_steps * (N_STATES + N_INPUTS) + N_STATES

    @property
    def n_gaps(self) -> int:
        """Rows of the multiple-shooting gaps."""
        return self.horizon_steps * N_STATES

    @property
    def n_constraints(self) -> int:
        """Rows of the constraint vector."""
        return self.n_gaps + self.horizon_steps

    @property
    def parameter_sizes(self) -> tuple[int, ...]:
        """Sizes of the parts of the parameter vector, in their order."""
        N = self.horizon_steps
        return (N + 1) * N_STATES, 2 * N, N_INPUTS, N_STATES, N_STATES, N_INPUTS, N_INPUTS

    @property
    def n_parameters(self) -> int:
        """Parameters of the programme."""
        return sum(self.parameter_sizes)

    @cached_property
    def state_index(self) -> NDArray[np.int64]:
        """Place of each state among the decision variables, shape (N+1, 6)."""
        first = np.arange(self.horizon_steps + 1)[:, None] * (N_STATES + N_INPUTS)
        return first + np.arange(N_STATES)

    @cached_property
    def input_index(self) -> NDArray[np.int64]:
        """Place of each input among the decision variables, shape (N, 2)."""
        return self.state_index[:-1, -1:] + 1 + np.arange(N_INPUTS)


def pack_parameters(out: Array, horizon: Horizon, previous_input: Array, options: OcpOptions) -> None:
    """Write the parameters of the programme into `out`, shape (n_parameters,)."""
    np.concatenate(
        (
            horizon.reference.ravel(),
            horizon.normals()[1:].ravel(),
            previous_input,
            options.state_weights,
            options.terminal_weights,
            options.input_weights,
            options.input_difference_weights,
        ),
        out=out,
    )


def pack_variable_bounds(lower: Array, upper: Array, state: Array, horizon: Horizon, options: OcpOptions) -> None:
    """Write the bounds of the decision variables: initial state pinned, state and input bounds, terminal set."""
    layout = Layout(options.horizon_steps)
    for out, side, sign in ((lower, 0, -1.0), (upper, 1, 1.0)):
        out[layout.state_index[:-1]] = (
            options.vx_mps[side], options.vy_mps[side], options.yaw_rate_radps[side], sign * np.inf, sign * np.inf, sign * np.inf,
        )  # fmt: skip
        out[layout.state_index[0]] = state
        out[layout.state_index[-1]] = horizon.reference[-1] + sign * np.array(options.terminal_box)
        out[layout.input_index] = (options.steer_rad[side], options.drive_norm[side])


def pack_constraint_bounds(lower: Array, upper: Array, horizon: Horizon, layout: Layout) -> None:
    """Write the bounds of the constraint rows: closed gaps, and the corridor."""
    lower[: layout.n_gaps] = upper[: layout.n_gaps] = 0.0
    lower[layout.n_gaps :] = -horizon.right_m[1:]
    upper[layout.n_gaps :] = horizon.left_m[1:]
