"""The controller's heart: one step of the 25 Hz cycle, from a measured state to a command."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from controller.delay import actuation_delays_s
from controller.disturbance import DisturbanceOptions
from controller.estimator import StateEstimator
from controller.fallback import Fallback, Plan
from controller.planning.obstacles import Obstacle
from controller.planning.planner import Planner, PlannerOptions, lateral_offset
from controller.planning.reference import ReferencePath
from controller.problem import N_CAR_STATES, SINGLE_TRACK_LAG, Array, Horizon, Model, OcpOptions
from controller.solver import Solver, SolveResult, SolveStatus
from dbc.vehicle import Vehicle
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS, ControlCommand, Mode, VehicleState

DRIVE_MODEL: Model = SINGLE_TRACK_LAG
"""The model that drives where nobody chooses another."""

_PLAUSIBLE_STATE = np.array((100.0, 50.0, 10.0, 1e6, 1e6, 1e6))
"""Largest state that a car on a site can have; beyond it numbers are wrong, not large."""
_PLAUSIBLE_INPUT = np.array((2.0, 10.0))

_STANDSTILL_MPS = 0.5
"""Speed below which a car that is to stand is braked to rest: what `PlannerOptions.crawl_mps` arrives with."""
_HOLD_DRIVE_NORM = -1.0
"""Brake that holds a standing car, on slopes up to 30 %: as the gateway's own after a safe stop."""
_HOLD_RATE_PER_S = 2.0
"""Rate at which it is pressed: the car stands, there is no hurry."""
_RELEASE_CYCLES = 8
"""Cycles in a row that must ask for motion before the brake is released: noise on a standing object must not saw at it."""


@dataclass(frozen=True)
class NmpcOptions:
    """Numbers of the control loop.

    Args:
        delays_s: time from a command to its effect, of steering and drive [s]; None takes `delay.actuation_delays_s` of the vehicle.
        max_state_age_ns: age from which a measured state is not planned from [ns]; the gateway refuses answers to such states.
        deadline_ns: solve time from which an answer is too late [ns]; None where time is virtual.
        disturbance: of the observer; None drives without one.
    """

    delays_s: tuple[float, float] | None = None
    max_state_age_ns: int = 100_000_000
    deadline_ns: int | None = None
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    disturbance: DisturbanceOptions | None = field(default_factory=DisturbanceOptions)


@dataclass(frozen=True)
class Solution:
    """What was solved in a cycle, and the answer.

    The drive in it contains the disturbance: it is what the model would need for the acceleration that is planned.

    Args:
        start: predicted state at the moment when the command acts, shape (n_states,).
        horizon: what was to be followed.
    """

    start: Array
    horizon: Horizon
    result: SolveResult

    @property
    def lateral_error_m(self) -> float:
        """To the left of the path [m]."""
        return lateral_offset(self.start, self.horizon)

    @property
    def heading_error_rad(self) -> float:
        """From the path's heading, counter-clockwise [rad]."""
        return math.remainder(float(self.start[2] - self.horizon.reference[0, 2]), 2.0 * math.pi)

    @property
    def speed_error_mps(self) -> float:
        """Above the reference speed [m/s]."""
        return float(self.start[0] - self.horizon.reference[0, 0])


@dataclass(frozen=True)
class NmpcOutput:
    """A command and how it came about.

    Args:
        plan: what is commanded.
        solution: None when there was no state to plan from.
        disturbance_mps2: acceleration that the model does not explain, as estimated [m/s2].
    """

    command: ControlCommand
    plan: Plan
    solution: Solution | None
    disturbance_mps2: float


class Nmpc:
    """The paper's controller on one path, with any model of a car.

    Raises:
        ValueError: the solver's horizon is not the one that a command carries, or its model is not one of a car.
    """

    def __init__(self, solver: Solver, path: ReferencePath, vehicle: Vehicle, boot_id: int, options: NmpcOptions | None = None) -> None:
        ocp = solver.options
        if (ocp.horizon_steps, round(ocp.sample_time_s * 1e9)) != (HORIZON_STEPS, PLAN_PERIOD_NS):
            raise ValueError(f"a command carries {HORIZON_STEPS} steps of {PLAN_PERIOD_NS} ns, the solver plans otherwise")
        self._options = options or NmpcOptions()
        delays_s = actuation_delays_s(vehicle, ocp.model) if self._options.delays_s is None else self._options.delays_s
        self._solver = solver
        self._ocp = ocp
        self._tuning: tuple[OcpOptions, PlannerOptions] | None = None
        self._planner = Planner(path, vehicle.model, ocp, self._options.planner, vehicle.body)
        self._estimator = StateEstimator(solver.advance, vehicle.model, ocp, delays_s, self._options.disturbance)
        self._fallback = Fallback(PLAN_PERIOD_NS, ocp.layout)
        self._boot_id = boot_id
        self._seq = 0
        self._solved_ns: int | None = None
        self._is_holding = False
        self._asked_cycles = 0
        self._last_drive_norm = 0.0
        self._yaw_rad = 0.0
        self._nothing_planned = Plan(0, np.zeros((HORIZON_STEPS + 1, ocp.model.n_states)), np.zeros((HORIZON_STEPS, ocp.model.n_inputs)))

    def tune(self, ocp: OcpOptions, planner: PlannerOptions) -> None:
        """Drive with other numbers from the next step on, all of them at once.

        Raises:
            ValueError: a number that is written into the solver's code differs; nothing is changed.
        """
        if ocp.generated() != self._ocp.generated():
            raise ValueError("model, horizon and sample time are written into the solver's code")
        self._tuning = ocp, planner

    def step(self, state: VehicleState, now_ns: int, objects: Sequence[Obstacle] = ()) -> NmpcOutput:
        """Answer one measured state with one command; what is commanded is always finite.

        Args:
            objects: on the road, in the ground frame, now. One that cannot be true makes the step fail as a bad state does.
        """
        self._apply_tuning()
        measured = np.array((state.vx_mps, state.vy_mps, state.yaw_rate_radps, state.x_m, state.y_m, self._unwrapped(state.yaw_rad)))
        acting = np.array((state.steer_rad, state.drive_norm))
        if not self._is_usable(state, measured, acting, now_ns) or not all(thing.is_usable for thing in objects):
            return self._answer(state, now_ns, None)
        self._observe(state, measured, acting)
        start = self._estimator.predict(now_ns)
        elapsed_s = 0.0 if self._solved_ns is None else max(0, now_ns - self._solved_ns) * 1e-9
        horizon = self._planner.horizon(start[:N_CAR_STATES], elapsed_s, objects)
        result = self._solve(start, horizon, now_ns)
        self._solved_ns, self._yaw_rad = now_ns, float(measured[5])
        self._decide_hold(state, horizon)
        return self._answer(state, now_ns, Solution(start, horizon, result))

    def _apply_tuning(self) -> None:
        tuning, self._tuning = self._tuning, None
        if tuning is not None:
            self._ocp, self._planner.options = tuning

    def _observe(self, state: VehicleState, measured: Array, acting: Array) -> None:
        """Tell the estimator what is measured, and who has driven until now."""
        if state.mode is not Mode.ENGAGED or self._solved_ns is None:  # someone else: what is measured is what acts
            self._estimator.restart(measured, acting, state.t_ns)
            self._planner.reset()
        elif self._is_holding:  # in the model a brake drives a standing car backwards
            self._estimator.hold(measured, acting * (1.0, 0.0), state.t_ns)
        else:
            self._estimator.observe(measured, acting, state.t_ns)

    def _decide_hold(self, state: VehicleState, horizon: Horizon) -> None:
        """Hold a car that is to stand; release it when motion has been asked for in every cycle of a while."""
        self._asked_cycles = self._asked_cycles + 1 if horizon.reference[:, 0].any() else 0
        if state.mode is not Mode.ENGAGED or self._asked_cycles >= _RELEASE_CYCLES:
            self._is_holding = False
        elif self._asked_cycles == 0 and abs(state.vx_mps) < _STANDSTILL_MPS:
            self._is_holding = True

    def _solve(self, start: Array, horizon: Horizon, now_ns: int) -> SolveResult:
        self._solver.options = self._shifted_options()
        self._solver.warm_start = self._fallback.guess(now_ns)
        result = self._solver.solve(start, self._estimator.previous_input, horizon)
        self._solver.options = self._ocp
        if result.status is SolveStatus.CONVERGED:
            self._fallback.prime(now_ns, self._solver.warm_start)
        return result

    def _shifted_options(self) -> OcpOptions:
        """The problem in terms of the model's input, which contains the disturbance."""
        shift = self._estimator.input_shift
        if not shift.any():
            return self._ocp
        bounds = tuple((lower + s, upper + s) for (lower, upper), s in zip(self._ocp.input_bounds, shift.tolist(), strict=True))
        return replace(self._ocp, input_bounds=bounds)

    def _commanded(self, now_ns: int, result: SolveResult) -> Plan:
        """The plan as commands: without the disturbance, within the bounds; a car that is to stand is held, whatever they are."""
        inputs = np.clip(result.inputs - self._estimator.input_shift, *np.transpose(self._ocp.input_bounds))
        if self._is_holding:
            pressed = self._last_drive_norm - _HOLD_RATE_PER_S * 1e-9 * PLAN_PERIOD_NS * np.arange(1, HORIZON_STEPS + 1)
            inputs[:, 1] = np.clip(pressed, _HOLD_DRIVE_NORM, 0.0)
        return Plan(now_ns, result.states, inputs)

    def _answer(self, state: VehicleState, now_ns: int, solution: Solution | None) -> NmpcOutput:
        if solution is not None and self._is_in_time(solution.result) and solution.result.status is SolveStatus.CONVERGED:
            status, plan = self._fallback.accept(self._commanded(now_ns, solution.result))
        else:
            status, plan = self._fallback.substitute(now_ns, self._nothing_planned)
        self._estimator.commanded(now_ns, plan.inputs[0])
        self._last_drive_norm = float(plan.inputs[0, 1])
        self._seq += 1
        steer_rad, drive_norm = plan.inputs.T.tolist()
        solve_time_ns = 0 if solution is None else solution.result.solve_time_ns
        command = ControlCommand(
            self._boot_id, self._seq, state.seq, now_ns, status, solve_time_ns,
            0.0 if solution is None else solution.lateral_error_m, 0.0 if solution is None else solution.heading_error_rad,
            steer_rad[0], drive_norm[0], tuple(steer_rad), tuple(drive_norm),
        )  # fmt: skip
        return NmpcOutput(command, plan, solution, self._estimator.disturbance_mps2)

    def _is_usable(self, state: VehicleState, measured: Array, acting: Array, now_ns: int) -> bool:
        is_fresh = abs(now_ns - state.t_ns) <= self._options.max_state_age_ns
        # Comparisons with NaN are false.
        return (
            state.is_valid
            and is_fresh
            and bool((np.abs(measured) <= _PLAUSIBLE_STATE).all() and (np.abs(acting) <= _PLAUSIBLE_INPUT).all())
        )

    def _is_in_time(self, result: SolveResult) -> bool:
        return self._options.deadline_ns is None or result.solve_time_ns <= self._options.deadline_ns

    def _unwrapped(self, yaw_rad: float) -> float:
        """The heading, with the whole turns that make it continuous; a jump of 2 pi would spoil the warm start."""
        return self._yaw_rad + math.remainder(yaw_rad - self._yaw_rad, 2.0 * math.pi) if math.isfinite(yaw_rad) else yaw_rad
