"""A scenario laid out on the ground for one car: the reference, the road, the gates and the outline that must pass them.

Pure geometry, ISO 8855 axes. A station is the distance along the base line.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.planning.reference import ReferencePath
from dbc.vehicle import Vehicle
from gateway.telemetry import Lane

Array = NDArray[np.float64]

SPACING_M = 0.2
"""Distance between two samples of the reference along the base line."""
STANDSTILL_MPS = 0.15
"""A car slower than this stands: far above the noise of the speed measurement (0.05 km/h), far below idle creep (1.4 m/s)."""

_STEPS_PER_SAMPLE = 10
_ROWS_AT_ONCE = 256
_POSE_STEP_M = 0.05


@dataclass(frozen=True)
class Pose:
    """Position of the centre of gravity, heading and speed."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float


@dataclass(frozen=True)
class Outline:
    """The car seen from above: a rectangle around the centre of gravity."""

    front_m: float
    rear_m: float
    half_width_m: float

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Outline":
        """The outline of the real or emulated car."""
        front_m = vehicle.multibody.masses.cog_to_front_m + vehicle.body.front_overhang_m
        return cls(front_m, vehicle.body.length_m - front_m, vehicle.body.width_m / 2.0)

    def corners_m(self, x_m: Array, y_m: Array, yaw_rad: Array) -> Array:
        """Corners at n poses, shape (n, 4, 2): front left, rear left, rear right, front right."""
        ahead = np.array([self.front_m, -self.rear_m, -self.rear_m, self.front_m])
        left = self.half_width_m * np.array([1.0, 1.0, -1.0, -1.0])
        cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
        return np.stack((x_m[:, None] + ahead * cos - left * sin, y_m[:, None] + ahead * sin + left * cos), axis=-1)


@dataclass(frozen=True)
class Line:
    """A line on the ground by its stations, all arrays of shape (n,)."""

    station_m: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    curvature_radpm: Array

    def beside_m(self, left_m: Array | float) -> Array:
        """Points at a distance to the left of the line, shape (n, 2)."""
        return np.column_stack((self.x_m - left_m * np.sin(self.yaw_rad), self.y_m + left_m * np.cos(self.yaw_rad)))


@dataclass(frozen=True)
class Projection:
    """Where points lie along a course, all arrays of shape (n,).

    Args:
        station_m: station of the closest point of the reference.
        lateral_error_m: distance from the reference along its normal, positive to the left of it.
        yaw_rad, speed_mps: of the reference there.
        left_m, right_m: drivable distance of the centre of gravity there.
    """

    station_m: Array
    lateral_error_m: Array
    yaw_rad: Array
    speed_mps: Array
    left_m: Array
    right_m: Array


@dataclass(frozen=True)
class Passage:
    """The car's closest approach to the limits of a gate.

    Args:
        clearance_m: smallest distance of the outline within the gate to the gate's left or right limit; negative beyond it.
        contact_x_m, contact_y_m: the point of the outline that is closest.
        x_m, y_m, yaw_rad: the car at that moment.
    """

    clearance_m: float
    contact_x_m: float
    contact_y_m: float
    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True)
class Course:
    """What a scenario asks of one car.

    Args:
        line: the base line; the reference has a sample for each of its own.
        left_edge_m, right_edge_m: the edges of the road, shape (n, 2).
        from_m, to_m: stations between which the drive is judged.
        ends_short: whether the car is to stand for good before it gets to `to_m`.
    """

    line: Line
    reference: ReferencePath
    left_edge_m: Array
    right_edge_m: Array
    lanes: list[Lane]
    outline: Outline
    from_m: float
    to_m: float
    ends_short: bool

    @property
    def station_m(self) -> Array:
        """Stations of the reference's samples, shape (n,)."""
        return self.line.station_m

    def is_at_end(self, x_m: float, y_m: float) -> bool:
        """Whether the car at a place is past the judged part."""
        return bool(self.project(np.array([x_m]), np.array([y_m])).station_m[0] >= self.to_m)

    def reference_offset_m(self, station_m: float) -> float:
        """How far to the left of the base line the reference is at a station."""
        line, path = self.line, self.reference
        offset_m = (path.y_m - line.y_m) * np.cos(line.yaw_rad) - (path.x_m - line.x_m) * np.sin(line.yaw_rad)
        return float(np.interp(station_m, line.station_m, offset_m))

    def project(self, x_m: Array, y_m: Array) -> Projection:
        """Closest points of the reference, exact between its samples."""
        index, share = self._closest(x_m, y_m)

        def between(values: Array) -> Array:
            return np.asarray(values[index] + share * (values[index + 1] - values[index]))

        path, yaw_rad = self.reference, between(self.reference.yaw_rad)
        dx_m, dy_m = x_m - between(path.x_m), y_m - between(path.y_m)
        return Projection(
            station_m=between(self.station_m), lateral_error_m=dy_m * np.cos(yaw_rad) - dx_m * np.sin(yaw_rad),
            yaw_rad=yaw_rad, speed_mps=between(path.speed_mps), left_m=between(path.left_m), right_m=between(path.right_m),
        )

    def _closest(self, x_m: Array, y_m: Array) -> tuple[NDArray[np.int64], Array]:
        """Segment of the reference and the share of it at which the closest point lies."""
        path = self.reference
        nearest = np.empty(len(x_m), dtype=np.int64)
        for first in range(0, len(x_m), _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            nearest[rows] = np.argmin((x_m[rows, None] - path.x_m) ** 2 + (y_m[rows, None] - path.y_m) ** 2, axis=1)
        index = np.clip(nearest, 1, len(path.x_m) - 1) - 1
        share = self._share(index, x_m, y_m)
        is_beyond = (share > 1.0) & (index < len(path.x_m) - 2)
        index = index + is_beyond
        return index, np.clip(self._share(index, x_m, y_m), 0.0, 1.0)

    def _share(self, index: NDArray[np.int64], x_m: Array, y_m: Array) -> Array:
        path = self.reference
        step_x_m, step_y_m = path.x_m[index + 1] - path.x_m[index], path.y_m[index + 1] - path.y_m[index]
        along = (x_m - path.x_m[index]) * step_x_m + (y_m - path.y_m[index]) * step_y_m
        return np.asarray(along / (step_x_m**2 + step_y_m**2))


def blend(share: Array) -> tuple[Array, Array]:
    """A quintic from 0 at 0 to 1 at 1 with zero slope and curvature at both ends, and its slope; constant outside."""
    u = np.clip(share, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2), 30.0 * u**2 * (1.0 - u) ** 2


def fine_stations(start_m: float, end_m: float) -> Array:
    """Stations close enough to integrate a base line along them."""
    samples = int(np.ceil((end_m - start_m) / SPACING_M))
    return np.asarray(start_m + SPACING_M / _STEPS_PER_SAMPLE * np.arange(samples * _STEPS_PER_SAMPLE + 1), dtype=np.float64)


def integrate(station_m: Array, curvature_radpm: Array) -> Line:
    """The line of a given curvature that starts at (first station, 0) along x, sampled every `SPACING_M`."""

    def integral(values: Array) -> Array:
        steps = np.diff(station_m) * (values[1:] + values[:-1]) / 2.0
        return np.insert(np.cumsum(steps, dtype=np.float64), 0, 0.0)

    yaw_rad = integral(curvature_radpm)
    x_m, y_m = station_m[0] + integral(np.cos(yaw_rad)), integral(np.sin(yaw_rad))
    return Line(*(values[::_STEPS_PER_SAMPLE] for values in (station_m, x_m, y_m, yaw_rad, curvature_radpm)))


def passage(lane: Lane, outline: Outline, x_m: Array, y_m: Array, yaw_rad: Array) -> Passage | None:
    """Closest approach of the outline to a gate's limits along a path of poses, or None when it never was in the gate.

    The outline is clipped to the gate's length exactly: the extremes of the clipped rectangle are its corners within the gate and the
    points where its sides cross the gate's ends. Between two poses the car moves straight, in steps of at most 0.05 m.
    """
    reach_m = outline.front_m + outline.rear_m + outline.half_width_m
    near = np.flatnonzero((x_m > lane.start_m - reach_m) & (x_m < lane.end_m + reach_m))
    if not len(near):
        return None
    x_m, y_m, yaw_rad = _densely(*(values[near[0] : near[-1] + 1] for values in (x_m, y_m, yaw_rad)))
    corners = outline.corners_m(x_m, y_m, yaw_rad)
    points = np.concatenate((corners, _crossings(corners, lane.start_m), _crossings(corners, lane.end_m)), axis=1)
    is_inside = (points[..., 0] >= lane.start_m) & (points[..., 0] <= lane.end_m)
    clearance_m = np.where(is_inside, np.minimum(lane.left_m - points[..., 1], points[..., 1] - lane.right_m), np.inf)
    row, column = np.unravel_index(int(np.argmin(clearance_m)), clearance_m.shape)
    if not np.isfinite(clearance_m[row, column]):
        return None
    closest = (clearance_m[row, column], *points[row, column], x_m[row], y_m[row], yaw_rad[row])
    return Passage(*map(float, closest))


def separation_m(first: Array, second: Array) -> Array:
    """Distance between rectangles, pair by pair, shape (n,) [m]; negative where they overlap, by how deep.

    By the separating axis theorem: the widest gap between their shadows on the directions of all sides. Beside each other that is the
    distance, corner to corner it is a little less.

    Args:
        first, second: corners in order, shape (n, 4, 2).
    """
    widest = np.full(len(first), -np.inf)
    for corners_m in (first, second):
        for k in (0, 1):
            side = corners_m[:, k + 1] - corners_m[:, k]
            axis = side / np.linalg.norm(side, axis=1, keepdims=True)
            a, b = (np.einsum("nij,nj->ni", rectangle, axis) for rectangle in (first, second))
            widest = np.maximum(widest, np.maximum(a.min(axis=1) - b.max(axis=1), b.min(axis=1) - a.max(axis=1)))
    return widest


def _crossings(corners_m: Array, at_x_m: float) -> Array:
    """Where the four sides of rectangles cross a line across x, shape (n, 4, 2); nan where they do not."""
    following = np.roll(corners_m, -1, axis=1)
    step = following - corners_m
    is_crossed = (corners_m[..., 0] - at_x_m) * (following[..., 0] - at_x_m) < 0.0
    share = np.where(is_crossed, at_x_m - corners_m[..., 0], np.nan) / np.where(is_crossed, step[..., 0], 1.0)
    return np.stack((np.where(is_crossed, at_x_m, np.nan), corners_m[..., 1] + share * step[..., 1]), axis=-1)


def _densely(x_m: Array, y_m: Array, yaw_rad: Array) -> tuple[Array, Array, Array]:
    """Poses with others between them, so that two in a row are at most 0.05 m apart."""
    way_m = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))))
    fine_m = np.union1d(way_m, np.arange(0.0, way_m[-1], _POSE_STEP_M))
    return np.interp(fine_m, way_m, x_m), np.interp(fine_m, way_m, y_m), np.interp(fine_m, way_m, yaw_rad)
