"""Closed loop around objects: planner, solver and a car that is not the model."""

import math
from dataclasses import replace

import numpy as np
import pytest

from controller.bench.loop import BenchCar
from controller.nmpc import Nmpc
from controller.planning.obstacles import Obstacle
from controller.planning.reference_sources import reference_from_curvature
from controller.problem import OcpOptions
from controller.solvers import make_solver
from gateway.messages import PLAN_PERIOD_NS, CommandStatus, Mode, VehicleState
from xil.course import Outline, separation_m

CAR = Obstacle("car", 90.0, 0.0, 0.0, 4.4, 1.8)


@pytest.fixture(scope="module")
def solver(vehicle):
    return make_solver("riccati", vehicle.model, OcpOptions(), print)


def road(speed_mps, left_m, right_m):
    path = reference_from_curvature([0.0, 250.0], [0.0, 0.0], [speed_mps] * 2, 1.0)
    return replace(path, left_m=np.full(path.x_m.size, left_m), right_m=np.full(path.x_m.size, right_m))


def drive(solver, vehicle, path, thing, duration_s):
    """States of the car, the smallest distance to the object, and the statuses of the commands."""
    solver.reset()
    nmpc, outline = Nmpc(solver, path, vehicle, 1), Outline.of(vehicle)
    box = Outline(thing.length_m / 2, thing.length_m / 2, thing.width_m / 2)
    car = BenchCar(vehicle, np.array((float(path.speed_mps[0]), 0, 0, 0, 0, 0)))
    states, boxes, statuses, steer_rad, drive_norm = [], [], [], 0.0, 0.0
    for cycle in range(round(duration_s * 1e9) // PLAN_PERIOD_NS):
        for _ in range(40 if cycle else 0):
            car.step(steer_rad, drive_norm)
        t_s, z = cycle * PLAN_PERIOD_NS * 1e-9, car.state
        now = replace(thing, x_m=thing.x_m + t_s * thing.vx_mps)
        state = VehicleState(
            boot_id=1, seq=4 * cycle, t_ns=cycle * PLAN_PERIOD_NS, mode=Mode.ENGAGED if cycle else Mode.READY, is_valid=True, x_m=z[3],
            y_m=z[4], yaw_rad=math.remainder(z[5], 2.0 * math.pi), vx_mps=z[0], vy_mps=z[1], yaw_rate_radps=z[2], ax_mps2=0.0,
            steer_rad=z[6], drive_norm=z[8],
        )  # fmt: skip
        command = nmpc.step(state, cycle * PLAN_PERIOD_NS, [now]).command
        steer_rad, drive_norm = command.steer_rad, command.drive_norm
        states.append(z.copy())
        boxes.append((now.x_m, now.y_m, now.yaw_rad))
        statuses.append(command.status)
    driven = np.array(states)
    clearance_m = separation_m(outline.corners_m(*driven[:, 3:6].T), box.corners_m(*np.array(boxes).T))
    return driven, float(clearance_m.min()), statuses


def test_a_slower_car_that_cuts_in_is_passed(solver, vehicle):
    driven, clearance_m, statuses = drive(solver, vehicle, road(16.67, 4.3, 0.8), replace(CAR, x_m=45.0, vx_mps=5.5), 9.0)
    assert clearance_m > 0.4
    assert set(statuses) == {CommandStatus.OK}
    assert driven[-1, 0] == pytest.approx(16.67, abs=0.1)
    assert driven[-1, 3] > 45.0 + 9.0 * 5.5 + 10.0


def test_a_pedestrian_on_a_car_park_is_passed(solver, vehicle):
    driven, clearance_m, _ = drive(solver, vehicle, road(2.78, 2.5, 2.5), Obstacle("pedestrian", 18.0, -0.3, 0.0, 0.5, 0.6), 12.0)
    assert clearance_m > 0.4
    assert driven[-1, 3] > 30.0


def test_before_a_wall_the_car_stops(solver, vehicle):
    driven, clearance_m, statuses = drive(solver, vehicle, road(16.67, 0.8, 0.8), replace(CAR, width_m=8.0), 13.0)
    assert clearance_m == pytest.approx(2.0, abs=0.3)
    assert abs(driven[-1, 0]) < 0.05
    assert np.abs(driven[:, 4]).max() < 0.1
    assert set(statuses) == {CommandStatus.OK}
