"""What is true of the car, the robots and the controller in one tick, and the events and refusals that follow from it."""

from dataclasses import dataclass

from gateway.codec import Measurement
from gateway.commands import CommandGate
from gateway.messages import CommandStatus
from gateway.modes import Event

COMMAND_TIMEOUT_NS = 100_000_000
"""Age at which a command is too old: one missed solve is tolerated, two are not."""
MAX_TICK_GAP_NS = 50_000_000
"""A gateway that slept longer must not go on with what it did before."""
READY_COMMANDS = 25
"""Good commands in a row before the gateway is ready: one second of the controller."""

_MS_PER_NS = 1e-6


@dataclass(frozen=True, slots=True)
class Situation:
    """All that decides on the mode.

    Args:
        missing: needed messages without a good frame within their timeout.
        tick_gap_ns: time since the previous step [ns].
        is_navigation_frozen: frames arrive, but their time of validity stands still.
        is_engagement_settled: the robots have had time to follow into Engaged.
    """

    now_ns: int
    measurement: Measurement
    commands: CommandGate
    missing: list[str]
    tick_gap_ns: int
    is_navigation_frozen: bool
    is_engagement_settled: bool


def state_faults(s: Situation) -> list[str]:
    """Why the state estimate cannot be used; empty when it can."""
    if s.missing:
        return ["no good " + ", ".join(s.missing)]
    faults = []
    if s.is_navigation_frozen:
        faults.append("navigation data frozen")
    if not s.measurement.is_navigation_precise:
        faults.append("position mode too coarse")
    return faults


def blockers(s: Situation) -> list[str]:
    """What keeps the gateway from being ready, each by name; empty when nothing does."""
    m = s.measurement
    conditions = (
        (m.is_stopped_by_robots, f"robots stopped by {m.stop_source}"),
        (m.has_robot_fault, "a robot reports a fault"),
        (not m.are_robots_ready, "robots not ready"),
        (not m.is_dead_man_pressed, "dead-man not pressed"),
        (m.is_driver_override, "driver override"),
        (s.commands.age_ns(s.now_ns) > COMMAND_TIMEOUT_NS, "controller silent"),
        (s.commands.good_in_a_row < READY_COMMANDS, f"fewer than {READY_COMMANDS} good commands in a row"),
    )
    return state_faults(s) + [name for is_true, name in conditions if is_true]


def events(s: Situation, blocked_by: list[str]) -> dict[Event, str]:
    """Events of this tick, each with a detail for people; the mode table decides which of them matter."""
    m = s.measurement
    age_ns = s.commands.age_ns(s.now_ns)
    faults = state_faults(s)
    conditions = (
        (Event.EMERGENCY_STOP, m.is_stopped_by_robots, m.stop_source),
        (Event.ROBOT_FAULT, m.has_robot_fault, "a robot reports a fault"),
        (Event.ROBOT_FAULT, m.has_command_timeout and s.is_engagement_settled, "a robot misses our commands"),
        (Event.ROBOT_FAULT, not m.is_engaged and s.is_engagement_settled, "the robot controller is not engaged"),
        (Event.STATE_LOST, bool(faults), ", ".join(faults)),
        (Event.COMMAND_FAILED, s.commands.status is CommandStatus.FAILED, "no usable solution"),
        (Event.COMMAND_LOST, age_ns > COMMAND_TIMEOUT_NS, f"command older than {COMMAND_TIMEOUT_NS * _MS_PER_NS:.0f} ms"),
        (Event.TICK_GAP, s.tick_gap_ns > MAX_TICK_GAP_NS, f"{s.tick_gap_ns * _MS_PER_NS:.0f} ms without a step"),
        (Event.DRIVER_OVERRIDE, m.is_driver_override, ""),
        (Event.NOT_READY, bool(blocked_by), ", ".join(blocked_by)),
        (Event.ALL_READY, not blocked_by, ""),
    )
    happened: dict[Event, str] = {}
    for event, is_true, detail in conditions:
        if is_true:
            happened.setdefault(event, detail)
    return happened
