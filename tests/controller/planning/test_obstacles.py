"""Objects along the path: where they are, where they will be, and which are none."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.planning.obstacles import Obstacle, PathFrame, Smoother, usable
from controller.planning.reference import ReferencePath
from controller.planning.reference_sources import reference_from_curvature

INSTANTS_S = np.linspace(0.0, 4.0, 17)
CAR = Obstacle("car", 0.0, 0.0, 0.0, 4.4, 1.8)


def bend(radius_m, length_m=120.0):
    return reference_from_curvature([0.0, length_m], [1.0 / radius_m] * 2, [10.0, 10.0], 2.0)


def beside(path, station_m, offset_m):
    x, y, yaw = (float(np.interp(station_m, path.arc_length_m, values)) for values in (path.x_m, path.y_m, path.yaw_rad))
    return x - offset_m * math.sin(yaw), y + offset_m * math.cos(yaw), yaw


@given(st.floats(2.0, 118.0), st.floats(-3.0, 3.0), st.sampled_from([12.0, -30.0, 1e6]))
def test_an_object_is_found_beside_the_path(station_m, offset_m, radius_m):
    path = bend(radius_m, 120.0 if radius_m > 1e3 else 30.0)
    station_m = min(station_m, path.arc_length_m[-1] - 1.5)
    x, y, yaw = beside(path, station_m, offset_m)
    (track,) = PathFrame(path).tracks([replace(CAR, x_m=x, y_m=y, yaw_rad=yaw)], INSTANTS_S, 0.0, 120.0, 1.0)
    np.testing.assert_allclose(track.station_m, station_m, atol=0.12)
    np.testing.assert_allclose(track.offset_m, offset_m, atol=0.05)
    assert track.half_along_m[0] == pytest.approx(2.2, abs=0.05)
    assert track.half_across_m[0] == pytest.approx(0.9 + 0.5 * 2.2**2 / abs(radius_m), abs=0.1)


def test_an_object_drives_on_at_its_velocity():
    path = bend(1e6)
    (track,) = PathFrame(path).tracks([replace(CAR, x_m=20.0, y_m=-1.0, vx_mps=5.0, vy_mps=0.5)], INSTANTS_S, 0.0, 120.0, 1.0)
    np.testing.assert_allclose(track.station_m, 20.0 + 5.0 * INSTANTS_S, atol=0.01)
    np.testing.assert_allclose(track.offset_m, -1.0 + 0.5 * INSTANTS_S, atol=0.01)


def test_a_turned_box_takes_its_length_across():
    (track,) = PathFrame(bend(1e6)).tracks([replace(CAR, x_m=20.0, yaw_rad=math.pi / 2)], INSTANTS_S, 0.0, 120.0, 1.0)
    assert (track.half_along_m[0], track.half_across_m[0]) == pytest.approx((0.9, 2.2), abs=1e-3)


def test_where_the_path_crosses_itself_an_object_is_on_the_branch_that_comes_first():
    t = np.linspace(np.pi / 2, 2.5 * np.pi, 800)[:-8] - 0.05
    x, y = 20.0 * np.cos(t), 10.0 * np.sin(2 * t)
    n = t.size
    path = ReferencePath(x, y, np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))), np.full(n, 5.0), np.full(n, 1.0), np.full(n, 1.0))
    away = np.hypot(x, y)
    first, second = (float(path.arc_length_m[k]) for k in (int(np.argmin(away[:200])), 300 + int(np.argmin(away[300:500]))))
    box = Obstacle("box", 0.0, 0.0, 0.0, 0.5, 0.5)
    frame = PathFrame(path)
    assert frame.tracks([box], INSTANTS_S, 0.0, 130.0, 1.0)[0].station_m[0] == pytest.approx(first, abs=0.5)
    assert frame.tracks([box], INSTANTS_S, first + 10.0, 130.0, 1.0)[0].station_m[0] == pytest.approx(second, abs=0.5)


@pytest.mark.parametrize("field", ["x_m", "y_m", "yaw_rad", "length_m", "width_m", "vx_mps", "vy_mps"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e9])
def test_a_number_that_makes_no_sense_makes_no_object(field, value):
    if field != "yaw_rad" or not math.isfinite(value):
        assert usable([CAR, replace(CAR, **{field: value})]) == [CAR]


def test_an_object_without_extent_is_none():
    assert usable([replace(CAR, width_m=0.0), replace(CAR, length_m=-1.0)]) == []


def test_objects_of_one_name_stay_apart():
    assert len({thing.name for thing in usable([CAR, CAR, replace(CAR, name="other")])}) == 3


def test_noise_shrinks_to_a_third_and_a_jump_is_believed_at_once():
    rng, smoother = np.random.default_rng(1), Smoother()
    true = 10.0 + 0.4 * np.arange(400)
    noisy = true + 0.1 * rng.standard_normal(400)
    seen = [smoother.smoothed([replace(CAR, x_m=x_m, vx_mps=10.0)], 0.04)[0].x_m for x_m in noisy.tolist()]
    assert np.std(np.array(seen)[50:] - true[50:]) < 0.045
    assert smoother.smoothed([replace(CAR, x_m=100.0)], 0.04)[0].x_m == 100.0
