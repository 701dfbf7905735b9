"""The stage functions: one sample of the model with its derivatives, as CasADi functions for `emit`.

The model does not know where it is nor where north is: turning the ground frame turns position and heading of the answer and nothing
else. So the Runge-Kutta steps start from position and heading zero (the stage frame), their derivatives are taken with respect to the
inner variables alone (all states but X, Y and psi, and the inputs), and the rotation by psi is put around the result. The map is the
same, rounding apart.

A Runge-Kutta method is linear but for its evaluations k_i = f(x_i, u). So the second derivative of lam' y, where y is the state at the
end, is the sum over i of V_i' B_i V_i, where V_i is the derivative of (x_i, u) with respect to the inner variables, and B_i the
Hessian of f weighted with the adjoint of k_i. That is half the work of differentiating the whole map twice.
"""

from dataclasses import dataclass

import casadi as ca

from controller.integrator import Expression
from controller.ocp import equations
from controller.problem import Model, OcpOptions
from dbc.vehicle import ModelParameters

RK4_OFFSETS = (0.0, 1 / 2, 1 / 2, 1.0)
RK4_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
"""Of the classical Runge-Kutta method: x_i = x + h offset_i k_i-1, and x after the step is x + h sum of weight_i k_i."""


_NOTHING: Expression = 0.0


@dataclass(frozen=True)
class StageParts:
    """What one sample is made of, as SX functions. The method of Runge and Kutta that puts them together is in `c/stage.c`.

    Args:
        begin: (z, lam) to y, u, sensitivity, bar, turn: state and input in the stage frame, the derivative of that state with respect
            to the inner variables, the multiplier lam of the next state as seen from there, (cos psi, sin psi).
        plain: the model at a point, (point, u) to k = f(point, u); and back through it, k_bar to (point_bar, input_bar), the gradient
            of k_bar' f.
        curved: the same, and sensitivity, the derivative of the point, to k_sensitivity, that of k; and curvature to curvature_sum:
            added is the second derivative of k_bar' f with respect to the inner variables, lower triangle.
        plain_end: (lam, turn, z, y, bar, u_bar) to x_next and the gradient of lam' x_next, from y, the state at the end, and its
            adjoint at the start.
        curved_end: (lam, turn, z, y, sensitivity, curvature) to x_next, the nonzeros of its Jacobian with respect to z, and those of
            the lower triangle of the Hessian of lam' x_next.
    """

    begin: ca.Function
    plain: ca.Function
    curved: ca.Function
    plain_end: ca.Function
    curved_end: ca.Function


def stage_parts(car: ModelParameters, model: Model) -> StageParts:
    """The parts of one sample."""
    places = _Places.of(model)
    pattern = ca.Sparsity.triplet(places.n_states, len(places.inner), places.inner_states, list(range(len(places.inner_states))))
    while True:  # what is zero at the start and after an evaluation is zero everywhere
        plain, curved = _evaluations(places, pattern, car, model)
        after = pattern.unite(curved.sparsity_out("k_sensitivity"))
        if after == pattern:
            break
        pattern = after
    curved_end = _curved_end(places, pattern, curved.sparsity_in("curvature"))
    return StageParts(_begin(places, pattern), plain, curved, _plain_end(places), curved_end)


def stage_functions(car: ModelParameters, options: OcpOptions) -> list[ca.Function]:
    """The whole sample in one, SX functions of z = (x, u) and of the multiplier lam of the next state.

    Returns:
        `stage_adjoint`: (z, lam) to x_next and J' lam, where J is the Jacobian of x_next.
        `stage_derivatives`: (z, lam) to x_next, the nonzeros of J and those of the lower triangle of the Hessian of lam' x_next.
    """
    parts, model = stage_parts(car, options.model), options.model
    inputs = {"z": ca.SX.sym("z", model.n_states + model.n_inputs), "lam": ca.SX.sym("lam", model.n_states)}
    values = inputs | parts.begin.call(inputs)
    values |= _there_and_back(parts.curved, values, options)
    plain, curved = (part.call({name: values[name] for name in part.name_in()}) for part in (parts.plain_end, parts.curved_end))
    return [
        _simplified("stage_adjoint", inputs, {name: plain[name] for name in parts.plain_end.name_out()}),
        _simplified("stage_derivatives", inputs, {name: curved[name] for name in parts.curved_end.name_out()}),
    ]


def _there_and_back(curved: ca.Function, start: dict[str, Expression], options: OcpOptions) -> dict[str, Expression]:
    """The Runge-Kutta steps of `c/stage.c` forwards, then their adjoints backwards."""
    h = options.sample_time_s / options.integrator_steps
    y, sensitivity, u = start["y"], start["sensitivity"], start["u"]
    points: list[dict[str, Expression]] = []
    for _ in range(options.integrator_steps):
        k, k_sensitivity, y_after, sensitivity_after = _NOTHING, _NOTHING, y, sensitivity
        for offset, weight in zip(RK4_OFFSETS, RK4_WEIGHTS, strict=True):
            points.append({"u": u, "point": y + h * offset * k, "sensitivity": sensitivity + h * offset * k_sensitivity})
            there = curved.call(points[-1])
            k, k_sensitivity = there["k"], there["k_sensitivity"]
            y_after, sensitivity_after = y_after + h * weight * k, sensitivity_after + h * weight * k_sensitivity
        y, sensitivity = y_after, sensitivity_after

    bar, u_bar, curvature = start["bar"], _NOTHING, _NOTHING
    for _ in range(options.integrator_steps):
        later_bar, later_offset, bar_before = _NOTHING, 0.0, bar
        for offset, weight in zip(reversed(RK4_OFFSETS), reversed(RK4_WEIGHTS), strict=True):
            k_bar = h * weight * bar + h * later_offset * later_bar
            back = curved.call(points.pop() | {"k_bar": k_bar, "curvature": curvature})
            later_bar, later_offset, curvature = back["point_bar"], offset, back["curvature_sum"]
            bar_before, u_bar = bar_before + later_bar, u_bar + back["input_bar"]
        bar = bar_before
    return {"y": y, "sensitivity": sensitivity, "bar": bar, "u_bar": u_bar, "curvature": curvature}


@dataclass(frozen=True)
class _Places:
    """Places in the stage vector z = (x, u).

    Args:
        inner_states: states but X, Y and psi.
    """

    n_states: int
    n_inputs: int
    X: int
    Y: int
    psi: int
    inner_states: list[int]

    @classmethod
    def of(cls, model: Model) -> "_Places":
        X, Y, psi = (model.states.index(name) for name in ("X", "Y", "psi"))
        return cls(model.n_states, model.n_inputs, X, Y, psi, [i for i in range(model.n_states) if i not in {X, Y, psi}])

    @property
    def n_stage(self) -> int:
        """Size of z."""
        return self.n_states + self.n_inputs

    @property
    def inner(self) -> list[int]:
        """The inner variables: states, then inputs."""
        return [*self.inner_states, *range(self.n_states, self.n_stage)]


def _begin(places: _Places, pattern: ca.Sparsity) -> ca.Function:
    z, lam = ca.SX.sym("z", places.n_stage), ca.SX.sym("lam", places.n_states)
    c, s = ca.cos(z[places.psi]), ca.sin(z[places.psi])
    y, sensitivity, bar = ca.SX.zeros(places.n_states), ca.SX.zeros(pattern), ca.SX(lam)
    for column, component in enumerate(places.inner_states):
        y[component], sensitivity[component, column] = z[component], 1.0
    bar[places.X], bar[places.Y] = c * lam[places.X] + s * lam[places.Y], c * lam[places.Y] - s * lam[places.X]
    outputs = {"y": y, "u": z[places.n_states :], "sensitivity": sensitivity, "bar": bar, "turn": ca.vertcat(c, s)}
    return _function("stage_begin", {"z": z, "lam": lam}, outputs)


def _evaluations(places: _Places, pattern: ca.Sparsity, car: ModelParameters, model: Model) -> tuple[ca.Function, ca.Function]:
    """The functions `plain` and `curved` of `StageParts`.

    Args:
        pattern: of the sensitivity.
    """
    n_states, n_inputs, n_inner = places.n_states, places.n_inputs, len(places.inner)
    point, u, k_bar = ca.SX.sym("point", n_states), ca.SX.sym("u", n_inputs), ca.SX.sym("k_bar", n_states)
    k, z = equations(model)(point, u, car), ca.vertcat(point, u)
    jacobian = ca.jacobian(k, z)
    gradient = ca.densify(jacobian.T @ k_bar)
    inputs = {"u": u, "point": point, "k_bar": k_bar}
    outputs = {"k": k, "point_bar": gradient[:n_states], "input_bar": gradient[n_states:]}

    sensitivity = ca.SX.sym("sensitivity", pattern)
    along = ca.vertcat(sensitivity, ca.horzcat(ca.SX(n_inputs, n_inner - n_inputs), ca.SX.eye(n_inputs)))
    added = ca.tril(along.T @ (ca.hessian(ca.dot(k_bar, k), z)[0] @ along))
    curvature = ca.SX.sym("curvature", added.sparsity())
    curved_inputs = inputs | {"sensitivity": sensitivity, "curvature": curvature}
    k_sensitivity = jacobian @ along
    k_sensitivity = ca.project(k_sensitivity, pattern.unite(k_sensitivity.sparsity()))
    curved_outputs = outputs | {"k_sensitivity": k_sensitivity, "curvature_sum": curvature + added}
    return _function("plain", inputs, outputs), _function("curved", curved_inputs, curved_outputs)


def _plain_end(places: _Places) -> ca.Function:
    inputs, x_next, along, across = _at_end(places)
    lam, bar, u_bar = inputs["lam"], ca.SX.sym("bar", places.n_states), ca.SX.sym("u_bar", places.n_inputs)
    adjoint = ca.vertcat(bar, u_bar)
    adjoint[places.X], adjoint[places.Y] = lam[places.X], lam[places.Y]
    adjoint[places.psi] = lam[places.psi] - lam[places.X] * across + lam[places.Y] * along
    return _function("plain_end", inputs | {"bar": bar, "u_bar": u_bar}, {"x_next": x_next, "adjoint": adjoint})


def _curved_end(places: _Places, of_sensitivity: ca.Sparsity, of_curvature: ca.Sparsity) -> ca.Function:
    inputs, x_next, *way = _at_end(places)
    sensitivity, curvature = ca.SX.sym("sensitivity", of_sensitivity), ca.SX.sym("curvature", of_curvature)
    jacobian = ca.sparsify(_jacobian(places, sensitivity, inputs["turn"], way))
    hessian = ca.sparsify(_hessian(places, curvature, jacobian, inputs["lam"], way))
    outputs = {"x_next": x_next, "jacobian": jacobian, "hessian": ca.tril(hessian)}
    return _function("curved_end", inputs | {"sensitivity": sensitivity, "curvature": curvature}, outputs)


def _at_end(places: _Places) -> tuple[dict[str, Expression], Expression, Expression, Expression]:
    """Inputs that both ends have; x_next; and the car's way along X and Y."""
    lam, turn, z = ca.SX.sym("lam", places.n_states), ca.SX.sym("turn", 2), ca.SX.sym("z", places.n_stage)
    y, c, s = ca.SX.sym("y", places.n_states), turn[0], turn[1]
    along, across = c * y[places.X] - s * y[places.Y], s * y[places.X] + c * y[places.Y]
    x_next = ca.SX(y)
    x_next[places.X], x_next[places.Y], x_next[places.psi] = z[places.X] + along, z[places.Y] + across, z[places.psi] + y[places.psi]
    return {"lam": lam, "turn": turn, "z": z, "y": y}, x_next, along, across


def _jacobian(places: _Places, inner: Expression, turn: Expression, way: list[Expression]) -> Expression:
    """Jacobian of x_next, shape (n_states, n_stage), from that in the stage frame, shape (n_states, n_inner)."""
    X, Y, psi, (along, across), c, s = places.X, places.Y, places.psi, way, turn[0], turn[1]
    jacobian = ca.SX(places.n_states, places.n_stage)
    for column, component in enumerate(places.inner):
        for row in (*places.inner_states, psi):
            jacobian[row, component] = inner[row, column]
        jacobian[X, component] = c * inner[X, column] - s * inner[Y, column]
        jacobian[Y, component] = s * inner[X, column] + c * inner[Y, column]
    for component in (X, Y, psi):
        jacobian[component, component] = 1
    jacobian[X, psi], jacobian[Y, psi] = -across, along
    return jacobian


def _hessian(places: _Places, inner: Expression, jacobian: Expression, lam: Expression, way: list[Expression]) -> Expression:
    """Hessian of lam' x_next, from the lower triangle of that in the stage frame and the Jacobian in the ground frame."""
    X, Y, psi, (along, across) = places.X, places.Y, places.psi, way
    hessian = ca.SX(places.n_stage, places.n_stage)
    for i, row in enumerate(places.inner):
        for j, column in enumerate(places.inner):
            hessian[row, column] = inner[max(i, j), min(i, j)]
        hessian[row, psi] = hessian[psi, row] = lam[Y] * jacobian[X, row] - lam[X] * jacobian[Y, row]
    hessian[psi, psi] = -lam[X] * along - lam[Y] * across
    return hessian


def _function(name: str, inputs: dict[str, Expression], outputs: dict[str, Expression]) -> ca.Function:
    return ca.Function(name, list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))


def _simplified(name: str, inputs: dict[str, Expression], outputs: dict[str, Expression]) -> ca.Function:
    """A function whose common subexpressions are computed once."""
    return _function(name, inputs, dict(zip(outputs, ca.cse(list(outputs.values())), strict=True)))
