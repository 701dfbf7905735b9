"""Localiser and planner: forward only, on the right branch, moving from rest, standing at the end."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.ocp import stage_function
from controller.planning.planner import Localiser, Planner, PlannerOptions, lateral_offset, steady_sideslip
from controller.planning.reference import ReferencePath
from controller.planning.reference_sources import reference_from_curvature
from controller.problem import OcpOptions
from dbc.vehicle import load_vehicle

CAR = load_vehicle().model
SPACING_M = 0.5


def path_of(x_m, y_m, speed_mps=10.0, left_m=2.0, right_m=1.5):
    n = len(x_m)
    yaw = np.unwrap(np.arctan2(np.gradient(y_m), np.gradient(x_m)))
    return ReferencePath(x_m, y_m, yaw, np.broadcast_to(speed_mps, n), np.full(n, left_m), np.full(n, right_m))


def bends():
    x_m = np.arange(0.0, 200.0, SPACING_M)
    return path_of(x_m, 8.0 * np.sin(x_m / 20.0))


def figure_of_eight():
    """Crosses itself at the origin, at half of its length of 136 m, at right angles."""
    t = np.linspace(np.pi / 2, 2.5 * np.pi, 400)[:-4] - 0.05
    return path_of(20.0 * np.cos(t), 20.0 * np.sin(2 * t) / 2)


def straight(speed_mps, length_m=100.0):
    x_m = np.arange(0.0, length_m + 1e-9, SPACING_M)
    return path_of(x_m, np.zeros(x_m.size), speed_mps(x_m) if callable(speed_mps) else speed_mps)


def planner_on(path, **options):
    return Planner(path, CAR, OcpOptions(), PlannerOptions(**options))


@given(st.integers(0, 399), st.floats(-2.0, 2.0), st.floats(0.0, 1.0))
def test_the_first_search_agrees_with_brute_force(row, offset_m, share):
    path = bends()
    row = min(row, path.x_m.size - 2)
    x = path.x_m[row] + share * (path.x_m[row + 1] - path.x_m[row]) - offset_m * np.sin(path.yaw_rad[row])
    y = path.y_m[row] + share * (path.y_m[row + 1] - path.y_m[row]) + offset_m * np.cos(path.yaw_rad[row])
    found = Localiser(path).locate(x, y, float(path.yaw_rad[row]), 0.0)
    brute = path.arc_length_m[np.argmin((path.x_m - x) ** 2 + (path.y_m - y) ** 2)]
    assert abs(found - brute) <= np.max(np.diff(path.arc_length_m))


@given(st.lists(st.tuples(st.floats(-3.0, 6.0), st.floats(-3.0, 3.0)), min_size=1, max_size=40))
def test_the_closest_point_never_goes_back_and_never_jumps(moves):
    path = bends()
    localiser = Localiser(path)
    x, y, last = 1.0, 0.0, None
    for along, across in moves:
        x, y = x + along, y + across
        found = localiser.locate(x, y, 0.3, reach_m=5.0)
        if last is not None:
            assert last <= found <= last + 5.0
        last = found


@given(st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), min_size=30, max_size=30))
def test_a_path_that_crosses_itself_is_followed_on_its_branch(noise):
    path = figure_of_eight()
    localiser = Localiser(path)
    arc = path.arc_length_m
    for row, (dx, dy) in zip(range(0, 390, 13), noise, strict=True):
        found = localiser.locate(path.x_m[row] + dx, path.y_m[row] + dy, float(path.yaw_rad[row]), reach_m=6.0)
        assert abs(found - arc[row]) < 1.0


def test_at_the_crossing_the_heading_decides_where_a_lost_car_is():
    path = figure_of_eight()
    near = np.flatnonzero(np.hypot(path.x_m, path.y_m) < 0.5)
    first, second = near[near < 100], near[near > 100]
    assert len(first)
    assert len(second)
    for branch in (first, second):
        row = branch[len(branch) // 2]
        assert Localiser(path).locate(path.x_m[row], path.y_m[row], float(path.yaw_rad[row]), 0.0) == pytest.approx(
            path.arc_length_m[row], abs=1.5
        )


def test_on_the_way_back_along_the_same_line_the_heading_decides():
    out = np.arange(0.0, 50.0, 0.5)
    turn = np.linspace(-np.pi / 2, np.pi / 2, 20)[1:-1]
    x = np.concatenate((out, 50.0 + np.cos(turn), out[::-1]))
    y = np.concatenate((np.full(out.size, -1.0), np.sin(turn), np.full(out.size, 1.0)))
    path = path_of(x, y)
    assert Localiser(path).locate(20.0, 0.9, 0.0, 0.0) == pytest.approx(20.0, abs=0.5)
    assert Localiser(path).locate(20.0, -0.9, np.pi, 0.0) > 60.0


def hairpins():
    """Four straights of 40 m side by side, 4 m apart, and the half circles between them."""
    s_m, curvature = [0.0], [0.0]
    for k in range(3):
        turn = 0.5 if k % 2 == 0 else -0.5
        for length, bend in ((40.0, 0.0), (0.01, turn), (2.0 * np.pi - 0.01, turn), (0.01, 0.0)):
            s_m.append(s_m[-1] + length)
            curvature.append(bend)
    s_m.append(s_m[-1] + 40.0)
    curvature.append(0.0)
    return reference_from_curvature(s_m, curvature, np.full(len(s_m), 5.0), 1.5)


@pytest.mark.parametrize("path", [bends(), figure_of_eight(), hairpins()], ids=["bends", "figure of eight", "hairpins"])
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.5, 12.0), st.floats(0.0, 0.5), st.floats(-0.8, 0.8))
def test_the_closest_point_follows_the_car_along_any_path(path, seed, speed_mps, noise_m, beside_m):
    """It stays on its branch, with noise and off the path, while the car drives all of it and at times rolls back a little."""
    rng, localiser, arc = np.random.default_rng(seed), Localiser(path), path.arc_length_m
    at, last = 0.0, 0.0
    while at < arc[-1] - 1.0:
        x, y, yaw = (np.interp(at, arc, values) for values in (path.x_m, path.y_m, path.yaw_rad))
        off_x, off_y = noise_m * rng.uniform(-1.0, 1.0, 2)
        reach_m = speed_mps * 0.2 + 2.0
        found = localiser.locate(x - beside_m * np.sin(yaw) + off_x, y + beside_m * np.cos(yaw) + off_y, float(yaw), reach_m)
        assert last <= found <= last + reach_m + at * (last == 0.0)
        assert abs(found - at) < 0.2 + 2.5 * noise_m + 0.5 * abs(beside_m)
        last = found
        at = max(at + speed_mps * 0.2 * (1.0 if rng.random() > 0.1 else -0.03), 0.0)


def test_a_car_that_rolls_back_keeps_its_place():
    localiser = Localiser(straight(5.0))
    assert [localiser.locate(x, 0.0, 0.0, 2.0) for x in (20.0, 20.5, 20.2, 19.9, 20.6)] == pytest.approx([20.0, 20.5, 20.5, 20.5, 20.6])


def test_after_a_reset_the_whole_path_is_searched():
    path = bends()
    localiser = Localiser(path)
    localiser.locate(150.0, float(path.y_m[300]), 0.0, 0.0)
    assert localiser.locate(0.0, 0.0, 0.4, 10.0) > 100.0
    localiser.reset()
    assert localiser.locate(0.0, 0.0, 0.4, 10.0) < 1.0


def test_the_slice_runs_along_the_path_at_its_speed():
    planner = planner_on(straight(10.0))
    horizon = planner.horizon(np.array((10.0, 0, 0, 20.2, 0.4, 0.0)), 0.0)
    np.testing.assert_allclose(horizon.reference[:, 3], 20.2 + 0.4 * np.arange(31))
    np.testing.assert_allclose(horizon.reference[:, 0], 10.0)
    assert not horizon.reference[:, [1, 2, 4, 5]].any()
    np.testing.assert_array_equal(horizon.left_m, 2.0)
    np.testing.assert_array_equal(horizon.right_m, 1.5)
    assert lateral_offset(np.array((10.0, 0, 0, 20.2, 0.4, 0.0)), horizon) == pytest.approx(0.4)


def test_from_standstill_the_reference_moves():
    profile = straight(lambda x: np.sqrt(2.0 * 1.0 * x))
    reference = planner_on(profile).horizon(np.zeros(6), 0.0).reference
    assert reference[0, 0] > 0.0
    assert (np.diff(reference[:, 3]) > 0.0).all()
    assert reference[-1, 3] > 0.5


@pytest.mark.parametrize("final_speed", [0.0, 10.0])
def test_at_the_end_of_the_path_the_reference_stands(final_speed):
    path = straight(lambda x: np.where(x < 90.0, 10.0, final_speed))
    reference = planner_on(path).horizon(np.array((0.0, 0, 0, 100.0, 0.0, 0.0)), 0.0).reference
    np.testing.assert_allclose(reference[:, 3], 100.0)
    np.testing.assert_array_equal(reference[1:, 0], 0.0)


def test_a_path_that_goes_on_beyond_the_stop_is_not_crawled_along():
    path = straight(lambda x: np.where(x < 60.0, 5.0, 0.0))
    reference = planner_on(path).horizon(np.array((0.0, 0, 0, 61.0, 0.0, 0.0)), 0.0).reference
    np.testing.assert_allclose(reference[:, 3], 61.0)


def test_a_profile_that_stops_is_followed_to_its_last_metre():
    path = straight(lambda x: np.sqrt(2.0 * 2.0 * np.maximum(100.0 - x, 0.0)))
    planner, x = planner_on(path), 80.0
    for _ in range(600):
        speed = planner.horizon(np.array((0.0, 0, 0, x, 0.0, 0.0)), 0.04).reference[0, 0]
        x += 0.04 * speed
    assert x == pytest.approx(100.0, abs=0.02)


def test_a_car_that_arrives_too_fast_is_given_room_to_brake():
    reference = planner_on(straight(10.0)).horizon(np.array((10.0, 0, 0, 99.0, 0.0, 0.0)), 0.0).reference
    assert (np.diff(reference[:, 0]) <= 1e-9).all()
    assert reference[-1, 0] == pytest.approx(10.0 - 1.0 - 2.0 * 1.2)  # the margin, and 2 m/s2
    np.testing.assert_allclose(np.diff(reference[:, 3]), 0.04 * reference[:-1, 0])


@given(st.floats(0.0, 30.0))
def test_the_reference_speed_stays_within_reach_of_the_car(v_x):
    reference = planner_on(straight(20.0)).horizon(np.array((v_x, 0, 0, 5.0, 0.0, 0.0)), 0.0).reference
    within = 1.0 + 2.0 * 0.04 * np.arange(31)
    assert (np.abs(reference[:, 0] - v_x) <= within + 1e-9).all()
    if abs(v_x - 20.0) <= 1.0:
        np.testing.assert_array_equal(reference[:, 0], 20.0)


@pytest.mark.parametrize("turns", [-2, 0, 1])
def test_headings_are_next_to_the_cars(turns):
    path = bends()
    state = np.array((10.0, 0, 0, path.x_m[100], path.y_m[100], path.yaw_rad[100] + 2 * np.pi * turns))
    reference = planner_on(path).horizon(state, 0.0).reference
    assert abs(reference[0, 5] - state[5]) < 0.3


@pytest.mark.parametrize("offset", [2.5, -2.5])
def test_the_corridor_holds_a_car_that_is_outside(offset):
    horizon = planner_on(straight(10.0)).horizon(np.array((10.0, 0, 0, 20.0, offset, 0.0)), 0.0)
    assert -horizon.right_m.min() < offset < horizon.left_m.min()
    assert (horizon.left_m[0], horizon.right_m[0]) == ((2.8, 1.5) if offset > 0 else (2.0, 2.8))


@pytest.mark.parametrize(("speed_mps", "radius_m"), [(2.78, 10.0), (16.7, 120.0), (22.2, -150.0)])
def test_the_heading_reference_is_that_of_a_steady_turn(speed_mps, radius_m):
    """Held in a steady turn, the model's own sideslip is the one that the planner expects."""
    stage, x = stage_function(CAR, OcpOptions()), np.array((speed_mps, 0.0, speed_mps / radius_m, 0.0, 0.0, 0.0))
    length = CAR.cog_to_front_m + CAR.cog_to_rear_m
    front, rear = CAR.front_cornering_stiffness_nprad, CAR.rear_cornering_stiffness_nprad
    understeer = CAR.mass_kg / length * (CAR.cog_to_rear_m / front - CAR.cog_to_front_m / rear)
    delta = (length + understeer * speed_mps**2) / radius_m
    for _ in range(60):
        x = np.array(stage(x, (delta, 0.0))).ravel()
        x[0] = speed_mps
    expected = steady_sideslip(np.array(1.0 / radius_m), np.array(speed_mps), CAR)
    assert np.arctan2(x[1], x[0]) == pytest.approx(float(expected), abs=0.004)
