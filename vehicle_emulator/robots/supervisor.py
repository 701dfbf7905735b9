"""The robot controller (RC): may the robots move, and why not. Rule 1: everything that affects its state is in this file.

    Init             robots start up
    Disarmed         robots released, pedals retracted
    Armed            robots powered, released
    Engaged          robots follow their commands
    ControlledStop   robots bring the car to a stop on their own; left by a Disarm at standstill, or for an emergency stop
    EStop            the same, asked for by an emergency stop; left by a Disarm at standstill when nobody asks for it any more
    Fault            a robot has a fault, and nothing is engaged; left when it is cleared

A robot that was never engaged stays neutral: a stop begins in Engaged only. Disarming while Engaged hands the car to
the driver in it; disarming during a stop does not, because nobody may be there to take it. When the driver takes over, the robots
let go and the system stays Engaged, so that the gateway learns why and disarms. It can arm again when the driver has let go.
"""

from enum import StrEnum
from typing import NamedTuple

STANDING_MPS = 0.1
"""Speed below which a stop counts as ended."""


class SystemState(StrEnum):
    """States in use; the values are entries of the DBC's table for RC_SafetyStatus.SystemState."""

    INIT = "Init"
    DISARMED = "Disarmed"
    ARMED = "Armed"
    ENGAGED = "Engaged"
    CONTROLLED_STOP = "ControlledStop"
    EMERGENCY_STOP = "EStop"
    FAULT = "Fault"


STOPS = (SystemState.CONTROLLED_STOP, SystemState.EMERGENCY_STOP)
RELEASED = (SystemState.INIT, SystemState.DISARMED, SystemState.FAULT)
"""States in which robots are in standby: here a new session may begin and faults may be cleared."""

_TRANSITIONS: dict[tuple[SystemState, str], SystemState] = {
    (SystemState.DISARMED, "Arm"): SystemState.ARMED,
    (SystemState.ARMED, "Engage"): SystemState.ENGAGED,
    (SystemState.ARMED, "Disarm"): SystemState.DISARMED,
    (SystemState.ARMED, "None"): SystemState.DISARMED,
    (SystemState.ENGAGED, "Arm"): SystemState.ARMED,
    (SystemState.ENGAGED, "Disarm"): SystemState.DISARMED,
    (SystemState.ENGAGED, "None"): SystemState.DISARMED,
    (SystemState.CONTROLLED_STOP, "Disarm"): SystemState.DISARMED,
    (SystemState.EMERGENCY_STOP, "Disarm"): SystemState.DISARMED,
}
"""What a request does; requests are entries of the DBC's table for GW_SafetyCommand.SystemRequest."""


class SafetyInputs(NamedTuple):
    """What the robot controller judges in one step.

    Args:
        request: system request of the gateway; "None" while its safety command is not fresh.
        is_stop_button_pressed: the one in the cabin.
        is_stop_requested: emergency stop of the gateway.
        are_commands_fresh: whether the safety command and the commands of all three robots are.
        are_frames_bad: whether commands that are not fresh arrive, with wrong CRC or counter.
        is_watchdog_answered: whether the gateway has answered a question of the watchdog of late.
        have_robots_started, has_robot_fault: of the three robots.
        is_overridden: whether the driver has taken over.
        is_too_fast: whether the car is faster than the gateway allows.
        is_standing: whether the car is slower than `STANDING_MPS`.
    """

    request: str
    is_stop_button_pressed: bool
    is_stop_requested: bool
    are_commands_fresh: bool
    are_frames_bad: bool
    is_watchdog_answered: bool
    is_dead_man_pressed: bool
    have_robots_started: bool
    has_robot_fault: bool
    is_overridden: bool
    is_too_fast: bool
    is_standing: bool


class Supervisor:
    """State of the robot controller.

    Attributes:
        stop_source: why the last stop began, an entry of the DBC's table for StopSource; "None" when no stop is on.
    """

    def __init__(self) -> None:
        self.state = SystemState.INIT
        self.stop_source = "None"
        self._settled: SafetyInputs | None = None

    def update(self, inputs: SafetyInputs) -> None:
        """Take at most one transition."""
        if inputs == self._settled:
            return
        before = self.state
        self._take(inputs)
        self._settled = inputs if self.state is before else None

    def _take(self, inputs: SafetyInputs) -> None:
        may_stop = self.state is SystemState.ENGAGED or (self.state is SystemState.CONTROLLED_STOP and _is_emergency(inputs))
        if may_stop and (stop := _stop(inputs)) is not None:
            self.state, self.stop_source = stop
        elif self.state in RELEASED and (resting := _resting(inputs)) is not self.state:
            self.state, self.stop_source = resting, "RobotFault" if resting is SystemState.FAULT else "None"
        elif (after := self._requested(inputs)) is not None:
            self.state, self.stop_source = after, "None"

    def _requested(self, inputs: SafetyInputs) -> SystemState | None:
        """The state that the request leads to, or None when it leads nowhere now."""
        if self.state in STOPS:
            return _TRANSITIONS.get((self.state, inputs.request)) if inputs.is_standing and not _is_emergency(inputs) else None
        if self.state is SystemState.DISARMED and inputs.is_overridden:
            return None
        must_disarm = _is_emergency(inputs) or inputs.has_robot_fault
        after = _TRANSITIONS.get((self.state, "Disarm" if must_disarm else inputs.request))
        return None if after is SystemState.ENGAGED and not _may_engage(inputs) else after


def _resting(inputs: SafetyInputs) -> SystemState:
    """Where a system that nobody has armed belongs."""
    if not inputs.have_robots_started:
        return SystemState.INIT
    return SystemState.FAULT if inputs.has_robot_fault else SystemState.DISARMED


def _is_emergency(inputs: SafetyInputs) -> bool:
    return inputs.is_stop_button_pressed or inputs.is_stop_requested


def _may_engage(inputs: SafetyInputs) -> bool:
    return (
        inputs.are_commands_fresh
        and inputs.is_watchdog_answered
        and inputs.is_dead_man_pressed
        and not inputs.is_overridden
        and not inputs.is_too_fast
    )


def _stop(inputs: SafetyInputs) -> tuple[SystemState, str] | None:
    """The stop that an engaged system must begin, the gravest first."""
    causes = (
        (inputs.is_stop_button_pressed, SystemState.EMERGENCY_STOP, "CabinButton"),
        (inputs.is_stop_requested, SystemState.EMERGENCY_STOP, "GatewayRequest"),
        (not inputs.are_commands_fresh and inputs.are_frames_bad, SystemState.CONTROLLED_STOP, "E2EFailure"),
        (not inputs.are_commands_fresh, SystemState.CONTROLLED_STOP, "CommandTimeout"),
        (not inputs.is_watchdog_answered, SystemState.CONTROLLED_STOP, "WatchdogAnswer"),
        (not inputs.is_dead_man_pressed, SystemState.CONTROLLED_STOP, "DeadmanReleased"),
        (inputs.has_robot_fault, SystemState.CONTROLLED_STOP, "RobotFault"),
        (inputs.is_too_fast, SystemState.CONTROLLED_STOP, "SpeedLimit"),
        (inputs.request == "ControlledStop", SystemState.CONTROLLED_STOP, "GatewayRequest"),
    )
    return next(((state, source) for is_true, state, source in causes if is_true), None)
