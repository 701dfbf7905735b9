"""The objects of a scenario: what stands, drives and walks on the road besides the car, and when it does what.

Offsets are left of the base line. An object is a box on the ground around its centre.
"""

from enum import StrEnum
from typing import Annotated, Self

from pydantic import Field, model_validator

from dbc.section import Section, between, misfit
from vehicle_emulator.road import Station

Lateral = Annotated[float, between(-20.0, 20.0)]
Size = Annotated[float, between(0.1, 50.0)]
Speed = Annotated[float, between(0.0, 250.0)]
Seconds = Annotated[float, between(0.0, 600.0)]
Acceleration = Annotated[float, between(0.1, 10.0)]

SIZES_M: dict[str, tuple[float, float]] = {
    "car": (4.0, 1.712),
    "adult": (0.6, 0.5),
    "child": (0.5, 0.298),
    "cyclist": (1.9, 0.5),
}
"""Length and width by kind. Widths of car, adult and child: those of Euro NCAP's targets, as in the public scenario files of its
protocols AEB Car-to-Car 4.3.1 and AEB VRU 4.5.1. Lengths, and the cyclist: assumption."""


class Motion(StrEnum):
    """How an object moves on: straight along its heading, or along the base line at its offset."""

    STRAIGHT = "straight"
    LANE = "lane"


class _Triggered(Section):
    """Something that happens once, at the first of the moments that are given; one has to be.

    Args:
        after_s: time since the object appeared.
        at_car_m: station at which the car then is.
        at_ttc_s: time in which the car would reach the object, both at their speeds of that moment.
    """

    after_s: Seconds | None = None
    at_car_m: Station | None = None
    at_ttc_s: Annotated[float, between(0.1, 60.0)] | None = None

    @model_validator(mode="after")
    def _has_a_moment(self) -> Self:
        given = {key for key in type(self).moments() if getattr(self, key) is not None}
        if len(given) != 1:
            raise misfit(f"one of {', '.join(type(self).moments())}")
        return self

    @classmethod
    def moments(cls) -> tuple[str, ...]:
        """Keys of which one says when."""
        return "after_s", "at_car_m", "at_ttc_s"


class SpeedChange(_Triggered):
    """An object accelerates or brakes to another speed."""

    to_kmh: Speed
    acceleration_mps2: Acceleration


class LaneChange(_Triggered):
    """An object moves aside along a quintic and then keeps its lane.

    Args:
        offset_m: by how much, left positive.
        duration_s: time that it takes at the speed at which it begins; the shift is one of the way driven, so that an object that
            brakes meanwhile takes longer.
    """

    offset_m: Lateral
    duration_s: Annotated[float, between(0.5, 60.0)]


class Crossing(_Triggered):
    """An object that stands beside the road walks straight across it, and stands again.

    Args:
        meets_car_percent: instead of another moment: it starts so that the car, going on at its speed of that moment along the
            reference, would hit it with this share of the width of its front, counted from the side that the object comes from; 25, 50
            and 75 in Euro NCAP's AEB VRU protocol.
        run_up_m: way in which it gets to its speed; that protocol has 1 m for an adult and 1.5 m for a runner.
        to_offset_m: where it stands in the end; else as far on the other side as it started from.
    """

    speed_kmh: Annotated[float, between(0.5, 30.0)]
    run_up_m: Annotated[float, between(0.0, 10.0)] = 0.0
    to_offset_m: Lateral | None = None
    meets_car_percent: Annotated[float, between(0.0, 100.0)] | None = None

    @classmethod
    def moments(cls) -> tuple[str, ...]:
        """See `_Triggered`."""
        return "after_s", "at_car_m", "at_ttc_s", "meets_car_percent"


class RoadObject(Section):
    """A box on the ground; it is there and moves from its appearance on.

    Args:
        kind: gives the size where none is given, see `SIZES_M`.
        station_m, offset_m: its centre when it appears.
        heading_deg: from the direction of the base line there, left positive. Along the lane it is 0, or 180 for oncoming traffic;
            what crosses looks where it will walk.
        speed_kmh: when it appears, along its heading.
        appears_at_m: station at which the car then is.
        appears_at_s: time since the start of the run. Without both it is there from the start.
        disappears_at_m: station at which the car then is.
        disappears_after_s: time since it appeared. Without both it stays.
        speed_changes: each holds until the next one begins.
    """

    name: Annotated[str, Field(min_length=1, max_length=80)]
    kind: str | None = None
    station_m: Station
    offset_m: Lateral
    length_m: Size | None = None
    width_m: Size | None = None
    heading_deg: Annotated[float, between(-180.0, 180.0)] = 0.0
    motion: Annotated[Motion, Field(strict=False)] = Motion.STRAIGHT
    speed_kmh: Speed = 0.0
    appears_at_m: Station | None = None
    appears_at_s: Seconds | None = None
    disappears_at_m: Station | None = None
    disappears_after_s: Seconds | None = None
    speed_changes: list[SpeedChange] = Field(default_factory=list)
    lane_change: LaneChange | None = None
    crossing: Crossing | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        has_size = self.kind in SIZES_M or None not in (self.length_m, self.width_m)
        crossing = self.crossing
        for is_wrong, rule in (
            (self.kind not in (None, *SIZES_M), f"kind one of {', '.join(SIZES_M)}"),
            (not has_size, f"length_m and width_m, or a kind that has them: {', '.join(SIZES_M)}"),
            (None not in (self.appears_at_m, self.appears_at_s), "one of appears_at_m and appears_at_s"),
            (None not in (self.disappears_at_m, self.disappears_after_s), "one of disappears_at_m and disappears_after_s"),
            (self.motion is Motion.LANE and self.heading_deg not in (0.0, 180.0), 'heading_deg 0 or 180 with motion "lane"'),
            (self.lane_change is not None and self.motion is not Motion.LANE, 'lane_change only with motion "lane"'),
            (
                crossing is not None and (self.motion is Motion.LANE or self.speed_kmh + abs(self.heading_deg) > 0.0 or self.speed_changes),
                "crossing without motion, heading_deg, speed_kmh and speed_changes",
            ),
            (crossing is not None and crossing_goal_m(self) == self.offset_m, "crossing from an offset_m other than where it ends"),
        ):
            if is_wrong:
                raise misfit(rule)
        return self

    @property
    def size_m(self) -> tuple[float, float]:
        """Length and width."""
        length_m, width_m = SIZES_M.get(self.kind or "", (0.0, 0.0))
        return self.length_m or length_m, self.width_m or width_m

    def is_due(self, t_s: float, reached_m: float) -> bool:
        """Whether it is there, at a time since the start and with the car having got to a station."""
        if self.appears_at_m is not None:
            return reached_m >= self.appears_at_m
        return t_s >= (self.appears_at_s or 0.0)

    def is_gone(self, age_s: float, reached_m: float) -> bool:
        """Whether it is there no more, at a time since it appeared and with the car having got to a station."""
        if self.disappears_at_m is not None:
            return reached_m >= self.disappears_at_m
        return self.disappears_after_s is not None and age_s >= self.disappears_after_s


def crossing_goal_m(thing: RoadObject) -> float:
    """Offset at which an object that crosses stands in the end."""
    given = thing.crossing.to_offset_m if thing.crossing else None
    return -thing.offset_m if given is None else given
