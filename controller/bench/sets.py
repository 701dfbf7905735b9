"""The bench's problems, recorded from closed loops in virtual time: `nominal`, `active` and `hard`.

A recording depends on its seeds, the car, and the answers of one named solver; not on how long that took.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from controller.bench.loop import drive
from controller.bench.scenarios import Case, active_cases, nominal_cases
from controller.nmpc import Nmpc
from controller.problem import N_CAR_STATES, Array, Horizon, OcpOptions, pack_constraint_bounds, pack_parameters, pack_variable_bounds
from controller.solver import NlpBuffers, Solver, SolveResult, SolveStatus, WarmStart
from controller.solvers import make_solver
from dbc.vehicle import Vehicle

NOMINAL_RECORDER = "casadi-c"
"""Solves the loops of the nominal set."""
ACTIVE_RECORDER = "riccati"
"""Solves those of the active set: a solver with a hard corridor has no answer for a car outside of it."""
HARD_KINDS = ("cold", "kicked", "infeasible", "wild")

_AT_BOUND = 1e-5
"""Distance to a bound that counts as none, ten times the solvers' tolerance."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Instance:
    """One recorded problem: what a solver was asked, and from where it began.

    Args:
        kind: name of the case or of the kind of start.
        is_feasible: whether a solver with hard constraints converges; None where nobody has asked.
    """

    state: Array
    previous_input: Array
    horizon: Horizon
    warm_start: WarmStart | None
    kind: str = ""
    is_feasible: bool | None = None


class RecordingSolver:
    """A solver that keeps what it is asked and what it answers.

    Args:
        case: whose horizons are solved in place of the planner's.
    """

    def __init__(self, solver: Solver, case: Case | None = None) -> None:
        self._solver, self._case = solver, case
        self.name, self.options = solver.name, solver.options
        self.advance, self.reset = solver.advance, solver.reset
        self.instances: list[Instance] = []
        self.results: list[SolveResult] = []

    @property
    def warm_start(self) -> WarmStart | None:
        """Of the solver inside."""
        return self._solver.warm_start

    @warm_start.setter
    def warm_start(self, value: WarmStart | None) -> None:
        self._solver.warm_start = value

    @property
    def answer(self) -> WarmStart:
        """Of the solver inside."""
        return self._solver.answer

    def solve(self, state: Array, previous_input: Array, horizon: Horizon) -> SolveResult:
        """Keep the problem, and solve it."""
        if self._case is not None:
            horizon = self._case.edited(state, horizon)
        kind = "" if self._case is None else self._case.name
        self.instances.append(Instance(state.copy(), previous_input.copy(), horizon, self.warm_start, kind))
        self.results.append(self._solver.solve(state, previous_input, horizon))
        return self.results[-1]


def nominal(vehicle: Vehicle, count: int, progress: Progress) -> list[Instance]:
    """Problems of the paper's four scenarios in which no bound is active, equally many from each.

    As in the feasibility study, whose four scenarios met no bound. Nor do ours as they stand; a problem that did would belong to
    the other set, and is left out.
    """
    solver = _recorder(NOMINAL_RECORDER, vehicle, progress)
    free = [i for i, active, _ in _recorded(solver, nominal_cases(), vehicle, progress) if active == 0]
    return _spread(free, count)


def active(vehicle: Vehicle, count: int, progress: Progress) -> list[Instance]:
    """Problems with a bound active in their answer: saturated throttle, tight corridor, cut-in, and a car outside the corridor.

    Equally many of each kind, as far as there are. Feasible are those in which the recording solver, whose bounds are soft,
    violates none, and in which `NOMINAL_RECORDER`, whose bounds are hard, converges.
    """
    solver, hard_solver = _recorder(ACTIVE_RECORDER, vehicle, progress), _recorder(NOMINAL_RECORDER, vehicle, progress)
    found = [(i, violation_m) for i, active, violation_m in _recorded(solver, active_cases(), vehicle, progress) if active > 0]
    chosen = _spread([replace(i, is_feasible=violation <= _AT_BOUND) for i, violation in found], count)
    return [replace(i, is_feasible=_converges(hard_solver, i)) if i.is_feasible else i for i in chosen]


def hard(bases: list[Instance], count: int, seed: int = 1) -> list[Instance]:
    """Starts that no closed loop should meet, made from recorded problems; equally many of each of `HARD_KINDS`.

    Cold: without a guess. Kicked: the state pushed, the guess stale. Infeasible: 0.9 to 2 m outside the corridor, cold. Wild: any
    state near and any input, cold or with a stale guess.
    """
    rng = np.random.default_rng(seed)
    return [_start(HARD_KINDS[n % len(HARD_KINDS)], bases[rng.integers(len(bases))], rng) for n in range(count)]


def beyond_bounds(state: Array, horizon: Horizon, result: SolveResult, options: OcpOptions) -> tuple[Array, Array]:
    """How far a plan is beyond each bound, negative within: states of the nodes 1 to N and corridor at them; inputs."""
    layout, position = options.layout, options.model.position_index
    lower, upper = np.zeros(layout.n_variables), np.zeros(layout.n_variables)
    pack_variable_bounds(lower, upper, state, horizon, options)

    def beyond(values: Array, index: NDArray[np.int64]) -> Array:
        return np.asarray(np.maximum(lower[index] - values, values - upper[index]))

    lateral_m = np.sum(horizon.normals() * (result.states[:, position] - horizon.reference[:, position]), axis=1)
    outside_m = np.maximum(-horizon.right_m - lateral_m, lateral_m - horizon.left_m)
    states = beyond(result.states[1:], layout.state_index[1:])
    return np.concatenate((states.ravel(), outside_m[1:])), beyond(result.inputs, layout.input_index).ravel()


def count_active(state: Array, horizon: Horizon, result: SolveResult, options: OcpOptions) -> tuple[int, float]:
    """Bounds that an answer lies at or beyond, and its largest violation of one; the pinned initial state is no bound."""
    beyond = np.concatenate(beyond_bounds(state, horizon, result, options))
    return int(np.count_nonzero(beyond >= -_AT_BOUND)), max(0.0, float(beyond.max()))


def pack_instance(buffers: NlpBuffers, instance: Instance, options: OcpOptions) -> None:
    """Write parameters and bounds of a problem, and its guess where it has one."""
    b, horizon = buffers, instance.horizon
    pack_parameters(b.p, horizon, instance.previous_input, options)
    pack_variable_bounds(b.lower_w, b.upper_w, instance.state, horizon, options)
    pack_constraint_bounds(b.lower_g, b.upper_g, horizon, options.layout)
    if instance.warm_start is not None:
        b.w0[:], b.lam_w0[:], b.lam_g0[:] = instance.warm_start.w, instance.warm_start.lam_w, instance.warm_start.lam_g
        b.w0[options.layout.state_index[0]] = instance.state


def _recorder(name: str, vehicle: Vehicle, progress: Progress) -> Solver:
    return make_solver(name, vehicle.model, OcpOptions(), progress, clock=lambda: 0)


def _recorded(solver: Solver, cases: tuple[Case, ...], vehicle: Vehicle, progress: Progress) -> list[tuple[Instance, int, float]]:
    """Converged problems of all cases, each with its active bounds and its largest violation."""
    progress(f"recording problems with {solver.name}: {', '.join(dict.fromkeys(case.name for case in cases))}")
    found = []
    for case in cases:
        solver.reset()
        recorder = RecordingSolver(solver, case)
        drive(Nmpc(recorder, case.scenario.path, vehicle, boot_id=1, options=case.nmpc), vehicle, case.scenario, case.seed)
        for instance, result in zip(recorder.instances, recorder.results, strict=True):
            if result.status is SolveStatus.CONVERGED:
                found.append((instance, *count_active(instance.state, instance.horizon, result, solver.options)))
    return found


def _spread(instances: list[Instance], count: int) -> list[Instance]:
    """`count` of them, equally many of each kind as far as there are, evenly spread over each."""
    kinds = [list(group) for _, group in groupby(sorted(instances, key=lambda i: i.kind), key=lambda i: i.kind)]
    chosen: list[Instance] = []
    for left, kind in zip(range(len(kinds), 0, -1), sorted(kinds, key=len), strict=True):
        share = min(len(kind), -(-(count - len(chosen)) // left))
        chosen += [kind[round(i)] for i in np.linspace(0, len(kind) - 1, share)]
    return chosen


def _converges(solver: Solver, instance: Instance) -> bool:
    solver.warm_start = instance.warm_start
    return solver.solve(instance.state, instance.previous_input, instance.horizon).status is SolveStatus.CONVERGED


def _start(kind: str, base: Instance, rng: np.random.Generator) -> Instance:
    state, previous_input, warm_start = base.state.copy(), base.previous_input, base.warm_start
    match kind:
        case "cold":
            warm_start = None
        case "kicked":
            state[:N_CAR_STATES] += rng.standard_normal(N_CAR_STATES) * (1.0, 0.3, 0.15, 0.3, 0.3, 0.08)
        case "infeasible":
            side = rng.choice((-1.0, 1.0))
            edge_m = base.horizon.left_m[0] if side > 0.0 else base.horizon.right_m[0]
            lateral_m = side * (edge_m + rng.uniform(0.9, 2.0))
            normal = base.horizon.normals()[0]
            state[3:5] += normal * (lateral_m - normal @ (state[3:5] - base.horizon.reference[0, 3:5]))
            warm_start = None
        case _:
            state[:N_CAR_STATES] += rng.uniform(-1.0, 1.0, N_CAR_STATES) * (3.0, 1.0, 0.6, 1.5, 1.5, 0.4)
            previous_input = rng.uniform((-0.55, -1.0), (0.55, 1.0))
            warm_start = warm_start if rng.random() < 0.5 else None
    return Instance(state, previous_input, base.horizon, warm_start, kind)
