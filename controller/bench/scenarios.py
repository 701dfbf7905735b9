"""What the bench drives: the paper's four scenarios, and those that push a controller against its bounds."""

from dataclasses import dataclass, field, replace

import numpy as np

from controller.nmpc import NmpcOptions
from controller.planning.planner import PlannerOptions
from controller.planning.reference import ReferencePath
from controller.problem import Array, Horizon


@dataclass(frozen=True)
class Scenario:
    """A path and where the car stands on it at the beginning.

    Args:
        offset_m: to the left of the first sample [m].
        speed_mps: at the beginning [m/s].
    """

    name: str
    path: ReferencePath
    offset_m: float
    speed_mps: float
    duration_s: float

    def start(self) -> Array:
        """State of the model at the beginning, shape (6,)."""
        path, yaw = self.path, float(self.path.yaw_rad[0])
        x_m, y_m = path.x_m[0] - self.offset_m * np.sin(yaw), path.y_m[0] + self.offset_m * np.cos(yaw)
        return np.array((self.speed_mps, 0.0, 0.0, x_m, y_m, yaw))


def nominal_scenarios() -> tuple[Scenario, ...]:
    """The paper's three kinds of driving: double lane change at 80 km/h, lane keeping at 60, parking at 10."""
    return (
        Scenario("dlc80", _double_lane_change(80 / 3.6), 0.0, 80 / 3.6, 8.0),
        Scenario("lane60", _lane_keeping(60 / 3.6), 0.5, 60 / 3.6 - 1.0, 10.0),
        Scenario("park10", _parking(10 / 3.6), 0.0, 0.0, 18.0),
    )


@dataclass(frozen=True)
class Obstacle:
    """Something that closes the right part of the road, over a stretch of X that has the safe distances in it.

    Args:
        first_x_m, last_x_m: the stretch [m].
        edge_m: the car's centre keeps to the left of this, measured from the path to the left [m].
        shift_m: by how much the reference steps to the left there [m].
        reported_m: distance to the stretch from which on it is known [m].
    """

    first_x_m: float
    last_x_m: float
    edge_m: float
    shift_m: float = 0.0
    reported_m: float = 20.0


@dataclass(frozen=True)
class Case:
    """A closed loop to record problems from.

    The horizons are edited after the planner, so that the problems stay what they are when the planner learns more.

    Args:
        half_width_m: corridor to each side that takes the place of the path's, and of the planner's relief for a car outside [m].
        seed: of the noise of the navigation system.
    """

    name: str
    scenario: Scenario
    obstacle: Obstacle | None = None
    half_width_m: float | None = None
    nmpc: NmpcOptions = field(default_factory=NmpcOptions)
    seed: int = 1

    def edited(self, state: Array, horizon: Horizon) -> Horizon:
        """The horizon with this case's corridor and obstacle, for a car in `state`, shape (6,)."""
        if self.half_width_m is not None:
            widths = np.full(horizon.left_m.size, self.half_width_m)
            horizon = replace(horizon, left_m=widths, right_m=widths)
        obstacle = self.obstacle
        if obstacle is None or obstacle.first_x_m - state[3] > obstacle.reported_m:
            return horizon
        reference = horizon.reference.copy()
        is_beside = (reference[:, 3] >= obstacle.first_x_m) & (reference[:, 3] <= obstacle.last_x_m)
        shift_m = np.where(is_beside, obstacle.shift_m, 0.0)
        reference[:, 3:5] += horizon.normals() * shift_m[:, None]
        right_m = np.where(is_beside, obstacle.shift_m - obstacle.edge_m, horizon.right_m)
        return replace(horizon, reference=reference, left_m=horizon.left_m - shift_m, right_m=right_m)


def nominal_cases() -> tuple[Case, ...]:
    """The paper's four scenarios: those of `nominal_scenarios`, and the cut-in at 60 km/h.

    In the cut-in an object is reported 20 m ahead; reference and corridor step aside for the 10 m that it takes with its safe
    distances, as far as a car can go in the time that is left.
    """
    cut_in = Scenario("cutin60", _straight(60 / 3.6, 2.5), 0.0, 60 / 3.6, 6.0)
    return (*(Case(s.name, s) for s in nominal_scenarios()), Case("cutin60", cut_in, Obstacle(40.0, 50.0, 0.4, 1.5)))


def active_cases() -> tuple[Case, ...]:
    """Driving against the bounds: throttle, corridor, an object that closes half of it, and a car outside of it."""
    dlc80, lane60, _ = nominal_scenarios()
    slow = replace(dlc80, speed_mps=(80 - 14) / 3.6)
    unlimited = NmpcOptions(planner=PlannerOptions(speed_margin_mps=20.0))
    beside = (replace(dlc80, offset_m=offset_m, duration_s=2.0) for offset_m in (-1.6, -1.2, -0.8, 0.8, 1.2, 1.6))
    straight = Scenario("straight", _straight(80 / 3.6, 1.0), 0.0, 80 / 3.6, 5.0)
    return (
        *(Case("saturated", slow, half_width_m=0.25, nmpc=unlimited, seed=seed) for seed in (1, 2, 3)),
        Case("tight", dlc80, half_width_m=0.1),
        Case("tight", replace(lane60, offset_m=0.0), half_width_m=0.1),
        Case("cut-in", straight, Obstacle(45.0, 65.0, 0.5)),
        Case("cut-in", replace(straight, speed_mps=60 / 3.6, path=_straight(60 / 3.6, 1.0)), Obstacle(40.0, 60.0, 0.5)),
        Case("cut-in", replace(lane60, offset_m=0.0), Obstacle(95.0, 115.0, 0.5)),
        *(Case("violated", scenario, half_width_m=0.25) for scenario in beside),
    )


def _straight(speed_mps: float, half_width_m: float) -> ReferencePath:
    x_m = np.arange(0.0, 200.0, 0.5)
    return _path(x_m, np.zeros(x_m.size), np.full(x_m.size, speed_mps), half_width_m)


def _shift(along_m: Array, start_m: float, length_m: float, height_m: float) -> Array:
    """Lateral shift by a polynomial of fifth degree, without a step in curvature."""
    t = np.clip((along_m - start_m) / length_m, 0.0, 1.0)
    return height_m * t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def _path(x_m: Array, y_m: Array, speed_mps: Array, half_width_m: float) -> ReferencePath:
    yaw_rad = np.unwrap(np.arctan2(np.gradient(y_m), np.gradient(x_m)))
    return ReferencePath(x_m, y_m, yaw_rad, speed_mps, np.full(x_m.size, half_width_m), np.full(x_m.size, half_width_m))


def _double_lane_change(speed_mps: float) -> ReferencePath:
    # ISO 3888-1: gates at 0 to 15, 45 to 70 and 95 to 125 m, lane offset 3.5 m; the shifts use the room in the gates.
    x_m = np.arange(-40.0, 200.0, 0.25)
    y_m = _shift(x_m, 11.25, 40.0, 3.5) - _shift(x_m, 63.25, 40.0, 3.5)
    return _path(x_m, y_m, np.full(x_m.size, speed_mps), 0.8)


def _lane_keeping(speed_mps: float) -> ReferencePath:
    x_m = np.arange(0.0, 260.0, 0.25)
    y_m = _shift(x_m, 60.0, 30.0, 3.0) - _shift(x_m, 130.0, 34.0, 3.0) + 4.0 * np.sin(x_m / 120.0) ** 2
    return _path(x_m, y_m, np.full(x_m.size, speed_mps), 1.0)


def _parking(speed_mps: float) -> ReferencePath:
    # From rest, 1.5 m aside and back, a quarter turn of 10 m radius, to rest.
    s_m = np.arange(0.0, 42.0, 0.1)
    curvature = np.convolve(np.where((s_m > 24.0) & (s_m < 24.0 + 5.0 * np.pi), 0.1, 0.0), np.ones(30) / 30, "same")
    yaw_rad = np.cumsum(curvature) * 0.1
    lateral_m = _shift(s_m, 4.0, 8.0, 1.5) - _shift(s_m, 14.0, 8.0, 1.5)
    x_m = np.cumsum(np.cos(yaw_rad)) * 0.1 - np.sin(yaw_rad) * lateral_m
    y_m = np.cumsum(np.sin(yaw_rad)) * 0.1 + np.cos(yaw_rad) * lateral_m
    ramp_mps = np.sqrt(2.0 * 0.8 * np.minimum(s_m, s_m[-1] - s_m))
    return _path(x_m, y_m, np.minimum(speed_mps, ramp_mps), 0.8)
