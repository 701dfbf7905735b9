"""Roads of the emulated car, made from data: a plane that may climb, a height profile, patches of other grip.

A road has a straight base line. A station is the distance along it, an offset the distance to its left.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from dbc.errors import UserMistake
from dbc.section import Section, between, misfit, read_section
from vehicle_emulator.plants.interface import Level, Road, RoadPoint

STEEPEST = 0.5
"""Largest slope of a road along or across its base line."""
_EDGE_M = 0.2
"""Width over which the grip changes at the edge of a patch: about the length of a tyre's contact patch."""
_STEEPEST_SHARE = 1.875
"""Largest slope of a quintic between two level ends, over that of its chord."""

Station = Annotated[float, between(-10_000.0, 10_000.0)]
Offset = Annotated[float, between(-1_000.0, 1_000.0)]
Percent = Annotated[float, between(-20.0, 20.0)]


class RoadError(UserMistake):
    """A road cannot be used; one line per mistake, each with file, key, value and what is allowed."""


class HeightPoint(Section):
    """A point of the height profile."""

    station_m: Station
    height_m: Annotated[float, between(-500.0, 500.0)]


class FrictionPatch(Section):
    """A rectangle of the road on which the tyres have another grip; without limits it reaches as far as the road.

    Args:
        factor: on the grip of the tyre's own road; dry asphalt is 1, a wet one 0.7, packed snow 0.3, ice 0.1.
    """

    factor: Annotated[float, between(0.02, 2.0)]
    from_m: Station = -10_000.0
    to_m: Station = 10_000.0
    right_m: Offset = -1_000.0
    left_m: Offset = 1_000.0

    @model_validator(mode="after")
    def _has_an_extent(self) -> Self:
        if self.to_m - self.from_m < _EDGE_M or self.left_m - self.right_m < _EDGE_M:
            raise misfit(f"to_m at least {_EDGE_M:g} above from_m, left_m at least {_EDGE_M:g} above right_m")
        return self


def _checked_heights(points: list[HeightPoint]) -> list[HeightPoint]:
    if len(points) == 1:
        raise misfit("no point or at least two")
    for before, after in pairwise(points):
        if after.station_m <= before.station_m:
            raise misfit(f"rising stations, not {after.station_m:g} behind {before.station_m:g}")
        slope = _STEEPEST_SHARE * abs(after.height_m - before.height_m) / (after.station_m - before.station_m)
        if slope > STEEPEST:
            raise misfit(f"slopes up to {STEEPEST:g}, not {slope:.2f} between {before.station_m:g} and {after.station_m:g}")
    return points


Heights = Annotated[list[HeightPoint], AfterValidator(_checked_heights)]
"""A height profile: no point or at least two, stations that rise, no slope beyond `STEEPEST`."""


class RoadDescription(Section):
    """A road as data.

    Args:
        x_m, y_m, heading_rad: where the base line starts, in the local frame, and where it heads, counter-clockwise from x.
        start_station_m: station of that place. The plane has height 0 there.
        grade_percent: rise of the plane along the base line.
        cross_fall_percent: fall of the plane to the right.
        heights: profile along the base line that is added to the plane; level before its first and behind its last point. Between two
            points of one height it is level, between a lower and a higher one it rises all the way.
        friction: patches; where they overlap the later one counts.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0
    start_station_m: Station = 0.0
    grade_percent: Percent = 0.0
    cross_fall_percent: Percent = 0.0
    heights: Heights = Field(default_factory=list)
    friction: list[FrictionPatch] = Field(default_factory=list)

    def to_toml(self) -> str:
        """The text of a file that `load_road` reads."""
        tables = self.model_dump()
        lines = [f"{key} = {value!r}" for key, value in tables.items() if isinstance(value, float)]
        for name in ("heights", "friction"):
            for entry in tables[name]:
                lines += ["", f"[[{name}]]", *(f"{key} = {value!r}" for key, value in entry.items())]
        return "\n".join(lines) + "\n"


def load_road(path: Path) -> RoadDescription:
    """Read a road from a TOML file.

    Raises:
        RoadError: missing file, malformed TOML, unknown or missing key, value out of range.
    """
    return read_section(path, RoadDescription, RoadError)


def make_road(description: RoadDescription) -> Road:
    """The road that a description means: the simplest kind that has all of it."""
    if description.heights or description.friction:
        return Surface(description)
    if description.grade_percent or description.cross_fall_percent:
        return Plane(description)
    return Level()


class Plane:
    """A plane that climbs evenly, with the grip of the tyre's own road; profile and patches of the description do not count."""

    def __init__(self, description: RoadDescription) -> None:
        cosine, sine = math.cos(description.heading_rad), math.sin(description.heading_rad)
        climb, left_rise = 0.01 * description.grade_percent, 0.01 * description.cross_fall_percent
        self._slope_x = climb * cosine - left_rise * sine
        self._slope_y = climb * sine + left_rise * cosine
        self._height_m = -self._slope_x * description.x_m - self._slope_y * description.y_m

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        """See `Road`."""
        return RoadPoint(self._height_m + self._slope_x * x_m + self._slope_y * y_m, self._slope_x, self._slope_y, 1.0)


class Surface:
    """A road with all that a description can have."""

    def __init__(self, description: RoadDescription) -> None:
        d = description
        self._cosine, self._sine = math.cos(d.heading_rad), math.sin(d.heading_rad)
        self._station_at_origin_m = d.start_station_m - d.x_m * self._cosine - d.y_m * self._sine
        self._offset_at_origin_m = d.x_m * self._sine - d.y_m * self._cosine
        self._start_station_m = d.start_station_m
        self._climb, self._left_rise = 0.01 * d.grade_percent, 0.01 * d.cross_fall_percent
        self._profile = Profile(d.heights)
        self._patches = [(p.from_m, p.to_m, p.right_m, p.left_m, p.factor) for p in d.friction]

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        """See `Road`."""
        cosine, sine = self._cosine, self._sine
        station_m = self._station_at_origin_m + x_m * cosine + y_m * sine
        offset_m = self._offset_at_origin_m - x_m * sine + y_m * cosine
        height_m, along = self._profile.at(station_m)
        along += self._climb
        height_m += self._climb * (station_m - self._start_station_m) + self._left_rise * offset_m
        friction = self._friction(station_m, offset_m) if self._patches else 1.0
        return RoadPoint(height_m, along * cosine - self._left_rise * sine, along * sine + self._left_rise * cosine, friction)

    def _friction(self, station_m: float, offset_m: float) -> float:
        friction, half_edge_m = 1.0, 0.5 * _EDGE_M
        for from_m, to_m, right_m, left_m, factor in self._patches:
            inside_m = min(station_m - from_m, to_m - station_m, offset_m - right_m, left_m - offset_m)
            if inside_m >= half_edge_m:
                friction = factor
            elif inside_m > -half_edge_m:
                u = inside_m / _EDGE_M + 0.5
                friction += u * u * (3.0 - 2.0 * u) * (factor - friction)
        return friction


class Profile:
    """A height over stations that is continuous up to its curvature: quintics that meet with a slope and without curvature.

    The slope at a point is the harmonic mean of those of the chords beside it, and zero at a crest, in a dip and at both ends
    (Fritsch and Butland, A method for constructing local monotone piecewise cubic interpolants, 1984): no overshoot. With zero
    curvature at both ends a quintic is monotone as well as long as its ends are at most twice as steep as its chord.
    """

    def __init__(self, points: Sequence[HeightPoint]) -> None:
        self._stations_m = [point.station_m for point in points]
        self._heights_m = [point.height_m for point in points]
        lengths_m = [after - before for before, after in pairwise(self._stations_m)]
        chords = [(after - before) / length_m for (before, after), length_m in zip(pairwise(self._heights_m), lengths_m, strict=True)]
        inner = [2.0 * a * b / (a + b) if a * b > 0.0 else 0.0 for a, b in pairwise(chords)]
        slopes = [0.0, *inner, 0.0] if chords else []
        self._pieces = [
            _quintic(length_m, chord, before, after)
            for length_m, chord, (before, after) in zip(lengths_m, chords, pairwise(slopes), strict=True)
        ]

    def at(self, station_m: float) -> tuple[float, float]:
        """Height [m] and slope at a station."""
        stations_m, heights_m = self._stations_m, self._heights_m
        k = bisect_right(stations_m, station_m) - 1
        if k < 0:
            return (heights_m[0] if heights_m else 0.0), 0.0
        if k == len(self._pieces):
            return heights_m[k], 0.0
        length_m, c1, c3, c4, c5 = self._pieces[k]
        u = (station_m - stations_m[k]) / length_m
        square = u * u
        rise_m = length_m * u * (c1 + square * (c3 + u * (c4 + u * c5)))
        return heights_m[k] + rise_m, c1 + square * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5))


def _quintic(length_m: float, chord: float, before: float, after: float) -> tuple[float, float, float, float, float]:
    """Length of a piece, and the coefficients of u, u^3, u^4 and u^5 of its rise over its length; its ends are not curved.

    Args:
        chord: rise over the length.
        before, after: slope at either end.
    """
    return (
        length_m,
        before,
        10.0 * chord - 6.0 * before - 4.0 * after,
        -15.0 * chord + 8.0 * before + 7.0 * after,
        6.0 * chord - 3.0 * before - 3.0 * after,
    )
