"""What the gateway tells telemetry of a step, and how often."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

from dbc.health import LinkHealth
from gateway.actuation import UNITS, Actuation
from gateway.causes import Disengagement
from gateway.core import GatewayCore, StepOutput
from gateway.telemetry import DisengagementReport, LimitActivation, Sample, StateSample, StatusSample

STATE_EVERY_TICKS = 2
STATUS_EVERY_TICKS = 10


@dataclass(frozen=True, slots=True)
class Process:
    """What the process around the core knows of itself; in virtual time there is nothing to know.

    Args:
        ticks_late: periods skipped since its start.
        step_cpu_ms: CPU time of the step [ms].
        dead_buses: networks whose bus refuses to deliver or to accept frames.
        frames_dropped: received frames that the core was not shown, by cause.
        frames_unsent: frames that were to be sent and were not, by cause.
        links: health of the bus of every network.
        datagrams_rejected: on the control sockets, by cause.
        ticks_unrecorded, record_problem: see `gateway.recorder.RecorderStatus`.
        realtime: what the control thread asked of the machine, and what it was refused.
        hashes: SHA-256 of all that it works with.
        bus_load: share of the last second in which the bus of every network was busy.
        message_rates_hz: frames per second by message.
    """

    ticks_late: int = 0
    step_cpu_ms: float = 0.0
    dead_buses: Sequence[str] = ()
    frames_dropped: Mapping[str, int] = field(default_factory=dict)
    frames_unsent: Mapping[str, int] = field(default_factory=dict)
    links: Mapping[str, LinkHealth] = field(default_factory=dict)
    bus_errors: Mapping[str, int] = field(default_factory=dict)
    bus_refusals: Mapping[str, str] = field(default_factory=dict)
    datagrams_rejected: Mapping[str, int] = field(default_factory=dict)
    ticks_unrecorded: int = 0
    record_problem: str = ""
    realtime: Mapping[str, str] = field(default_factory=dict)
    hashes: Mapping[str, str] = field(default_factory=dict)
    bus_load: Mapping[str, float] = field(default_factory=dict)
    message_rates_hz: Mapping[str, float] = field(default_factory=dict)


VIRTUAL = Process()


class GatewaySampler:
    """Makes the samples that are due after a step: on their cycle, and at every change of mode."""

    def __init__(self) -> None:
        self._state_seq = count()
        self._status_seq = count()

    def sample(self, core: GatewayCore, output: StepOutput, now_ns: int, process: Process = VIRTUAL) -> list[Sample]:
        """Samples of this step, possibly none."""
        samples: list[Sample] = []
        if core.ticks % STATE_EVERY_TICKS == 0 or output.transition is not None:
            samples.append(_state(next(self._state_seq), core, output, now_ns))
        if self.is_status_due(core, output):
            samples.append(_status(next(self._status_seq), core, now_ns, process))
        return samples

    def is_status_due(self, core: GatewayCore, output: StepOutput) -> bool:
        """Whether this step's samples tell of the process."""
        return core.ticks % STATUS_EVERY_TICKS == 0 or output.transition is not None


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


def _status(seq: int, core: GatewayCore, now_ns: int, process: Process) -> StatusSample:
    return StatusSample(
        t_ns=now_ns,
        seq=seq,
        mode=core.mode.name,
        reason=core.reason,
        blockers=core.blockers,
        command_age_ms=min(core.commands.age_ns(now_ns) * 1e-6, 1e6),
        frames_received=core.supervisor.received,
        frames_rejected={**core.supervisor.rejected, **process.frames_dropped},
        commands_rejected={**core.commands.rejected, **process.datagrams_rejected},
        ticks=core.ticks,
        ticks_late=process.ticks_late,
        step_cpu_ms=process.step_cpu_ms,
        dead_buses=list(process.dead_buses),
        buses={network: health.state.value for network, health in process.links.items()},
        bus_errors=dict(process.bus_errors),
        bus_refusals=dict(process.bus_refusals),
        frames_unsent=dict(process.frames_unsent),
        ticks_unrecorded=process.ticks_unrecorded,
        record_problem=process.record_problem,
        realtime=dict(process.realtime),
        hashes=dict(process.hashes),
        profile=core.profile.name,
        limits=_limits(core.actuation),
        limited_share=core.actuation.held_back_ticks / max(core.actuation.engaged_ticks, 1),
        disengagement=None if core.disengagement is None else _report(core.disengagement),
        actuation_age_ms=core.latency.newest_ns * 1e-6,
        actuation_age_max_ms=core.latency.max_ns * 1e-6,
        bus_load=dict(process.bus_load),
        message_rates_hz=dict(process.message_rates_hz),
    )


def _limits(actuation: Actuation) -> dict[str, LimitActivation]:
    return {
        name: LimitActivation(
            ticks=actuation.limited[name], unit=UNITS[name], asked=last.asked, limit=last.limit, given=last.given
        )
        for name, last in actuation.last_limited.items()
    }


def _report(disengagement: Disengagement) -> DisengagementReport:
    finding = disengagement.finding
    return DisengagementReport(
        t_ns=disengagement.t_ns,
        cause=finding.cause.name,
        code=finding.cause.code,
        value=finding.value,
        limit=finding.limit,
        unit=finding.cause.value.unit,
        source=finding.source,
    )
