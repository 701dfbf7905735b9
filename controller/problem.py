"""The optimal control problem (5) of the paper as data: its numbers, its sizes, and where each thing lies in its vectors.

Whoever solves the problem reads this; only `ocp` turns it into expressions.
"""

from dataclasses import asdict, dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbc.errors import UserMistake
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS

Array = NDArray[np.float64]


class ProblemError(UserMistake):
    """Numbers that make no optimal control problem; one line that names the number and its range."""


@dataclass(frozen=True)
class Model:
    """What the problem knows of a vehicle model. Its equations are elsewhere, so that solving needs no CasADi.

    Args:
        equations: `module:function` of the function (x, u, car) to dx/dt.
        states: names; `X`, `Y` and `psi` must be among them, and the model must not depend on where the car is and on
            where north is: only the derivatives of X and Y may contain psi, as a rotation.
        inputs: names.
        bounded: states that have bounds at every node.
    """

    name: str
    equations: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    bounded: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("X", "Y", "psi", *self.bounded):
            if name not in self.states:
                raise ProblemError(f"model {self.name}: no state {name}")

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def bounded_index(self) -> list[int]:
        """Places of the bounded states among the states."""
        return [self.states.index(name) for name in self.bounded]

    @property
    def position_index(self) -> list[int]:
        """Places of X and Y among the states."""
        return [self.states.index(name) for name in ("X", "Y")]


SINGLE_TRACK = Model(
    "single-track",
    "controller.model:single_track",
    states=("v_x", "v_y", "omega", "X", "Y", "psi"),
    inputs=("delta", "t_r"),
    bounded=("v_x", "v_y", "omega"),
)
"""The paper's model, equations (1) to (4)."""

SINGLE_TRACK_LAG = Model(
    "single-track-lag",
    "controller.model:single_track_lag",
    states=(*SINGLE_TRACK.states, "delta_a", "t_a"),
    inputs=SINGLE_TRACK.inputs,
    bounded=SINGLE_TRACK.bounded,
)
"""The same behind actuators with lag: road-wheel angle and drive follow what is commanded."""

N_CAR_STATES = SINGLE_TRACK.n_states
"""States of the car itself, without actuators: the columns that a planner gives references for."""

SLOWEST_GRIP_MPS = 1.0
"""Speed below which the bound on the yaw rate stays as it is at this speed; it is far above what the steering can do there."""


@dataclass(frozen=True)
class OcpOptions:
    """Numbers of the optimal control problem. The paper gives the first three and the bounds of t_r; the rest is ours.

    Weights are the diagonals of Q, Q_N (terminal), R and S; the unit of each is 1 over that of its quantity squared.
    Ours are tuned in closed loop on the double lane change at 80 km/h, for accuracy with robots as they are and for a car that
    is not lost with 60 ms of dead time more: weight on the heading buys that margin, weight on the position spends it.
    Bounds are (smallest, largest). Where a model has more states than there are numbers, the rest has weight zero and no box.

    Args:
        model: the model of the car.
        horizon_steps: N.
        sample_time_s: T_s [s].
        integrator_steps: Runge-Kutta steps in one sample.
        state_weights: Q for v_x, v_y, omega, X, Y, psi; X and Y alike, so that the cost does not know north.
        terminal_weights: Q_N, heavier than Q.
        input_weights: R for delta, t_r.
        input_difference_weights: S for the change of delta and t_r from one sample to the next.
        state_bounds: of each bounded state of the model: v_x, v_y [m/s], omega [rad/s]. That of v_x is below zero, so that a
            car at rest with noise on its speed is feasible.
        input_bounds: of delta [rad] and t_r.
        lateral_acceleration_mps2: what the tyres can hold; omega stays below this over the reference speed. The model's tyres
            are linear and would promise more.
        terminal_box: largest absolute tracking error at the end of the horizon, for v_x, v_y, omega, X, Y, psi.
            Wide enough for a start 0.5 m beside the path or 5 m/s from its speed.
    """

    model: Model = SINGLE_TRACK
    horizon_steps: int = HORIZON_STEPS
    sample_time_s: float = PLAN_PERIOD_NS * 1e-9
    integrator_steps: int = 4
    state_weights: tuple[float, ...] = (1.0, 0.02, 0.02, 5.0, 5.0, 100.0)
    terminal_weights: tuple[float, ...] = (10.0, 0.2, 0.2, 50.0, 50.0, 1000.0)
    input_weights: tuple[float, ...] = (1.0, 0.1)
    input_difference_weights: tuple[float, ...] = (1000.0, 200.0)
    state_bounds: tuple[tuple[float, float], ...] = ((-1.0, 45.0), (-4.0, 4.0), (-1.5, 1.5))
    input_bounds: tuple[tuple[float, float], ...] = ((-0.55, 0.55), (-1.0, 1.0))
    lateral_acceleration_mps2: float = 8.5
    terminal_box: tuple[float, ...] = (8.0, 4.0, 1.5, 8.0, 8.0, 0.8)

    def __post_init__(self) -> None:
        for name, smallest in (("horizon_steps", 2), ("integrator_steps", 1)):
            if getattr(self, name) < smallest:
                raise ProblemError(f"{name} = {getattr(self, name)}: at least {smallest}")
        if not 0.0 < self.sample_time_s < 1.0:
            raise ProblemError(f"sample_time_s = {self.sample_time_s}: between 0 and 1 s")
        if not 0.0 < self.lateral_acceleration_mps2 < np.inf:
            raise ProblemError(f"lateral_acceleration_mps2 = {self.lateral_acceleration_mps2}: above 0 and finite")
        n_states, n_inputs = self.model.n_states, self.model.n_inputs
        for name, most, least in (
            ("state_weights", n_states, 1),
            ("terminal_weights", n_states, 1),
            ("input_weights", n_inputs, n_inputs),
            ("input_difference_weights", n_inputs, n_inputs),
            ("terminal_box", n_states, 0),
        ):
            values = getattr(self, name)
            if not least <= len(values) <= most or not all(0.0 <= value < np.inf for value in values):
                raise ProblemError(f"{name} = {values}: {most} finite numbers at most, {least} at least, none negative")
        for name, size in (("state_bounds", len(self.model.bounded)), ("input_bounds", n_inputs)):
            bounds = getattr(self, name)
            if len(bounds) != size or not all(lower <= upper for lower, upper in bounds):
                raise ProblemError(f"{name} = {bounds}: {size} pairs, the smallest not above the largest")

    @property
    def layout(self) -> "Layout":
        """Where things lie in the vectors of this problem."""
        return _layout(self.horizon_steps, self.model.n_states, self.model.n_inputs)

    def generated(self) -> dict[str, Any]:
        """What is written into the generated code; all others are given at every solve."""
        numbers = {name: getattr(self, name) for name in ("horizon_steps", "sample_time_s", "integrator_steps")}
        return numbers | {"model": _as_data(self.model)}


@dataclass(frozen=True)
class Horizon:
    """What the car is to follow over the horizon; row k belongs to the shooting node k, N+1 of them.

    Args:
        reference: reference states, shape (N+1, 6); further states of the model have the reference zero.
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

    Decision variables: x_0, u_0, x_1, u_1, ..., x_N. Constraints: the N gaps of the shooting nodes, then one corridor row for
    each of the nodes 1 to N. Parameters: the references x_ref,0 to x_ref,N, the path's normals at the nodes 1 to N, the
    previous input, then the diagonals of Q, Q_N, R and S.
    """

    horizon_steps: int
    n_states: int
    n_inputs: int

    @property
    def n_variables(self) -> int:
        """Decision variables."""
        return self.horizon_steps * (self.n_states + self.n_inputs) + self.n_states

    @property
    def n_gaps(self) -> int:
        """Rows of the multiple-shooting gaps."""
        return self.horizon_steps * self.n_states

    @property
    def n_constraints(self) -> int:
        """Rows of the constraint vector."""
        return self.n_gaps + self.horizon_steps

    @property
    def parameter_sizes(self) -> tuple[int, ...]:
        """Sizes of the parts of the parameter vector, in their order."""
        N, nx, nu = self.horizon_steps, self.n_states, self.n_inputs
        return (N + 1) * nx, 2 * N, nu, nx, nx, nu, nu

    @property
    def n_parameters(self) -> int:
        """Parameters of the programme."""
        return sum(self.parameter_sizes)

    @cached_property
    def state_index(self) -> NDArray[np.int64]:
        """Place of each state among the decision variables, shape (N+1, n_states)."""
        first = np.arange(self.horizon_steps + 1)[:, None] * (self.n_states + self.n_inputs)
        return first + np.arange(self.n_states)

    @cached_property
    def input_index(self) -> NDArray[np.int64]:
        """Place of each input among the decision variables, shape (N, n_inputs)."""
        return self.state_index[:-1, -1:] + 1 + np.arange(self.n_inputs)


_layout = cache(Layout)
_as_data = cache(asdict)  # asked for in every cycle


def pack_parameters(out: Array, horizon: Horizon, previous_input: Array, options: OcpOptions) -> None:
    """Write the parameters of the programme into `out`, shape (n_parameters,)."""
    n_states = options.model.n_states
    np.concatenate(
        (
            full_reference(horizon, n_states).ravel(),
            horizon.normals()[1:].ravel(),
            previous_input,
            _padded(options.state_weights, n_states, 0.0),
            _padded(options.terminal_weights, n_states, 0.0),
            options.input_weights,
            options.input_difference_weights,
        ),
        out=out,
    )


def full_reference(horizon: Horizon, n_states: int) -> Array:
    """References of all states of the model, shape (N+1, n_states)."""
    reference = horizon.reference
    return np.pad(reference, ((0, 0), (0, n_states - reference.shape[1]))) if reference.shape[1] < n_states else reference


def pack_variable_bounds(lower: Array, upper: Array, state: Array, horizon: Horizon, options: OcpOptions) -> None:
    """Write the bounds of the decision variables: initial state pinned, state and input bounds, grip, terminal set."""
    layout, model = options.layout, options.model
    reference = full_reference(horizon, model.n_states)
    box = np.array(_padded(options.terminal_box, model.n_states, np.inf))
    for out, side, sign in ((lower, 0, -1.0), (upper, 1, 1.0)):
        bounds = np.full((layout.horizon_steps, model.n_states), sign * np.inf)
        bounds[:, model.bounded_index] = [pair[side] for pair in options.state_bounds]
        out[layout.state_index[:-1]] = bounds
        out[layout.state_index[0]] = state
        out[layout.state_index[-1]] = reference[-1] + sign * box
        out[layout.input_index] = [pair[side] for pair in options.input_bounds]
    if {"v_x", "omega"} <= set(model.bounded):
        yaw_rate = layout.state_index[1:-1, model.states.index("omega")]
        grip = options.lateral_acceleration_mps2 / np.maximum(reference[1:-1, model.states.index("v_x")], SLOWEST_GRIP_MPS)
        lower[yaw_rate] = np.maximum(lower[yaw_rate], -grip)
        upper[yaw_rate] = np.minimum(upper[yaw_rate], grip)


def pack_constraint_bounds(lower: Array, upper: Array, horizon: Horizon, layout: Layout) -> None:
    """Write the bounds of the constraint rows: closed gaps, and the corridor."""
    lower[: layout.n_gaps] = upper[: layout.n_gaps] = 0.0
    lower[layout.n_gaps :] = -horizon.right_m[1:]
    upper[layout.n_gaps :] = horizon.left_m[1:]


def _padded(values: tuple[float, ...], size: int, filler: float) -> tuple[float, ...]:
    return (*values, *(filler for _ in range(size - len(values))))
