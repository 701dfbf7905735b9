"""The heart of the gateway: one step of the 100 Hz cycle, from frames and a command to frames and a state.

Decode, judge, decide the mode, choose a demand, limit it, encode. Nothing here knows a clock, a socket or a bus.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from dbc.catalogue import Catalogue
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle
from gateway.actuation import Actuation
from gateway.codec import NEEDED_MESSAGES, Codec, Measurement, RobotLimits
from gateway.commands import CommandGate
from gateway.conditions import Situation, blockers, events, state_faults
from gateway.limits import PROVING_GROUND, Demand, LimitProfile
from gateway.messages import ControlCommand, Mode, Operation, OperatorRequest, VehicleState
from gateway.modes import Event, ModeMachine, Transition
from gateway.safe_stop import SafeStop, plan_index
from gateway.supervision import Supervisor

TICK_NS = 10_000_000
"""Period of the gateway [ns]: that of the fastest cyclic messages."""
ENGAGE_GRACE_NS = 200_000_000
"""Time that the robots have to follow into Engaged [ns]."""

_TIME_MESSAGE = "MilliTime"
"""Tells the time of validity of the navigation data."""
_EVENT_OF_OPERATION = {
    Operation.ENGAGE: Event.ENGAGE_REQUESTED,
    Operation.DISENGAGE: Event.DISENGAGE_REQUESTED,
    Operation.RESET: Event.RESET_REQUESTED,
}


@dataclass(frozen=True, slots=True)
class StepOutput:
    """Result of one step.

    Args:
        frames: to be sent on the bus now.
        state: to be sent to the controller.
        transition: the change of mode in this step, if any.
    """

    frames: list[CanFrame]
    state: VehicleState
    transition: Transition | None


class GatewayCore:
    """One gateway.

    Attributes:
        measurement: what is known of the car and the robots.
        blockers: what keeps the gateway from READY, by name; empty when nothing does.
    """

    def __init__(self, catalogue: Catalogue, vehicle: Vehicle, boot_id: int, profile: LimitProfile = PROVING_GROUND) -> None:
        self._profile = profile
        self._ratio = vehicle.steering.ratio
        self._boot_id = boot_id
        self._codec = Codec(catalogue, RobotLimits(profile.steering_wheel_rate_radps))
        self._navigation_timeout_ns = catalogue.by_name[_TIME_MESSAGE].timeout_ns
        self._heartbeat_ticks = catalogue.by_name["GW_Heartbeat"].cycle_time_ns // TICK_NS
        self._modes = ModeMachine()
        self._safe_stop: SafeStop | None = None
        self._last_step_ns: int | None = None
        self._state_time_ns = 0
        self._engaged_since_ns = 0
        self._request_seq: dict[int, int] = {}
        self.ticks = 0
        self.supervisor = Supervisor(catalogue, NEEDED_MESSAGES)
        self.commands = CommandGate()
        self.actuation = Actuation(vehicle, profile, TICK_NS)
        self.measurement = Measurement()
        self.blockers: list[str] = []

    @property
    def mode(self) -> Mode:
        """The present mode."""
        return self._modes.mode

    @property
    def reason(self) -> str:
        """Why the mode is what it is."""
        return self._modes.reason

    def step(
        self, now_ns: int, frames: Sequence[CanFrame], command: ControlCommand | None = None, request: OperatorRequest | None = None
    ) -> StepOutput:
        """Advance to `now_ns` with what has arrived since the last step."""
        self._observe(frames)
        self.commands.offer(now_ns, command, self.ticks)
        situation = self._situation(now_ns)
        self.blockers = blockers(situation)
        transition = self._modes.update(now_ns, events(situation, self.blockers) | self._operator_event(request))
        if transition is not None:
            self._enter(now_ns, transition)
        self._actuate(now_ns)
        self._last_step_ns = now_ns
        self.ticks += 1
        return StepOutput(self._encode(now_ns), self._state(not state_faults(situation)), transition)

    def _observe(self, frames: Sequence[CanFrame]) -> None:
        previous_time_ms = self.measurement.navigation_time_ms
        self._codec.update(self.measurement, self.supervisor.observe(frames))
        if self.measurement.navigation_time_ms != previous_time_ms:
            # Only a new time of validity makes the state young: a frozen navigation system grows old.
            self._state_time_ns = self.supervisor.arrival_ns(_TIME_MESSAGE)

    def _situation(self, now_ns: int) -> Situation:
        return Situation(
            now_ns=now_ns,
            measurement=self.measurement,
            commands=self.commands,
            missing=self.supervisor.missing(now_ns),
            tick_gap_ns=0 if self._last_step_ns is None else now_ns - self._last_step_ns,
            is_navigation_frozen=now_ns - self._state_time_ns > self._navigation_timeout_ns,
            is_engagement_settled=self.mode is not Mode.ENGAGED or now_ns - self._engaged_since_ns > ENGAGE_GRACE_NS,
        )

    def _operator_event(self, request: OperatorRequest | None) -> dict[Event, str]:
        """The event of a request that is new; a repeated datagram acts once."""
        if request is None or request.seq <= self._request_seq.get(request.boot_id, -1):
            return {}
        self._request_seq[request.boot_id] = request.seq
        if request.operation is Operation.ENGAGE and not self.measurement.is_armed:
            return {}  # the robots arm after the gateway is ready; until then an engagement is refused
        return {_EVENT_OF_OPERATION[request.operation]: ""}

    def _enter(self, now_ns: int, transition: Transition) -> None:
        m = self.measurement
        if transition.after is Mode.ENGAGED:
            self._engaged_since_ns = now_ns
            self.actuation.start_from(Demand(m.steering_wheel_rad, m.accelerator_norm, m.brake_norm))
        elif transition.after is Mode.SAFE_STOP:
            self._safe_stop = SafeStop(now_ns, self.commands.newest, self.actuation.steer_rad, -m.ax_mps2, self._profile)
        elif transition.after is Mode.STANDBY and transition.before is not Mode.READY:
            self.commands.reset()

    def _actuate(self, now_ns: int) -> None:
        """Choose what the robots are to do in this mode."""
        m, command = self.measurement, self.commands.newest
        if self.mode is Mode.ENGAGED and command is not None:
            k = plan_index(command, now_ns)
            self.actuation.follow(command.plan_steer_rad[k], command.plan_drive_norm[k], m.vx_mps, m.brake_norm)
        elif self.mode is Mode.SAFE_STOP and self._safe_stop is not None:
            stop = self._safe_stop.demand(now_ns, m.vx_mps)
            if stop.is_standing:
                self.actuation.hold_still()
            else:
                self.actuation.decelerate(stop.steer_rad, stop.deceleration_mps2, m.vx_mps, m.brake_norm)
        else:
            self.actuation.release()

    def _state(self, is_valid: bool) -> VehicleState:
        m = self.measurement
        return VehicleState(
            boot_id=self._boot_id,
            seq=self.ticks,
            t_ns=self._state_time_ns,
            mode=self.mode,
            is_valid=is_valid,
            x_m=m.x_m,
            y_m=m.y_m,
            yaw_rad=m.yaw_rad,
            vx_mps=m.vx_mps,
            vy_mps=m.vy_mps,
            yaw_rate_radps=m.yaw_rate_radps,
            ax_mps2=m.ax_mps2,
            steer_rad=m.steering_wheel_rad / self._ratio,
            drive_norm=self.actuation.drive_norm(m.accelerator_norm, m.brake_norm),
        )

    def _encode(self, now_ns: int) -> list[CanFrame]:
        age_ms = self.commands.age_ns(now_ns) * 1e-6
        is_precise = self.measurement.is_navigation_precise
        frames = self._codec.encode(now_ns, self.mode, self.actuation.demand, age_ms, is_precise)
        if self.ticks % self._heartbeat_ticks == 0:
            uptime_s = self.ticks * TICK_NS * 1e-9
            frames.append(self._codec.encode_heartbeat(now_ns, uptime_s, self.supervisor.rejected.total()))
        return frames
