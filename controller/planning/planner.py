"""Local planner: where the car is on its path, the piece of path that the horizon covers, and what the objects on it leave."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.planning.corridor import Bounds, Encounter, Gap, Outline, Surroundings, bounds, encounters, gaps
from controller.planning.linking import Motion
from controller.planning.localiser import Localiser
from controller.planning.obstacles import Obstacle, PathFrame, Smoother, Track, usable
from controller.planning.options import PlannerError, PlannerOptions
from controller.planning.passing import Decision, Passing
from controller.planning.reference import ReferencePath
from controller.planning.shift import Knot, Shift, blend_length_m
from controller.planning.speed import Leader, SpeedPlanner
from controller.problem import N_CAR_STATES, Array, Horizon, OcpOptions
from dbc.vehicle import Body, ModelParameters

__all__ = ["Localiser", "Obstacle", "Planner", "PlannerError", "PlannerOptions", "lateral_offset", "steady_sideslip"]

_RUN_OUT_M = 500.0
"""Straight line added beyond the last sample, with target speed zero: a car that arrives too fast brakes on it."""
_CURVATURE_STEP_M = 1.0
"""Curvature is the turn of the path from this far behind to this far ahead: noise on a recorded heading does not matter."""
_LOOK_AHEAD_STEPS = 24
_LOOK_AHEAD_STEP_S = 0.5
_INSTANTS_S: Array = np.linspace(0.0, _LOOK_AHEAD_STEPS * _LOOK_AHEAD_STEP_S, _LOOK_AHEAD_STEPS + 1)
"""Time over which objects are predicted: long enough to see the end of an overtaking manoeuvre."""
_BEHIND_M = 40.0
"""How far behind the car an object can be on the path and matter, because it is fast."""
_LONGEST_OBJECT_M = 50.0
_STANDSTILL_MPS = 0.5
_PULL_OUT_SHARE = 0.8
"""Share of the tightest curvature that the room for pulling out is for."""


@dataclass(frozen=True)
class Line:
    """The reference at the nodes of the horizon in terms of the path; arrays of shape (N+1,).

    Args:
        offset_m, slope: of the shift from the path.
    """

    station_m: Array
    speed_mps: Array
    offset_m: Array
    slope: Array


class Planner:
    """Cuts the horizon's piece out of the path, and leads it past the objects there.

    `options` may be replaced between two calls.

    Args:
        body: outline of the car; without it there can be no objects.
    """

    def __init__(
        self, path: ReferencePath, car: ModelParameters, ocp: OcpOptions, options: PlannerOptions, body: Body | None = None
    ) -> None:
        end_m = _stop_m(path)
        self._path = _with_run_out(path)
        self._localiser = Localiser(self._path)
        self._frame = PathFrame(self._path)
        self._speed = SpeedPlanner(self._path, self._frame, end_m)
        self._smoother = Smoother()
        self._passing = Passing()
        self._car = car
        self._outline = None if body is None else Outline.of(body, car)
        self._horizon_steps = ocp.horizon_steps
        self._sample_time_s = ocp.sample_time_s
        self.options = options
        self.decision = Decision(Shift())
        self.objects_ignored = 0

    def reset(self) -> None:
        """Forget where the car was, and what was decided about objects."""
        self._localiser.reset()
        self._smoother.reset()
        self._passing.reset()

    def horizon(self, state: Array, elapsed_s: float, objects: Sequence[Obstacle] = ()) -> Horizon:
        """References and corridor from the car's closest point on, one every sample time.

        The heading is that of a car whose centre of gravity follows the path, which is not the path's own: at parking speed it
        points 9 degrees into a turn of 10 m. Headings carry the whole turns that bring them next to the car's.

        Args:
            state: of the model; the first six are those of the car.
            elapsed_s: time since the last call [s].
            objects: in the ground frame, now. One that is not finite or too large is ignored and counted in `objects_ignored`.

        Raises:
            ValueError: there are objects, but no outline of the car was given.
        """
        v_x, _, _, x_m, y_m, yaw_rad = state[:N_CAR_STATES].tolist()
        reach_m = max(v_x, 0.0) * elapsed_s + self.options.search_slack_m
        station_m = self._localiser.locate(x_m, y_m, yaw_rad, reach_m)
        good = usable(objects)
        self.objects_ignored += len(objects) - len(good)
        self.decision, leaders = self._decide(self._smoother.smoothed(good, elapsed_s), station_m, v_x)
        line = self._line(station_m, v_x, leaders)
        path_yaw, reference = self._reference(line, yaw_rad)
        corridor = self._corridor(line, v_x)
        return self._relieved(Horizon(reference, path_yaw, corridor.left_m, corridor.right_m), state)

    def _decide(self, objects: Sequence[Obstacle], station_m: float, v_x: float) -> tuple[Decision, list[Leader]]:
        if not objects and self._passing.shift.is_none:
            return Decision(Shift()), []
        options, around = self.options, self._surroundings(v_x)
        motion = Motion(*self._speed.advance(station_m, v_x, _LOOK_AHEAD_STEPS, _LOOK_AHEAD_STEP_S, options))
        sight_m = station_m + around.outline.front_m + options.detection_range_m
        beside_m = around.outline.half_width_m + options.safe_lateral_m
        tracks = self._frame.tracks(objects, _INSTANTS_S, station_m - _BEHIND_M, sight_m + _LONGEST_OBJECT_M, beside_m)
        seen = [track for track in tracks if track.station_m[0] - track.half_along_m[0] <= sight_m]
        offset_m = self._passing.shift.at(station_m).offset_m
        decision = self._passing.decide(encounters(seen, motion.station_m, offset_m, around), motion, around)
        return decision, [_leader(meeting, around) for meeting in decision.blockers]

    def _surroundings(self, v_x: float) -> Surroundings:
        if self._outline is None:
            raise ValueError("objects cannot be passed without the outline of the car")
        return Surroundings(self._frame, self._outline, self.options, v_x)

    def _line(self, station_m: float, v_x: float, leaders: Sequence[Leader]) -> Line:
        shift = self.decision.shift
        station, speed = self._speed.advance(
            station_m, v_x, self._horizon_steps, self._sample_time_s, self.options,
            leaders=leaders, shift=None if shift.is_none else shift.at,
        )  # fmt: skip
        offset, slope, _ = shift.sample(station)
        return Line(station, speed, offset, slope)

    def _reference(self, line: Line, yaw_rad: float) -> tuple[Array, Array]:
        """Direction of the path, shape (N+1,), and references of the car's states, shape (N+1, 6)."""
        path, step_m = self._path, _CURVATURE_STEP_M

        def along(samples: Array, ahead_m: float = 0.0) -> Array:
            return np.asarray(np.interp(line.station_m + ahead_m, path.arc_length_m, samples))

        path_yaw = along(path.yaw_rad)
        path_yaw += 2.0 * np.pi * np.round((yaw_rad - path_yaw[0]) / (2.0 * np.pi))
        curvature = (along(path.yaw_rad, step_m) - along(path.yaw_rad, -step_m)) / (2.0 * step_m)
        x_m, y_m, course = along(path.x_m), along(path.y_m), path_yaw
        if not self.decision.shift.is_none:
            x_m, y_m = x_m - line.offset_m * np.sin(path_yaw), y_m + line.offset_m * np.cos(path_yaw)
            course = path_yaw + np.arctan2(line.slope, 1.0 - curvature * line.offset_m)
            curvature = self._shifted_curvature(line, curvature)
        heading = course - steady_sideslip(curvature, line.speed_mps, self._car)
        none = np.zeros_like(heading)
        return path_yaw, np.column_stack((line.speed_mps, none, none, x_m, y_m, heading))

    def _shifted_curvature(self, line: Line, curvature_radpm: Array) -> Array:
        """Curvature of the shifted line [1/m], over the same distance as that of the path."""
        step_m = _CURVATURE_STEP_M

        def turn(ahead_m: float) -> Array:
            offset, slope, _ = self.decision.shift.sample(line.station_m + ahead_m)
            return np.arctan2(slope, 1.0 - curvature_radpm * offset)

        way_m = 2.0 * step_m * np.hypot(1.0 - curvature_radpm * line.offset_m, line.slope)
        return np.asarray((2.0 * step_m * curvature_radpm + turn(step_m) - turn(-step_m)) / way_m)

    def _corridor(self, line: Line, v_x: float) -> Bounds:
        path = self._path
        edges = tuple(np.asarray(np.interp(line.station_m, path.arc_length_m, samples)) for samples in (path.left_m, path.right_m))
        if self.decision.shift.is_none and not self.decision.passed:
            return Bounds(*edges)
        passed = [self._at_nodes(meeting, gap) for meeting, gap in self.decision.passed]
        return bounds(line.station_m, line.offset_m, (edges[0], edges[1]), passed, self._surroundings(v_x))

    def _at_nodes(self, meeting: Encounter, gap: Gap) -> tuple[Track, Gap]:
        times_s, track = self._sample_time_s * np.arange(self._horizon_steps + 1), meeting.track
        columns = (track.station_m, track.offset_m, track.half_along_m, track.half_across_m)
        return Track(track.name, *(np.interp(times_s, _INSTANTS_S, column) for column in columns)), gap

    def _relieved(self, horizon: Horizon, state: Array) -> Horizon:
        """The corridor, widened to hold a car that is already outside, which could not obey it."""
        offset = lateral_offset(state, horizon)
        relief = self.options.corridor_relief_m
        if offset > horizon.left_m[0]:
            return replace(horizon, left_m=np.maximum(horizon.left_m, offset + relief))
        if -offset > horizon.right_m[0]:
            return replace(horizon, right_m=np.maximum(horizon.right_m, relief - offset))
        return horizon


def _leader(meeting: Encounter, around: Surroundings) -> Leader:
    """What the car has to stay behind: the rear of an object, and the safe distances at its speed.

    Behind something that stands and can be passed once the way is free, there has to be room to pull out.
    """
    track, options = meeting.track, around.options
    speed_mps = float(track.station_m[1] - track.station_m[0]) / _LOOK_AHEAD_STEP_S
    rear_m = float(track.station_m[0] - track.half_along_m[0])
    safe_m = replace(around, speed_mps=speed_mps).safe_distance_m
    if abs(speed_mps) < _STANDSTILL_MPS:
        ways = gaps([replace(meeting, side=None)], around.frame.edges(meeting.firm.from_m, meeting.firm.from_m), {}, options)
        bend_radpm = _PULL_OUT_SHARE * options.tightest_curvature_radpm
        pull_out_m = (blend_length_m(Knot(0.0), way.target_m, bend_radpm, (-np.inf, np.inf)) for way in ways)
        safe_m = max(safe_m, min(pull_out_m, default=0.0))
    return Leader(rear_m - around.outline.front_m - safe_m, speed_mps)


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
