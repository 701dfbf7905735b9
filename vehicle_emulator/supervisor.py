"""The robot controller (RC): may the robots move, and why not. Rule 1: everything that affects its state is in this file.

    Disarmed         robots released, pedals retracted
    Armed            robots powered, released
    Engaged          robots follow their commands
    ControlledStop   robots bring the car to a stop on their own; left by a Disarm at standstill only
    EStop            the same, asked for by an emergency stop

A robot that was never engaged stays neutral: the stops are reached from Engaged only. Disarming while Engaged hands the car to
the driver in it; disarming during a stop does not, because nobody may be there to take it.
"""

from dataclasses import dataclass
from enum import StrEnum

STANDING_MPS = 0.1
"""Speed below which a stop counts as ended."""


class SystemState(StrEnum):
    """States in use; the values are entries of the DBC's table for RC_SafetyStatus.SystemState."""

    DISARMED = "Disarmed"
    ARMED = "Armed"
    ENGAGED = "Engaged"
    CONTROLLED_STOP = "ControlledStop"
    EMERGENCY_STOP = "EStop"


STOPS = (SystemState.CONTROLLED_STOP, SystemState.EMERGENCY_STOP)

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


@dataclass(frozen=True, slots=True)
class SafetyInputs:
    """What the robot controller judges in one step.

    Args:
        request: system request of the gateway; "None" while its safety command is not fresh.
        are_commands_fresh: whether the safety command and the commands of all three robots are.
        is_standing: whether the car is slower than `STANDING_MPS`.
    """

    request: str
    is_emergency_stop_requested: bool
    are_commands_fresh: bool
    is_dead_man_pressed: bool
    is_standing: bool


class Supervisor:
    """State of the robot controller.

    Attributes:
        stop_source: why the last stop began, an entry of the DBC's table for StopSource; "None" when no stop is on.
    """

    def __init__(self) -> None:
        self.state = SystemState.DISARMED
        self.stop_source = "None"

    def update(self, inputs: SafetyInputs) -> None:
        """Take at most one transition."""
        if self.state is SystemState.ENGAGED and (stop := _stop(inputs)) is not None:
            self.state, self.stop_source = stop
            return
        request = "Disarm" if inputs.is_emergency_stop_requested else inputs.request
        after = _TRANSITIONS.get((self.state, request), self.state)
        may_engage = inputs.are_commands_fresh and inputs.is_dead_man_pressed
        if (after is SystemState.ENGAGED and not may_engage) or (self.state in STOPS and not inputs.is_standing):
            return
        self.state = after
        if after not in STOPS:
            self.stop_source = "None"


def _stop(inputs: SafetyInputs) -> tuple[SystemState, str] | None:
    """The stop that an engaged system must begin, the gravest first."""
    if inputs.is_emergency_stop_requested:
        return SystemState.EMERGENCY_STOP, "GatewayRequest"
    if not inputs.are_commands_fresh:
        return SystemState.CONTROLLED_STOP, "CommandTimeout"
    if not inputs.is_dead_man_pressed:
        return SystemState.CONTROLLED_STOP, "DeadmanReleased"
    if inputs.request == "ControlledStop":
        return SystemState.CONTROLLED_STOP, "GatewayRequest"
    return None
