"""Paths from the log of a drive and from a profile of curvature."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.planning.reference import ReferencePathError
from controller.planning.reference_sources import reference_from_curvature, reference_from_log

TURN = ([0.0, 20.0, 30.0, 46.0, 56.0, 80.0], [0.0, 0.0, 0.1, 0.1, 0.0, 0.0])


def turn():
    return reference_from_curvature(*TURN, np.full(6, 3.0), 1.0)


def logged(path, noise_m=0.02, seed=0):
    """A drive along a path that starts from rest, stands in between and at the end."""
    way = np.linspace(0.0, 1.0, 600) ** 1.5 * path.arc_length_m[-1]
    way = np.concatenate((way[:300], np.full(80, way[300]), way[300:], np.full(120, way[-1])))
    rng = np.random.default_rng(seed)
    return tuple(np.interp(way, path.arc_length_m, values) + noise_m * rng.standard_normal(way.size) for values in (path.x_m, path.y_m))


def test_an_arc_ends_where_geometry_says():
    path = reference_from_curvature([0.0, 5.0 * np.pi], [0.1, 0.1], [3.0, 3.0], 1.0, start=(1.0, 2.0, np.pi / 2))
    assert (path.x_m[-1], path.y_m[-1], path.yaw_rad[-1]) == pytest.approx((-9.0, 12.0, np.pi), abs=1e-5)


def test_a_clothoid_turns_by_the_integral_of_its_curvature_and_ends_at_the_fresnel_integrals():
    path = reference_from_curvature([0.0, 40.0], [0.0, 0.05], [5.0, 5.0], 1.0)
    assert path.yaw_rad[-1] == pytest.approx(1.0)
    fine = (np.arange(400_000) + 0.5) * 1e-4
    assert path.x_m[-1] == pytest.approx(np.sum(np.cos(0.05 / 80.0 * fine**2)) * 1e-4, abs=1e-4)
    assert path.y_m[-1] == pytest.approx(np.sum(np.sin(0.05 / 80.0 * fine**2)) * 1e-4, abs=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_a_noisy_log_gives_back_the_path_with_a_smooth_curvature(seed):
    path = turn()
    found = reference_from_log(*logged(path, seed=seed), np.full(800, 2.0), 1.5)
    closest = [float(np.hypot(path.x_m - x, path.y_m - y).min()) for x, y in zip(found.x_m, found.y_m, strict=True)]
    assert max(closest) < 0.13  # half of the spacing, and the noise
    assert found.arc_length_m[-1] == pytest.approx(80.0, abs=0.7)
    curvature = np.gradient(found.yaw_rad, found.arc_length_m)
    assert np.abs(curvature - np.interp(found.arc_length_m, *TURN)).max() < 0.04
    assert np.abs(np.diff(curvature)).max() < 0.01
    assert (found.left_m == 1.5).all()


def test_the_speed_of_the_log_is_kept_along_the_way():
    x = np.linspace(0.0, 100.0, 500)
    path = reference_from_log(x, 0.0 * x, 5.0 + 0.05 * x, 1.0)
    np.testing.assert_allclose(path.speed_mps, 5.0 + 0.05 * path.x_m, atol=0.05)
    np.testing.assert_allclose(path.yaw_rad, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda x, y, v: y.__setitem__(7, np.nan), "row 8, column y_m = nan: must be finite"),
        (lambda x, y, v: v.__setitem__(3, -2.0), "row 4, column speed_mps = -2: allowed: 0 to 100"),
        (lambda x, y, v: x.__setitem__(slice(50, None), x[50:] + 500.0), r"row 51, column x_m = 550: 501\.0 m from the row before"),
        (lambda x, y, v: x.__setitem__(slice(None), 3.0), "100 rows: the car gets on by less than"),
    ],
)
def test_a_bad_log_is_refused_with_its_row(change, named):
    columns = np.arange(100.0), np.zeros(100), np.full(100, 5.0)
    change(*columns)
    with pytest.raises(ReferencePathError, match=named) as caught:
        reference_from_log(*columns, 1.0)
    assert "\n" not in str(caught.value)


def test_columns_and_numbers_that_do_not_fit_are_refused():
    with pytest.raises(ReferencePathError, match=r"column y_m: shape \(2,\), expected \(3,\) as x_m"):
        reference_from_log(np.zeros(3), np.zeros(2), np.zeros(3), 1.0)
    with pytest.raises(ReferencePathError, match=r"half_width_m = nan: allowed: 0\.01 to 50"):
        reference_from_log(np.arange(9.0), np.zeros(9), np.ones(9), float("nan"))
    with pytest.raises(ReferencePathError, match="row 3, column station_m = 1: must be greater than the row before"):
        reference_from_curvature([0.0, 1.0, 1.0], [0.0] * 3, [1.0] * 3, 1.0)
    with pytest.raises(ReferencePathError, match="1 rows; a path needs at least 2"):
        reference_from_curvature([0.0], [0.0], [1.0], 1.0)
