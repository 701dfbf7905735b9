"""The rules of engagement, written down a second time: what an engagement needs, what ends it, and what nobody may do.

Nothing here is the gateway's own table. A condition is switched by the test, which therefore knows what is so; for each it is said after
how many ticks the gateway must have noticed, and which word its refusal has to contain.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from dbc.health import BusState, LinkHealth
from gateway.conditions import Surroundings
from gateway.messages import CommandStatus, Mode, Operation, OperatorReply
from tests.support.campaign import MS, World

HOLD_NS = 1_000 * MS
"""E2: for at least 1.0 s without a break."""
LATE_NS = 40 * MS
"""Time between what is so and what the gateway knows of it."""
SETTLED_TICKS = 360
"""Everything good for so long: the hold, one second after bad frames, 25 commands and a margin."""
DRIVING = (Mode.ENGAGED, Mode.COMFORT_STOP, Mode.SAFE_STOP)


class Grade(IntEnum):
    """What a condition does to a drive."""

    BLOCKS = 0  # keeps from READY and ENGAGED, does not end a drive
    COMFORT = 1
    SAFE = 2
    FAULT = 3
    DRIVER = 4  # or nobody: the robots have not


@dataclass(frozen=True)
class Condition:
    """One thing that may be wrong.

    Args:
        set: makes it so (True), or good again.
        word: in the refusal; one of several, where there are `|` between them.
        sure_ticks: after so many ticks it is known to the gateway; three, because the car speaks in cycles of its own.
        is_for_engage_only: does not keep from READY.
    """

    set: Callable[[World, bool], None]
    word: str
    grade: Grade = Grade.BLOCKS
    sure_ticks: int = 3
    is_for_engage_only: bool = False


def field(name: str, bad: object, good: object) -> Callable[[World, bool], None]:
    """A field of the car."""
    return lambda world, is_bad: setattr(world.car, name, bad if is_bad else good)


def member(name: str, element: str) -> Callable[[World, bool], None]:
    """An element of a set of the car."""
    return lambda world, is_bad: (getattr(world.car, name).add if is_bad else getattr(world.car, name).discard)(element)


def of_controller(name: str, bad: object, good: object) -> Callable[[World, bool], None]:
    """A field of the controller."""
    return lambda world, is_bad: setattr(world.controller, name, bad if is_bad else good)


def around(**bad: object) -> Callable[[World, bool], None]:
    """Something around the core; `health` is that of the robots' bus."""

    def switch(world: World, is_bad: bool) -> None:
        for name, value in bad.items():
            if is_bad:
                world.around[name] = value
            else:
                world.around.pop(name, None)

    return switch


_COMMAND_TICKS = 10
"""A command every 40 ms, at most 20 ms on its way, and steps of 8.5 ms and more."""

CONDITIONS = {
    "dead-man": Condition(field("dead_man", 0, 1), "dead-man"),
    "robots not ready": Condition(field("ready", 0, 1), "robots not ready"),
    "driver override": Condition(field("override", 1, 0), "driver", Grade.DRIVER),
    "driver accelerates": Condition(member("override_of", "AR"), "driver", Grade.DRIVER),
    "robot fault": Condition(field("fault", 1, 0), "robot fault", Grade.SAFE),
    "emergency stop": Condition(field("emergency_stop", 1, 0), "emergency stop", Grade.FAULT),
    "selector": Condition(field("selector", "N", "D"), "selector", Grade.COMFORT),
    "position mode": Condition(field("position_mode", "SPS", "RTKInteger"), "position mode", Grade.SAFE),
    "time frozen": Condition(field("is_time_frozen", True, False), "frozen", Grade.SAFE, 9),
    "watchdog": Condition(field("is_asking", False, True), "questions", Grade.SAFE, 15),
    "VelocityLevel missing": Condition(member("silent", "VelocityLevel"), "VelocityLevel", Grade.SAFE, 9),
    "BR_Status missing": Condition(member("silent", "BR_Status"), "BR_Status", Grade.SAFE, 9),
    "SR_Status corrupt": Condition(member("corrupt", "SR_Status"), "SR_Status", Grade.SAFE, 9),
    "not armed": Condition(field("system_state", "Disarmed", None), "not armed", Grade.DRIVER, 28, is_for_engage_only=True),
    "controller silent": Condition(of_controller("is_alive", False, True), "controller silent", Grade.SAFE, 18),
    "controller degraded": Condition(
        of_controller("status", CommandStatus.DEGRADED, CommandStatus.OK), "good commands|degraded", sure_ticks=_COMMAND_TICKS
    ),
    "controller failed": Condition(
        of_controller("status", CommandStatus.FAILED, CommandStatus.OK), "controller failed", Grade.SAFE, _COMMAND_TICKS
    ),
    "beside the path": Condition(
        of_controller("lateral_error_m", 1.6, 0.0), "beside the path", sure_ticks=_COMMAND_TICKS, is_for_engage_only=True
    ),
    "off in heading": Condition(
        of_controller("heading_error_rad", -0.27, 0.0), "heading", sure_ticks=_COMMAND_TICKS, is_for_engage_only=True
    ),
    "recorder": Condition(around(is_recording=False), "recorder"),
    "disk": Condition(around(disk_free_share=0.06), "disk"),
    "bus passive": Condition(around(health=LinkHealth(state=BusState.ERROR_PASSIVE)), "error-passive"),
    "bus blocked": Condition(around(health=LinkHealth(unconfirmed_ns=51 * MS)), "get through", Grade.FAULT),
}
SILENT, TOLD_BY_CONTROLLER = "controller silent", ("controller degraded", "controller failed", "beside the path", "off in heading")
_SAME = (("controller degraded", "controller failed"), ("bus passive", "bus blocked"))
"""Conditions that one switch sets to one value or the other."""


class Rules:
    """Watches a world tick by tick; `complaints` holds what broke a rule.

    Attributes:
        bad: conditions that are bad now, with the tick since which.
    """

    def __init__(self, world: World, settled_ticks: int) -> None:
        self.world = world
        self.bad: dict[str, int] = {}
        self.complaints: list[str] = []
        self._tick = 0
        self._good_since = -settled_ticks
        self._ready_since = 0
        self._last_sure_ns: dict[str, int] = {}
        self._driver_ns = -LATE_NS

    def switch(self, name: str) -> None:
        """Make a good condition bad or a bad one good."""
        for pair in _SAME:
            if name in pair:
                for other in pair:
                    if other != name and other in self.bad:
                        self._set(other, False)
        self._set(name, name not in self.bad)

    def _set(self, name: str, is_bad: bool) -> None:
        CONDITIONS[name].set(self.world, is_bad)
        if is_bad:
            self.bad[name] = self._tick
        else:
            del self.bad[name]
        if name == SILENT:
            self.bad |= dict.fromkeys(set(TOLD_BY_CONTROLLER) & set(self.bad), self._tick)

    def restart(self) -> None:
        """The gateway's process begins anew and has to learn that all is good."""
        self.world.restart_gateway()
        self._good_since = self._tick
        self.bad = dict.fromkeys(self.bad, self._tick)

    def step(self, operation: Operation | None = None, is_fresh: bool = True) -> None:
        """One tick, and its judgement.

        Args:
            operation: that the operator has just asked for.
            is_fresh: whether the request is new and of this moment.
        """
        world, before, answered = self.world, self.world.mode, len(self.world.replies)
        was_good = self._is_good
        world.tick()
        self._tick += 1
        if self.bad:
            self._good_since = self._tick
            self._last_sure_ns |= {name: world.now_ns for name in self.bad if self._sure(name)}
        if any(CONDITIONS[name].grade is Grade.DRIVER for name in self.bad):
            self._driver_ns = world.now_ns
        reply = world.replies[-1] if len(world.replies) > answered else None
        self._judge_change(before, world.mode, operation, reply, is_fresh)
        self._judge_staying(world.mode)
        if operation is not None and reply is not None:
            self._judge_answer(before, operation, reply, is_fresh, was_good)
        elif operation is not None:
            self._complain(f"no reply to {operation.name}")
        if world.mode is not before and world.mode is Mode.READY:
            self._ready_since = self._tick
        if world.mode is not before and world.mode is Mode.STANDBY:
            # The controller is a new one: it has to show 25 good commands, and what it says is not known yet.
            self._good_since = self._tick
            self.bad |= dict.fromkeys(set(TOLD_BY_CONTROLLER) & set(self.bad), self._tick)
        self.complaints += [f"oracle: {violation}" for violation in world.oracle.finish(world.now_ns)]
        world.oracle.violations.clear()

    @property
    def _is_good(self) -> bool:
        return not self.bad and self._tick - self._good_since >= SETTLED_TICKS

    def _sure(self, name: str) -> bool:
        """Whether the gateway must know of a bad condition by now."""
        return (SILENT not in self.bad or name not in TOLD_BY_CONTROLLER) and self._tick - self.bad[name] >= CONDITIONS[name].sure_ticks

    def _complain(self, what: str) -> None:
        self.complaints.append(f"tick {self._tick}, {self.world.mode.name}, bad {sorted(self.bad)}: {what}")

    def _judge_change(self, before: Mode, after: Mode, operation: Operation | None, reply: OperatorReply | None, is_fresh: bool) -> None:
        if after is before:
            return
        is_granted = reply is not None and not reply.refusals and is_fresh
        asked = {
            (Mode.SILENT, Mode.READY): Operation.ARM, (Mode.STANDBY, Mode.READY): Operation.ARM,
            (Mode.READY, Mode.ENGAGED): Operation.ENGAGE, (Mode.SILENT, Mode.STANDBY): Operation.RESET,
            (Mode.FAULT, Mode.STANDBY): Operation.RESET,
        }
        step = f"{before.name} -> {after.name}"
        if (before, after) in asked:
            if operation is not asked[before, after] or not is_granted:
                self._complain(f"{step} without a new request")
        elif before in (Mode.SILENT, Mode.STANDBY, Mode.FAULT) or after in (Mode.SILENT, Mode.READY, Mode.ENGAGED):
            self._complain(f"{step} must not be")
        elif before in (Mode.COMFORT_STOP, Mode.SAFE_STOP) and after is Mode.STANDBY:
            has_driver = self.world.now_ns - self._driver_ns <= LATE_NS
            if not has_driver and not (operation is Operation.RESET and is_granted and self.world.car.vx_mps <= 0.15):
                self._complain(f"{step} at {self.world.car.vx_mps:.1f} m/s without driver or reset")
        elif (before, after) == (Mode.SAFE_STOP, Mode.COMFORT_STOP):
            self._complain(f"{step}: a stop has become milder")
        if after in (Mode.READY, Mode.ENGAGED):
            recent = [
                name for name, sure_ns in self._last_sure_ns.items()
                if self.world.now_ns - sure_ns < HOLD_NS - LATE_NS and not CONDITIONS[name].is_for_engage_only
            ]
            if recent:
                self._complain(f"{step} although {recent} within the last second")

    def _judge_staying(self, mode: Mode) -> None:
        sure = {name for name in self.bad if self._sure(name)}
        worst = max((CONDITIONS[name].grade for name in sure if CONDITIONS[name].grade is not Grade.DRIVER), default=Grade.BLOCKS)
        drivers = [name for name in sure if CONDITIONS[name].grade is Grade.DRIVER]
        forbidden = {
            Mode.READY: any(not CONDITIONS[name].is_for_engage_only for name in sure),
            Mode.ENGAGED: worst > Grade.BLOCKS or bool(drivers),
            Mode.COMFORT_STOP: worst >= Grade.SAFE or bool(drivers),
            Mode.SAFE_STOP: worst >= Grade.FAULT or bool(drivers),
        }
        if forbidden.get(mode):
            self._complain(f"still {mode.name}")

    def _judge_answer(self, before: Mode, operation: Operation, reply: OperatorReply, is_fresh: bool, was_good: bool) -> None:
        after, text = self.world.mode, " / ".join(reply.refusals)
        if not is_fresh and operation is not Operation.STOP and not reply.refusals:
            self._complain(f"a stale {operation.name} was granted")
        must_act = operation is Operation.STOP or (operation is Operation.DISENGAGE and is_fresh)
        if must_act and before is Mode.ENGAGED and after is Mode.ENGAGED:
            self._complain(f"{operation.name} did not act: {text}")
        if not is_fresh:
            return
        wanted = {
            (Operation.ARM, Mode.SILENT): Mode.READY, (Operation.ARM, Mode.STANDBY): Mode.READY,
            (Operation.ENGAGE, Mode.READY): Mode.ENGAGED,
        }
        if (operation, before) not in wanted:
            return
        has_armed = operation is not Operation.ENGAGE or self._tick - self._ready_since > 5
        if was_good and not self.bad and has_armed and after is not wanted[operation, before]:
            self._complain(f"{operation.name} refused although all is good: {text}")
        for name in self.bad:
            condition = CONDITIONS[name]
            is_due = self._sure(name) and (operation is Operation.ENGAGE or not condition.is_for_engage_only)
            if is_due and not any(word in text for word in condition.word.split("|")):
                self._complain(f"refusal of {operation.name} does not name {name}: {text!r}")


def surroundings_of(world: World) -> None:
    """Let `world.around` decide what the core is told of its surroundings."""
    plain = world.surroundings

    def told(now_ns: int) -> Surroundings:
        around: dict[str, Any] = dict(world.around)
        if (health := around.pop("health", None)) is not None:
            around["links"] = {"robots": health}
        return replace(plain(now_ns), **around)

    world.surroundings = told
