"""All faults of a run, one millisecond at a time.

    active = faults.update(now_ns, Situation(state, is_engaged))    first in every step
    frames = faults.incoming(now_ns, frames)                        what reaches the robots of what was sent to them
    frames = faults.outgoing(now_ns, frames)                        what reaches the bus of what the car sends

Deterministic: every fault has a random generator of its own, made of the seed and its name, so that one more fault changes nothing
about the others.
"""

from collections.abc import Iterable, Sequence
from random import Random
from typing import NamedTuple

from dbc.catalogue import Catalogue
from dbc.frame import CanFrame
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.effects import NOTHING, ActiveFaults, Disturbance
from vehicle_emulator.faults.instance import Direction, Fault, FrameFault, make_fault
from vehicle_emulator.faults.schedule import NEVER_NS
from vehicle_emulator.faults.spec import MAX_FAULTS, FaultMistake, FaultSpec, named

BEGINS, ENDS, CLEARED = "begins", "ends", "cleared"
MAX_BEGINNINGS_NOTED = 100
"""Of one fault: a condition that comes and goes makes up to 1,000 events a second."""


class FaultEvent(NamedTuple):
    """A fault began, ended, or was taken back while it was active.

    Args:
        what: the fault as people type it.
        event: `BEGINS`, `ENDS` or `CLEARED`. After `MAX_BEGINNINGS_NOTED` beginnings and their ends one more beginning is noted,
            and from then on only that it is cleared or ends for good.
        hits: frames that it has hit so far.
    """

    t_ns: int
    name: str
    what: str
    event: str
    hits: int


class FaultEngine:
    """The faults of a run.

    Args:
        specs: that are there from the start.
        start_ns: time from which their times count [ns].

    Raises:
        FaultMistake: a fault names what the DBC does not have, or there are too many.
    """

    def __init__(self, specs: Iterable[FaultSpec], seed: int, start_ns: int, catalogue: Catalogue) -> None:
        self._seed = seed
        self._catalogue = catalogue
        self._faults: list[Fault] = []
        self._of_frames: list[FrameFault] = []
        self._on_frames: list[FrameFault] = []
        self._events: list[FaultEvent] = []
        self._active = NOTHING
        self._undisturbed: list[int | None] = []
        self._wake_ns = NEVER_NS
        self.add(start_ns, specs)

    @property
    def faults(self) -> Sequence[Fault]:
        """Every fault that was not cleared, in the order in which they came."""
        return self._faults

    def add(self, now_ns: int, specs: Iterable[FaultSpec]) -> list[Fault]:
        """Add faults, all or none; their times count from now.

        Returns:
            The new faults; each has a name now.

        Raises:
            FaultMistake: a name is taken, or there are too many faults, or see the class.
        """
        taken = [fault.spec.name for fault in self._faults]
        added = named(specs, taken)
        names = taken + [spec.name for spec in added]
        if repeated := [name for place, name in enumerate(names) if name in names[:place]]:
            raise FaultMistake(f"name = {repeated[0]!r}: allowed: a name that no fault has; clear it first")
        if len(names) > MAX_FAULTS:
            raise FaultMistake(f"{len(names)} faults: allowed: {MAX_FAULTS}; clear some first")
        new = [make_fault(spec, now_ns, Random(f"{self._seed} {spec.name}"), self._catalogue) for spec in added]
        self._faults += new
        self._of_frames += [fault for fault in new if isinstance(fault, FrameFault)]
        if new:
            self._wake_ns = 0
        return new

    def clear(self, now_ns: int, name: str | None = None) -> list[Fault]:
        """Take a fault back, or all of them; frames that it keeps go on.

        Returns:
            Those that were taken back.

        Raises:
            FaultMistake: there is none of that name.
        """
        cleared = [fault for fault in self._faults if name in (None, fault.spec.name)]
        if name is not None and not cleared:
            known = ", ".join(fault.spec.name for fault in self._faults) or "there is none"
            raise FaultMistake(f"fault {name!r} is unknown; known: {known}")
        for fault in cleared:
            if fault.schedule.is_active:
                self._note(now_ns, fault, CLEARED)
                self._undisturbed += fault.disturbed
            fault.schedule.end()
        self._faults = [fault for fault in self._faults if fault not in cleared]
        self._wake_ns = 0
        return cleared

    def update(self, now_ns: int, situation: Situation) -> ActiveFaults:
        """Take note of time and situation; what is wrong from now on."""
        if now_ns >= self._wake_ns:
            self._awake(now_ns, situation)
        return self._active

    def incoming(self, now_ns: int, frames: list[CanFrame]) -> list[CanFrame]:
        """What the car's nodes get of the frames that others have sent."""
        return self._through(Direction.TO_CAR, now_ns, frames)

    def outgoing(self, now_ns: int, frames: list[CanFrame]) -> list[CanFrame]:
        """What goes on the bus of the frames that the car's nodes send."""
        return self._through(Direction.FROM_CAR, now_ns, frames)

    def take_events(self) -> list[FaultEvent]:
        """What has happened since the last call."""
        if not self._events:
            return []
        events, self._events = self._events, []
        return events

    def _through(self, direction: Direction, now_ns: int, frames: list[CanFrame]) -> list[CanFrame]:
        for fault in self._on_frames:
            frames = fault.through(direction, now_ns, frames)
            if fault.picker.is_exhausted and not fault.schedule.is_over:
                self._wake_ns = 0
        return frames

    def _awake(self, now_ns: int, situation: Situation) -> None:
        active, wake_ns = NOTHING, NEVER_NS
        for fault in self._faults:
            was_active = fault.schedule.is_active
            fault.update(now_ns, situation)
            if fault.schedule.is_active is not was_active:
                self._note(now_ns, fault, ENDS if was_active else BEGINS)
                self._undisturbed += fault.disturbed if was_active else ()
            if fault.schedule.is_active:
                active = fault.apply(active, now_ns)
            wake_ns = min(wake_ns, fault.wake_ns)
        self._of_frames = [fault for fault in self._of_frames if fault.is_holding or not fault.schedule.is_over]
        self._on_frames = [fault for fault in self._of_frames if fault.is_in_use]
        if self._undisturbed:
            active = self._take_back(active)
        self._active = active
        # What is destroyed on the wire is asked for in one step only.
        self._wake_ns = now_ns if active.disturbances else wake_ns

    def _take_back(self, active: ActiveFaults) -> ActiveFaults:
        """Nothing of a fault that is over is left on the wire, unless another one is about the same frames."""
        disturbed = {identifier for fault in self._faults if fault.schedule.is_active for identifier in fault.disturbed}
        free = [identifier for identifier in dict.fromkeys(self._undisturbed) if identifier not in disturbed]
        self._undisturbed = []
        return active._replace(disturbances=(*(Disturbance(identifier, 0) for identifier in free), *active.disturbances))

    def _note(self, now_ns: int, fault: Fault, event: str) -> None:
        is_untold = fault.begun > MAX_BEGINNINGS_NOTED + (event == BEGINS)
        if is_untold and event != CLEARED and not fault.schedule.is_over:
            return
        self._events.append(FaultEvent(now_ns, fault.spec.name, fault.spec.text, event, fault.hits))
