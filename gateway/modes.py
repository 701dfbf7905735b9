"""The mode machine of the gateway. Rule 1: everything that affects the mode is in this file, as two tables.

    SILENT        nothing is sent; the state after every start
    STANDBY       robots disarmed
    READY         robots armed, neutral demands; waits for the operator
    ENGAGED       the controller's commands drive the car
    COMFORT_STOP  the gateway itself brings the car to a gentle stop and holds it
    SAFE_STOP     the same, firmly
    FAULT         the robots cannot be reached or relied on: disarmed

An engagement takes two steps, ARM and ENGAGE, each a request of the operator with preconditions of its own (`conditions`).
Nothing re-engages by itself: a stop is left by a reset of the operator or by a driver who takes the wheel, FAULT by a reset alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from gateway.causes import Cause, Finding
from gateway.messages import Mode


class Trigger(Enum):
    """What can change the mode, the gravest first: when several happen in one tick, the first that has a row acts."""

    GIVE_UP = "the robots cannot be relied on"
    HAND_OVER = "driver or operator takes over"
    STOP = "stop"
    STOP_GENTLY = "gentle stop"
    RESET = "operator reset"
    BLOCKED = "not ready"
    ENGAGE = "operator engaged"
    ARM = "operator armed"


REACTIONS: Mapping[Cause, Trigger] = {
    Cause.ROBOTS_EMERGENCY_STOP: Trigger.GIVE_UP,
    Cause.ROBOTS_STOPPED: Trigger.GIVE_UP,
    Cause.BUS_DOWN: Trigger.GIVE_UP,
    Cause.BUS_OFF: Trigger.GIVE_UP,
    Cause.BUS_BLOCKED: Trigger.GIVE_UP,
    Cause.SECOND_SENDER: Trigger.GIVE_UP,
    Cause.WATCHDOG_SILENT: Trigger.STOP,
    Cause.ROBOT_FAULT: Trigger.STOP,
    Cause.ROBOT_MISSES_COMMANDS: Trigger.STOP,
    Cause.TICK_GAP: Trigger.STOP,
    Cause.MESSAGE_MISSING: Trigger.STOP,
    Cause.MESSAGE_INVALID: Trigger.STOP,
    Cause.NAVIGATION_FROZEN: Trigger.STOP,
    Cause.NAVIGATION_COARSE: Trigger.STOP,
    Cause.SPEED_IMPLAUSIBLE: Trigger.STOP,
    Cause.POSITION_IMPLAUSIBLE: Trigger.STOP,
    Cause.YAW_RATE_IMPLAUSIBLE: Trigger.STOP,
    Cause.STEERING_IMPLAUSIBLE: Trigger.STOP,
    Cause.STEERING_NOT_FOLLOWING: Trigger.STOP,
    Cause.FRAMES_LOST: Trigger.STOP,
    Cause.CAR_NOT_SLOWING: Trigger.STOP,
    Cause.COMMAND_FAILED: Trigger.STOP,
    Cause.COMMAND_LOST: Trigger.STOP,
    Cause.COMMAND_INVALID: Trigger.STOP,
    Cause.SECOND_CONTROLLER: Trigger.STOP,
    Cause.LATENCY: Trigger.STOP_GENTLY,
    Cause.OVERSPEED: Trigger.STOP_GENTLY,
    Cause.SELECTOR_NOT_IN_DRIVE: Trigger.STOP_GENTLY,
    Cause.OPERATOR_STOP: Trigger.STOP_GENTLY,
    Cause.DRIVER_STEERS: Trigger.HAND_OVER,
    Cause.DRIVER_BRAKES: Trigger.HAND_OVER,
    Cause.DRIVER_ACCELERATES: Trigger.HAND_OVER,
    Cause.DRIVER_OVERRIDE: Trigger.HAND_OVER,
    Cause.OPERATOR_DISENGAGE: Trigger.HAND_OVER,
    Cause.ROBOTS_NOT_ENGAGED: Trigger.HAND_OVER,  # disarmed, or they would engage later by themselves, when nobody expects it
}
"""What each cause asks for."""

TRANSITIONS: Mapping[tuple[Mode, Trigger], Mode] = {
    (Mode.SILENT, Trigger.ARM): Mode.READY,
    (Mode.SILENT, Trigger.RESET): Mode.STANDBY,  # robots that a gateway has left in a stop end it for a Disarm only
    (Mode.STANDBY, Trigger.ARM): Mode.READY,
    (Mode.READY, Trigger.GIVE_UP): Mode.STANDBY,
    (Mode.READY, Trigger.STOP): Mode.STANDBY,
    (Mode.READY, Trigger.STOP_GENTLY): Mode.STANDBY,
    (Mode.READY, Trigger.HAND_OVER): Mode.STANDBY,
    (Mode.READY, Trigger.BLOCKED): Mode.STANDBY,
    (Mode.READY, Trigger.ENGAGE): Mode.ENGAGED,
    (Mode.ENGAGED, Trigger.GIVE_UP): Mode.FAULT,
    (Mode.ENGAGED, Trigger.STOP): Mode.SAFE_STOP,
    (Mode.ENGAGED, Trigger.STOP_GENTLY): Mode.COMFORT_STOP,
    (Mode.ENGAGED, Trigger.HAND_OVER): Mode.STANDBY,
    (Mode.COMFORT_STOP, Trigger.GIVE_UP): Mode.FAULT,
    (Mode.COMFORT_STOP, Trigger.STOP): Mode.SAFE_STOP,
    (Mode.COMFORT_STOP, Trigger.HAND_OVER): Mode.STANDBY,
    (Mode.COMFORT_STOP, Trigger.RESET): Mode.STANDBY,
    (Mode.SAFE_STOP, Trigger.GIVE_UP): Mode.FAULT,
    (Mode.SAFE_STOP, Trigger.HAND_OVER): Mode.STANDBY,
    (Mode.SAFE_STOP, Trigger.RESET): Mode.STANDBY,
    (Mode.FAULT, Trigger.RESET): Mode.STANDBY,
}

DRIVING = (Mode.ENGAGED, Mode.COMFORT_STOP, Mode.SAFE_STOP)
"""In these the gateway moves the car."""
QUIET = (Mode.SILENT, Mode.STANDBY)
"""In these nobody is driven and nobody expects to be: another configuration may come in force, another controller may come."""


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of mode and why.

    Args:
        finding: what was found; None when nobody but the operator caused it.
    """

    t_ns: int
    before: Mode
    after: Mode
    trigger: Trigger
    finding: Finding | None

    @property
    def reason(self) -> str:
        """One line for people."""
        return self.trigger.value if self.finding is None else str(self.finding)


class ModeMachine:
    """Applies the tables."""

    def __init__(self) -> None:
        self.mode = Mode.SILENT
        self.reason = "started"

    def update(self, now_ns: int, findings: Sequence[Finding], requests: frozenset[Trigger] = frozenset()) -> Transition | None:
        """Take at most one transition.

        Args:
            findings: what would end an engagement now.
            requests: what the operator asked for and may have, and BLOCKED when READY cannot be kept.
        """
        happened: dict[Trigger, Finding | None] = dict.fromkeys(requests)
        for finding in sorted(findings, key=lambda finding: _ORDER[finding.cause], reverse=True):
            happened[REACTIONS[finding.cause]] = finding  # the gravest of a trigger stays
        for trigger in sorted(happened, key=_URGENCY.__getitem__):
            if (after := TRANSITIONS.get((self.mode, trigger))) is not None:
                transition = Transition(now_ns, self.mode, after, trigger, happened[trigger])
                self.mode, self.reason = after, transition.reason
                return transition
        return None


_URGENCY = {trigger: k for k, trigger in enumerate(Trigger)}
_ORDER = {cause: k for k, cause in enumerate(Cause)}
