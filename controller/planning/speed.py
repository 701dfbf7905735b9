"""The speed reference: the path's profile as far as the car can follow it, and stops before what cannot be passed.

A car that follows keeps the safe time gap at the speed of what is before it; before something that stands, it stops.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from controller.planning.obstacles import PathFrame
from controller.planning.options import PlannerOptions
from controller.planning.reference import ReferencePath
from controller.planning.shift import Knot
from controller.problem import Array

_CLOSING_RATE_PER_S = 1.5
"""Near the place to stop, the speed is this rate times the distance: a square root to the very end would be infinitely steep."""
_ARRIVED_M = 0.1
"""Distance from the place to stop at which the car stands."""
_RESERVE = 1.1
"""Factor on the deceleration that is needed to stop in time."""
_BRAKING_MARGIN_MPS = 0.2
"""Difference to the measured speed with which braking begins: noise. A larger step asks for more than the brakes can do."""
_FLAT = 1e-6
_LEAST_STRETCH = 0.1
"""Beyond the centre of a bend there is no line beside the path."""


@dataclass(frozen=True)
class Leader:
    """Something that the car must stay behind.

    Args:
        limit_m: station that the car may not pass now, safe distances included.
        speed_mps: at which that station moves on; negative when it comes nearer.
    """

    limit_m: float
    speed_mps: float

    def allowed_mps(self, distance_m: float, deceleration_mps2: float) -> float:
        """Speed at a distance from the limit, from which the car comes to follow at the deceleration or less."""
        knee_mps = deceleration_mps2 / _CLOSING_RATE_PER_S
        if distance_m <= 0.0:
            return max(self.speed_mps + _CLOSING_RATE_PER_S * distance_m, 0.0)
        closing_mps = math.sqrt(2.0 * deceleration_mps2 * distance_m + knee_mps**2) - knee_mps
        allowed_mps = max(self.speed_mps + closing_mps, 0.0)
        return 0.0 if self.speed_mps <= 0.0 and distance_m < _ARRIVED_M else allowed_mps

    def needed_mps2(self, station_m: float, speed_mps: float) -> float:
        """Deceleration with which a car just comes to follow in time [m/s2]; infinite when it is too late."""
        closing_mps = max(speed_mps - self.speed_mps, 0.0)
        distance_m = self.limit_m - station_m
        if closing_mps == 0.0:
            return 0.0
        return closing_mps**2 / (2.0 * distance_m) if distance_m > 0.0 else math.inf


class SpeedPlanner:
    """Speed along one path."""

    def __init__(self, path: ReferencePath, frame: PathFrame, end_m: float) -> None:
        self._stations: list[float] = path.arc_length_m.tolist()
        self._speeds: list[float] = path.speed_mps.tolist()
        self._frame = frame
        self._end_m = end_m

    def advance(
        self, station_m: float, speed_mps: float, steps: int, step_s: float, options: PlannerOptions,
        *, leaders: Sequence[Leader] = (), shift: Callable[[float], Knot] | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Stations and reference speeds from a station on, one every step.

        Args:
            speed_mps: measured; the reference stays within reach of it.
            shift: lateral shift of the reference, where there is one.

        Returns:
            Both of shape (steps + 1,).
        """
        needed = max((leader.needed_mps2(station_m, speed_mps) for leader in leaders), default=0.0)
        braking = min(max(_RESERVE * needed, options.acceleration_mps2), options.hardest_deceleration_mps2)
        stations, speeds = [], []
        for t_s in [step_s * k for k in range(steps + 1)]:
            wanted = max(self._profile(station_m), options.crawl_mps) if station_m < self._end_m else 0.0
            progress = 1.0
            if shift is not None and (knot := shift(station_m)).is_aside:
                if abs(knot.bend_radpm) > _FLAT:
                    wanted = min(wanted, (options.hardest_lateral_acceleration_mps2 / abs(knot.bend_radpm)) ** 0.5)
                progress = self._progress(knot)
            within = options.speed_margin_mps + options.acceleration_mps2 * t_s
            wanted = min(max(wanted, speed_mps - within), speed_mps + within)
            for leader in leaders:
                distance_m = leader.limit_m + leader.speed_mps * t_s - station_m
                slowest = speed_mps - _BRAKING_MARGIN_MPS - braking * t_s
                wanted = min(wanted, max(leader.allowed_mps(distance_m, options.acceleration_mps2), slowest))
            stations.append(station_m)
            speeds.append(max(0.0, wanted))
            station_m += speeds[-1] * step_s * progress
        return np.array(stations), np.array(speeds)

    def _profile(self, station_m: float) -> float:
        stations = self._stations
        k = bisect_right(stations, station_m, 1, len(stations) - 1)
        low, high = stations[k - 1], stations[k]
        share = min((station_m - low) / (high - low), 1.0)
        return self._speeds[k - 1] + share * (self._speeds[k] - self._speeds[k - 1])

    def _progress(self, knot: Knot) -> float:
        """Distance along the path for each metre along its shifted line."""
        stretch = 1.0 - self._frame.curvature_at(knot.station_m) * knot.offset_m
        return 1.0 / math.hypot(max(stretch, _LEAST_STRETCH), knot.slope)
