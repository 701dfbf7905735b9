"""Geometry of a course: passing a gate with the outline of the car, and where a point lies along the reference."""

import numpy as np
import pytest

from dbc.vehicle import load_vehicle
from gateway.telemetry import Lane
from xil.course import Outline, passage
from xil.scenario import load_scenario

# Four metres long, two wide, centre of gravity in the middle: numbers to reckon with by hand.
BOX = Outline(front_m=2.0, rear_m=2.0, half_width_m=1.0)
LANE = Lane(name="gate", start_m=10.0, end_m=20.0, right_m=-1.5, left_m=1.5)


def drive_straight(y_m: float, yaw_rad: float = 0.0, from_m: float = 0.0, to_m: float = 30.0):
    x_m = np.arange(from_m, to_m, 0.2)
    return passage(LANE, BOX, x_m, np.full_like(x_m, y_m), np.full_like(x_m, yaw_rad))


def test_straight_through_the_middle_leaves_half_a_metre():
    assert drive_straight(0.0).clearance_m == pytest.approx(0.5)


def test_offset_to_the_left_is_measured_at_the_left():
    way = drive_straight(0.2)
    assert way.clearance_m == pytest.approx(0.3)
    assert way.contact_y_m == pytest.approx(1.2)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_millimetre_decides(side):
    assert drive_straight(side * 0.499).clearance_m == pytest.approx(0.001)
    assert drive_straight(side * 0.501).clearance_m == pytest.approx(-0.001)


def test_yawed_car_within_the_gate_is_as_wide_as_its_corners():
    yaw_rad = 0.1
    # The front left corner is highest: 2 sin + 1 cos above the centre.
    assert drive_straight(0.0, yaw_rad).clearance_m == pytest.approx(1.5 - 2.0 * np.sin(0.1) - np.cos(0.1))


def test_part_outside_the_gate_does_not_count():
    # Yawed by 30 degrees at x = 8, the front left corner is at 9.23, the front right corner, at x = 10.23, alone is in the gate.
    yaw_rad = np.radians(30.0)
    way = passage(LANE, BOX, np.array([8.0]), np.array([0.0]), np.array([yaw_rad]))
    # The front edge crosses x = 10 a little to the left of that corner; both are far from the left limit, the edge is closer to it.
    front_right = np.array([8.0 + 2.0 * np.cos(yaw_rad) + np.sin(yaw_rad), 2.0 * np.sin(yaw_rad) - np.cos(yaw_rad)])
    crossing_y_m = front_right[1] + (front_right[0] - 10.0) / np.tan(yaw_rad)
    assert front_right[0] == pytest.approx(10.232, abs=1e-3)
    assert way.clearance_m == pytest.approx(min(1.5 - crossing_y_m, front_right[1] + 1.5))


def test_side_between_two_corners_touches_the_end_of_a_gate():
    # At x = 20, with the front out and the rear in, the left side crosses the end of the gate: no corner is there.
    yaw_rad = np.radians(20.0)
    way = passage(LANE, BOX, np.array([19.5]), np.array([0.3]), np.array([yaw_rad]))
    crossing_y_m = 0.3 + np.tan(yaw_rad) * 0.5 + 1.0 / np.cos(yaw_rad)
    assert way.clearance_m == pytest.approx(1.5 - crossing_y_m)
    assert (way.contact_x_m, way.contact_y_m) == pytest.approx((20.0, crossing_y_m))


def test_cone_struck_between_two_poses_is_found():
    # The car slides sideways out of the gate's line while its tail leaves: the poses on either side of it are clear.
    poses = np.array([[18.0, 0.0], [22.4, 2.2]])
    way = passage(LANE, BOX, poses[:, 0], poses[:, 1], np.zeros(2))
    assert passage(LANE, BOX, *poses[:1].T, np.zeros(1)).clearance_m == pytest.approx(0.5)
    assert passage(LANE, BOX, *poses[1:].T, np.zeros(1)) is None
    # The tail leaves at x = 22 of the centre, where y is 2.0.
    assert way.clearance_m == pytest.approx(1.5 - 3.0, abs=0.03)


def test_gate_that_was_not_reached_has_no_clearance():
    assert drive_straight(0.0, to_m=7.0) is None
    assert drive_straight(0.0, from_m=23.0) is None


def test_driving_past_a_gate_is_touching_it():
    assert drive_straight(5.0).clearance_m == pytest.approx(1.5 - 6.0)


def test_outline_of_the_car_has_its_length_and_width():
    corners = Outline.of(load_vehicle()).corners_m(np.array([10.0]), np.array([5.0]), np.array([np.pi / 2.0]))[0]
    # Heading along y: the length lies along y, the left side towards smaller x.
    assert np.ptp(corners[:, 1]) == pytest.approx(4.358)
    assert np.ptp(corners[:, 0]) == pytest.approx(1.823)
    assert corners[0] == pytest.approx([10.0 - 1.823 / 2.0, 5.0 + 1.13 + 0.88])


@pytest.fixture(scope="module")
def course():
    return load_scenario("lane-keeping").course(load_vehicle())


def test_projection_finds_the_distance_along_the_normal(course):
    path, rows = course.reference, np.array([50, 700, 1500, 2400])
    for left_m in (-0.7, 0.0, 0.7):
        x_m = path.x_m[rows] - left_m * np.sin(path.yaw_rad[rows])
        y_m = path.y_m[rows] + left_m * np.cos(path.yaw_rad[rows])
        along = course.project(x_m, y_m)
        assert along.lateral_error_m == pytest.approx(np.full(4, left_m), abs=1e-4)
        assert along.station_m == pytest.approx(course.station_m[rows], abs=1e-3)
        assert along.yaw_rad == pytest.approx(path.yaw_rad[rows], abs=1e-4)


def test_projection_is_exact_between_samples(course):
    along = course.project(np.array([50.07, 50.13]), np.array([0.25, -0.25]))
    assert along.station_m == pytest.approx([50.07, 50.13])
    assert along.lateral_error_m == pytest.approx([0.25, -0.25])


def test_projection_ends_with_the_path(course):
    along = course.project(np.array([-5.0]), np.array([0.1]))
    assert along.station_m == pytest.approx([0.0])
