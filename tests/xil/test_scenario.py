"""Scenarios: what their files may hold, how mistakes are told, and the reference that follows from them."""

from pathlib import Path

import numpy as np
import pytest

from dbc.vehicle import load_vehicle
from vehicle_emulator.road import make_road
from xil.course import passage
from xil.scenario import SCENARIO_FOLDER, Scenario, ScenarioError, Stage, load_scenario, scenario_names

VEHICLE = load_vehicle()
ISO = (SCENARIO_FOLDER / "iso3888-1.toml").read_text(encoding="utf-8")


def written(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def mistakes(folder: Path, text: str) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(written(folder, text))
    return str(caught.value).splitlines()


@pytest.mark.parametrize("name", scenario_names())
def test_scenario_is_named_like_its_file_and_can_be_laid_out(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    course = scenario.course(VEHICLE)
    assert course.station_m[0] == scenario.start_pose.x_m
    assert course.reference.speed_mps[-1] == 0.0
    assert (course.reference.speed_mps[:-200] > 0.0).all()


def test_the_two_scenarios_of_the_first_drive_are_there():
    assert {"iso3888-1", "lane-keeping"} <= set(scenario_names())


def test_user_may_name_a_file_of_his_own(tmp_path):
    text = ISO.replace('name = "iso3888-1"', 'name = "mine"').replace("time_limit_s = 30.0", "time_limit_s = 25")
    scenario = load_scenario(written(tmp_path, text))
    assert (scenario.name, scenario.time_limit_s) == ("mine", 25.0)


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ScenarioError) as caught:
        load_scenario("iso3888")
    assert "'iso3888'" in str(caught.value)
    assert "iso3888-1, lane-keeping" in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere\.toml: No such file or directory"):
        load_scenario(str(tmp_path / "nowhere.toml"))


def test_malformed_toml_shows_the_line_with_the_key(tmp_path):
    lines = mistakes(tmp_path, ISO.replace("stop_m = 220.0", "stop_m = = 220.0"))
    assert len(lines) == 1
    assert "mine.toml: not valid TOML" in lines[0]
    assert lines[0].endswith("stop_m = = 220.0")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("time_limit_s = 30.0", "time_limit_s = 0.0", "time_limit_s = 0.0: allowed: 1 to 600"),
        ("cruise_kmh = 80.0", "cruise_kmh = 400.0", "speed.cruise_kmh = 400.0: allowed: 5 to 250"),
        ("cruise_kmh = 80.0", 'cruise_kmh = "80"', "speed.cruise_kmh = '80': "),
        ("cruise_kmh = 80.0", "cruise_kmh = nan", "speed.cruise_kmh = nan: "),
        ("cruise_kmh = 80.0", "cruise_kph = 80.0", "speed.cruise_kph: unknown key"),
        ("deceleration_mps2 = 3.0", "", "speed.deceleration_mps2: missing"),
        ("car_widths = 1.2", "car_widths = 0.5", "gates.1.car_widths = 0.5: allowed: 1 to 5"),
        ("end_m = 70.0", "end_m = 40.0", "gates.1: allowed: end_m greater than start_m"),
        ("start_m = 0.0\nend_m = 15.0", "start_m = -130.0\nend_m = 15.0", "gates only between path.start_m and judge.to_m"),
        ("to_m = 130.0", "to_m = 150.0", "judge.to_m before the stop begins, at 137.7"),
        ("speed_kmh = 80.0", "speed_kmh = 0.0", "only with speed.acceleration_mps2"),
        ("speed_kmh = 80.0", "speed_kmh = 90.0", "start.speed_kmh of at most speed.cruise_kmh"),
        (
            "[[path.shifts]]\nstart_m = 12.75",
            "[[path.curves]]\nstart_m = 0\nend_m = 50\nradius_m = 100\ntransition_m = 10\n\n[[path.shifts]]\nstart_m = 12.75",
            "gates only on a straight base line",
        ),
    ],
)
def test_mistake_is_told_with_file_key_and_what_is_allowed(tmp_path, old, new, expected):
    assert old in ISO
    lines = mistakes(tmp_path, ISO.replace(old, new, 1))
    assert any(str(tmp_path / "mine.toml") in line and expected in line for line in lines), lines


def test_every_mistake_has_a_line_of_its_own(tmp_path):
    text = ISO.replace("time_limit_s = 30.0", "time_limit_s = 0.0").replace("margin_m", "margin", 1)
    assert len(mistakes(tmp_path, text)) == 3


ROAD = """[road]
left_m = 7.0
right_m = 3.5
"""
HILL = """[[road.heights]]
station_m = 0.0
height_m = 0.0
[[road.heights]]
station_m = 20.0
height_m = {}
"""
ICE = """[[road.friction]]
factor = {}
from_m = 10.0
to_m = 30.0
right_m = -3.0
left_m = -0.5
"""


def test_the_surface_of_the_road_lies_along_the_drive(tmp_path):
    text = ISO.replace(ROAD, ROAD + "grade_percent = 5.0\ncross_fall_percent = 2.0\n" + HILL.format(1.0) + ICE.format(0.1))
    scenario = load_scenario(written(tmp_path, text))
    road = make_road(scenario.road_surface())
    start, top, ice = road.at(-120.0, 0.0), road.at(20.0, 0.0), road.at(20.0, -2.0)
    assert (start.z_m, start.slope_x, start.slope_y) == pytest.approx((0.0, 0.05, 0.02))
    assert (top.z_m, top.friction) == pytest.approx((0.05 * 140.0 + 1.0, 1.0))
    assert (ice.z_m, ice.friction) == pytest.approx((top.z_m - 0.04, 0.1))


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (HILL.format(9.0), "road.heights: allowed: slopes up to 0.5"),
        (ICE.format(3.0), "road.friction.0.factor = 3.0: allowed: 0.02 to 2"),
        ("cross_fall_percent = 30.0", "road.cross_fall_percent = 30.0: allowed: -20 to 20"),
    ],
)
def test_a_mistake_about_the_surface_is_named(tmp_path, more, named):
    (line,) = mistakes(tmp_path, ISO.replace(ROAD, ROAD + more))
    assert named in line


def test_road_too_narrow_for_the_car_is_told():
    scenario = load_scenario("iso3888-1")
    narrow = scenario.model_copy(update={"road": scenario.road.model_copy(update={"left_m": 4.0})})
    with pytest.raises(ScenarioError, match=r"road\.left_m = 4: allowed: more than 4\.41"):
        narrow.reference(VEHICLE)


def test_iso_gates_are_as_wide_as_the_standard_asks():
    widths_m = [lane.left_m - lane.right_m for lane in load_scenario("iso3888-1").lanes(VEHICLE)]
    # 1.1, 1.2 and 1.3 times 1.823 m, plus 0.25 m each.
    assert widths_m == pytest.approx([2.2553, 2.4376, 2.6199])


def test_iso_gates_lie_where_the_standard_puts_them():
    lanes = load_scenario("iso3888-1").lanes(VEHICLE)
    assert [(lane.start_m, lane.end_m) for lane in lanes] == [(0.0, 15.0), (45.0, 70.0), (95.0, 125.0)]
    assert [(lane.left_m + lane.right_m) / 2.0 for lane in lanes] == pytest.approx([0.0, 3.5, 0.0])


def test_car_on_the_iso_reference_keeps_clear_of_every_gate_with_grip_to_spare():
    course = load_scenario("iso3888-1").course(VEHICLE)
    path = course.reference
    ways = [passage(lane, course.outline, path.x_m, path.y_m, path.yaw_rad) for lane in course.lanes]
    assert [way.clearance_m for way in ways] == pytest.approx([0.194, 0.211, 0.218], abs=0.001)
    curvature = np.gradient(path.yaw_rad) / np.hypot(np.gradient(path.x_m), np.gradient(path.y_m))
    assert np.abs(curvature * path.speed_mps**2).max() == pytest.approx(6.85, abs=0.1)


@pytest.mark.parametrize("name", scenario_names())
def test_reference_is_continuous_up_to_its_curvature(name):
    path = load_scenario(name).reference(VEHICLE)
    step_m = np.hypot(np.diff(path.x_m), np.diff(path.y_m))
    chord_rad = np.unwrap(np.arctan2(np.diff(path.y_m), np.diff(path.x_m)))
    middle_rad = (path.yaw_rad[1:] + path.yaw_rad[:-1]) / 2.0
    curvature = np.diff(path.yaw_rad) / step_m
    assert step_m.min() > 0.1
    assert step_m.max() < 0.25
    assert np.abs(chord_rad - middle_rad).max() < 1e-4
    # A step in curvature would be as large as the curvature itself; the smooth reference changes by less than 6 % of it per sample.
    assert np.abs(np.diff(curvature)).max() <= 0.06 * np.abs(curvature).max()


def test_curves_turn_as_their_radius_says():
    path = load_scenario("lane-keeping").reference(VEHICLE)
    curvature = np.diff(path.yaw_rad) / np.hypot(np.diff(path.x_m), np.diff(path.y_m))
    assert curvature.max() == pytest.approx(1.0 / 300.0, rel=1e-3)
    assert curvature.min() == pytest.approx(-1.0 / 250.0, rel=1e-3)
    # A stretch of 150 m turns by the 110 m between the middles of its transitions.
    assert path.yaw_rad.max() == pytest.approx(110.0 / 300.0, abs=1e-4)
    assert path.yaw_rad[-1] == pytest.approx(110.0 / 300.0 - 110.0 / 250.0, abs=1e-4)


def test_speed_rises_from_standstill_and_falls_to_it_as_planned():
    course = load_scenario("lane-keeping").course(VEHICLE)
    speed_mps = np.interp([0.0, 60.0, 300.0, 484.0, 500.0], course.station_m, course.reference.speed_mps)
    # v^2 = v0^2 + 2 a s with 1 m/s and 1.5 m/s2; 60 km/h; v^2 = 2 a s with 2 m/s2 over the last 16 m.
    assert speed_mps == pytest.approx([1.0, np.sqrt(181.0), 60.0 / 3.6, 8.0, 0.0], abs=1e-3)


def test_drivable_distance_is_the_road_less_half_a_car():
    path = load_scenario("iso3888-1").reference(VEHICLE)
    at_gate_2 = int(np.argmin(np.abs(path.x_m - 57.0)))
    assert path.left_m[at_gate_2] == pytest.approx(7.0 - 3.5 - 1.823 / 2.0)
    assert path.right_m[at_gate_2] == pytest.approx(3.5 + 3.5 - 1.823 / 2.0)


def test_scene_shows_the_same_course_thinned():
    scenario = load_scenario("iso3888-1")
    scene = scenario.scene(Stage.HIL, VEHICLE, t_ns=7, seq=3)
    assert (scene.t_ns, scene.seq, scene.scenario, scene.stage) == (7, 3, "iso3888-1", "hil")
    assert scene.car_front_m == pytest.approx(1.13 + 0.88)
    assert np.diff(scene.reference_x_m) == pytest.approx(1.0)
    assert set(scene.left_y_m) == {7.0}
    assert set(scene.right_y_m) == {-3.5}
    assert [lane.name for lane in scene.lanes] == ["gate 1", "gate 2", "gate 3"]


def test_scenario_is_frozen():
    scenario = load_scenario("iso3888-1")
    assert isinstance(scenario, Scenario)
    with pytest.raises(ValueError, match="frozen"):
        scenario.name = "other"
