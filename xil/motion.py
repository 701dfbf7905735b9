"""How one object of a scenario moves: the line that it follows, its speed along that line, and what sets off the changes of both.

Pure. Every position comes with its own velocity: between two calls speed and way are integrated exactly for the acceleration that holds.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from gateway.telemetry import WorldObject
from xil.course import Course, Line, blend
from xil.scenario_objects import Crossing, LaneChange, Motion, RoadObject, SpeedChange, crossing_goal_m

_SLOWEST_LANE_CHANGE_MPS = 1.0
"""An object that stands when its lane change begins makes it as if it drove this fast."""


class Car(NamedTuple):
    """The car as the objects see it.

    Args:
        front_m: station of its front.
        reached_m: largest station that its centre of gravity has had.
    """

    front_m: float
    reached_m: float
    speed_mps: float


class Place(NamedTuple):
    """A place on the line that an object follows.

    Args:
        stretch: way driven per coordinate of the line.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    stretch: float


class Track(Protocol):
    """The line that an object follows, by a coordinate that is 0 where the object appears and grows as it drives on."""

    def at(self, along_m: float) -> Place:
        """Place and direction on the line."""
        ...


@dataclass(frozen=True)
class Straight:
    """Straight on from a place."""

    x_m: float
    y_m: float
    yaw_rad: float

    def at(self, along_m: float) -> Place:
        """See `Track`."""
        return Place(self.x_m + along_m * math.cos(self.yaw_rad), self.y_m + along_m * math.sin(self.yaw_rad), self.yaw_rad, 1.0)


class Lane:
    """Along a base line at an offset that may change; straight on beyond its ends.

    Args:
        direction: 1 along the line, -1 against it.
    """

    def __init__(self, line: Line, station_m: float, offset_m: float, direction: float) -> None:
        self._line = line
        self._station_m, self._offset_m, self._direction = station_m, offset_m, direction
        self._shift_m, self._from_m, self._length_m = 0.0, 0.0, 1.0

    def shift(self, offset_m: float, from_m: float, length_m: float) -> None:
        """Move aside from a coordinate on, within a length."""
        self._shift_m, self._from_m, self._length_m = offset_m, from_m, length_m

    def at(self, along_m: float) -> Place:
        """See `Track`."""
        value, steepness = blend(np.array((along_m - self._from_m) / self._length_m))
        offset_m = self._offset_m + self._shift_m * float(value)
        aside = self._shift_m / self._length_m * float(steepness)
        (x_m, y_m), yaw_rad, curvature_radpm = beside(self._line, self._station_m + self._direction * along_m, offset_m)
        ahead = self._direction * (1.0 - curvature_radpm * offset_m)
        return Place(x_m, y_m, yaw_rad + math.atan2(aside, ahead), math.hypot(ahead, aside))


def beside(line: Line, station_m: float, offset_m: float) -> tuple[tuple[float, float], float, float]:
    """Point beside a line, and the line's direction and curvature there; straight on beyond its ends."""
    nearest_m = min(max(station_m, float(line.station_m[0])), float(line.station_m[-1]))
    x_m, y_m, yaw_rad, curvature_radpm = (
        float(np.interp(nearest_m, line.station_m, values)) for values in (line.x_m, line.y_m, line.yaw_rad, line.curvature_radpm)
    )
    beyond_m, cosine, sine = station_m - nearest_m, math.cos(yaw_rad), math.sin(yaw_rad)
    point_m = (x_m + beyond_m * cosine - offset_m * sine, y_m + beyond_m * sine + offset_m * cosine)
    return point_m, yaw_rad, 0.0 if beyond_m else curvature_radpm


class Mover:
    """An object since it is there.

    Args:
        t_s: time of its appearance.
    """

    def __init__(self, spec: RoadObject, course: Course, t_s: float) -> None:
        self.spec = spec
        self._course = course
        self._since_s = self._t_s = t_s
        self._along_m = 0.0
        self._end_m = math.inf
        self._speed_mps = self._goal_mps = spec.speed_kmh / 3.6
        self._acceleration_mps2 = 1.0
        self._track: Track = self._made_track()
        self._pending: list[SpeedChange | LaneChange | Crossing] = [
            *spec.speed_changes, *(change for change in (spec.lane_change, spec.crossing) if change is not None)
        ]  # fmt: skip

    def is_gone(self, t_s: float, reached_m: float) -> bool:
        """Whether it is to disappear."""
        return self.spec.is_gone(t_s - self._since_s, reached_m)

    def at(self, t_s: float, car: Car) -> WorldObject:
        """Where it is now, and how fast; times have to rise."""
        self._advance(t_s - self._t_s)
        self._t_s = t_s
        due = [change for change in self._pending if self._is_due(change, car)]
        for change in due:
            self._pending.remove(change)
            self._begin(change)
        x_m, y_m, yaw_rad, _ = self._track.at(self._along_m)
        length_m, width_m = self.spec.size_m
        return WorldObject(
            name=self.spec.name, x_m=x_m, y_m=y_m, yaw_rad=math.remainder(yaw_rad, 2.0 * math.pi), length_m=length_m, width_m=width_m,
            vx_mps=self._speed_mps * math.cos(yaw_rad), vy_mps=self._speed_mps * math.sin(yaw_rad),
        )  # fmt: skip

    def _made_track(self) -> Track:
        spec, line = self.spec, self._course.line
        if spec.motion is Motion.LANE:
            return Lane(line, spec.station_m, spec.offset_m, -1.0 if spec.heading_deg else 1.0)
        (x_m, y_m), yaw_rad, _ = beside(line, spec.station_m, spec.offset_m)
        if spec.crossing is not None:
            return Straight(x_m, y_m, yaw_rad + math.copysign(0.5 * math.pi, crossing_goal_m(spec) - spec.offset_m))
        return Straight(x_m, y_m, yaw_rad + math.radians(spec.heading_deg))

    def _advance(self, duration_s: float) -> None:
        """Drive on with the acceleration that holds, until the speed is what it is to be."""
        difference_mps = self._goal_mps - self._speed_mps
        changing_s = min(abs(difference_mps) / self._acceleration_mps2, duration_s)
        after_mps = self._speed_mps + math.copysign(self._acceleration_mps2 * changing_s, difference_mps)
        if changing_s < duration_s:
            after_mps = self._goal_mps
        way_m = 0.5 * (self._speed_mps + after_mps) * changing_s + after_mps * (duration_s - changing_s)
        self._speed_mps = after_mps
        middle_m = self._along_m + 0.5 * way_m / self._track.at(self._along_m).stretch
        self._along_m += way_m / self._track.at(middle_m).stretch
        if self._along_m >= self._end_m:
            self._along_m, self._speed_mps, self._goal_mps = self._end_m, 0.0, 0.0

    def _is_due(self, change: SpeedChange | LaneChange | Crossing, car: Car) -> bool:
        if change.after_s is not None:
            return self._t_s - self._since_s >= change.after_s
        if change.at_car_m is not None:
            return car.reached_m >= change.at_car_m
        if change.at_ttc_s is not None:
            return self._car_arrives_s(car) <= change.at_ttc_s
        return isinstance(change, Crossing) and self._car_arrives_s(car) <= self._walk_s(change)

    def _begin(self, change: SpeedChange | LaneChange | Crossing) -> None:
        if isinstance(change, SpeedChange):
            self._goal_mps, self._acceleration_mps2 = change.to_kmh / 3.6, change.acceleration_mps2
        elif isinstance(change, Crossing):
            self._goal_mps = change.speed_kmh / 3.6
            if change.run_up_m:
                self._acceleration_mps2 = self._goal_mps**2 / (2.0 * change.run_up_m)
            else:
                self._speed_mps = self._goal_mps
            self._end_m = abs(crossing_goal_m(self.spec) - self.spec.offset_m)
        elif isinstance(self._track, Lane):
            length_m = change.duration_s * max(self._speed_mps, _SLOWEST_LANE_CHANGE_MPS)
            self._track.shift(change.offset_m, self._along_m, length_m)

    def _car_arrives_s(self, car: Car) -> float:
        """Time until the car's front reaches the object, both at their present speeds; infinite when it does not."""
        x_m, y_m, yaw_rad, _ = self._track.at(self._along_m)
        along = self._course.project(np.array([x_m]), np.array([y_m]))
        cosine, sine = (part(yaw_rad - float(along.yaw_rad[0])) for part in (math.cos, math.sin))
        length_m, width_m = self.spec.size_m
        gap_m = float(along.station_m[0]) - 0.5 * (length_m * abs(cosine) + width_m * abs(sine)) - car.front_m
        closing_mps = car.speed_mps - self._speed_mps * cosine
        return gap_m / closing_mps if closing_mps > 0.0 and gap_m > 0.0 else math.inf

    def _walk_s(self, crossing: Crossing) -> float:
        """Time from the first step to the place where the car is to be met."""
        spec, speed_mps = self.spec, crossing.speed_kmh / 3.6
        side = math.copysign(1.0, spec.offset_m - crossing_goal_m(spec))
        car_m = self._course.reference_offset_m(spec.station_m)
        share = 0.01 * (crossing.meets_car_percent or 0.0)
        way_m = side * (spec.offset_m - car_m) - self._course.outline.half_width_m * (1.0 - 2.0 * share)
        if way_m <= crossing.run_up_m:
            return 2.0 * math.sqrt(crossing.run_up_m * max(way_m, 0.0)) / speed_mps
        return (way_m + crossing.run_up_m) / speed_mps
