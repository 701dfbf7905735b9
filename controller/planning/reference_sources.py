"""Reference paths from what there is of them: the log of a drive, or a profile of curvature.

A log is sampled in time and has noise: it is reduced to samples that advance, smoothed over the arc length by a natural cubic spline that
gives up closeness for little bending, and sampled anew at even distances. Such a spline has a continuous second derivative, and so
the path has a continuous curvature.
Source of the spline: C. H. Reinsch, Smoothing by spline functions, Numerische Mathematik 10 (1967).
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.planning.reference import ReferencePath, ReferencePathError
from controller.problem import Array

SPACING_M = 0.25
"""Distance between two samples of a path that is made here."""
_ADVANCE_M = 0.5
"""Samples of a log closer than this to the last that was taken are no advance: a car that stands, or noise."""
_SMOOTHING_M = 2.0
"""Waves shorter than 2 pi times this are noise; what a car does on purpose is longer. A turn of 10 m radius is cut by 16 mm."""
_LONGEST_GAP_M = 20.0
_LEAST_SAMPLES = 4
_CLOTHOID_STEP_M = 0.05
_WIDEST_M = 50.0
_STANDSTILL_NOISE_MPS = 0.5
_FASTEST_MPS = 100.0


def reference_from_log(
    x_m: ArrayLike, y_m: ArrayLike, speed_mps: ArrayLike, half_width_m: float, smoothing_m: float = _SMOOTHING_M
) -> ReferencePath:
    """The path of a drive, from samples in the order in which they were driven, wherever and however often the car stood.

    Args:
        x_m, y_m, speed_mps: samples, shape (n,).
        half_width_m: drivable distance to either side of the path at the centre of gravity [m].
        smoothing_m: waves shorter than 2 pi times this are taken for noise [m].

    Raises:
        ReferencePathError: columns of unlike length, a number that is none, a jump, or too short a drive; names the row, from 1.
    """
    columns = _columns(x_m=x_m, y_m=y_m, speed_mps=speed_mps)
    _check_range("half_width_m", half_width_m, 0.01, _WIDEST_M)
    _check_range("smoothing_m", smoothing_m, 0.1, 50.0)
    rows = _advancing(columns["x_m"], columns["y_m"])
    taken_x_m, taken_y_m, taken_mps = (values[rows] for values in columns.values())
    way_m = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(taken_x_m), np.diff(taken_y_m)))))
    fine_m = np.linspace(0.0, way_m[-1], int(way_m[-1] / SPACING_M) + 1)
    (x, dx), (y, dy) = (_smoothed(way_m, values, fine_m, smoothing_m) for values in (taken_x_m, taken_y_m))
    speed, width = np.maximum(np.interp(fine_m, way_m, taken_mps), 0.0), np.full(fine_m.size, half_width_m)
    return ReferencePath(x, y, np.unwrap(np.arctan2(dy, dx)), speed, width, width)


def reference_from_curvature(
    station_m: ArrayLike, curvature_radpm: ArrayLike, speed_mps: ArrayLike, half_width_m: float,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ReferencePath:  # fmt: skip
    """The path of a curvature that is linear between its samples: straight lines, arcs and clothoids.

    Args:
        station_m: arc length at the samples, ascending, shape (n,).
        curvature_radpm: at the samples, left positive [1/m].
        speed_mps: at the samples, linear between them.
        half_width_m: drivable distance to either side of the path at the centre of gravity [m].
        start: x [m], y [m] and heading [rad] at the first sample.

    Raises:
        ReferencePathError: columns of unlike length, a number that is none, or a station that does not ascend; names the row, from 1.
    """
    columns = _columns(station_m=station_m, curvature_radpm=curvature_radpm, speed_mps=speed_mps)
    _check_range("half_width_m", half_width_m, 0.01, _WIDEST_M)
    stations, curvature, speed = columns.values()
    _refuse_rows("station_m", stations, np.append(False, np.diff(stations) <= 0.0), "must be greater than the row before")
    steps = max(int(np.ceil((stations[-1] - stations[0]) / SPACING_M)), 1)
    per_sample = round(SPACING_M / _CLOTHOID_STEP_M)
    fine_m = np.linspace(stations[0], stations[-1], steps * per_sample + 1)
    x_m, y_m, yaw_rad = _driven(np.interp(fine_m, stations, curvature), float(fine_m[1] - fine_m[0]), start)
    coarse = slice(None, None, per_sample)
    width = np.full(steps + 1, half_width_m)
    driven_mps = np.maximum(np.interp(fine_m[coarse], stations, speed), 0.0)
    return ReferencePath(x_m[coarse], y_m[coarse], yaw_rad[coarse], driven_mps, width, width)


def _driven(curvature: Array, step_m: float, start: tuple[float, float, float]) -> tuple[Array, Array, Array]:
    """Positions and headings along a curvature; each step is a clothoid, taken as its chord."""
    turn = step_m * 0.5 * (curvature[1:] + curvature[:-1])
    yaw_rad = start[2] + np.concatenate(([0.0], np.cumsum(turn)))
    middle = yaw_rad[:-1] + step_m * (3.0 * curvature[:-1] + curvature[1:]) / 8.0
    chord_m = step_m * (1.0 - turn**2 / 24.0)
    x_m = start[0] + np.concatenate(([0.0], np.cumsum(chord_m * np.cos(middle))))
    y_m = start[1] + np.concatenate(([0.0], np.cumsum(chord_m * np.sin(middle))))
    return x_m, y_m, yaw_rad


def _smoothed(way_m: Array, values: Array, fine_m: Array, smoothing_m: float) -> tuple[Array, Array]:
    """A natural cubic spline near samples, and its derivative, at other places.

    It minimises the sum of squared distances, each by its share of the way, plus smoothing_m^4 times the integral of the squared second
    derivative: a wave of length 2 pi smoothing_m is halved.
    """
    h = np.diff(way_m)
    first, middle, last = 1.0 / h[:-1], -1.0 / h[:-1] - 1.0 / h[1:], 1.0 / h[1:]  # a column of Q: a second difference
    give = smoothing_m**4 / np.gradient(way_m)
    diagonal = (h[:-1] + h[1:]) / 3.0 + first**2 * give[:-2] + middle**2 * give[1:-1] + last**2 * give[2:]
    beside = h[1:-1] / 6.0 + middle[:-1] * first[1:] * give[1:-2] + last[:-1] * middle[1:] * give[2:-1]
    beyond = last[:-2] * first[2:] * give[2:-2]
    bend = _solved(diagonal, beside, beyond, np.diff(np.diff(values) / h))
    moved = np.zeros_like(values)
    for k, column in enumerate((first, middle, last)):
        moved[k : k + len(bend)] += column * bend
    level, bends = values - give * moved, np.concatenate(([0.0], bend, [0.0]))
    k_of = np.clip(np.searchsorted(way_m, fine_m, side="right") - 1, 0, len(h) - 1)
    step, low, high = h[k_of], bends[k_of], bends[k_of + 1]
    a, b = (way_m[k_of + 1] - fine_m) / step, (fine_m - way_m[k_of]) / step
    value = a * level[k_of] + b * level[k_of + 1] + step**2 / 6.0 * ((a**3 - a) * low + (b**3 - b) * high)
    slope = (level[k_of + 1] - level[k_of]) / step + step / 6.0 * ((3.0 * b**2 - 1.0) * high - (3.0 * a**2 - 1.0) * low)
    return value, slope


def _solved(diagonal: Array, beside: Array, beyond: Array, right: Array) -> Array:
    """Solution of a symmetric positive definite system with five diagonals, by its L D L^T factors."""
    n = len(diagonal)
    d, lower, lowest = diagonal.tolist(), [*beside.tolist(), 0.0], [*beyond.tolist(), 0.0, 0.0]
    x = right.tolist()
    for k in range(n):
        near, far = lower[k] / d[k], lowest[k] / d[k]
        if k + 1 < n:
            d[k + 1] -= near * lower[k]
            lower[k + 1] -= near * lowest[k]
            x[k + 1] -= near * x[k]
        if k + 2 < n:
            d[k + 2] -= far * lowest[k]
            x[k + 2] -= far * x[k]
        lower[k], lowest[k], x[k] = near, far, x[k] / d[k]
    for k in range(n - 2, -1, -1):
        x[k] -= lower[k] * x[k + 1] + (lowest[k] * x[k + 2] if k + 2 < n else 0.0)
    return np.array(x)


def _advancing(x_m: Array, y_m: Array) -> NDArray[np.int64]:
    """Rows at which the car has got on."""
    rows = [0]
    for row, (x, y) in enumerate(zip(x_m.tolist(), y_m.tolist(), strict=True)):
        way_m = math.hypot(x - x_m[rows[-1]], y - y_m[rows[-1]])
        if way_m > _LONGEST_GAP_M:
            raise ReferencePathError(f"row {row + 1}, column x_m = {x:g}: {way_m:.1f} m from the row before, at most {_LONGEST_GAP_M:g} m")
        if way_m >= _ADVANCE_M:
            rows.append(row)
    if len(rows) < _LEAST_SAMPLES:
        raise ReferencePathError(f"{len(x_m)} rows: the car gets on by less than {_ADVANCE_M * (_LEAST_SAMPLES - 1):g} m")
    return np.array(rows)


def _columns(**named: ArrayLike) -> dict[str, Array]:
    """Columns as arrays of one length, all numbers finite."""
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in named.items()}
    (first, expected), *_ = columns.items()
    for name, values in columns.items():
        if values.ndim != 1 or values.shape != expected.shape:
            raise ReferencePathError(f"column {name}: shape {values.shape}, expected {(expected.size,)} as {first}")
    if expected.size < 2:
        raise ReferencePathError(f"{expected.size} rows; a path needs at least 2")
    for name, values in columns.items():
        _refuse_rows(name, values, ~np.isfinite(values), "must be finite")
    speed = columns["speed_mps"]
    _refuse_rows("speed_mps", speed, (speed < -_STANDSTILL_NOISE_MPS) | (speed > _FASTEST_MPS), f"allowed: 0 to {_FASTEST_MPS:g}")
    return columns


def _refuse_rows(name: str, values: Array, is_bad: NDArray[np.bool_], rule: str) -> None:
    if is_bad.any():
        row = int(np.argmax(is_bad))
        raise ReferencePathError(f"row {row + 1}, column {name} = {values[row]:g}: {rule}")


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # so for NaN as well
        raise ReferencePathError(f"{name} = {value:g}: allowed: {low:g} to {high:g}")
