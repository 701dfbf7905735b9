"""What objects leave of the road: where the car would meet each, and between which of them it can pass.

The corridor is for the car's centre of gravity. Around every object lies a box that it may not enter: half of the object, half of the
car, and the safe distances. It is hard where the outlines would be beside each other, and soft as far as the safe distances reach.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from controller.planning.obstacles import PathFrame, Track
from controller.planning.options import PlannerOptions
from controller.problem import Array
from dbc.vehicle import Body, ModelParameters


class Side(IntEnum):
    """On which side of an object the car passes."""

    LEFT = 1
    RIGHT = -1


@dataclass(frozen=True)
class Outline:
    """Extents of the car from its centre of gravity."""

    front_m: float
    rear_m: float
    half_width_m: float

    @classmethod
    def of(cls, body: Body, car: ModelParameters) -> "Outline":
        """The outline of a car."""
        front_m = car.cog_to_front_m + body.front_overhang_m
        return cls(front_m, body.length_m - front_m, body.width_m / 2.0)

    def half_width_in_bend_m(self, curvature_radpm: float) -> float:
        """Half of the width that the outline sweeps in a bend [m]: its front corner is further out than its side."""
        return self.half_width_m + 0.5 * max(self.front_m, self.rear_m) ** 2 * curvature_radpm


@dataclass(frozen=True)
class Surroundings:
    """What the car is driving on, with which outline, and how far it keeps from what is there.

    Args:
        speed_mps: of the car.
    """

    frame: PathFrame
    outline: Outline
    options: PlannerOptions
    speed_mps: float

    @property
    def safe_distance_m(self) -> float:
        """Distance to keep along the path before and behind an object [m]."""
        return self.options.safe_longitudinal_m + self.options.safe_time_s * max(self.speed_mps, 0.0)

    def half_width_m(self, track: Track) -> Array:
        """Half of the width of an object's box for the centre of gravity, at the instants of its track [m]."""
        bend_radpm = self.frame.bend_radpm(float(track.station_m.min()), float(track.station_m.max()))
        return track.half_across_m + self.outline.half_width_in_bend_m(bend_radpm) + self.options.safe_lateral_m


@dataclass(frozen=True)
class Box:
    """Where the car would be in the way of an object.

    Args:
        from_m, to_m: stations of the car; the second is infinite when it does not get past.
        low_m, high_m: offsets of the car between which it would be too near the object at some time there.
    """

    from_m: float
    to_m: float
    low_m: float
    high_m: float

    def side_room_m(self, offset_m: float, side: Side) -> float:
        """By how much an offset is beyond the box on a side [m]."""
        return offset_m - self.high_m if side is Side.LEFT else self.low_m - offset_m


@dataclass(frozen=True)
class Encounter:
    """An object beside which the car would be.

    Args:
        soft: with the safe distances along the path.
        hard: without them; None when the outlines are not going to be beside each other, or no longer.
        side: where the car must pass because it already is there; None where it may choose.
    """

    track: Track
    soft: Box
    hard: Box | None
    side: Side | None

    @property
    def firm(self) -> Box:
        """The part of the box that is nearest to the object."""
        return self.hard or self.soft


@dataclass(frozen=True)
class Gap:
    """A way past a group of objects.

    Args:
        sides: on which side of each object, by its name.
        low_m, high_m: smallest and largest offset on this way.
        target_m: offset to drive at.
    """

    sides: Mapping[str, Side]
    low_m: float
    high_m: float
    target_m: float


def encounters(tracks: Sequence[Track], motion_m: Array, offset_m: float, around: Surroundings) -> list[Encounter]:
    """Objects on the road that the car will be beside, the nearest first.

    Args:
        motion_m: stations of the car at the instants of the tracks, if nothing were in its way, shape (K,).
        offset_m: of the reference now.
    """
    found = (_encounter(track, motion_m, offset_m, around) for track in tracks)
    return sorted((meeting for meeting in found if meeting is not None), key=lambda meeting: meeting.firm.from_m)


def _encounter(track: Track, motion_m: Array, offset_m: float, around: Surroundings) -> Encounter | None:
    ahead_m, outline, half_width_m = motion_m - track.station_m, around.outline, around.half_width_m(track)
    before_m, behind_m = track.half_along_m + outline.front_m, track.half_along_m + outline.rear_m
    soft, hard = (
        _box(track, ahead_m, (before_m + safe_m, behind_m + safe_m), motion_m, half_width_m) for safe_m in (around.safe_distance_m, 0.0)
    )
    if soft is None:
        return None
    left_m, right_m = around.frame.edges(soft.from_m, min(soft.to_m, float(motion_m[-1])))
    if soft.low_m >= left_m or soft.high_m <= -right_m:
        return None
    aside_m = float(offset_m - track.offset_m[0])
    if ahead_m[0] > behind_m[0] and abs(aside_m) < track.half_across_m[0] + outline.half_width_m:
        return None  # behind the car on its own line: it has to keep its distance
    is_beside = ahead_m[0] > -before_m[0]
    return Encounter(track, soft, hard, (Side.LEFT if aside_m >= 0.0 else Side.RIGHT) if is_beside else None)


def _box(track: Track, ahead_m: Array, reach_m: tuple[Array, Array], motion_m: Array, half_width_m: Array) -> Box | None:
    """The box of the first time that the car is from one reach before an object to the other behind it; None when it never is.

    Args:
        ahead_m: by how much the car is ahead of the object's centre.
    """
    depth_in, depth_out = ahead_m + reach_m[0], reach_m[1] - ahead_m
    if depth_out[0] < 0.0:  # the object comes from behind
        depth_in, depth_out = depth_out, depth_in
    entered = np.flatnonzero(depth_in >= 0.0)
    if not entered.size:
        return None
    first = int(entered[0])
    left = np.flatnonzero(np.minimum(depth_in, depth_out)[first:] < 0.0)
    last = first + int(left[0]) if left.size else len(motion_m) - 1
    from_m = float(motion_m[0]) if first == 0 else _crossing(depth_in, first, motion_m)
    to_m = _crossing(depth_out if depth_out[last] < 0.0 else depth_in, last, motion_m) if left.size else np.inf
    part = slice(max(first - 1, 0), last + 1)
    offset_m, half_width_m = track.offset_m[part], half_width_m[part]
    return Box(from_m, to_m, float((offset_m - half_width_m).min()), float((offset_m + half_width_m).max()))


def _crossing(depth_m: Array, k: int, motion_m: Array) -> float:
    """Station at which a depth is zero between the instants k - 1 and k."""
    before, after = float(depth_m[k - 1]), float(depth_m[k])
    return float(motion_m[k - 1]) + before / (before - after) * float(motion_m[k] - motion_m[k - 1])


def groups(meetings: Sequence[Encounter], gap_m: float) -> list[list[Encounter]]:
    """Encounters so close to each other along the way that they must be passed on one line.

    Args:
        gap_m: between two boxes, below which there is no changing the line between them [m].
    """
    together: list[list[Encounter]] = []
    end_m = -np.inf
    for meeting in meetings:
        if together and meeting.firm.from_m <= end_m + gap_m:
            together[-1].append(meeting)
        else:
            together.append([meeting])
        end_m = max(end_m, meeting.firm.to_m)
    return together


def gaps(group: Sequence[Encounter], edges_m: tuple[float, float], chosen: Mapping[str, Side], options: PlannerOptions) -> list[Gap]:
    """Ways past a group that are wide enough for the car, the best first.

    The best needs the least shift; one that changes a side that was chosen before needs `side_hysteresis_m` less. Of two alike it is
    the left, as traffic on the right overtakes.

    Args:
        edges_m: room of the centre of gravity to the left and right of the path.
    """
    left_m, right_m = edges_m
    ordered = sorted(group, key=lambda meeting: meeting.soft.low_m + meeting.soft.high_m)
    found: list[tuple[float, float, Gap]] = []
    for k in range(len(ordered) + 1):
        sides = {meeting.track.name: Side.LEFT if place < k else Side.RIGHT for place, meeting in enumerate(ordered)}
        low_m = max((meeting.soft.high_m for meeting in ordered[:k]), default=-right_m)
        high_m = min((meeting.soft.low_m for meeting in ordered[k:]), default=left_m)
        low_m, high_m = max(low_m, -right_m), min(high_m, left_m)
        if low_m > high_m or any(meeting.side not in (None, sides[meeting.track.name]) for meeting in group):
            continue
        changed = any(chosen.get(name, side) is not side for name, side in sides.items())
        target_m = _target_m(low_m, high_m, k > 0, k < len(ordered), options.reference_room_m)
        found.append((abs(target_m) + changed * options.side_hysteresis_m, -target_m, Gap(sides, low_m, high_m, target_m)))
    return [gap for _, _, gap in sorted(found, key=lambda entry: entry[:2])]


def _target_m(low_m: float, high_m: float, is_object_right: bool, is_object_left: bool, room_m: float) -> float:
    """Offset closest to the path with some room to the objects; the middle where there is less."""
    low = low_m + room_m * is_object_right
    high = high_m - room_m * is_object_left
    return 0.5 * (low_m + high_m) if low > high else min(max(0.0, low), high)


@dataclass(frozen=True)
class Bounds:
    """A corridor about a reference, arrays of shape (N+1,): distances to its left and right end, neither negative."""

    left_m: Array
    right_m: Array


def bounds(
    station_m: Array, offset_m: Array, edges_m: tuple[Array, Array], passed: Iterable[tuple[Track, Gap]], around: Surroundings
) -> Bounds:
    """The corridor at the nodes of a horizon.

    Where the reference still is on its way to the line on which it passes an object, the corridor keeps some room about it.

    Args:
        station_m, offset_m: of the reference, shape (N+1,).
        edges_m: room of the centre of gravity on the road, to the left and right of the path.
        passed: objects at the nodes, and the gaps through which they are passed.
    """
    low, high, outline = -edges_m[1], edges_m[0], around.outline
    for track, gap in passed:
        ahead_m, reach_m = station_m - track.station_m, track.half_along_m + around.safe_distance_m
        is_in = (ahead_m >= -reach_m - outline.front_m) & (ahead_m <= reach_m + outline.rear_m)
        room_m, half_width_m = min(around.options.reference_room_m, 0.5 * (gap.high_m - gap.low_m)), around.half_width_m(track)
        if gap.sides[track.name] is Side.LEFT:
            low = np.where(is_in, np.maximum(low, np.minimum(track.offset_m + half_width_m, offset_m - room_m)), low)
        else:
            high = np.where(is_in, np.minimum(high, np.maximum(track.offset_m - half_width_m, offset_m + room_m)), high)
    return Bounds(np.maximum(high - offset_m, 0.0), np.maximum(offset_m - low, 0.0))
