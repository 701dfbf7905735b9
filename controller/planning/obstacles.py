"""Objects on the road as the planner takes them, and where they will be along the path.

An object drives on at its velocity. In the coordinates of the path it is a box: a station along it, an offset to the left of it, and
half its extent along and across. Stations are arc lengths of the path.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controller.planning.reference import ReferencePath
from controller.problem import Array

_GRID_M = 1.0
"""Distance between two points of the path that objects are projected on: off by 12 mm on a radius of 10 m."""
_LEAST_STRETCH = 0.2
"""Near the centre of a bend all stations are alike."""
_LARGEST_SIZE_M = 100.0
_LARGEST_SPEED_MPS = 100.0
_FARTHEST_M = 1e6
_NOISE_M = 0.5
"""A report further than this from where the object was expected is no noise."""
_NEW_SHARE = 0.2
"""Weight of a report against the expectation: a third of the noise remains."""


@dataclass(frozen=True)
class Obstacle:
    """A thing on the ground, seen from above: a box around its centre.

    Args:
        name: by which it is known again in the next cycle.
        x_m, y_m, yaw_rad: centre and heading of the box in the ground frame.
        vx_mps, vy_mps: velocity in the ground frame.
    """

    name: str
    x_m: float
    y_m: float
    yaw_rad: float
    length_m: float
    width_m: float
    vx_mps: float = 0.0
    vy_mps: float = 0.0

    @property
    def numbers(self) -> tuple[float, ...]:
        """All but the name, in the order of the fields."""
        return self.x_m, self.y_m, self.yaw_rad, self.length_m, self.width_m, self.vx_mps, self.vy_mps

    @property
    def is_usable(self) -> bool:
        """Whether its numbers can be those of a thing on a road."""
        return (
            all(map(math.isfinite, self.numbers))
            and max(abs(self.x_m), abs(self.y_m)) <= _FARTHEST_M
            and 0.0 < self.length_m <= _LARGEST_SIZE_M
            and 0.0 < self.width_m <= _LARGEST_SIZE_M
            and math.hypot(self.vx_mps, self.vy_mps) <= _LARGEST_SPEED_MPS
        )


@dataclass(frozen=True)
class Track:
    """An object along the path at the instants of a prediction, arrays of shape (K,).

    Args:
        station_m, offset_m: of its centre.
        half_along_m, half_across_m: half of its extent along the path and across.
    """

    name: str
    station_m: Array
    offset_m: Array
    half_along_m: Array
    half_across_m: Array

    @property
    def approaches(self) -> bool:
        """Whether it comes the other way along the path."""
        return bool(self.station_m[1] < self.station_m[0])


class PathFrame:
    """The path as the coordinates that objects are placed in."""

    def __init__(self, path: ReferencePath) -> None:
        end_m = float(path.arc_length_m[-1])
        self.station_m: Array = np.arange(0.0, end_m, _GRID_M)

        def along(samples: Array) -> Array:
            return np.asarray(np.interp(self.station_m, path.arc_length_m, samples))

        self._points = np.stack((along(path.x_m), along(path.y_m)))
        self._yaw_rad = along(path.yaw_rad)
        self._tangents = np.stack((np.cos(self._yaw_rad), np.sin(self._yaw_rad)))
        self._curvature_radpm = np.gradient(self._yaw_rad, _GRID_M)
        self._curvatures: list[float] = self._curvature_radpm.tolist()
        self.left_m, self.right_m = along(path.left_m), along(path.right_m)

    def window(self, from_m: float, to_m: float) -> slice:
        """Points of the grid from one station to another, two at least where the path has them."""
        last = len(self.station_m) - 1
        from_m, to_m = (min(max(station_m, 0.0), float(self.station_m[-1])) for station_m in (from_m, to_m))
        first = min(int(from_m / _GRID_M), max(last - 1, 0))
        return slice(first, min(max(math.ceil(to_m / _GRID_M), first + 1), last) + 1)

    def edges(self, from_m: float, to_m: float) -> tuple[float, float]:
        """Least room for the centre of gravity between two stations, to the left and to the right of the path [m]."""
        part = self.window(from_m, to_m)
        return float(self.left_m[part].min()), float(self.right_m[part].min())

    def curvature_at(self, station_m: float) -> float:
        """Curvature of the path at a station [1/m]."""
        return self._curvatures[min(max(round(station_m / _GRID_M), 0), len(self._curvatures) - 1)]

    def tracks(self, objects: Sequence[Obstacle], instants_s: Array, from_m: float, to_m: float, beside_m: float) -> list[Track]:
        """Where objects are along the path at some instants, the first of them zero.

        Only the path between two stations counts. Where it crosses itself, an object is on the first branch that it is in the way of.

        Args:
            beside_m: how far beside the room of the centre of gravity the side of an object is in the way [m].
        """
        part = self.window(from_m, to_m)
        standing = [k for k, thing in enumerate(objects) if thing.vx_mps == thing.vy_mps == 0.0]
        moving = [k for k in range(len(objects)) if k not in standing]
        found: dict[int, Track] = {}
        for chosen, times_s in ((standing, instants_s[:1]), (moving, instants_s)):
            if not chosen:
                continue
            rows = self._project([objects[k] for k in chosen], times_s, part, beside_m)
            for k, row in zip(chosen, np.broadcast_to(rows, (*rows.shape[:2], len(instants_s))), strict=True):
                found[k] = Track(objects[k].name, *row)
        return [found[k] for k in range(len(objects))]

    def _project(self, objects: Sequence[Obstacle], instants_s: Array, part: slice, beside_m: float) -> Array:
        """Station, offset and half extents of each object at each instant, shape (objects, 4, K)."""
        x, y, yaw, length, width, vx, vy = np.array([thing.numbers for thing in objects]).T[:, :, None]
        x, y = x + vx * instants_s, y + vy * instants_s
        points = self._points[:, part]
        squared = (x[..., None] - points[0]) ** 2 + (y[..., None] - points[1]) ** 2
        reach = np.maximum(self.left_m, self.right_m)[part] + beside_m + 0.5 * np.hypot(length, width)
        now = _first_closest(squared[:, 0], reach**2)
        if len(instants_s) > 1:  # as far as it can drive, which keeps it on its branch
            farthest = np.ceil(np.hypot(vx, vy) * instants_s[-1] / _GRID_M) + 1.0
            squared += np.where(np.abs(np.arange(points.shape[1]) - now[:, None]) <= farthest, 0.0, np.inf)[:, None]
            closest = np.argmin(squared, axis=-1)
            closest[:, 0] = now
        else:
            closest = now[:, None]
        index = part.start + closest
        cos, sin = self._tangents[:, index]
        dx, dy = x - self._points[0, index], y - self._points[1, index]
        along, across = np.abs(np.cos(yaw - self._yaw_rad[index])), np.abs(np.sin(yaw - self._yaw_rad[index]))
        half_along = 0.5 * (length * along + width * across)
        # A straight box beside a bend reaches further in than its half width, by the rise of the arc.
        half_across = 0.5 * (length * across + width * along) + 0.5 * np.abs(self._curvature_radpm[index]) * half_along**2
        offset = dy * cos - dx * sin
        stretch = np.maximum(1.0 - self._curvature_radpm[index] * offset, _LEAST_STRETCH)
        return np.stack((self.station_m[index] + (dx * cos + dy * sin) / stretch, offset, half_along, half_across), axis=1)

    def bend_radpm(self, from_m: float, to_m: float) -> float:
        """Largest curvature of the path between two stations, unsigned [1/m]."""
        return float(np.abs(self._curvature_radpm[self.window(from_m, to_m)]).max())


class Smoother:
    """Takes the noise off the positions of objects, as far as they move as their velocity says."""

    def __init__(self) -> None:
        self._last: dict[str, Obstacle] = {}

    def reset(self) -> None:
        """Forget all objects."""
        self._last = {}

    def smoothed(self, objects: Sequence[Obstacle], elapsed_s: float) -> list[Obstacle]:
        """Objects between where they are reported and where they were to be expected after the time since the last call [s]."""
        self._last = {thing.name: self._smoothed(thing, elapsed_s) for thing in objects}
        return list(self._last.values())

    def _smoothed(self, thing: Obstacle, elapsed_s: float) -> Obstacle:
        last = self._last.get(thing.name)
        if last is None:
            return thing
        x_m, y_m = last.x_m + elapsed_s * thing.vx_mps, last.y_m + elapsed_s * thing.vy_mps
        off_x_m, off_y_m = thing.x_m - x_m, thing.y_m - y_m
        if math.hypot(off_x_m, off_y_m) > _NOISE_M:
            return thing
        return replace(thing, x_m=x_m + _NEW_SHARE * off_x_m, y_m=y_m + _NEW_SHARE * off_y_m)


def usable(objects: Sequence[Obstacle]) -> list[Obstacle]:
    """Objects with numbers that make sense, each with a name of its own."""
    good = [thing for thing in objects if thing.is_usable]
    names = {thing.name for thing in good}
    return good if len(names) == len(good) else [replace(thing, name=f"{thing.name} {k}") for k, thing in enumerate(good)]


def _first_closest(squared: Array, within: Array) -> NDArray[np.int64]:
    """Index along the last axis of the first local minimum that is within reach; of the smallest, where none is."""
    is_near = squared <= within
    first = np.argmax(is_near, axis=-1, keepdims=True)
    place = np.arange(squared.shape[-1])
    is_run = np.logical_and.accumulate(is_near | (place < first), axis=-1) & (place >= first)
    closest: NDArray[np.int64] = np.argmin(np.where(is_run | ~is_near.any(axis=-1, keepdims=True), squared, np.inf), axis=-1)
    return closest
