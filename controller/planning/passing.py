"""Which way the car passes the objects before it, decided once and kept: the shift of the reference, and what cannot be passed.

Every cycle weighs the ways anew, but what has been decided stands as long as it is good. Only when it no longer is, or when there is
something new, is the shift changed, from the car's station on and without a step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from controller.planning.corridor import Encounter, Gap, Side, Surroundings, gaps, groups
from controller.planning.linking import Linker, Motion, Passage
from controller.planning.shift import Shift

_TOLERANCE_M = 0.5
_TOLERANCE_SHARE = 0.2
"""What was decided stands while the boxes' ends move by less than this distance plus this share of the safe distance."""
_ASIDE_M = 0.4
"""What was decided stands while it is at most this far from the line that would be chosen now, and clear of all boxes."""
_TOLERABLE_SHARE = 0.5
"""Share of the lateral safe distance that may be used up where there is no better way; all of it where the car cannot stop."""
_FAR_M = 1e6
_REOPENING_CYCLES = 8
"""For so many cycles a way must be open that was closed before it is taken: a third of a second."""
_SHORTER = 0.8
"""A return to the path is changed for one of at most this share of its length."""
_LATE_M = 0.3
"""By how much later than the outlines' meeting a shift that has been decided may be found to end."""


@dataclass(frozen=True)
class Decision:
    """What the planner does about the objects before it.

    Args:
        passed: encounters and the gap through which each is passed.
        blockers: encounters before which the car has to stop, or that it has to follow.
    """

    shift: Shift
    passed: tuple[tuple[Encounter, Gap], ...] = ()
    blockers: tuple[Encounter, ...] = ()


@dataclass
class Group:
    """Objects that are passed on one line, and the ways to do so, the best first."""

    meetings: Sequence[Encounter]
    ways: list[Gap] = field(default_factory=list)

    @property
    def names(self) -> set[str]:
        """Names of the objects."""
        return {meeting.track.name for meeting in self.meetings}

    @property
    def from_m(self) -> float:
        """Station of the car where the box of the first begins."""
        return min(meeting.soft.from_m for meeting in self.meetings)

    @property
    def to_m(self) -> float:
        """Station of the car where the box of the last ends."""
        return max(meeting.soft.to_m for meeting in self.meetings)


class Passing:
    """Decides, and remembers what it has decided."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the reference is the path."""
        self._shift = Shift()
        self._passages: tuple[Passage, ...] = ()
        self._sides: dict[str, Side] = {}
        self._closed: dict[str, int] = {}

    @property
    def shift(self) -> Shift:
        """The shift as it was decided last."""
        return self._shift

    def decide(self, meetings: Sequence[Encounter], motion: Motion, around: Surroundings) -> Decision:
        """Find ways past the objects, the nearest first, up to one that has none."""
        linker, here_m = Linker(self._shift, motion, around), float(motion.station_m[0])
        together = [self._group(group, linker, around) for group in groups(meetings, around.options.safe_longitudinal_m)]
        active = [p for p in self._passages if p.free_m > here_m or any(group.names & p.gap.sides.keys() for group in together)]
        passages = self._linked(together, active, linker, around)
        if len(passages) < len(together) and active:
            loyal = Linker(self._shift, motion, around)
            kept = self._linked(together, active, loyal, around, is_loyal=True)
            if len(kept) > len(passages):
                passages, linker = kept, loyal
        while passages and _is_trap(passages, together, linker, around):
            self._closed |= dict.fromkeys(together[len(passages) - 1].names, _REOPENING_CYCLES)
            linker = Linker(self._shift, motion, around)
            passages = self._linked(together, active, linker, around, most=len(passages) - 1)
        blocked = [meeting for group in together[len(passages) :] for meeting in group.meetings]
        is_beside = any(meeting.side is not None and meeting.hard is not None for meeting in blocked)
        if _stations(passages) != _stations(active) and not (is_beside and not passages):
            self._shift = linker.finish(in_haste=bool(blocked))
        elif blocked and not passages and not is_beside:
            self._shift = self._returned_earlier(linker)
        self._passages = tuple(passages)
        self._remember(meetings)
        passed = tuple((meeting, p.gap) for group, p in zip(together, passages, strict=False) for meeting in group.meetings)
        return Decision(self._shift, passed, self._blockers(blocked, here_m))

    def _returned_earlier(self, linker: Linker) -> Shift:
        """A return to the path before something that cannot be passed: the slower the car becomes, the shorter it can be."""
        remaining_m = self._shift.knots[-1].station_m - linker.here_m
        if remaining_m <= 0.0:
            return self._shift
        shorter = linker.finish(in_haste=True)
        return shorter if shorter.knots[-1].station_m - linker.here_m < _SHORTER * remaining_m else self._shift

    def _linked(
        self, together: list[Group], active: Sequence[Passage], linker: Linker, around: Surroundings, *,
        most: int | None = None, is_loyal: bool = False,
    ) -> list[Passage]:  # fmt: skip
        """What was decided where it is good, then new passages; what was decided also where it is tolerable and nothing else is left.

        Args:
            together: groups; one of which only a part can be passed is divided in place.
            most: number of passages.
            is_loyal: keep what was decided rather than look for a new passage, because that would close the way behind it.
        """
        passages: list[Passage] = []
        is_as_decided = True
        while len(passages) < (len(together) if most is None else most):
            k = len(passages)
            old = next((p for p in active if is_as_decided and together[k].names & p.gap.sides.keys()), None)
            passage = self._renewed(old, together[k], linker.here_m, around, is_last=old is active[-1]) if old else None
            if passage is None and old is not None and is_loyal:
                passage = self._tolerated(old, together, k, linker, around)
            if passage is None and (new := self._new(together[k], linker)) is not None:
                is_as_decided = False
                linker.take(new)
                passages.append(new)
                continue
            if passage is None and old is not None:
                passage = self._tolerated(old, together, k, linker, around)
            if passage is None:
                break
            linker.follow(passage)
            passages.append(passage)
        return passages

    def _tolerated(self, passage: Passage, together: list[Group], k: int, linker: Linker, around: Surroundings) -> Passage | None:
        """What was decided about a group, or about a part of it, if it will do."""
        group, names = together[k], passage.gap.sides.keys()
        part = Group([meeting for meeting in group.meetings if meeting.track.name in names])
        if not part.meetings or not self._is_tolerable(passage, part, linker.here_m, around):
            return None
        rest = [meeting for meeting in group.meetings if meeting.track.name not in names]
        together[k : k + 1] = [part, *([self._group(rest, linker, around)] if rest else [])]
        return passage

    def _group(self, meetings: Sequence[Encounter], linker: Linker, around: Surroundings) -> Group:
        group = Group(meetings)
        group.ways = gaps(meetings, linker.edges_m(group.to_m), self._sides, around.options)
        return group

    def _new(self, group: Group, linker: Linker) -> Passage | None:
        """The best way past a group that the car can take; after none was open, only one that stays open for a while."""
        passage = next((found for gap in group.ways if (found := linker.find(group.meetings, gap)) is not None), None)
        names = group.names & self._closed.keys()
        if passage is None:
            self._closed |= dict.fromkeys(group.names, _REOPENING_CYCLES)
        elif names:
            self._closed |= {name: self._closed[name] - 1 for name in names}
            return passage if all(self._closed[name] <= 0 for name in names) else None
        return passage

    def _renewed(self, passage: Passage, group: Group, here_m: float, around: Surroundings, is_last: bool) -> Passage | None:
        """A passage with its end where it now is seen to be; None when it is no longer good."""
        if not group.ways or not group.ways[0].sides.items() <= passage.gap.sides.items():
            return None
        gap, tolerance_m = group.ways[0], _TOLERANCE_M + _TOLERANCE_SHARE * around.safe_distance_m
        is_aside = abs(passage.offset_m - gap.target_m) > _ASIDE_M and here_m < passage.free_m
        if is_aside or not gap.low_m <= passage.offset_m <= gap.high_m:
            return None
        if not self._clears(group, gap, here_m, 0.0):
            return None
        is_begun = not passage.knots or here_m >= passage.knots[0].station_m
        if not is_begun and abs(passage.arrive_m - group.from_m) > tolerance_m:
            return None
        leave_m = max(passage.arrive_m, group.to_m)
        if here_m > passage.leave_m:
            return replace(passage, gap=gap) if leave_m < here_m + tolerance_m else None
        is_moved = is_last and abs(leave_m - passage.leave_m) > tolerance_m
        return replace(passage, gap=gap, leave_m=leave_m if is_moved else passage.leave_m)

    def _is_tolerable(self, passage: Passage, group: Group, here_m: float, around: Surroundings) -> bool:
        if any(meeting.side not in (None, passage.gap.sides[meeting.track.name]) for meeting in group.meetings):
            return False
        can_stop = _can_stop(group, here_m, around)
        return self._clears(group, passage.gap, here_m, -(_TOLERABLE_SHARE if can_stop else 1.0) * around.options.safe_lateral_m)

    def _clears(self, group: Group, gap: Gap, here_m: float, least_m: float) -> bool:
        """Whether the shift is on its side of each object from where the outlines meet."""
        return all(
            meeting.firm.side_room_m(self._shift.at(max(station_m, here_m)).offset_m, gap.sides[meeting.track.name]) >= least_m
            for meeting in group.meetings
            if meeting.hard is not None or meeting.side is None
            for station_m in (meeting.firm.from_m + _LATE_M, min(meeting.firm.to_m, here_m + _FAR_M))
        )

    def _remember(self, meetings: Sequence[Encounter]) -> None:
        """Keep the sides of what still is there."""
        chosen = self._sides | {name: side for passage in self._passages for name, side in passage.gap.sides.items()}
        names = {meeting.track.name for meeting in meetings}
        self._sides = {name: side for name, side in chosen.items() if name in names}
        self._closed = {name: left for name, left in self._closed.items() if name in names and left > 0}

    def _blockers(self, blocked: Sequence[Encounter], here_m: float) -> tuple[Encounter, ...]:
        """Objects without a way that the shift as it is would run into."""
        ahead = [meeting for meeting in blocked if meeting.side is None]
        return tuple([meeting for meeting in ahead if self._conflicts(meeting, here_m)] or ahead or blocked)

    def _conflicts(self, meeting: Encounter, here_m: float) -> bool:
        box = meeting.firm
        return any(box.low_m < self._shift.at(max(m, here_m)).offset_m < box.high_m for m in (box.from_m, min(box.to_m, here_m + _FAR_M)))


def _is_trap(passages: Sequence[Passage], together: Sequence[Group], linker: Linker, around: Surroundings) -> bool:
    """Whether the last passage leads in front of something that is not in the way on the path, as oncoming traffic is.

    Where the car can no longer stop before what it passes, only what comes towards it counts: it can stop before the rest.
    """
    if len(passages) == len(together) or any(m.side is not None and m.hard is not None for m in together[len(passages) - 1].meetings):
        return False
    last, back_m = passages[-1], linker.back_m(passages[-1])
    can_stop = _can_stop(together[len(passages) - 1], linker.here_m, around)
    counted = [meeting for meeting in together[len(passages)].meetings if can_stop or meeting.track.approaches]
    boxes = [meeting.firm for meeting in counted]
    return any(box.from_m < back_m and box.low_m < last.offset_m < box.high_m and not box.low_m < 0.0 < box.high_m for box in boxes)


def _can_stop(group: Group, here_m: float, around: Surroundings) -> bool:
    """Whether the hardest braking ends before the outlines would meet."""
    stop_m = here_m + around.speed_mps**2 / (2.0 * around.options.hardest_deceleration_mps2)
    return stop_m < min(meeting.firm.from_m for meeting in group.meetings)


def _stations(passages: Sequence[Passage]) -> list[tuple[float, float, float]]:
    """What makes the shift."""
    return [(passage.offset_m, passage.arrive_m, passage.leave_m) for passage in passages]
