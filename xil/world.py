"""The objects of a scenario along a run: which of them are there, and where. Pure: time and the car's place are arguments."""

import math

import numpy as np

from dbc.vehicle import Vehicle
from gateway.telemetry import ObjectsSample
from xil.course import Pose
from xil.motion import Car, Mover
from xil.scenario import Scenario

_NS_PER_S = 1e9


class World:
    """What stands, drives and walks on the road besides the car.

    Args:
        start_ns: time zero of the run [ns].
    """

    def __init__(self, scenario: Scenario, vehicle: Vehicle, start_ns: int) -> None:
        self._course = scenario.course(vehicle)
        self._waiting = list(scenario.objects)
        self._there: list[Mover] = []
        self._start_ns = start_ns
        self._reached_m = -math.inf

    def sample(self, now_ns: int, seq: int, car: Pose) -> ObjectsSample:
        """The objects that are there; times have to rise from call to call."""
        if not (self._waiting or self._there):
            return ObjectsSample(t_ns=now_ns, seq=seq, objects=[])
        t_s = (now_ns - self._start_ns) / _NS_PER_S
        station_m = float(self._course.project(np.array([car.x_m]), np.array([car.y_m])).station_m[0])
        self._reached_m = max(self._reached_m, station_m)
        due = [spec for spec in self._waiting if spec.is_due(t_s, self._reached_m)]
        self._waiting = [spec for spec in self._waiting if spec not in due]
        self._there += [Mover(spec, self._course, t_s) for spec in due]
        self._there = [thing for thing in self._there if not thing.is_gone(t_s, self._reached_m)]
        seen = Car(station_m + self._course.outline.front_m, self._reached_m, car.speed_mps)
        return ObjectsSample(t_ns=now_ns, seq=seq, objects=[thing.at(t_s, seen) for thing in self._there])
