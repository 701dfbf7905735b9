"""The judged part of a drive seen from above, in the coordinates of a picture: x to the right, y up, y enlarged on a flat course."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gateway.telemetry import Lane
from xil.course import Array, Course, Passage, passage
from xil.metrics import Meeting, Trace

WIDTH_PX = 1120

_LEFT_PX = 44
_FOOT_PX = 30
_LEAST_HEIGHT_PX = 170
_AROUND_M = 15.0
_MAX_POINTS = 600
_CONE_SPACING_M = 5.0
_OUTLINES_WITHOUT_GATES = 10
_ENLARGEMENTS = (1, 2, 3, 5, 10)
_TICK_STEPS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_LEAST_TICK_PX = 44.0


@dataclass(frozen=True)
class Tick:
    """A line of the grid."""

    at_px: float
    label: str


@dataclass(frozen=True)
class DrawnGate:
    """A gate: its two rows of cones, and where the car came closest to one of them.

    Args:
        box_px: left, top, width, height.
        contact_px: the place closest to the car, or None when the gate was not reached.
    """

    name: str
    label: str
    is_touched: bool
    box_px: tuple[float, float, float, float]
    cones_px: list[tuple[float, float]]
    contact_px: tuple[float, float] | None


@dataclass(frozen=True)
class DrawnObject:
    """An object where it was when the car came closest to it.

    Args:
        label_px: where the label begins.
    """

    label: str
    is_touched: bool
    outline: str
    label_px: tuple[float, float]


@dataclass(frozen=True)
class Map:
    """Everything to draw; lines are SVG path data.

    Args:
        enlargement: by how much y is larger than x.
        outlines: the car at the gates, or at even distances where there are none.
        marker: what a script needs to move a car along the drive: times, poses, outline and scale.
    """

    width_px: int
    height_px: int
    enlargement: int
    road: str
    edges: list[str]
    reference: str
    driven: str
    outlines: list[str]
    gates: list[DrawnGate]
    objects: list[DrawnObject]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    marker: dict[str, Any]


@dataclass(frozen=True)
class _Scale:
    """From the ground to the picture, fitted to points of shape (n, 2)."""

    left_m: float
    top_m: float
    px_per_m: float
    enlargement: int

    @classmethod
    def fit(cls, points_m: Array) -> "_Scale":
        (left_m, bottom_m), (right_m, top_m) = points_m.min(axis=0), points_m.max(axis=0)
        px_per_m = (WIDTH_PX - _LEFT_PX) / (right_m - left_m)
        flat_px = (top_m - bottom_m) * px_per_m
        enlargement = next((factor for factor in _ENLARGEMENTS if flat_px * factor >= _LEAST_HEIGHT_PX), _ENLARGEMENTS[-1])
        return cls(float(left_m), float(top_m), float(px_per_m), enlargement)

    def px(self, x_m: float, y_m: float) -> tuple[float, float]:
        return _LEFT_PX + (x_m - self.left_m) * self.px_per_m, (self.top_m - y_m) * self.px_per_m * self.enlargement

    def path(self, points_m: Array, close: str = "") -> str:
        pixels = (self.px(x_m, y_m) for x_m, y_m in points_m.tolist())
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in pixels) + close


def draw_map(course: Course, drive: Trace, meetings: Sequence[Meeting] = ()) -> Map:
    """Draw the judged part of a drive and a little around it.

    Args:
        meetings: the closest approaches to objects.
    """
    from_m, to_m = course.from_m - _AROUND_M, course.to_m + _AROUND_M
    left_m, right_m, reference_m = (
        _thinned(points_m[(course.station_m >= from_m) & (course.station_m <= to_m)])
        for points_m in (course.left_edge_m, course.right_edge_m, np.column_stack((course.reference.x_m, course.reference.y_m)))
    )
    around_m = np.concatenate((left_m, right_m[::-1]))
    scale = _Scale.fit(around_m)
    bottom_m = float(around_m[:, 1].min())
    is_shown = (drive.along.station_m >= from_m) & (drive.along.station_m <= to_m)
    driven_m = np.column_stack((drive.x_m, drive.y_m))[is_shown]
    passages = [passage(lane, course.outline, drive.x_m, drive.y_m, drive.yaw_rad) for lane in course.lanes]
    return Map(
        width_px=WIDTH_PX,
        height_px=round(scale.px(0.0, bottom_m)[1]) + _FOOT_PX,
        enlargement=scale.enlargement,
        road=scale.path(around_m, "Z"),
        edges=[scale.path(left_m), scale.path(right_m)],
        reference=scale.path(reference_m),
        driven=scale.path(_thinned(driven_m)) if len(driven_m) else "",
        outlines=[scale.path(corners_m, "Z") for corners_m in _outlines(course, drive, passages, meetings)],
        gates=[_gate(scale, lane, way) for lane, way in zip(course.lanes, passages, strict=True)],
        objects=[_object(scale, meeting) for meeting in meetings],
        x_ticks=_ticks(scale.left_m, float(around_m[:, 0].max()), scale.px_per_m, lambda x_m: scale.px(x_m, 0.0)[0]),
        y_ticks=_ticks(bottom_m, scale.top_m, scale.px_per_m * scale.enlargement, lambda y_m: scale.px(0.0, y_m)[1]),
        marker=_marker(course, drive, scale),
    )


def _outlines(course: Course, drive: Trace, passages: list[Passage | None], meetings: Sequence[Meeting]) -> Array:
    """Corners of the car as it enters each gate, comes closest to it and leaves it, and beside each object, shape (n, 4, 2)."""
    stations_m = [end_m for lane in course.lanes for end_m in (lane.start_m, lane.end_m)]
    if not course.lanes:
        stations_m = list(np.linspace(course.from_m, course.to_m, _OUTLINES_WITHOUT_GATES))
    reached = [int(np.argmax(drive.along.station_m >= station_m)) for station_m in stations_m if drive.along.station_m.max() >= station_m]
    poses = [(drive.x_m[k], drive.y_m[k], drive.yaw_rad[k]) for k in reached]
    poses += [(way.x_m, way.y_m, way.yaw_rad) for way in passages if way]
    times_s = np.array([meeting.t_s for meeting in meetings])
    beside = np.stack([np.interp(times_s, drive.t_s, column) for column in (drive.x_m, drive.y_m, drive.yaw_rad)])
    return course.outline.corners_m(*np.concatenate((np.array(poses, dtype=np.float64).reshape(-1, 3).T, beside), axis=1))


def _gate(scale: _Scale, lane: Lane, way: Passage | None) -> DrawnGate:
    (left_px, top_px), (right_px, bottom_px) = scale.px(lane.start_m, lane.left_m), scale.px(lane.end_m, lane.right_m)
    along_m = np.linspace(lane.start_m, lane.end_m, round((lane.end_m - lane.start_m) / _CONE_SPACING_M) + 1)
    return DrawnGate(
        name=lane.name,
        label=f"{lane.name}: " + (f"{way.clearance_m:.3f} m".replace("-", "\N{MINUS SIGN}") if way else "not reached"),
        is_touched=way is not None and way.clearance_m < 0.0,
        box_px=(left_px, top_px, right_px - left_px, bottom_px - top_px),
        cones_px=[scale.px(float(x_m), y_m) for y_m in (lane.left_m, lane.right_m) for x_m in along_m],
        contact_px=scale.px(way.contact_x_m, way.contact_y_m) if way else None,
    )


def _object(scale: _Scale, meeting: Meeting) -> DrawnObject:
    right_m, top_m = meeting.box_m.max(axis=0).tolist()
    return DrawnObject(
        label=f"{meeting.name}: {meeting.clearance_m:.3f} m".replace(": -", ": \N{MINUS SIGN}"),
        is_touched=meeting.clearance_m < 0.0,
        outline=scale.path(meeting.box_m, "Z"),
        label_px=scale.px(right_m, top_m),
    )


def _ticks(low_m: float, high_m: float, px_per_m: float, at_px: Callable[[float], float]) -> list[Tick]:
    step_m = next((step for step in _TICK_STEPS_M if step * px_per_m >= _LEAST_TICK_PX), _TICK_STEPS_M[-1])
    values_m = np.arange(np.ceil(low_m / step_m), np.floor(high_m / step_m) + 1.0) * step_m
    return [Tick(at_px(float(value)), f"{value:z.0f}".replace("-", "\N{MINUS SIGN}")) for value in values_m]


def _marker(course: Course, drive: Trace, scale: _Scale) -> dict[str, Any]:
    outline = course.outline
    columns = {"t": (drive.t_s, 2), "x": (drive.x_m, 3), "y": (drive.y_m, 3), "yaw": (drive.yaw_rad, 4)}
    return {name: np.round(_thinned(values), decimals).tolist() for name, (values, decimals) in columns.items()} | {
        "car": [outline.front_m, outline.rear_m, outline.half_width_m],
        "scale": [_LEFT_PX, scale.left_m, scale.top_m, scale.px_per_m, scale.enlargement],
    }


def _thinned(values: Array) -> Array:
    """Every k-th row and the last, at most about 600."""
    step = max(1, -(-len(values) // _MAX_POINTS))
    return values if step == 1 else np.concatenate((values[:-1:step], values[-1:]))
