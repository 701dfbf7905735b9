"""Telemetry samples of the controller, made from what a step puts out."""

from collections import Counter
from dataclasses import dataclass

from controller.nmpc import NmpcOutput, Solution
from controller.parameters import Entry
from controller.problem import Array
from controller.solver import Effort
from gateway.telemetry import CommandSample, ParametersSample, PlanSample, ProfileSample

UNKNOWN = -1
PROFILE_PERIOD_NS = 200_000_000
"""Shortest time between two profiles [ns]."""


@dataclass(frozen=True)
class Circumstances:
    """What a step was made with, besides the state.

    Args:
        parameters_version: of the parameters in force.
        objects: how many objects the planner was given.
        objects_rejected: things on the topic of the objects that were none, since the start.
        controller_sha256: of all that the controller decides with.
    """

    parameters_version: int = 0
    objects: int = 0
    objects_rejected: int = 0
    controller_sha256: str = ""


def command_sample(output: NmpcOutput, solver_name: str, step_time_ns: int, made_with: Circumstances = Circumstances()) -> CommandSample:
    """The command and how the solver came to it; residuals are -1 when nothing finite was solved."""
    command, solution = output.command, output.solution
    result = solution.result if solution else None
    effort = result.effort if result else Effort()
    has_residuals = result is not None and result.primal_residual == result.primal_residual  # JSON knows no NaN
    return CommandSample(
        t_ns=command.t_ns,
        seq=command.seq,
        state_seq=command.state_seq,
        status=command.status.name,
        solver=solver_name,
        steer_rad=command.steer_rad,
        drive_norm=command.drive_norm,
        solve_time_ms=command.solve_time_ns * 1e-6,
        step_time_ms=step_time_ns * 1e-6,
        sqp_iterations=UNKNOWN if effort.sqp_iterations is None else effort.sqp_iterations,
        qp_iterations=UNKNOWN if effort.qp_iterations is None else effort.qp_iterations,
        work=UNKNOWN if effort.work is None else effort.work,
        primal_residual=result.primal_residual if result and has_residuals else -1.0,
        dual_residual=result.dual_residual if result and has_residuals else -1.0,
        lateral_error_m=solution.lateral_error_m if solution else 0.0,
        speed_error_mps=solution.speed_error_mps if solution else 0.0,
        disturbance_mps2=output.disturbance_mps2,
        parameters_version=made_with.parameters_version,
        objects=made_with.objects,
        objects_rejected=made_with.objects_rejected,
        controller_sha256=made_with.controller_sha256,
    )


def parameters_sample(entry: Entry, now_ns: int) -> ParametersSample:
    """A change of the parameters that is in force from the cycle at `now_ns` on."""
    return ParametersSample(
        t_ns=now_ns, seq=entry.version, version=entry.version, accepted_ns=entry.accepted_ns, who=entry.who,
        changes=entry.changes, reverts=entry.reverts,
    )  # fmt: skip


class ProfileMeter:
    """Adds up where the solver spends its time, for a sample a few times a second.

    Args:
        solver_name: for the sample.
    """

    def __init__(self, solver_name: str) -> None:
        self._solver_name = solver_name
        self._seq = 0
        self._next_ns = 0
        self._clear()

    def _clear(self) -> None:
        self._cycles = 0
        self._time_ns: Counter[str] = Counter()
        self._calls: Counter[str] = Counter()

    def add(self, output: NmpcOutput, now_ns: int) -> ProfileSample | None:
        """Take one cycle; a sample of the cycles since the last one when it is time, and the solver tells."""
        profile = output.solution.result.effort.profile if output.solution else None
        if profile is None:
            return None
        self._cycles += 1
        for name, part in profile.items():
            self._time_ns[name] += part.time_ns
            self._calls[name] += part.calls
        if now_ns < self._next_ns:
            return None
        sample = ProfileSample(
            t_ns=now_ns, seq=self._seq, solver=self._solver_name, cycles=self._cycles,
            time_us={name: time_ns * 1e-3 / self._cycles for name, time_ns in self._time_ns.items()},
            calls={name: calls / self._cycles for name, calls in self._calls.items()},
        )  # fmt: skip
        self._seq, self._next_ns = self._seq + 1, now_ns + PROFILE_PERIOD_NS
        self._clear()
        return sample


def plan_sample(output: NmpcOutput) -> PlanSample | None:
    """Predicted trajectory, reference and corridor; None when there was nothing to plan from."""
    return None if output.solution is None else _plan_sample(output, output.solution)


def _plan_sample(output: NmpcOutput, solution: Solution) -> PlanSample:
    horizon, states = solution.horizon, output.plan.states
    positions, normals = horizon.reference[:, 3:5], horizon.normals()
    left, right = positions + horizon.left_m[:, None] * normals, positions - horizon.right_m[:, None] * normals

    def column(values: Array, index: int) -> list[float]:
        listed: list[float] = values[:, index].tolist()
        return listed

    return PlanSample(
        t_ns=output.command.t_ns,
        seq=output.command.seq,
        x_m=column(states, 3),
        y_m=column(states, 4),
        yaw_rad=column(states, 5),
        vx_mps=column(states, 0),
        reference_x_m=column(positions, 0),
        reference_y_m=column(positions, 1),
        left_x_m=column(left, 0),
        left_y_m=column(left, 1),
        right_x_m=column(right, 0),
        right_y_m=column(right, 1),
    )
