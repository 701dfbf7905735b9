"""What one robot is doing, as one table, and what can be wrong with it.

    PowerOff -> Init -> NotLearned -> Learning -> Standby   by itself, once; learning recalls the limits of an earlier run, nothing moves
    Standby       released
    Armed         powered and released: the system is armed, or it is engaged and the robot's own command does not enable it
    Engaged       follows its command
    Override      the driver has taken over; released until the system is disarmed, in a stop as well
    SafeStop      does its part to stop the car
    EStop         the same, asked for by an emergency stop
    FaultSoft     does its part in a stop, follows nothing
    FaultHard     lets go

Faults stay until ClearFault, with the cause gone and the system disarmed. Ramping, LimitHold and Maintenance are not used.
"""

from collections.abc import Collection
from enum import Enum, StrEnum

SELF_TEST_S = 0.020
LEARNING_S = 0.010
"""Assumptions; real robots take seconds, which every run of the emulator would have to wait for."""


class RobotState(StrEnum):
    """States in use; the values are entries of the DBC's tables for State."""

    POWER_OFF = "PowerOff"
    INIT = "Init"
    NOT_LEARNED = "NotLearned"
    LEARNING = "Learning"
    STANDBY = "Standby"
    ARMED = "Armed"
    ENGAGED = "Engaged"
    OVERRIDE = "Override"
    SAFE_STOP = "SafeStop"
    EMERGENCY_STOP = "EStop"
    FAULT_SOFT = "FaultSoft"
    FAULT_HARD = "FaultHard"


class Event(Enum):
    """What can change the state, the gravest first: when several are true, the first that has a row acts."""

    HARD_FAULT = "a hard fault"
    SOFT_FAULT = "a soft fault"
    CLEARED = "faults are cleared and gone"
    DISARMED = "the system is disarmed"
    OVERRIDE = "the driver has taken over"
    EMERGENCY_STOP = "the system is in an emergency stop"
    CONTROLLED_STOP = "the system is in a controlled stop"
    FOLLOW = "the system is engaged, and the robot's own command enables it"
    ARMED = "the system is armed or engaged"
    NEXT = "the step of the start-up is over"


_POWERED = (RobotState.STANDBY, RobotState.ARMED, RobotState.ENGAGED)
_STOPPING = (RobotState.SAFE_STOP, RobotState.EMERGENCY_STOP)
FAULTED = frozenset({RobotState.FAULT_SOFT, RobotState.FAULT_HARD})
STARTING = frozenset({RobotState.POWER_OFF, RobotState.INIT, RobotState.NOT_LEARNED, RobotState.LEARNING})
READY = frozenset({RobotState.STANDBY, RobotState.ARMED, RobotState.ENGAGED})
"""States in which a robot can do, now or when it is engaged, what it is told."""

TRANSITIONS: dict[tuple[RobotState, Event], RobotState] = {
    (RobotState.POWER_OFF, Event.NEXT): RobotState.INIT,
    (RobotState.INIT, Event.NEXT): RobotState.NOT_LEARNED,
    (RobotState.NOT_LEARNED, Event.NEXT): RobotState.LEARNING,
    (RobotState.LEARNING, Event.NEXT): RobotState.STANDBY,
    **{(state, Event.HARD_FAULT): RobotState.FAULT_HARD for state in RobotState if state is not RobotState.FAULT_HARD},
    **{(state, Event.SOFT_FAULT): RobotState.FAULT_SOFT for state in RobotState if state not in FAULTED},
    **{(state, Event.CLEARED): RobotState.STANDBY for state in FAULTED},
    **{(state, Event.EMERGENCY_STOP): RobotState.EMERGENCY_STOP for state in (*_POWERED, RobotState.SAFE_STOP)},
    **{(state, Event.CONTROLLED_STOP): RobotState.SAFE_STOP for state in _POWERED},
    **{(state, Event.DISARMED): RobotState.STANDBY for state in (*_POWERED[1:], RobotState.OVERRIDE, *_STOPPING)},
    **{(state, Event.OVERRIDE): RobotState.OVERRIDE for state in (*_POWERED[1:], *_STOPPING)},
    (RobotState.ARMED, Event.FOLLOW): RobotState.ENGAGED,
    (RobotState.ENGAGED, Event.FOLLOW): RobotState.ENGAGED,
    (RobotState.ENGAGED, Event.ARMED): RobotState.ARMED,
    (RobotState.STANDBY, Event.ARMED): RobotState.ARMED,
}
"""What an event does."""
_ROWS = {state: [(event, TRANSITIONS[state, event]) for event in Event if (state, event) in TRANSITIONS] for state in RobotState}

_DURATIONS_S = {RobotState.INIT: SELF_TEST_S, RobotState.LEARNING: LEARNING_S}


class Dtc(StrEnum):
    """Trouble that a robot finds itself; the values are entries of the DBC's tables for Dtc."""

    COMMAND_TIMEOUT = "CmdTimeout"
    COMMAND_CRC = "CmdCrcError"
    COMMAND_COUNTER = "CmdCounterError"
    COMMAND_OUT_OF_RANGE = "CmdOutOfRange"
    FOLLOWING_ERROR = "FollowingErrorLimit"
    FORCE_LIMIT = "TorqueOrForceLimit"
    END_STOP = "EndStopReached"


SOFT_CODES = range(1, 32)
"""Codes about commands and limits; all others are about hardware: a robot with one of those can no longer be relied on."""


class RobotStateMachine:
    """Applies the table.

    Args:
        period_s: time between two updates [s].
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._time_in_state_s = 0.0
        self.state = RobotState.POWER_OFF

    def update(self, events: Collection[Event]) -> RobotState:
        """Take at most one transition for what is true now."""
        self._time_in_state_s += self._period_s
        after = self._after(events)
        if after is not self.state:
            self.state, self._time_in_state_s = after, 0.0
        return after

    def _after(self, events: Collection[Event]) -> RobotState:
        is_over = self._time_in_state_s >= _DURATIONS_S.get(self.state, 0.0)
        for event, after in _ROWS[self.state]:
            if event in events or (event is Event.NEXT and is_over):
                return after
        return self.state


class Persistence:
    """Whether something has been true for a time without a break."""

    def __init__(self, period_s: float, time_s: float) -> None:
        self._needed = max(1, round(time_s / period_s))
        self._count = 0

    def step(self, is_true: bool) -> bool:
        """Note one period."""
        if not is_true:
            self._count = 0
            return False
        self._count = min(self._count + 1, self._needed)
        return self._count == self._needed
