"""Strings passages together to one shift: when to begin each, how to get there, and the way back to the path."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.planning.corridor import Encounter, Gap, Surroundings
from controller.planning.shift import Knot, Shift, blend_length_m
from controller.problem import Array

_KEEP_BEHIND_M = 2.0
_LEAST_BEND_SHARE = 0.2
"""Share of the largest curvature that a shift may use in whatever bend of the path."""
_SLOWEST_MPS = 0.1
_LONGEST_RETURN_M = 20.0
"""Length of a return to the path where none is gentle enough."""


@dataclass(frozen=True)
class Motion:
    """How the car would drive on if nothing were in its way; arrays of shape (K,), the first entry is now."""

    station_m: Array
    speed_mps: Array

    def speed_at(self, station_m: float) -> float:
        """Speed at a station ahead [m/s]."""
        return float(np.interp(station_m, self.station_m, self.speed_mps))


@dataclass(frozen=True)
class Passage:
    """A group of objects that is passed on one line, and the knots that lead there.

    Args:
        knots: of the shift up to `arrive_m`, from the passage before on.
        arrive_m, leave_m: stations between which the reference is on the line; the second is infinite while no end is in sight.
        free_m: station from which the line may be left for another passage.
    """

    gap: Gap
    offset_m: float
    knots: tuple[Knot, ...]
    arrive_m: float
    leave_m: float
    free_m: float


class Linker:
    """Makes one shift of passages, from the car's station on."""

    def __init__(self, shift: Shift, motion: Motion, around: Surroundings) -> None:
        self._shift = shift
        self._motion = motion
        self._frame = around.frame
        self._options = around.options
        self.here_m = float(motion.station_m[0])
        self._knots: tuple[Knot, ...] = ()
        self._last: Passage | None = None

    def edges_m(self, to_m: float) -> tuple[float, float]:
        """Least room to the left and right of the path from the car to a station, as far as the car looks ahead."""
        return self._frame.edges(self.here_m, min(to_m, float(self._motion.station_m[-1])))

    def back_m(self, passage: Passage) -> float:
        """Station at which the reference can be back on the path after a passage."""
        return passage.free_m + self._shortest_m(Knot(passage.free_m, passage.offset_m), 0.0, passage.free_m)

    def follow(self, passage: Passage) -> None:
        """Go on with a passage that is in the shift already."""
        if passage.leave_m > self.here_m:
            self._knots = tuple(knot for knot in self._shift.ahead(self.here_m) if knot.station_m <= passage.arrive_m)
            self._last = passage

    def find(self, group: Sequence[Encounter], gap: Gap) -> Passage | None:
        """The passage of a group through a gap, if there is room to get there."""
        found = (self._from(knots, start, group, gap) for knots, start in self._starts())
        return next((passage for passage in found if passage is not None), None)

    def take(self, passage: Passage) -> None:
        """Go on with a passage that was found."""
        self._knots += passage.knots
        self._last = passage

    def finish(self, in_haste: bool) -> Shift:
        """The shift with its return to the path.

        Args:
            in_haste: return as fast as can be, because there is no way on.
        """
        if self._last is not None and not np.isfinite(self._last.leave_m):
            return self._shift.continued(self.here_m, self._knots, _KEEP_BEHIND_M)
        knots, end = self._starts()[-1] if in_haste and self._last is None else self._starts()[0]
        knots = (*self._knots, *knots, end)
        if end.offset_m != 0.0 or not end.is_at_rest:
            length_m = self._shortest_m(end, 0.0, end.station_m) if in_haste else self._comfortable_m(end, 0.0, end.station_m)
            knots += (Knot(end.station_m + (length_m if np.isfinite(length_m) else _LONGEST_RETURN_M), 0.0),)
        return self._shift.continued(self.here_m, knots, _KEEP_BEHIND_M)

    def _starts(self) -> list[tuple[tuple[Knot, ...], Knot]]:
        """Where a blend can begin, and the knots up to there: behind what is under way, or else from the midst of it."""
        if self._last is not None:
            stations_m = sorted({max(self.here_m, m) for m in (self._last.leave_m, self._last.free_m)}, reverse=True)
            return [((), Knot(station_m, self._last.offset_m)) for station_m in stations_m if np.isfinite(station_m)]
        here = self._shift.at(self.here_m)
        if here.is_at_rest:
            return [((), here)]
        ahead = self._shift.ahead(self.here_m)
        settled = next(k for k, knot in enumerate(ahead) if knot.is_at_rest)
        return [(ahead[: settled + 1], ahead[settled]), ((), here)]

    def _from(self, knots: tuple[Knot, ...], start: Knot, group: Sequence[Encounter], gap: Gap) -> Passage | None:
        due_m = min(meeting.soft.from_m for meeting in group)
        in_the_way = [m for m in group if m.soft.side_room_m(start.offset_m, gap.sides[m.track.name]) < 0.0]
        if not all(np.isfinite(meeting.soft.to_m) for meeting in in_the_way):
            return None
        is_there = gap.low_m <= start.offset_m <= gap.high_m and abs(start.offset_m - gap.target_m) <= self._options.reference_room_m
        if start.is_at_rest and is_there:
            return _passage(group, gap, start.offset_m, (*knots, start), start.station_m)
        latest_m = min((meeting.firm.from_m for meeting in in_the_way), default=np.inf)
        way = self._way(start, gap.target_m, due_m)
        if not way or way[-1].station_m > latest_m:
            return None
        return _passage(group, gap, gap.target_m, (*knots, start, *way), way[-1].station_m)

    def _way(self, start: Knot, target_m: float, due_m: float) -> tuple[Knot, ...]:
        """Knots from a start to a line, comfortable if there is time for that; empty when there is no way."""
        if start.is_at_rest and start.offset_m != 0.0:
            path = Knot(start.station_m + self._comfortable_m(start, 0.0, due_m), 0.0)
            length_m = self._comfortable_m(path, target_m, due_m)
            if path.station_m + length_m <= due_m:
                return path, *_ending(path, target_m, length_m, due_m)
        length_m = self._comfortable_m(start, target_m, due_m)
        if start.station_m + length_m <= due_m:
            return _ending(start, target_m, length_m, due_m)
        length_m = self._shortest_m(start, target_m, due_m)
        if not np.isfinite(length_m):
            return ()
        arrive_m = start.station_m + length_m
        return (Knot(max(arrive_m, due_m) if start.is_at_rest else arrive_m, target_m),)

    def _comfortable_m(self, start: Knot, target_m: float, due_m: float) -> float:
        speed_mps = self._motion.speed_at(max(due_m, start.station_m))
        return self._blend_m(start, target_m, due_m, self._options.lateral_acceleration_mps2 / max(speed_mps, _SLOWEST_MPS) ** 2)

    def _shortest_m(self, start: Knot, target_m: float, due_m: float) -> float:
        speed_mps = max(float(self._motion.speed_mps[0]), _SLOWEST_MPS)
        return self._blend_m(start, target_m, due_m, self._options.hardest_lateral_acceleration_mps2 / speed_mps**2)

    def _blend_m(self, start: Knot, target_m: float, due_m: float, bend_radpm: float) -> float:
        to_m = max(due_m, start.station_m)
        most_radpm = min(bend_radpm, self._options.tightest_curvature_radpm)
        least_radpm = _LEAST_BEND_SHARE * most_radpm
        left_m, right_m = self._frame.edges(start.station_m, to_m)
        bend_radpm = max(most_radpm - self._frame.bend_radpm(start.station_m, to_m), least_radpm)
        return blend_length_m(start, target_m, bend_radpm, (-right_m, left_m))


def _passage(group: Sequence[Encounter], gap: Gap, offset_m: float, knots: tuple[Knot, ...], arrive_m: float) -> Passage:
    leave_m, free_m = max(meeting.soft.to_m for meeting in group), max(meeting.firm.to_m for meeting in group)
    return Passage(gap, offset_m, knots, arrive_m, max(arrive_m, leave_m), max(arrive_m, free_m))


def _ending(start: Knot, target_m: float, length_m: float, due_m: float) -> tuple[Knot, ...]:
    """A blend from a start that ends when it is due; where it must begin at once, after its length."""
    if not start.is_at_rest:
        return (Knot(start.station_m + length_m, target_m),)
    return Knot(due_m - length_m, start.offset_m), Knot(due_m, target_m)
