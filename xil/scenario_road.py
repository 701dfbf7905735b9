"""The road of a scenario: its edges beside the base line, and how it climbs, bends up and down and grips along it."""

from typing import Annotated

from pydantic import Field

from dbc.section import Section, between
from vehicle_emulator.road import FrictionPatch, Heights, Percent, RoadDescription

Edge = Annotated[float, between(0.5, 100.0)]


class Road(Section):
    """Distance from the base line to the edges of the road, and its surface.

    The surface is laid out along the direction in which the base line starts: on a straight base line its stations are those of the
    drive, beside curves they are x coordinates.

    Args:
        grade_percent: rise all along, from height 0 at the start.
        cross_fall_percent: fall to the right.
        heights: profile on top of that; level before its first and behind its last point.
        friction: patches of other grip; where they overlap the later one counts.
    """

    left_m: Edge
    right_m: Edge
    grade_percent: Percent = 0.0
    cross_fall_percent: Percent = 0.0
    heights: Heights = Field(default_factory=list)
    friction: list[FrictionPatch] = Field(default_factory=list)

    def surface(self, start_m: float) -> RoadDescription:
        """The surface under a base line that starts at a station."""
        return RoadDescription(
            x_m=start_m, start_station_m=start_m, grade_percent=self.grade_percent, cross_fall_percent=self.cross_fall_percent,
            heights=self.heights, friction=self.friction,
        )  # fmt: skip
