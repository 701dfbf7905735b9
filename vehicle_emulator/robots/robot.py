"""What the three robots have in common: commands, state machine, faults, driver override, and the flags of their status."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

from dbc.catalogue import Catalogue
from dbc.robots import RobotParameters
from vehicle_emulator.robots.faults import HEALTHY
from vehicle_emulator.robots.receiver import CommandReceiver, Values
from vehicle_emulator.robots.states import FAULTED, READY, SOFT_CODES, STARTING, Dtc, Event, Persistence, RobotState, RobotStateMachine
from vehicle_emulator.robots.supervisor import RELEASED, STOPS, SystemState

PASSIVE_MODES = ("Off", "Standby", "Release", "Retract")
"""Modes in which a robot is released."""


class View(NamedTuple):
    """What a robot knows of the system in one step.

    Args:
        is_overridden: whether the driver has taken over from any robot.
        clears_faults: whether the gateway asks to clear the faults of all robots.
    """

    now_ns: int
    state: SystemState
    is_safety_fresh: bool = True
    is_overridden: bool = False
    clears_faults: bool = False


class LimitsHit(NamedTuple):
    """Which limits shape what a robot does now."""

    is_position: bool = False
    is_rate: bool = False
    is_force: bool = False


FREE = LimitsHit()
_WELL = (0, False, FREE, None)
"""A `Robot.condition` without troubles."""


def limits_hit(is_position: bool, is_rate: bool, is_force: bool) -> LimitsHit:
    """Which limits are hit; usually none."""
    return LimitsHit(is_position, is_rate, is_force) if is_position or is_rate or is_force else FREE


_ENGAGED, _STANDBY, _FAULT_HARD, _SYSTEM_ENGAGED = RobotState.ENGAGED, RobotState.STANDBY, RobotState.FAULT_HARD, SystemState.ENGAGED
"""For what is done every millisecond: Python 3.11 takes long to look up a member of an enumeration."""


class Robot(ABC):
    """One robot without its mechanics.

    Its Mode changes in standby only: a command that asks an engaged robot for another active mode does not count.

    Args:
        node: the robot's node in the DBC; its messages are NODE_Command, NODE_Status and NODE_Diag.
        modes: active modes, entries of the command's Mode table.

    Attributes:
        is_overridden: whether the driver has taken over from this robot; until it is in standby again and he has let go.
        faults: what is wrong with it; may be replaced at any step.
        latched: code of the fault that it is in, the first one or the first hard one; 0 for none.
        limits_hit: in the last step.
    """

    def __init__(self, catalogue: Catalogue, node: str, parameters: RobotParameters, modes: Iterable[str], period_s: float) -> None:
        self.node = node
        self.command = CommandReceiver(catalogue, f"{node}_Command", self._accepts)
        self.machine = RobotStateMachine(period_s)
        self.is_overridden = False
        self.faults = HEALTHY
        self.latched = 0
        self.limits_hit = FREE
        table = catalogue.enumeration(f"{node}_Command", "Mode")
        self._active_modes: dict[float, str] = {table[name]: name for name in modes}
        self._modes = {table[name] for name in PASSIVE_MODES if name in table} | set(self._active_modes)
        self._states = catalogue.enumeration(f"{node}_Status", "State")
        self._codes = catalogue.enumeration(f"{node}_Diag", "Dtc")
        self._override = Persistence(period_s, parameters.override_time_s)
        self._following_error = Persistence(period_s, parameters.following_error_time_s)
        self._is_timed_out = True
        self._is_overdue = False
        self._settled: tuple[object, ...] | None = None

    @property
    @abstractmethod
    def effort(self) -> float:
        """Share of its torque or force that it applies."""

    @abstractmethod
    def status(self) -> dict[str, float]:
        """Signals of NODE_Status, in the units of the DBC; reads its noisy sensor."""

    @property
    def state(self) -> RobotState:
        """What the robot is doing."""
        return self.machine.state

    @property
    def is_engaged(self) -> bool:
        """Whether it follows its command."""
        return self.machine.state is _ENGAGED

    @property
    def has_let_go(self) -> bool:
        """Whether it is without torque and force."""
        return self.faults.drops_torque or self.machine.state is _FAULT_HARD

    @property
    def mode(self) -> str | None:
        """Active mode of the newest good command."""
        return self._active_modes.get(self.command.values["Mode"])

    @property
    def is_ready(self) -> bool:
        """Whether it can do, now or when it is engaged, what it is told."""
        return self.state in READY

    @property
    def has_started(self) -> bool:
        """Whether its start-up is over."""
        return self.state not in STARTING

    @property
    def has_fault(self) -> bool:
        """Whether it is in a fault."""
        return self.state in FAULTED

    @property
    def troubles(self) -> frozenset[int]:
        """Codes of what is wrong now: the fault that it is in, and warnings."""
        if self.condition == _WELL:
            return frozenset()
        warnings = (
            (self._is_overdue, Dtc.COMMAND_TIMEOUT),
            (self.limits_hit.is_position, Dtc.END_STOP),
            (self.limits_hit.is_force, Dtc.FORCE_LIMIT),
            (self.command.trouble is not None, self.command.trouble),
        )
        codes = (self._codes.get(name, 0) for is_true, name in warnings if is_true and name is not None)
        return frozenset(filter(None, (self.latched, *codes)))

    @property
    def condition(self) -> tuple[object, ...]:
        """Changes when `troubles` change."""
        return self.latched, self._is_overdue, self.limits_hit, self.command.trouble

    @property
    def dtc(self) -> int:
        """Code that its diagnosis shows: the fault, else the first warning, else 0."""
        return self.latched or min(self.troubles, default=0)

    def _accepts(self, values: Values) -> bool:
        mode = int(values["Mode"])
        is_change = mode in self._active_modes and mode != int(self.command.values["Mode"])
        return mode in self._modes and not (is_change and self.state is RobotState.ENGAGED)

    def _update(self, view: View, is_astray: bool, is_driver_stronger: bool) -> RobotState:
        """Decide on the state: once in each step, before the robot moves.

        Args:
            is_astray: whether it is too far from where it should be.
            is_driver_stronger: whether the driver pulls or presses harder than the robot allows.
        """
        state, command = self.machine.state, self.command
        was_engaged = state is _ENGAGED
        is_fresh = command.is_fresh(view.now_ns)
        self._is_overdue = not is_fresh and command.is_overdue(view.now_ns)
        self._is_timed_out = not (is_fresh and view.is_safety_fresh)
        is_lost = self._following_error.step(is_astray and was_engaged)
        is_taken = self._override.step(is_driver_stronger and was_engaged)
        self.is_overridden = is_taken or (self.is_overridden and (state is not _STANDBY or is_driver_stronger))
        found = self.faults.dtc or (self._codes[Dtc.FOLLOWING_ERROR] if is_lost else 0)
        is_cleared = state in FAULTED and not found and self.clears(view)
        if is_cleared:
            self.latched = 0
        elif found and (not self.latched or (self.latched in SOFT_CODES and found not in SOFT_CODES)):
            self.latched = found
        follows = is_fresh and view.state is _SYSTEM_ENGAGED and bool(command.values["Enable"]) and self.mode is not None
        situation = (state, view.state, view.is_overridden, self.latched, is_cleared, follows)
        if situation == self._settled:
            return state
        after = self.machine.update(self._events(view, is_cleared, follows))
        self._settled = situation if after is state and self.has_started else None
        return after

    def _events(self, view: View, is_cleared: bool, follows: bool) -> set[Event]:
        events = (
            (Event.HARD_FAULT, self.latched != 0 and self.latched not in SOFT_CODES),
            (Event.SOFT_FAULT, self.latched in SOFT_CODES),
            (Event.CLEARED, is_cleared),
            (Event.EMERGENCY_STOP, view.state is SystemState.EMERGENCY_STOP),
            (Event.CONTROLLED_STOP, view.state is SystemState.CONTROLLED_STOP),
            (Event.DISARMED, view.state in RELEASED),
            (Event.OVERRIDE, view.is_overridden),
            (Event.FOLLOW, follows),
            (Event.ARMED, view.state in (SystemState.ARMED, SystemState.ENGAGED)),
        )
        return {event for event, is_true in events if is_true}

    def clears(self, view: View) -> bool:
        """Whether its faults are to be cleared now: asked for all robots, or by its own command."""
        is_asked = view.clears_faults or (bool(self.command.values["ClearFault"]) and self.command.is_fresh(view.now_ns))
        return is_asked and view.state in RELEASED

    def _stops(self, view: View) -> bool:
        """Whether it has to do its part in a stop: one that is on, or that its own fault is about to bring; never against the driver."""
        if view.is_overridden:
            return False
        if view.state is _SYSTEM_ENGAGED:
            return self.state is RobotState.FAULT_SOFT
        return view.state in STOPS and self.state is not RobotState.FAULT_HARD

    def _common_status(self) -> dict[str, float]:
        return {
            "State": self._states[self.state],
            "Fault": self.has_fault,
            "Warning": bool(self.troubles - {self.latched}),
            "DriverOverride": self.is_overridden,
            "LimitRate": self.limits_hit.is_rate,
            "Tracking": self.state is RobotState.ENGAGED,
            "CommandTimeout": self._is_timed_out,
        }
