"""Local planner: where the car is on its path, and the piece of path that the horizon covers."""

from dataclasses import dataclass, replace

import numpy as np

from controller.problem import Array, Horizon, OcpOptions
from controller.reference import ReferencePath
from dbc.vehicle import ModelParameters

_RUN_OUT_M = 500.0
"""Straight line added beyond the last sample, with target speed zero: a car that arrives too fast brakes on it."""
_CURVATURE_STEP_M = 1.0
"""Curvature is the turn of the path from this far behind to this far ahead: noise on a recorded heading does not matter."""


@dataclass(frozen=True)
class PlannerOptions:
    """Numbers of the planner.

    Args:
        crawl_mps: slowest reference speed before the end of the path [m/s]: a profile that starts at rest must move.
        speed_margin_mps: difference to the measured speed up to which the profile is taken as it is [m/s].
        acceleration_mps2: rate at which the reference leaves that margin [m/s2]. A profile out of reach would make the
            terminal set infeasible; the model car does 3 m/s2 both ways.
        search_slack_m: by how much the search window exceeds the distance that the car can have moved [m].
        corridor_relief_m: room left to a car that is found outside the corridor, beyond where it is [m].
    """

    crawl_mps: float = 0.5
    speed_margin_mps: float = 1.0
    acceleration_mps2: float = 2.0
    search_slack_m: float = 2.0
    corridor_relief_m: float = 0.3


class Localiser:
    """Closest point of a path to the car, that only ever moves forward, by what the car can have driven.

    So it stays on its branch of a path that crosses itself.
    """

    def __init__(self, path: ReferencePath) -> None:
        self._points = np.column_stack((path.x_m, path.y_m))
        self._steps = np.diff(self._points, axis=0)
        self._lengths = np.diff(path.arc_length_m)
        self._arc_length = path.arc_length_m
        self._last: float | None = None

    def reset(self) -> None:
        """Forget where the car was: the next search covers the whole path."""
        self._last = None

    def locate(self, x_m: float, y_m: float, yaw_rad: float, reach_m: float) -> float:
        """Arc length of the closest point [m].

        Args:
            yaw_rad: heading of the car; a search of the whole path prefers branches that run its way.
            reach_m: how far the car can have moved since the last call [m].
        """
        if self._last is None:
            found = self._search(x_m, y_m, 0, len(self._lengths), yaw_rad)
        else:
            first = int(np.searchsorted(self._arc_length, self._last, side="right")) - 1
            beyond = int(np.searchsorted(self._arc_length, self._last + reach_m, side="left"))
            first = min(first, len(self._lengths) - 1)
            found = min(max(self._search(x_m, y_m, first, max(beyond, first + 1), None), self._last), self._last + reach_m)
        self._last = found
        return found

    def _search(self, x_m: float, y_m: float, first: int, beyond: int, yaw_rad: float | None) -> float:
        starts, steps, lengths = self._points[first:beyond], self._steps[first:beyond], self._lengths[first:beyond]
        offsets = np.array((x_m, y_m)) - starts[: len(steps)]
        share = np.clip(np.sum(offsets * steps, axis=1) / lengths**2, 0.0, 1.0)
        squared = np.sum((offsets - share[:, None] * steps) ** 2, axis=1)
        if yaw_rad is not None:
            runs_our_way = steps @ np.array((np.cos(yaw_rad), np.sin(yaw_rad))) > 0.0
            if runs_our_way.any():
                squared = np.where(runs_our_way, squared, np.inf)
        best = int(np.argmin(squared))
        return float(self._arc_length[first + best] + share[best] * lengths[best])


class Planner:
    """Cuts the horizon's piece out of the path."""

    def __init__(self, path: ReferencePath, car: ModelParameters, ocp: OcpOptions, options: PlannerOptions) -> None:
        self._end_m = _stop_m(path)
        self._path = _with_run_out(path)
        self._localiser = Localiser(self._path)
        self._car = car
        self._horizon_steps = ocp.horizon_steps
        self._sample_time_s = ocp.sample_time_s
        self._options = options

    def reset(self) -> None:
        """Forget where the car was."""
        self._localiser.reset()

    def horizon(self, state: Array, elapsed_s: float) -> Horizon:
        """References and corridor from the car's closest point on, one every sample time.

        The heading is that of a car whose centre of gravity follows the path, which is not the path's own: at parking speed it
        points 9 degrees into a turn of 10 m. Headings carry the whole turns that bring them next to the car's.

        Args:
            state: of the model, shape (6,).
            elapsed_s: time since the last call [s].
        """
        v_x, _, _, x_m, y_m, yaw_rad = state.tolist()
        path = self._path
        reach_m = max(v_x, 0.0) * elapsed_s + self._options.search_slack_m
        arc, speed = self._advance(self._localiser.locate(x_m, y_m, yaw_rad, reach_m), v_x)

        def along(samples: Array, ahead_m: float = 0.0) -> Array:
            return np.asarray(np.interp(arc + ahead_m, path.arc_length_m, samples))

        path_yaw = along(path.yaw_rad)
        path_yaw += 2.0 * np.pi * np.round((yaw_rad - path_yaw[0]) / (2.0 * np.pi))
        curvature = (along(path.yaw_rad, _CURVATURE_STEP_M) - along(path.yaw_rad, -_CURVATURE_STEP_M)) / (2.0 * _CURVATURE_STEP_M)
        heading = path_yaw - steady_sideslip(curvature, speed, self._car)
        none = np.zeros_like(speed)
        reference = np.column_stack((speed, none, none, along(path.x_m), along(path.y_m), heading))
        return self._relieved(Horizon(reference, path_yaw, along(path.left_m), along(path.right_m)), state)

    def _advance(self, arc_m: float, v_x: float) -> tuple[Array, Array]:
        """Arc length and speed of each reference, driving the profile as far as the car can follow it."""
        options, path = self._options, self._path
        arc, speed = np.empty(self._horizon_steps + 1), np.empty(self._horizon_steps + 1)
        for k in range(self._horizon_steps + 1):
            profile = float(np.interp(arc_m, path.arc_length_m, path.speed_mps))
            wanted = max(profile, options.crawl_mps) if arc_m < self._end_m else 0.0
            within = options.speed_margin_mps + options.acceleration_mps2 * k * self._sample_time_s
            arc[k], speed[k] = arc_m, max(0.0, min(max(wanted, v_x - within), v_x + within))
            arc_m += speed[k] * self._sample_time_s
        return arc, speed

    def _relieved(self, horizon: Horizon, state: Array) -> Horizon:
        """The corridor, widened to hold a car that is already outside, which could not obey it."""
        offset = lateral_offset(state, horizon)
        relief = self._options.corridor_relief_m
        if offset > horizon.left_m[0]:
            return replace(horizon, left_m=np.maximum(horizon.left_m, offset + relief))
        if -offset > horizon.right_m[0]:
            return replace(horizon, right_m=np.maximum(horizon.right_m, relief - offset))
        return horizon


def steady_sideslip(curvature_radpm: Array, speed_mps: Array, car: ModelParameters) -> Array:
    """Angle from the heading to the velocity of a car in a steady turn, left positive [rad].

    Source: the model's equations (1) to (3) at rest, for small angles: the rear axle carries L_f / L of the lateral force.
    """
    load_share = car.cog_to_front_m / (car.cog_to_front_m + car.cog_to_rear_m)
    rear_slip = car.mass_kg * speed_mps**2 * load_share / car.rear_cornering_stiffness_nprad
    return curvature_radpm * (car.cog_to_rear_m - rear_slip)


def lateral_offset(state: Array, horizon: Horizon) -> float:
    """Distance of the car to the left of the first reference [m]."""
    return float(horizon.normals()[0] @ (state[3:5] - horizon.reference[0, 3:5]))


def _stop_m(path: ReferencePath) -> float:
    """Arc length from which on the path asks for standstill; its end, when it never does."""
    moving = np.flatnonzero(path.speed_mps > 0.0)
    return float(path.arc_length_m[min(int(moving[-1]) + 1, len(path.arc_length_m) - 1)]) if moving.size else 0.0


def _with_run_out(path: ReferencePath) -> ReferencePath:
    heading = np.array((np.cos(path.yaw_rad[-1]), np.sin(path.yaw_rad[-1])))
    columns = {name: np.append(getattr(path, name), getattr(path, name)[-1]) for name in ("yaw_rad", "left_m", "right_m")}
    return ReferencePath(
        x_m=np.append(path.x_m, path.x_m[-1] + _RUN_OUT_M * heading[0]),
        y_m=np.append(path.y_m, path.y_m[-1] + _RUN_OUT_M * heading[1]),
        speed_mps=np.append(path.speed_mps, 0.0),
        **columns,
    )
