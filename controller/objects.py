"""Objects on the road as they are told from outside: checked, moved to now, the nearest of them.

A sample names all objects there are. One that is not named any more is gone, and so are all of them when no sample has come
for half a second. For a virtual world that is right: a tool that was closed must not leave a wall on the test track. For a
real perception it is not safe, an object that is not seen may still be there: then silence on this topic has to end the drive,
as silence of the navigation system does, and an object has to be kept by whoever tracks it.
"""

from dataclasses import dataclass, replace

import numpy as np

from controller.planning.obstacles import Obstacle
from controller.problem import Array
from gateway.telemetry import ObjectsSample, WorldObject

MAX_AGE_NS = 500_000_000
"""Age from which a report counts no more [ns]; it comes 25 times a second."""
MOST_OBJECTS = 32
"""Objects that the planner is given at most: the nearest."""
FARTHEST_M = 1000.0
"""Distance from which an object is none of the car's business [m]; the planner's own detection range is shorter."""


@dataclass(frozen=True)
class ObjectReport:
    """What one sample told.

    Args:
        t_ns: time for which it is true [ns].
        objects: the usable ones, names once each.
        positions_m: their places, shape (n, 2).
        rejected: how many were none.
    """

    t_ns: int
    objects: tuple[Obstacle, ...]
    positions_m: Array
    rejected: int


def report_of(sample: ObjectsSample) -> ObjectReport:
    """The usable objects of a sample."""
    usable = {thing.name: thing for thing in map(_obstacle, sample.objects) if thing.is_usable}
    positions_m = np.array([(thing.x_m, thing.y_m) for thing in usable.values()]).reshape(-1, 2)
    return ObjectReport(sample.t_ns, tuple(usable.values()), positions_m, len(sample.objects) - len(usable))


def nearest(report: ObjectReport | None, now_ns: int, x_m: float, y_m: float) -> tuple[Obstacle, ...]:
    """The objects nearest to the car, where they are now if they drive on as they did; none when the report is too old."""
    if report is None or abs(now_ns - report.t_ns) > MAX_AGE_NS:  # a time far ahead is no better than one long past
        return ()
    distance_m = np.hypot(*(report.positions_m - (x_m, y_m)).T)
    order = np.argsort(distance_m, kind="stable")[:MOST_OBJECTS]
    elapsed_s = (now_ns - report.t_ns) * 1e-9
    return tuple(_moved(report.objects[k], elapsed_s) for k in order[distance_m[order] <= FARTHEST_M].tolist())


def _obstacle(thing: WorldObject) -> Obstacle:
    return Obstacle(thing.name, thing.x_m, thing.y_m, thing.yaw_rad, thing.length_m, thing.width_m, thing.vx_mps, thing.vy_mps)


def _moved(thing: Obstacle, elapsed_s: float) -> Obstacle:
    if thing.vx_mps == thing.vy_mps == 0.0:
        return thing
    return replace(thing, x_m=thing.x_m + thing.vx_mps * elapsed_s, y_m=thing.y_m + thing.vy_mps * elapsed_s)
