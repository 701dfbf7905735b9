"""One fault at work: its times, the frames that it is about, and its effect."""

import math
from collections.abc import Sequence
from enum import Enum
from random import Random

from dbc.catalogue import Catalogue
from dbc.frame import CanFrame
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.effects import GROWING, STATE_EFFECTS, ActiveFaults, Disturbance, Moment
from vehicle_emulator.faults.frames import FRAME_EFFECTS, Picker
from vehicle_emulator.faults.kinds import KINDS, Group
from vehicle_emulator.faults.schedule import NEVER_NS, Schedule
from vehicle_emulator.faults.spec import FaultSpec
from vehicle_emulator.faults.targets import Target, target_of

_BUS_OFF_ERRORS = 48
"""Transmit error counter 256 at 8 for each error (ISO 11898-1), and half as many again: each other frame of the controller takes 1 off."""
_NS_PER_MS = 1_000_000


class Direction(Enum):
    """Which way a frame goes."""

    FROM_CAR = "from the car"
    TO_CAR = "to the car"


class Fault:
    """One fault; the kinds of faults differ in what they do while they are active.

    Attributes:
        spec: what was asked for.
        schedule: when it is active.
        begun: how often it has begun.
        hits: frames that it has hit.
    """

    def __init__(self, spec: FaultSpec, base_ns: int) -> None:
        self.spec = spec
        self.schedule = Schedule(spec, base_ns)
        self.begun = 0

    @property
    def disturbed(self) -> Sequence[int | None]:
        """Identifiers whose transmissions it destroys; None for any."""
        return ()

    @property
    def hits(self) -> int:
        """Frames that it has hit."""
        return 0

    @property
    def state(self) -> str:
        """Whether it is yet to come, there, or over, for people."""
        return "active" if self.schedule.is_active else "over" if self.schedule.is_over else "waiting"

    @property
    def wake_ns(self) -> int:
        """Time before which nothing about it changes [ns]."""
        return self.schedule.wake_ns

    def update(self, now_ns: int, situation: Situation) -> None:
        """Take note of time and situation."""
        was_active = self.schedule.is_active
        self.schedule.update(now_ns, situation)
        if self.schedule.is_active and not was_active:
            self.begun += 1
            self.begin(now_ns)

    def begin(self, now_ns: int) -> None:
        """Become active, for the first time or again."""

    def apply(self, active: ActiveFaults, now_ns: int) -> ActiveFaults:
        """Add what it does besides what it does to frames; called while it is active."""
        return active


class FrameFault(Fault):
    """A fault that frames pass through."""

    def __init__(self, spec: FaultSpec, base_ns: int, random: Random, target: Target) -> None:
        super().__init__(spec, base_ns)
        self._identifiers = frozenset(target.messages)
        make = FRAME_EFFECTS[spec.kind]
        self._effects = {direction: make(spec, target.messages, random) for direction in self._directions(spec)}
        self.picker = Picker(spec, random)

    @staticmethod
    def _directions(spec: FaultSpec) -> Sequence[Direction]:
        return (Direction.FROM_CAR,) if spec.kind == "babble" else tuple(Direction)

    @property
    def hits(self) -> int:
        """See `Fault`."""
        return self.picker.hits

    @property
    def is_holding(self) -> bool:
        """Whether it keeps frames for later."""
        return any(effect.is_holding for effect in self._effects.values())

    @property
    def is_in_use(self) -> bool:
        """Whether frames must pass through it now."""
        needs_all = not self.schedule.is_over and any(effect.needs_all for effect in self._effects.values())
        return self.schedule.is_active or needs_all or self.is_holding

    def update(self, now_ns: int, situation: Situation) -> None:
        """See `Fault`."""
        if self.picker.is_exhausted:
            self.schedule.end()
        super().update(now_ns, situation)

    def begin(self, now_ns: int) -> None:
        """See `Fault`."""
        for effect in self._effects.values():
            effect.begin(now_ns)

    def through(self, direction: Direction, now_ns: int, frames: list[CanFrame]) -> list[CanFrame]:
        """What becomes of the frames of one step."""
        effect, is_active = self._effects.get(direction), self.schedule.is_active
        if effect is None or not (is_active or effect.needs_all or effect.is_holding):
            return frames
        passed = effect.release(now_ns, is_active)
        for frame in frames:
            if frame.arbitration_id not in self._identifiers:
                passed.append(frame)
                continue
            effect.see(now_ns, frame)
            passed += effect.take(now_ns, frame) if is_active and self.picker.picks() else effect.skip(now_ns, frame)
        return passed


class StateFault(Fault):
    """A fault of robots, driver, navigation system or car."""

    def __init__(self, spec: FaultSpec, base_ns: int, random: Random) -> None:
        super().__init__(spec, base_ns)
        self._effect = STATE_EFFECTS[spec.kind]
        self._direction_rad = random.uniform(-math.pi, math.pi)
        self._began_ns = base_ns

    @property
    def wake_ns(self) -> int:
        """See `Fault`."""
        return 0 if self.schedule.is_active and self.spec.kind in GROWING else self.schedule.wake_ns

    def begin(self, now_ns: int) -> None:
        """See `Fault`."""
        self._began_ns = now_ns

    def apply(self, active: ActiveFaults, now_ns: int) -> ActiveFaults:
        """See `Fault`."""
        return self._effect(active, self.spec, Moment((now_ns - self._began_ns) * 1e-9, self._direction_rad))


class WireFault(Fault):
    """A fault that destroys transmissions on the wire."""

    def __init__(self, spec: FaultSpec, base_ns: int, target: Target) -> None:
        super().__init__(spec, base_ns)
        self._period_ns = round(spec.number("period_ms") * _NS_PER_MS) if "period_ms" in spec.values else NEVER_NS
        self._disturbances = _disturbances(spec, target)
        self._next_ns = NEVER_NS

    @property
    def disturbed(self) -> Sequence[int | None]:
        """See `Fault`."""
        return [disturbance.arbitration_id for disturbance in self._disturbances]

    @property
    def wake_ns(self) -> int:
        """See `Fault`."""
        return min(self.schedule.wake_ns, self._next_ns) if self.schedule.is_active else self.schedule.wake_ns

    def begin(self, now_ns: int) -> None:
        """See `Fault`."""
        self._next_ns = now_ns

    def apply(self, active: ActiveFaults, now_ns: int) -> ActiveFaults:
        """See `Fault`."""
        if now_ns < self._next_ns:
            return active
        self._next_ns += self._period_ns
        return active._replace(disturbances=(*active.disturbances, *self._disturbances))


def _disturbances(spec: FaultSpec, target: Target) -> tuple[Disturbance, ...]:
    if spec.kind == "bus_off":
        # Error counters belong to the controller: the message that comes soonest takes all its others with it.
        soonest = min(target.messages.values(), key=lambda message: (message.cycle_time_ns or math.inf, message.arbitration_id))
        return (Disturbance(soonest.arbitration_id, _BUS_OFF_ERRORS),)
    errors = int(spec.number("errors"))
    identifiers = [None] if target.is_everything else sorted(target.messages)
    return tuple(Disturbance(identifier, errors) for identifier in identifiers)


def make_fault(spec: FaultSpec, base_ns: int, random: Random, catalogue: Catalogue) -> Fault:
    """The fault that was asked for.

    Raises:
        FaultMistake: it names what the DBC does not have.
    """
    target = target_of(spec, catalogue)
    match KINDS[spec.kind].group:
        case Group.FRAMES:
            return FrameFault(spec, base_ns, random, target)
        case Group.WIRE:
            return WireFault(spec, base_ns, target)
        case _:
            return StateFault(spec, base_ns, random)
