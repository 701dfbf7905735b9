"""The objects of a scenario along a run: when each appears, and how it drives on. Pure: time and the car's place are arguments."""

import math
from dataclasses import dataclass

import numpy as np

from dbc.vehicle import Vehicle
from gateway.telemetry import ObjectsSample, WorldObject
from xil.course import Course
from xil.scenario import RoadObject, Scenario

_NS_PER_S = 1e9


@dataclass(frozen=True)
class _Appeared:
    """An object since it is there."""

    spec: RoadObject
    x_m: float
    y_m: float
    yaw_rad: float
    since_s: float

    def at(self, t_s: float) -> WorldObject:
        vx_mps, vy_mps = (self.spec.speed_kmh / 3.6 * part(self.yaw_rad) for part in (math.cos, math.sin))
        driven_s = t_s - self.since_s
        return WorldObject(
            name=self.spec.name, x_m=self.x_m + vx_mps * driven_s, y_m=self.y_m + vy_mps * driven_s, yaw_rad=self.yaw_rad,
            length_m=self.spec.length_m, width_m=self.spec.width_m, vx_mps=vx_mps, vy_mps=vy_mps,
        )  # fmt: skip


class World:
    """What stands and drives on the road besides the car.

    Args:
        start_ns: time zero of the run [ns].
    """

    def __init__(self, scenario: Scenario, vehicle: Vehicle, start_ns: int) -> None:
        self._course = scenario.course(vehicle)
        self._road = scenario.road
        self._waiting = list(scenario.objects)
        self._there: list[_Appeared] = []
        self._start_ns = start_ns
        self._reached_m = -math.inf

    def sample(self, now_ns: int, seq: int, x_m: float, y_m: float) -> ObjectsSample:
        """The objects that are there, with the car at a place."""
        t_s = (now_ns - self._start_ns) / _NS_PER_S
        if self._waiting:
            station_m = float(self._course.project(np.array([x_m]), np.array([y_m])).station_m[0])
            self._reached_m = max(self._reached_m, station_m)
            due = [spec for spec in self._waiting if spec.is_due(t_s, self._reached_m)]
            self._waiting = [spec for spec in self._waiting if spec not in due]
            self._there += [_Appeared(spec, *_pose(self._course, self._road.right_m, spec), t_s) for spec in due]
        return ObjectsSample(t_ns=now_ns, seq=seq, objects=[thing.at(t_s) for thing in self._there])


def _pose(course: Course, right_edge_m: float, spec: RoadObject) -> tuple[float, float, float]:
    """Place [m] and heading [rad] of an object beside the base line of a course, when it appears."""
    (left_x, left_y), (right_x, right_y) = (
        (float(np.interp(spec.station_m, course.station_m, edge_m[:, 0])), float(np.interp(spec.station_m, course.station_m, edge_m[:, 1])))
        for edge_m in (course.left_edge_m, course.right_edge_m)
    )
    width_m = math.hypot(left_x - right_x, left_y - right_y)
    share = (right_edge_m + spec.offset_m) / width_m
    yaw_rad = math.atan2(left_y - right_y, left_x - right_x) - 0.5 * math.pi
    x_m, y_m = right_x + share * (left_x - right_x), right_y + share * (left_y - right_y)
    return x_m, y_m, math.remainder(yaw_rad + math.radians(spec.heading_deg), 2.0 * math.pi)
