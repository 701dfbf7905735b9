"""The lateral shift of the reference: quintics along the arc length of the path, so that position, heading and curvature have no step.

It is a function of the station and not of time: what has been decided stays where it is on the ground while the car drives on. A
quintic that is cut at a station and begun again there with its offset, slope and bend is the same quintic.
"""

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from controller.problem import Array

_SHORTEST_BLEND_M = 1.0
_PEAK_BEND = 10.0 / np.sqrt(3.0)
"""Largest bend of a quintic from rest to rest of length 1 and height 1."""
_LENGTHS = np.geomspace(0.4, 8.0, 32)
_SAMPLES = np.linspace(0.0, 1.0, 21)
_AT_REST = 1e-9
_SAME_STATION_M = 1e-6


@dataclass(frozen=True)
class Knot:
    """The shift at one station.

    Args:
        offset_m: to the left of the path.
        slope: derivative of the offset by the station.
        bend_radpm: second derivative [1/m].
    """

    station_m: float
    offset_m: float = 0.0
    slope: float = 0.0
    bend_radpm: float = 0.0

    @property
    def is_at_rest(self) -> bool:
        """Whether the reference runs along the path here."""
        return abs(self.slope) < _AT_REST and abs(self.bend_radpm) < _AT_REST

    @property
    def is_aside(self) -> bool:
        """Whether the reference is beside the path here, or leaves it."""
        return self.offset_m != 0.0 or not self.is_at_rest


@dataclass(frozen=True)
class Shift:
    """Quintics between knots in ascending order, and constant behind the last, which is at rest.

    What is before the first knot is behind the car and forgotten; there it is constant as well.
    """

    knots: tuple[Knot, ...] = (Knot(0.0),)

    @cached_property
    def _stations(self) -> list[float]:
        return [knot.station_m for knot in self.knots]

    @cached_property
    def _coefficients(self) -> list[list[float]]:
        """Of each piece, lowest power first: a constant, the quintics, a constant."""
        first, last = self.knots[0], self.knots[-1]
        constants = [[knot.offset_m, 0.0, 0.0, 0.0, 0.0, 0.0] for knot in (first, last)]
        return [constants[0], *(_quintic(a, b).tolist() for a, b in zip(self.knots, self.knots[1:], strict=False)), constants[1]]

    @cached_property
    def _table(self) -> tuple[Array, Array, Array]:
        starts = [self._stations[0], *self._stations]
        return np.array(self._stations), np.array(starts), np.array(self._coefficients).T

    @property
    def is_none(self) -> bool:
        """Whether it is zero everywhere."""
        return len(self.knots) == 1 and self.knots[0].offset_m == 0.0

    def sample(self, station_m: Array) -> tuple[Array, Array, Array]:
        """Offset [m], slope and bend [1/m] at the stations."""
        stations, starts, coefficients = self._table
        piece = np.searchsorted(stations, station_m, side="right")
        return _polynomial(coefficients[:, piece], station_m - starts[piece])

    def at(self, station_m: float) -> Knot:
        """The shift at one station."""
        piece = bisect_right(self._stations, station_m)
        x = station_m - self._stations[max(piece - 1, 0)]
        a, b, c, d, e, f = self._coefficients[piece]
        offset_m = a + x * (b + x * (c + x * (d + x * (e + x * f))))
        slope = b + x * (2.0 * c + x * (3.0 * d + x * (4.0 * e + x * 5.0 * f)))
        return Knot(station_m, offset_m, slope, 2.0 * c + x * (6.0 * d + x * (12.0 * e + x * 20.0 * f)))

    def ahead(self, station_m: float) -> tuple[Knot, ...]:
        """Knots beyond a station."""
        return self.knots[bisect_right(self._stations, station_m) :]

    def continued(self, station_m: float, knots: tuple[Knot, ...], keep_m: float) -> "Shift":
        """The same shift up to a station, other knots beyond it; what lies more than `keep_m` behind the station is dropped."""
        here = self.at(station_m)
        behind = [knot for knot in self.knots if knot.station_m < station_m]
        oldest = max((k for k, knot in enumerate(behind) if knot.station_m <= station_m - keep_m), default=0)
        kept = behind[oldest:]
        for knot in (here, *knots):
            if not kept or knot.station_m > kept[-1].station_m + _SAME_STATION_M:
                kept.append(knot)
        return Shift(tuple(kept))


def _quintic(a: Knot, b: Knot) -> Array:
    """Coefficients of the polynomial of fifth degree from one knot to the next, in the distance from the first."""
    length = b.station_m - a.station_m
    rise = b.offset_m - a.offset_m - length * (a.slope + 0.5 * length * a.bend_radpm)
    turn = (b.slope - a.slope - length * a.bend_radpm) * length
    curl = (b.bend_radpm - a.bend_radpm) * length**2
    upper = np.array((10.0 * rise - 4.0 * turn + 0.5 * curl, -15.0 * rise + 7.0 * turn - curl, 6.0 * rise - 3.0 * turn + 0.5 * curl))
    return np.concatenate(((a.offset_m, a.slope, 0.5 * a.bend_radpm), upper / length ** np.arange(3, 6)))


def _polynomial(coefficients: Array, x: Array) -> tuple[Array, Array, Array]:
    a, b, c, d, e, f = coefficients
    value = a + x * (b + x * (c + x * (d + x * (e + x * f))))
    slope = b + x * (2.0 * c + x * (3.0 * d + x * (4.0 * e + x * 5.0 * f)))
    return value, slope, 2.0 * c + x * (6.0 * d + x * (12.0 * e + x * 20.0 * f))


def blend_length_m(start: Knot, offset_m: float, bend_radpm: float, edges_m: tuple[float, float]) -> float:
    """Shortest length of a quintic from a knot to rest at an offset that bends no more than allowed and stays between edges.

    Args:
        bend_radpm: the largest second derivative; where the start has more already, that [1/m].
        edges_m: smallest and largest offset; where start or end lie beyond them, those.

    Returns:
        The length [m]; infinite where no quintic does it.
    """
    from_rest = float(np.sqrt(_PEAK_BEND * abs(offset_m - start.offset_m) / bend_radpm))
    if start.is_at_rest:
        return max(from_rest, _SHORTEST_BLEND_M)
    lengths = max(from_rest, 2.0 * abs(start.slope) / bend_radpm, _SHORTEST_BLEND_M) * _LENGTHS
    coefficients = np.array([_quintic(start, Knot(start.station_m + length, offset_m)) for length in lengths.tolist()]).T
    value, _, bend = _polynomial(coefficients[:, :, None], lengths[:, None] * _SAMPLES)
    low, high = min(edges_m[0], start.offset_m, offset_m), max(edges_m[1], start.offset_m, offset_m)
    is_gentle = np.abs(bend).max(axis=1) <= max(bend_radpm, abs(start.bend_radpm)) * 1.001
    is_within = (value.min(axis=1) >= low - 1e-6) & (value.max(axis=1) <= high + 1e-6)
    chosen = np.flatnonzero(is_gentle & is_within)
    return float(lengths[chosen[0]]) if chosen.size else np.inf
