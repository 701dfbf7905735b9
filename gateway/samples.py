"""What the gateway tells telemetry of a step, and how often."""

from itertools import count

from gateway.core import GatewayCore, StepOutput
from gateway.telemetry import Sample, StateSample, StatusSample

STATE_EVERY_TICKS = 2
STATUS_EVERY_TICKS = 10


class GatewaySampler:
    """Makes the samples that are due after a step: on their cycle, and at every change of mode."""

    def __init__(self) -> None:
        self._state_seq = count()
        self._status_seq = count()

    def sample(self, core: GatewayCore, output: StepOutput, now_ns: int, ticks_late: int, step_cpu_ms: float) -> list[Sample]:
        """Samples of this step, possibly none."""
        samples: list[Sample] = []
        if core.ticks % STATE_EVERY_TICKS == 0 or output.transition is not None:
            samples.append(_state(next(self._state_seq), core, output, now_ns))
        if core.ticks % STATUS_EVERY_TICKS == 0 or output.transition is not None:
            samples.append(_status(next(self._status_seq), core, now_ns, ticks_late, step_cpu_ms))
        return samples


def _state(seq: int, core: GatewayCore, output: StepOutput, now_ns: int) -> StateSample:
    state, measured, demand = output.state, core.measurement, core.actuation.demand
    return StateSample(
        t_ns=now_ns,
        seq=seq,
        mode=state.mode.name,
        is_valid=state.is_valid,
        x_m=state.x_m,
        y_m=state.y_m,
        yaw_rad=state.yaw_rad,
        vx_mps=state.vx_mps,
        vy_mps=state.vy_mps,
        yaw_rate_radps=state.yaw_rate_radps,
        ax_mps2=state.ax_mps2,
        sr_angle_rad=measured.steering_wheel_rad,
        ar_position_norm=measured.accelerator_norm,
        br_position_norm=measured.brake_norm,
        sr_command_rad=demand.steering_wheel_rad,
        ar_command_norm=demand.accelerator_norm,
        br_command_norm=demand.brake_norm,
    )


def _status(seq: int, core: GatewayCore, now_ns: int, ticks_late: int, step_cpu_ms: float) -> StatusSample:
    return StatusSample(
        t_ns=now_ns,
        seq=seq,
        mode=core.mode.name,
        reason=core.reason,
        blockers=core.blockers,
        command_age_ms=min(core.commands.age_ns(now_ns) * 1e-6, 1e6),
        frames_received=core.supervisor.received,
        frames_rejected=dict(core.supervisor.rejected),
        commands_rejected=dict(core.commands.rejected),
        ticks=core.ticks,
        ticks_late=ticks_late,
        step_cpu_ms=step_cpu_ms,
    )
