"""Telemetry samples of the controller, made from what a step puts out."""

from controller.nmpc import NmpcOutput, Solution
from controller.problem import Array
from gateway.telemetry import CommandSample, PlanSample

UNKNOWN_ITERATIONS = -1


def command_sample(output: NmpcOutput, solver_name: str, step_time_ns: int) -> CommandSample:
    """The command and how the solver came to it; residuals are -1 when nothing finite was solved."""
    command, solution = output.command, output.solution
    result = solution.result if solution else None
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
        sqp_iterations=UNKNOWN_ITERATIONS if result is None or result.effort.sqp_iterations is None else result.effort.sqp_iterations,
        primal_residual=result.primal_residual if result and has_residuals else -1.0,
        dual_residual=result.dual_residual if result and has_residuals else -1.0,
        lateral_error_m=solution.lateral_error_m if solution else 0.0,
        speed_error_mps=solution.speed_error_mps if solution else 0.0,
    )


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
