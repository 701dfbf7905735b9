"""The controller's heart: one step of the 25 Hz cycle, from a measured state to a command."""

import math
from dataclasses import dataclass, field

import numpy as np

from controller.delay import DelayCompensator, actuation_delay_s
from controller.fallback import Fallback, Plan
from controller.planner import Planner, PlannerOptions, lateral_offset
from controller.problem import N_CAR_STATES, Array, Horizon
from controller.reference import ReferencePath
from controller.solver import Solver, SolveResult, SolveStatus
from dbc.vehicle import Vehicle
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS, ControlCommand, Mode, VehicleState

_PLAUSIBLE_STATE = np.array((100.0, 50.0, 10.0, 1e6, 1e6, 1e6))
"""Largest state that a car on a site can have; beyond it numbers are wrong, not large."""
_PLAUSIBLE_INPUT = np.array((2.0, 10.0))


@dataclass(frozen=True)
class NmpcOptions:
    """Numbers of the control loop.

    Args:
        delay_s: time from a command to its effect [s]; None takes `delay.actuation_delay_s` of the vehicle.
        max_state_age_ns: age from which a measured state is not planned from [ns]; the gateway refuses answers to such states.
        deadline_ns: solve time from which an answer is too late [ns]; None where time is virtual.
    """

    delay_s: float | None = None
    max_state_age_ns: int = 100_000_000
    deadline_ns: int | None = None
    planner: PlannerOptions = field(default_factory=PlannerOptions)


@dataclass(frozen=True)
class Solution:
    """What was solved in a cycle, and the answer.

    Args:
        start: predicted state at the moment when the command acts, shape (6,).
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
    def speed_error_mps(self) -> float:
        """Above the reference speed [m/s]."""
        return float(self.start[0] - self.horizon.reference[0, 0])


@dataclass(frozen=True)
class NmpcOutput:
    """A command and how it came about.

    Args:
        plan: what is commanded.
        solution: None when there was no state to plan from.
    """

    command: ControlCommand
    plan: Plan
    solution: Solution | None


class Nmpc:
    """The paper's controller on one path.

    Raises:
        ValueError: the solver's horizon is not the one that a command carries.
    """

    def __init__(self, solver: Solver, path: ReferencePath, vehicle: Vehicle, boot_id: int, options: NmpcOptions | None = None) -> None:
        ocp = solver.options
        if (ocp.horizon_steps, round(ocp.sample_time_s * 1e9)) != (HORIZON_STEPS, PLAN_PERIOD_NS):
            raise ValueError(f"a command carries {HORIZON_STEPS} steps of {PLAN_PERIOD_NS} ns, the solver plans otherwise")
        self._options = options or NmpcOptions()
        delay_s = actuation_delay_s(vehicle) if self._options.delay_s is None else self._options.delay_s
        self._solver = solver
        self._planner = Planner(path, vehicle.model, ocp, self._options.planner)
        self._compensator = DelayCompensator(solver.advance, delay_s, ocp.sample_time_s)
        self._fallback = Fallback(PLAN_PERIOD_NS)
        self._boot_id = boot_id
        self._seq = 0
        self._solved_ns: int | None = None
        self._yaw_rad = 0.0
        self._nothing_planned = Plan(0, np.zeros((HORIZON_STEPS + 1, N_CAR_STATES)), np.zeros((HORIZON_STEPS, ocp.model.n_inputs)))

    def step(self, state: VehicleState, now_ns: int) -> NmpcOutput:
        """Answer one measured state with one command; what is commanded is always finite."""
        measured = np.array((state.vx_mps, state.vy_mps, state.yaw_rate_radps, state.x_m, state.y_m, self._unwrapped(state.yaw_rad)))
        acting = np.array((state.steer_rad, state.drive_norm))
        if not self._is_usable(state, measured, acting, now_ns):
            return self._answer(state, now_ns, None)
        if state.mode is not Mode.ENGAGED or self._solved_ns is None:  # someone else drives: what is measured is what acts
            self._compensator.restart(acting)
            self._planner.reset()
        start = self._compensator.predict(measured, state.t_ns, now_ns)
        horizon = self._planner.horizon(start, 0.0 if self._solved_ns is None else (now_ns - self._solved_ns) * 1e-9)
        result = self._solver.solve(start, self._compensator.last_input, horizon)
        self._solved_ns, self._yaw_rad = now_ns, float(measured[5])
        return self._answer(state, now_ns, Solution(start, horizon, result))

    def _answer(self, state: VehicleState, now_ns: int, solution: Solution | None) -> NmpcOutput:
        if solution is not None and self._is_in_time(solution.result) and solution.result.status is SolveStatus.CONVERGED:
            status, plan = self._fallback.accept(Plan(now_ns, solution.result.states, solution.result.inputs))
        else:
            status, plan = self._fallback.substitute(now_ns, self._nothing_planned)
        if solution is not None and solution.result.status is not SolveStatus.CONVERGED:
            self._solver.reset()
        self._compensator.commanded(now_ns, plan.inputs[0])
        self._seq += 1
        steer_rad, drive_norm = plan.inputs.T.tolist()
        solve_time_ns = 0 if solution is None else solution.result.solve_time_ns
        command = ControlCommand(
            self._boot_id, self._seq, state.seq, now_ns, status, solve_time_ns,
            steer_rad[0], drive_norm[0], tuple(steer_rad), tuple(drive_norm),
        )  # fmt: skip
        return NmpcOutput(command, plan, solution)

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
