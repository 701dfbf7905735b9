"""The heart of the gateway: one step of the 100 Hz cycle, from frames and a command to frames and a state.

Decode, judge, decide the mode, choose a demand, limit it, encode. Nothing here knows a clock, a socket or a bus.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dbc.catalogue import Catalogue, CatalogueError
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle
from gateway.actuation import Actuation
from gateway.causes import Cause, Disengagement, Finding
from gateway.codec import COMMAND_MESSAGES, MONITOR_MESSAGES, NEEDED_MESSAGES, Codec, Cycle, Measurement, Monitors, RobotLimits
from gateway.commands import MAX_STATE_LAG, CommandGate
from gateway.conditions import (
    COMMAND_TIMEOUT_NS,
    UNDISTURBED,
    Situation,
    Surroundings,
    blockers,
    findings,
    refusals,
    settling,
    state_findings,
    unsound_messages,
    untimely,
)
from gateway.latency import LatencyChain, ValidityClock
from gateway.limits import PROVING_GROUND, Demand, LimitProfile, coarsest, lateral_acceleration_mps2
from gateway.messages import ControlCommand, Mode, Operation, OperatorReply, OperatorRequest, VehicleState
from gateway.modes import DRIVING, QUIET, REACTIONS, TRANSITIONS, ModeMachine, Transition, Trigger
from gateway.pacing import PULL_NS
from gateway.plausibility import Plausibility
from gateway.safe_stop import SafeStop, plan_index
from gateway.supervision import Supervisor
from gateway.transmit import TransmitGate

TICK_NS = 10_000_000
"""Period of the gateway [ns]: that of the fastest cyclic messages."""
ROBOT_SPEED_MARGIN = 1.1
"""Speed at which the robots stop the car by themselves, over that at which the gateway does it gently."""
ENGAGE_GRACE_NS = 200_000_000
"""Time that the robots have to follow into Engaged [ns]."""

_SHORTEST_TICK_S = (TICK_NS - PULL_NS) * 1e-9
_REMEMBERED_STATES = MAX_STATE_LAG + 1
"""States that a command may answer."""
_TIME_MESSAGE = "MilliTime"
"""Tells the time of validity of the navigation data."""
_TRIGGER_OF_OPERATION = {Operation.ARM: Trigger.ARM, Operation.ENGAGE: Trigger.ENGAGE, Operation.RESET: Trigger.RESET}
_STOPPED = (Mode.COMFORT_STOP, Mode.SAFE_STOP, Mode.FAULT)
_CAUSE_OF_OPERATION = {Operation.DISENGAGE: Cause.OPERATOR_DISENGAGE, Operation.STOP: Cause.OPERATOR_STOP}


@dataclass(frozen=True, slots=True)
class StepOutput:
    """Result of one step.

    Args:
        frames: to be sent on the bus now.
        state: to be sent to the controller; the one that `sense` has given since the step before, if it has given one.
        transition: the change of mode in this step, if any.
        reply: to the operator, if he asked for something new.
    """

    frames: list[CanFrame]
    state: VehicleState
    transition: Transition | None
    reply: OperatorReply | None


def _check_cycles(catalogue: Catalogue) -> None:
    """Refuse cycle times at which the gateway does not send: its commands with every step, its monitors together, with every so many."""
    ticks = max(catalogue.by_name["GW_Status"].cycle_time_ns // TICK_NS, 1)
    allowed_ns = dict.fromkeys(COMMAND_MESSAGES, TICK_NS) | dict.fromkeys(MONITOR_MESSAGES, ticks * TICK_NS)
    wrong = [
        f"{name}: cycle time {catalogue.by_name[name].cycle_time_ns * 1e-6:g} ms, allowed: {cycle_ns * 1e-6:g} ms"
        for name, cycle_ns in allowed_ns.items()
        if catalogue.by_name[name].cycle_time_ns != cycle_ns
    ]
    if wrong:
        raise CatalogueError(f"{', '.join(catalogue.sha256)}: {'; '.join(wrong)}")


class GatewayCore:
    """One gateway.

    Raises:
        CatalogueError: the DBC files are not what it needs; one line.

    Attributes:
        measurement: what is known of the car and the robots.
        findings: what would end an engagement now.
        blockers: what keeps the gateway from READY, by name; empty when nothing does.
        disengagement: how the last engagement ended; None when none has.
    """

    def __init__(self, catalogue: Catalogue, vehicle: Vehicle, boot_id: int, profile: LimitProfile = PROVING_GROUND) -> None:
        self.profile = profile
        self._ratio = vehicle.steering.ratio
        self._wheel_radius_m = vehicle.model.wheel_radius_m
        self._wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
        self._boot_id = boot_id
        self._codec = Codec(catalogue, RobotLimits(profile.steering_wheel_rate_radps, ROBOT_SPEED_MARGIN * profile.max_speed_mps))
        self._codec.check_resolution(coarsest(vehicle, profile, _SHORTEST_TICK_S), f"limits {profile.name} allow")
        _check_cycles(catalogue)
        self._navigation_timeout_ns = catalogue.by_name[_TIME_MESSAGE].timeout_ns
        self._monitor_ticks = catalogue.by_name["GW_Status"].cycle_time_ns // TICK_NS
        self._modes = ModeMachine()
        self._plausibility = Plausibility(vehicle, is_on_lift=not profile.are_wheels_on_the_road)
        self._gate = TransmitGate(catalogue)
        self._safe_stop: SafeStop | None = None
        self._start_ns: int | None = None
        self._last_step_ns: int | None = None
        self._good_since_ns: int | None = None
        self._validity = ValidityClock()
        self._state_time_ns = 0
        self._state_seq = 0
        self._is_state_good = False
        self._sensed: VehicleState | None = None
        self._asked_ns = 0
        self._engaged_since_ns: int | None = None
        self._stop_since_ns: int | None = None
        self._state_times_ns = [0] * _REMEMBERED_STATES
        self._measurement_id = 0
        self._last_request_ns: int | None = None
        self.ticks = 0
        self.supervisor = Supervisor(catalogue, NEEDED_MESSAGES)
        self.commands = CommandGate()
        self.latency = LatencyChain()
        self.actuation = Actuation(vehicle, profile, TICK_NS, self._codec.resolution)
        self.measurement = Measurement()
        self.findings: list[Finding] = []
        self.blockers: list[str] = []
        self.disengagement: Disengagement | None = None

    @property
    def mode(self) -> Mode:
        """The present mode."""
        return self._modes.mode

    @property
    def reason(self) -> str:
        """Why the mode is what it is."""
        return self._modes.reason

    def step(
        self,
        now_ns: int,
        frames: Sequence[CanFrame],
        command: ControlCommand | None = None,
        request: OperatorRequest | None = None,
        surroundings: Surroundings = UNDISTURBED,
    ) -> StepOutput:
        """Advance to `now_ns` with what has arrived since the last step."""
        if self._last_request_ns is None:
            self._start_ns = now_ns
            self._last_request_ns = now_ns - TICK_NS  # what was asked before this gateway lived does not act
        self._observe(now_ns, frames)
        self._admit(now_ns, command)
        situation = self._situation(now_ns, surroundings)
        of_state = state_findings(situation)
        self._is_state_good = not of_state
        self.findings = findings(situation, of_state)
        self.blockers = self._blockers(situation)
        refused = [] if request is None else self._refusals(request, situation, self._last_request_ns)
        granted = None if refused or request is None else request.operation
        transition = self._modes.update(now_ns, self._with_request(request, granted), self._triggers(granted))
        if transition is not None:
            self._enter(now_ns, transition)
        self._actuate(now_ns)
        self._last_step_ns = now_ns
        self.ticks += 1
        state, self._sensed = self._sensed or self._state(), None
        reply = None if request is None else self._reply(request, refused, transition)
        return StepOutput(self._gate.admit(now_ns, self.mode, self._encode(now_ns, surroundings)), state, transition, reply)

    def sense(self, now_ns: int, frames: Sequence[CanFrame]) -> VehicleState | None:
        """Take frames in between two steps.

        Returns:
            A state for the controller at once when the navigation data are new, one between two steps; what is wrong with them is
            judged by `step`.
        """
        before_ns = self._state_time_ns
        self._observe(now_ns, frames)
        if self._state_time_ns == before_ns or self._sensed is not None:
            return None
        self._sensed = self._state()
        return self._sensed

    def _observe(self, now_ns: int, frames: Sequence[CanFrame]) -> None:
        m = self.measurement
        before = (m.navigation_time_ms, m.watchdog_question, m.measurement_id)
        self._codec.update(m, self.supervisor.observe(frames))
        if m.navigation_time_ms != before[0] and (arrival_ns := self.supervisor.arrival_ns(_TIME_MESSAGE)) is not None:
            # Only a newer time of validity makes the state young: a frozen navigation system grows old, and so does one that lags.
            valid_ns = self._validity.arrived(arrival_ns, m.navigation_time_ms)
            self._state_time_ns = self._state_time_ns if valid_ns is None else valid_ns
        if m.watchdog_question != before[1]:
            self._asked_ns = now_ns
        if m.measurement_id != before[2]:
            self.latency.echoed(m.measurement_id, now_ns)

    def _admit(self, now_ns: int, command: ControlCommand | None) -> None:
        if self.mode in QUIET:
            self.commands.forgive(now_ns)
            self._validity.restart()  # a lag is judged from READY on: until then other data may come, or a system that has begun anew
        if self.mode in QUIET and self.commands.age_ns(now_ns) > COMMAND_TIMEOUT_NS:
            self.commands.release()  # a controller that has gone may come back as another process
        if command is not None and self.commands.offer(now_ns, command, self._state_seq):
            self._measurement_id = self.latency.answered(self._state_times_ns[command.state_seq % _REMEMBERED_STATES])

    def _situation(self, now_ns: int, surroundings: Surroundings) -> Situation:
        m, is_driving = self.measurement, self.mode in DRIVING
        is_settled = self._engaged_since_ns is not None and now_ns - self._engaged_since_ns > ENGAGE_GRACE_NS
        observed = self.supervisor.findings(now_ns)
        unsound = unsound_messages(observed)
        contradictions = self._plausibility.update(now_ns, m, self.actuation.demand, is_driving and is_settled)
        observed += [finding for finding in contradictions if finding.source not in unsound]
        if is_driving:
            observed += self.latency.findings(now_ns)
        return Situation(
            now_ns=now_ns,
            measurement=m,
            commands=self.commands,
            surroundings=surroundings,
            profile=self.profile,
            observed=observed,
            state_age_ns=now_ns - self._state_time_ns,
            navigation_timeout_ns=self._navigation_timeout_ns,
            question_age_ns=now_ns - self._asked_ns,
            tick_gap_ns=now_ns - (self._last_step_ns or now_ns),
            is_driving=is_driving,
            is_settled=is_settled,
            steer_rad=m.steering_wheel_rad / self._ratio,
            lateral_mps2=lateral_acceleration_mps2(m.steering_wheel_rad / self._ratio, self._wheelbase_m, self._limiting_speed_mps),
            speed_mps=self._speed_mps,
            allowed_mps=self._safe_stop.allowed_mps(now_ns) if self.mode is Mode.COMFORT_STOP and self._safe_stop is not None else math.inf,
            stopping_ns=0 if self._stop_since_ns is None else now_ns - self._stop_since_ns,
        )

    @property
    def _speed_mps(self) -> float:
        """By whoever says more: a car stands when navigation and wheels agree that it does."""
        return max(abs(self.measurement.vx_mps), abs(self.measurement.wheels_radps) * self._wheel_radius_m)

    @property
    def _limiting_speed_mps(self) -> float:
        """For the lateral limits. On a lift the wheels say nothing of the car that is steered."""
        return self._speed_mps if self.profile.are_wheels_on_the_road else abs(self.measurement.vx_mps)

    def _blockers(self, situation: Situation) -> list[str]:
        blocked = blockers(situation, self.findings)
        since_ns = situation.now_ns if blocked or self._good_since_ns is None else self._good_since_ns
        self._good_since_ns = None if blocked else since_ns
        return blocked + settling(situation.now_ns - since_ns, self.commands.good_in_a_row)

    def _refusals(self, request: OperatorRequest, situation: Situation, last_ns: int) -> list[str]:
        """Why a request is not granted; empty when it is. It is looked at once: all who ask share one clock."""
        if refused := untimely(request, situation.now_ns, last_ns):
            return [refused]
        if request.operation is not Operation.STOP:  # which acts whatever its date is: that says nothing about those after it
            self._last_request_ns = max(request.t_ns, last_ns)
        trigger = _TRIGGER_OF_OPERATION.get(request.operation) or REACTIONS[_CAUSE_OF_OPERATION[request.operation]]
        if (self.mode, trigger) not in TRANSITIONS:
            return [f"not possible in {self.mode.name}"]
        return refusals(request.operation, situation, self.blockers)

    def _reply(self, request: OperatorRequest, refused: Sequence[str], transition: Transition | None) -> OperatorReply:
        asked = _TRIGGER_OF_OPERATION.get(request.operation)
        if not refused and asked is not None and transition is not None and transition.trigger is not asked:
            refused = [transition.reason]  # something graver happened in the same step
        return OperatorReply(request.boot_id, request.seq, request.operation, self.mode, tuple(refused))

    def _with_request(self, request: OperatorRequest | None, granted: Operation | None) -> list[Finding]:
        """The findings, and what the operator wants ended, or the gateway's own process before it ends."""
        if request is None or granted not in _CAUSE_OF_OPERATION:
            return self.findings
        source = "operator" if request.boot_id != self._boot_id else "the gateway is to end"
        return [*self.findings, Finding(_CAUSE_OF_OPERATION[granted], 1, 0, source)]

    def _triggers(self, granted: Operation | None) -> frozenset[Trigger]:
        blocked = [Trigger.BLOCKED] if self.blockers else []
        asked = [_TRIGGER_OF_OPERATION[granted]] if granted in _TRIGGER_OF_OPERATION else []
        return frozenset(blocked + asked)

    def _enter(self, now_ns: int, transition: Transition) -> None:
        m = self.measurement
        if transition.finding is not None and (transition.before is Mode.ENGAGED or transition.after in _STOPPED):
            self.disengagement = Disengagement(now_ns, transition.finding)
        if transition.after is Mode.ENGAGED:
            self._engaged_since_ns = now_ns
            self.latency.restart()
            self.actuation.start_from(Demand(m.steering_wheel_rad, m.accelerator_norm, m.brake_norm))
        elif transition.after in (Mode.COMFORT_STOP, Mode.SAFE_STOP):
            grade = self.profile.safe_stop if transition.after is Mode.SAFE_STOP else self.profile.comfort_stop
            self._safe_stop = SafeStop(
                now_ns,
                self.commands.newest,
                grade,
                steer_rad=self.actuation.steer_rad,
                speed_mps=self._speed_mps,
                deceleration_mps2=-self.actuation.acceleration_mps2,
            )
        elif transition.after is Mode.STANDBY and transition.before is not Mode.READY:
            self.commands.reset()
        self._stop_since_ns = now_ns if transition.after in _STOPPED else None

    def _actuate(self, now_ns: int) -> None:
        """Choose what the robots are to do in this mode."""
        m, command = self.measurement, self.commands.newest
        if self._last_step_ns is not None:
            self.actuation.pass_time(now_ns - self._last_step_ns)
        if self.mode is Mode.ENGAGED and command is not None:
            k = plan_index(command, now_ns)
            self.actuation.follow(command.plan_steer_rad[k], command.plan_drive_norm[k], self._limiting_speed_mps, m.brake_norm)
        elif self.mode in (Mode.COMFORT_STOP, Mode.SAFE_STOP) and self._safe_stop is not None:
            stop = self._safe_stop.demand(now_ns, self._speed_mps)
            steer_rad = stop.steer_rad
            if self.mode is Mode.COMFORT_STOP and command is not None:  # it takes long, and the controller is well
                steer_rad = command.plan_steer_rad[plan_index(command, now_ns)]
            if stop.is_standing:
                self.actuation.hold_still()
            else:
                self.actuation.decelerate(steer_rad, stop.deceleration_mps2, self._limiting_speed_mps, m.brake_norm)
        else:
            self.actuation.release()

    def _state(self) -> VehicleState:
        m = self.measurement
        self._state_seq += 1
        self._state_times_ns[self._state_seq % _REMEMBERED_STATES] = self._state_time_ns
        return VehicleState(
            boot_id=self._boot_id,
            seq=self._state_seq,
            t_ns=self._state_time_ns,
            mode=self.mode,
            is_valid=self._is_state_good,
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

    def _encode(self, now_ns: int, surroundings: Surroundings) -> list[CanFrame]:
        if self.mode is Mode.SILENT:
            return []
        m, frames = self.measurement, []
        if self.mode is not Mode.FAULT:  # then the robots' own timeout stops the car
            age_ms = self.commands.age_ns(now_ns) * 1e-6
            cycle = Cycle(age_ms, self._measurement_id, m.watchdog_question, m.is_navigation_precise)
            frames = self._codec.encode(now_ns, self.mode, self.actuation.demand, cycle)
        if self.ticks % self._monitor_ticks == 0:
            finding = None if self.disengagement is None else self.disengagement.finding
            monitors = Monitors(
                uptime_s=(now_ns - (self._start_ns or now_ns)) * 1e-9,
                bus_load_norm=surroundings.bus_load_norm,
                cpu_load_norm=surroundings.cpu_load_norm,
                rejected=self.supervisor.rejected.total(),
                tx_error_count=max((link.tx_error_count for link in surroundings.links.values()), default=0),
                mode=self.mode,
                finding=finding,
            )
            frames += self._codec.encode_monitors(now_ns, monitors)
        return frames
