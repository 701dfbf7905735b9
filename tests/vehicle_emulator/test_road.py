"""Roads: heights that are continuous with their slope, patches of other grip, and what their files may hold."""

import math
from itertools import pairwise

import pytest

from vehicle_emulator.plants.interface import Level
from vehicle_emulator.road import FrictionPatch, HeightPoint, Plane, Profile, RoadDescription, RoadError, Surface, load_road, make_road


def points(*pairs):
    return [HeightPoint(station_m=station_m, height_m=height_m) for station_m, height_m in pairs]


HILL = points((0.0, 0.0), (20.0, 0.0), (30.0, 0.5), (40.0, 1.5), (50.0, 2.5), (60.0, 3.0), (80.0, 1.0))
ICE = FrictionPatch(factor=0.1, from_m=10.0, to_m=30.0, right_m=-4.0, left_m=0.0)


def patched(*patches):
    return make_road(RoadDescription(friction=list(patches)))


def test_nothing_said_is_a_level_road():
    road = make_road(RoadDescription())
    assert isinstance(road, Level)
    assert road.at(17.0, -3.0) == (0.0, 0.0, 0.0, 1.0)


def test_a_plane_climbs_where_its_base_line_heads_and_falls_to_the_right_of_it():
    road = make_road(RoadDescription(x_m=5.0, y_m=-2.0, heading_rad=math.pi / 2, grade_percent=10.0, cross_fall_percent=2.0))
    assert isinstance(road, Plane)
    assert road.at(5.0, -2.0).z_m == pytest.approx(0.0)
    assert road.at(5.0, 8.0).z_m == pytest.approx(1.0)
    assert road.at(15.0, -2.0).z_m == pytest.approx(-0.2)
    assert road.at(0.0, 0.0)[1:] == pytest.approx((-0.02, 0.1, 1.0))


@pytest.mark.parametrize("heading_rad", [0.0, 0.7, -2.5])
def test_the_slopes_are_the_derivatives_of_the_height(heading_rad):
    place = {"x_m": 3.0, "y_m": 1.0, "heading_rad": heading_rad, "start_station_m": -7.0}
    road = make_road(RoadDescription(**place, grade_percent=4.0, cross_fall_percent=-3.0, heights=HILL))
    assert isinstance(road, Surface)
    step_m = 1e-4
    for k in range(-200, 1000):
        x_m, y_m = 3.0 + 0.1 * k * math.cos(heading_rad), 1.0 + 0.1 * k * math.sin(heading_rad)
        point = road.at(x_m, y_m)
        across = road.at(x_m + step_m, y_m).z_m - road.at(x_m - step_m, y_m).z_m
        along = road.at(x_m, y_m + step_m).z_m - road.at(x_m, y_m - step_m).z_m
        assert (point.slope_x, point.slope_y) == pytest.approx((across / (2 * step_m), along / (2 * step_m)), abs=1e-6)


def test_station_and_height_start_where_the_description_says():
    road = make_road(RoadDescription(x_m=-90.0, start_station_m=-90.0, grade_percent=5.0, heights=HILL))
    assert road.at(-90.0, 0.0).z_m == pytest.approx(0.0)
    assert road.at(40.0, 0.0).z_m == pytest.approx(0.05 * 130.0 + 1.5)


def test_a_profile_meets_its_points_and_is_smooth_up_to_its_curvature():
    profile = Profile(HILL)
    for point in HILL:
        assert profile.at(point.station_m)[0] == pytest.approx(point.height_m, abs=1e-12)
        sides = [profile.at(point.station_m + side_m) for side_m in (-1e-5, 1e-5)]
        assert sides[0][0] == pytest.approx(sides[1][0], abs=1e-5)
        assert (sides[1][1] - sides[0][1]) / 2e-5 == pytest.approx(0.0, abs=1e-3)


def test_between_points_on_one_slope_a_profile_is_a_plane():
    ramp = Profile(points((0.0, 0.0), (10.0, 0.5), (20.0, 1.5), (30.0, 2.5), (40.0, 3.5), (50.0, 4.0)))
    assert [ramp.at(station_m) for station_m in (20.0, 23.7, 30.0)] == [pytest.approx((h, 0.1), abs=1e-12) for h in (1.5, 1.87, 2.5)]


def test_a_profile_rises_between_a_lower_and_a_higher_point_and_nowhere_overshoots():
    profile = Profile(HILL)
    heights_m = [profile.at(0.05 * k)[0] for k in range(-100, 1800)]
    crest = max(range(len(heights_m)), key=heights_m.__getitem__)
    assert heights_m[crest] == pytest.approx(3.0, abs=1e-3)
    assert all(after >= before - 1e-12 for before, after in pairwise(heights_m[:crest]))
    assert heights_m[:500] == [0.0] * 500
    assert heights_m[-1] == 1.0


def test_a_patch_has_its_grip_inside_and_smooth_edges():
    road = patched(ICE)
    assert [road.at(x_m, -2.0).friction for x_m in (9.89, 10.11, 20.0, 30.11)] == [1.0, 0.1, 0.1, 1.0]
    assert road.at(10.0, -2.0).friction == pytest.approx(0.55)
    edge = [road.at(20.0, -0.1 + 0.002 * k).friction for k in range(101)]
    assert edge == sorted(edge)
    assert max(after - before for before, after in pairwise(edge)) < 0.015


def test_mu_split_has_one_grip_on_either_side_of_the_base_line():
    road = make_road(RoadDescription(heading_rad=math.pi / 2, friction=[FrictionPatch(factor=0.3, left_m=0.0)]))
    assert road.at(0.8, 50.0).friction == 0.3
    assert road.at(-0.8, 50.0).friction == 1.0


def test_where_patches_overlap_the_later_one_counts():
    wet = FrictionPatch(factor=0.7)
    assert patched(wet, ICE).at(20.0, -2.0).friction == 0.1
    assert patched(wet, ICE).at(20.0, 2.0).friction == 0.7
    assert patched(ICE, wet).at(20.0, -2.0).friction == 0.7


def test_a_description_is_the_same_after_a_file(tmp_path):
    description = RoadDescription(x_m=-90.0, start_station_m=-90.0, heading_rad=0.1, grade_percent=5.0, heights=HILL, friction=[ICE])
    path = tmp_path / "road.toml"
    path.write_text(description.to_toml(), encoding="utf-8")
    assert load_road(path) == description
    path.write_text(RoadDescription().to_toml(), encoding="utf-8")
    assert load_road(path) == RoadDescription()


HEIGHTS = "[[heights]]\nstation_m = 0.0\nheight_m = 0.0\n[[heights]]\nstation_m = {}\nheight_m = {}\n"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("grade_percent = 30.0", "grade_percent = 30.0: allowed: -20 to 20"),
        ("grade_percent = nan", "grade_percent = nan"),
        ("grade = 3.0", "grade: unknown key"),
        ("[[friction]]\nfrom_m = 1.0", "friction.0.factor: missing"),
        ("[[friction]]\nfactor = 0.0", "friction.0.factor = 0.0: allowed: 0.02 to 2"),
        ("[[friction]]\nfactor = 0.5\nfrom_m = 5.0\nto_m = 5.1", "friction.0: allowed: to_m at least 0.2 above from_m"),
        (HEIGHTS.format(0.0, 1.0), "heights: allowed: rising stations, not 0 behind 0"),
        (HEIGHTS.format(10.0, 9.0), "heights: allowed: slopes up to 0.5, not 1.69 between 0 and 10"),
        ("[[heights]]\nstation_m = 0.0\nheight_m = 0.0\n", "heights: allowed: no point or at least two"),
        ("grade_percent = = 3", "not valid TOML: Invalid value (at line 1, column 17): grade_percent = = 3"),
    ],
)
def test_a_mistake_in_a_file_is_named(tmp_path, text, named):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(RoadError) as caught:
        load_road(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert named in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RoadError, match=r"none\.toml: No such file"):
        load_road(tmp_path / "none.toml")
