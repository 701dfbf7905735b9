"""Why an engagement ends: every cause by name and number, with the value that was found, its limit and where it was found.

The numbers travel on the bus (GW_Status.Cause) and in records: they are never given a second time.
"""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple


class Meaning(NamedTuple):
    """What a cause means.

    Args:
        code: on the bus, 1 to 255; 0 says that there is none.
        text: for people.
        unit: of value and limit; empty where they count.
    """

    code: int
    text: str
    unit: str


class Cause(Enum):
    """Causes, the gravest first among those with the same reaction."""

    ROBOTS_EMERGENCY_STOP = Meaning(1, "emergency stop of the robots", "")
    ROBOTS_STOPPED = Meaning(2, "the robots stop the car", "")
    BUS_DOWN = Meaning(3, "bus is gone", "")
    BUS_OFF = Meaning(4, "bus-off", "")
    BUS_BLOCKED = Meaning(5, "own frames do not get through", "ms")
    SECOND_SENDER = Meaning(6, "another node sends the gateway's frames", "")
    WATCHDOG_SILENT = Meaning(7, "robot controller asks no new questions", "ms")
    ROBOT_FAULT = Meaning(10, "robot fault", "")
    ROBOT_MISSES_COMMANDS = Meaning(11, "robot misses commands", "")
    TICK_GAP = Meaning(20, "gateway was stopped", "ms")
    MESSAGE_MISSING = Meaning(21, "message is missing", "ms")
    MESSAGE_INVALID = Meaning(22, "message is invalid", "")
    NAVIGATION_FROZEN = Meaning(23, "navigation data frozen or late", "ms")
    NAVIGATION_COARSE = Meaning(24, "position mode too coarse", "")
    SPEED_IMPLAUSIBLE = Meaning(25, "speed contradicts itself or the wheels", "m/s")
    POSITION_IMPLAUSIBLE = Meaning(26, "position and speed contradict each other", "m")
    YAW_RATE_IMPLAUSIBLE = Meaning(27, "yaw rate and heading contradict each other", "rad/s")
    STEERING_IMPLAUSIBLE = Meaning(28, "steering angle moves impossibly fast", "rad/s")
    STEERING_NOT_FOLLOWING = Meaning(29, "steering robot does not follow", "rad")
    FRAMES_LOST = Meaning(30, "frames are lost", "%")
    CAR_NOT_SLOWING = Meaning(31, "car does not slow down in a gentle stop", "m/s")
    COMMAND_FAILED = Meaning(40, "controller failed", "")
    COMMAND_LOST = Meaning(41, "controller silent", "ms")
    COMMAND_INVALID = Meaning(42, "commands are invalid", "")
    SECOND_CONTROLLER = Meaning(43, "a second controller sends commands", "")
    LATENCY = Meaning(50, "control lags", "ms")
    OVERSPEED = Meaning(51, "too fast for the limit profile", "m/s")
    SELECTOR_NOT_IN_DRIVE = Meaning(52, "selector is not in D", "")
    OPERATOR_STOP = Meaning(53, "a stop is asked for", "")
    DRIVER_STEERS = Meaning(60, "driver steers", "")
    DRIVER_BRAKES = Meaning(61, "driver brakes", "")
    DRIVER_ACCELERATES = Meaning(62, "driver accelerates", "")
    DRIVER_OVERRIDE = Meaning(63, "driver override", "")
    OPERATOR_DISENGAGE = Meaning(64, "operator disengaged", "")
    ROBOTS_NOT_ENGAGED = Meaning(12, "robot controller is not engaged", "")

    @property
    def code(self) -> int:
        """Number on the bus."""
        return self.value.code


class Finding(NamedTuple):
    """That a cause is there, and how much of it.

    Args:
        value, limit: in the unit of the cause.
        source: message, robot, bus or process in which it was found.
    """

    cause: Cause
    value: float
    limit: float
    source: str

    def __str__(self) -> str:
        if {self.value, self.limit} == {0, 1} and not self.cause.value.unit:  # a yes or a no
            return f"{self.cause.value.text}: {self.source}"
        unit = f" {self.cause.value.unit}" if self.cause.value.unit else ""
        return f"{self.cause.value.text}: {self.source}, {self.value:.6g}{unit}, limit {self.limit:.6g}{unit}"


@dataclass(frozen=True, slots=True)
class Disengagement:
    """An engagement that ended, or a stop that became graver.

    Args:
        t_ns: monotonic time [ns].
    """

    t_ns: int
    finding: Finding
