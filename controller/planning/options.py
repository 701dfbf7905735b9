"""Numbers of the planner. All of them may be replaced between two cycles."""

import math
from dataclasses import dataclass

from dbc.errors import UserMistake


class PlannerError(UserMistake):
    """A number that the planner cannot work with; one line that names key, value and range."""


@dataclass(frozen=True)
class PlannerOptions:
    """Numbers of the planner; `RANGES` says what each may be.

    Args:
        crawl_mps: slowest reference speed before the end of the path [m/s]: a profile that starts at rest must move.
        speed_margin_mps: difference to the measured speed up to which the profile is taken as it is [m/s].
        acceleration_mps2: rate at which the reference leaves that margin, and at which it brakes for an object [m/s2]. A profile out
            of reach would make the terminal set infeasible; the model car does 3 m/s2 both ways.
        hardest_deceleration_mps2: with which it brakes for an object that appears too late for that [m/s2]; a reference that asks for more
            than the brakes can do makes the solver shed speed by steering.
        search_slack_m: by how much the search window exceeds the distance that the car can have moved [m].
        corridor_relief_m: room left to a car that is found outside the corridor, beyond where it is [m].
        detection_range_m: from the car's front to an object along the path, beyond which the object does not exist [m].
        safe_time_s: time gap to an object, before and behind [s]. The paper drove with 1.8 and then 1.2 s.
        safe_longitudinal_m: distance to an object at standstill, before and behind [m].
        safe_lateral_m: distance from the side of the car to an object [m].
        reference_room_m: from the reference to the edge of the corridor, where an object makes it pass there and the road has it [m].
        lateral_acceleration_mps2: of a shift that is begun in time, bends of the path included [m/s2].
        hardest_lateral_acceleration_mps2: of a shift around an object that appears too late for that [m/s2].
        tightest_curvature_radpm: of a shifted reference [1/m]; with full lock the car does 0.23.
        side_hysteresis_m: by how much less of a shift the other side must need to be taken instead of the one chosen [m].
    """

    crawl_mps: float = 0.5
    speed_margin_mps: float = 1.0
    acceleration_mps2: float = 2.0
    hardest_deceleration_mps2: float = 2.8
    search_slack_m: float = 2.0
    corridor_relief_m: float = 0.3
    detection_range_m: float = 60.0
    safe_time_s: float = 1.2
    safe_longitudinal_m: float = 2.0
    safe_lateral_m: float = 0.4
    reference_room_m: float = 0.2
    lateral_acceleration_mps2: float = 2.0
    hardest_lateral_acceleration_mps2: float = 4.0
    tightest_curvature_radpm: float = 0.15
    side_hysteresis_m: float = 0.5

    def __post_init__(self) -> None:
        for key, (low, high) in RANGES.items():
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and low <= value <= high):
                raise PlannerError(f"{key} = {value!r}: allowed: {low:g} to {high:g}")
        for key, most in (
            ("acceleration_mps2", "hardest_deceleration_mps2"),
            ("lateral_acceleration_mps2", "hardest_lateral_acceleration_mps2"),
        ):
            if getattr(self, key) > getattr(self, most):
                raise PlannerError(f"{key} = {getattr(self, key):g}: allowed: at most {most} = {getattr(self, most):g}")


RANGES: dict[str, tuple[float, float]] = {
    "crawl_mps": (0.1, 5.0),
    "speed_margin_mps": (0.0, 50.0),
    "acceleration_mps2": (0.1, 10.0),
    "hardest_deceleration_mps2": (0.1, 10.0),
    "search_slack_m": (0.1, 50.0),
    "corridor_relief_m": (0.0, 5.0),
    "detection_range_m": (0.0, 200.0),
    "safe_time_s": (0.0, 5.0),
    "safe_longitudinal_m": (0.5, 50.0),
    "safe_lateral_m": (0.0, 5.0),
    "reference_room_m": (0.0, 2.0),
    "lateral_acceleration_mps2": (0.1, 10.0),
    "hardest_lateral_acceleration_mps2": (0.1, 10.0),
    "tightest_curvature_radpm": (0.02, 0.25),
    "side_hysteresis_m": (0.0, 5.0),
}
"""Smallest and largest value of each number."""
