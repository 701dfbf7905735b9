"""The mode machine of the gateway. Rule 1: everything that affects the mode is in this file, as one table.

    STANDBY     silent: robots disarmed; waits until everything that an engagement needs is good
    READY       robots armed, neutral demands; waits for the operator
    ENGAGED     the controller's commands drive the car
    SAFE_STOP   the gateway itself brings the car to a stop and holds it, until the operator resets
    FAULT       the robots cannot be relied on: disarmed, until the operator resets

Nothing re-engages by itself: SAFE_STOP and FAULT are left by a reset of the operator only.
"""

from dataclasses import dataclass
from enum import Enum

from gateway.messages import Mode


class Event(Enum):
    """What can change the mode, the gravest first: when several happen in one tick, the first that has a row acts."""

    EMERGENCY_STOP = "emergency stop of the robot controller"
    ROBOT_FAULT = "robot fault"
    STATE_LOST = "vehicle state lost"
    COMMAND_FAILED = "controller failed"
    COMMAND_LOST = "controller silent"
    TICK_GAP = "gateway was stopped"
    DRIVER_OVERRIDE = "driver override"
    DISENGAGE_REQUESTED = "operator disengaged"
    RESET_REQUESTED = "operator reset"
    NOT_READY = "not ready"
    ENGAGE_REQUESTED = "operator engaged"
    ALL_READY = "everything ready"


TRANSITIONS: dict[tuple[Mode, Event], Mode] = {
    (Mode.STANDBY, Event.ALL_READY): Mode.READY,
    (Mode.READY, Event.NOT_READY): Mode.STANDBY,
    (Mode.READY, Event.ENGAGE_REQUESTED): Mode.ENGAGED,
    (Mode.READY, Event.DISENGAGE_REQUESTED): Mode.STANDBY,
    (Mode.ENGAGED, Event.EMERGENCY_STOP): Mode.FAULT,
    (Mode.ENGAGED, Event.ROBOT_FAULT): Mode.SAFE_STOP,
    (Mode.ENGAGED, Event.STATE_LOST): Mode.SAFE_STOP,
    (Mode.ENGAGED, Event.COMMAND_FAILED): Mode.SAFE_STOP,
    (Mode.ENGAGED, Event.COMMAND_LOST): Mode.SAFE_STOP,
    (Mode.ENGAGED, Event.TICK_GAP): Mode.SAFE_STOP,
    (Mode.ENGAGED, Event.DRIVER_OVERRIDE): Mode.STANDBY,
    (Mode.ENGAGED, Event.DISENGAGE_REQUESTED): Mode.STANDBY,
    (Mode.SAFE_STOP, Event.EMERGENCY_STOP): Mode.FAULT,
    (Mode.SAFE_STOP, Event.DRIVER_OVERRIDE): Mode.STANDBY,
    (Mode.SAFE_STOP, Event.RESET_REQUESTED): Mode.STANDBY,
    (Mode.FAULT, Event.RESET_REQUESTED): Mode.STANDBY,
}


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of mode and why."""

    t_ns: int
    before: Mode
    after: Mode
    event: Event
    detail: str

    @property
    def reason(self) -> str:
        """One line for people."""
        return f"{self.event.value}: {self.detail}" if self.detail else self.event.value


class ModeMachine:
    """Applies the table."""

    def __init__(self) -> None:
        self.mode = Mode.STANDBY
        self.reason = "started"

    def update(self, now_ns: int, events: dict[Event, str]) -> Transition | None:
        """Take at most one transition for the events of this tick, each with a detail for people."""
        for event in Event:
            if event in events and (after := TRANSITIONS.get((self.mode, event))) is not None:
                transition = Transition(now_ns, self.mode, after, event, events[event])
                self.mode, self.reason = after, transition.reason
                return transition
        return None
