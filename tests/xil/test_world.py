"""Objects of scenarios: what files may say of them, when they appear, where they drive, and how the car's distance to them is judged."""

import json

import numpy as np
import pytest

from controller.objects import report_of
from dbc.vehicle import load_vehicle
from gateway.telemetry import ObjectsSample
from tests.support.processes import xilgate
from tests.support.recorded_drive import RecordedDrive
from xil.course import Outline, Pose, separation_m
from xil.map_view import draw_map
from xil.metrics import closest, evaluate, trace
from xil.scenario import SCENARIO_FOLDER, ScenarioError, Stage, load_scenario
from xil.world import World

VEHICLE = load_vehicle()
CUT_IN = (SCENARIO_FOLDER / "cut-in.toml").read_text(encoding="utf-8")
SECOND_NS = 1_000_000_000


def car_at(x_m, y_m=0.0, speed_mps=0.0):
    return Pose(x_m, y_m, 0.0, speed_mps)


def cut_in(tmp_path, *changes):
    text = CUT_IN
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    return load_scenario(str(tmp_path / "mine.toml"))


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("width_m = 1.8", "width_m = 0.0", "objects.0.width_m = 0.0: allowed: 0.1 to 50"),
        ("width_m = 1.8", "", "objects.0: allowed: length_m and width_m, or a kind that has them: car, adult, child, cyclist"),
        ("width_m = 1.8", "width_m = nan", "objects.0.width_m = nan"),
        ("speed_kmh = 20.0", "speed_kmh = 20.0\ncolour = 1", "objects.0.colour: unknown key"),
        ("appears_at_m = 0.0", "appears_at_m = 0.0\nappears_at_s = 1.0", "allowed: one of appears_at_m and appears_at_s"),
        ("station_m = 45.0", "station_m = -200.0", "allowed: objects only from path.start_m to 280"),
        ('name = "slow car"', 'name = ""', "objects.0.name"),
    ],
)
def test_a_mistake_about_an_object_is_named(tmp_path, old, new, named):
    with pytest.raises(ScenarioError) as caught:
        cut_in(tmp_path, (old, new))
    assert named in str(caught.value)
    assert "mine.toml" in str(caught.value)


def test_objects_of_one_name_are_refused(tmp_path):
    block = CUT_IN[CUT_IN.index("[[objects]]") : CUT_IN.index("[judge]")]
    with pytest.raises(ScenarioError, match="objects only with names that differ"):
        cut_in(tmp_path, ("[judge]", block + "[judge]"))


def test_an_object_appears_when_the_car_gets_to_its_station_and_stays_and_drives_on():
    world = World(load_scenario("cut-in"), VEHICLE, SECOND_NS)
    assert world.sample(SECOND_NS, 0, car_at(-60.0, 0.0)).objects == []
    assert world.sample(2 * SECOND_NS, 1, car_at(-0.5, 0.0)).objects == []
    (seen,) = world.sample(3 * SECOND_NS, 2, car_at(0.1, 0.3)).objects
    assert (seen.name, seen.x_m, seen.y_m, seen.yaw_rad) == ("slow car", pytest.approx(45.0), pytest.approx(0.0), pytest.approx(0.0))
    (later,) = world.sample(5 * SECOND_NS, 3, car_at(-30.0, 0.3)).objects
    assert later.x_m == pytest.approx(45.0 + 2.0 * 20.0 / 3.6)
    assert report_of(ObjectsSample(t_ns=0, seq=0, objects=[later])).rejected == 0


def test_an_object_may_appear_by_time_and_drive_across(tmp_path):
    across = ("appears_at_m = 0.0", "appears_at_s = 2.0\nheading_deg = 90.0")
    scenario = cut_in(tmp_path, across, ("offset_m = 0.0\nlength", "offset_m = -3.0\nlength"))
    world = World(scenario, VEHICLE, SECOND_NS)
    assert world.sample(2 * SECOND_NS, 0, car_at(0.0, 0.0)).objects == []
    assert len(world.sample(3 * SECOND_NS, 1, car_at(0.0, 0.0)).objects) == 1
    (seen,) = world.sample(4 * SECOND_NS, 2, car_at(0.0, 0.0)).objects
    assert (seen.x_m, seen.y_m) == pytest.approx((45.0, -3.0 + 20.0 / 3.6))
    assert seen.yaw_rad == pytest.approx(np.pi / 2)


def test_beside_a_curved_line_an_object_stands_along_it():
    scenario = load_scenario("lane-keeping")
    spec = load_scenario("parking").objects[0].model_copy(update={"station_m": 200.0, "offset_m": 1.2, "appears_at_m": None})
    (seen,) = World(scenario.model_copy(update={"objects": [spec]}), VEHICLE, 0).sample(0, 0, car_at(0.0)).objects
    course = scenario.course(VEHICLE)
    along = course.project(np.array([seen.x_m]), np.array([seen.y_m]))
    assert (along.station_m[0], along.lateral_error_m[0]) == pytest.approx((200.0, 1.2), abs=0.02)
    assert seen.yaw_rad == pytest.approx(along.yaw_rad[0], abs=1e-3)


def boxes(*poses, length_m=4.0, width_m=2.0):
    x, y, yaw = np.array(poses, dtype=float).T
    return Outline(length_m / 2, length_m / 2, width_m / 2).corners_m(x, y, yaw)


def test_the_distance_of_rectangles():
    first = boxes((0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, np.pi / 4))
    second = boxes((10, 0, 0), (0, 2.5, np.pi), (3.5, 1.5, 0), (0, 5, -np.pi / 4))
    expected = (6.0, 0.5, -0.5, 5.0 * np.sqrt(0.5) - 3.0)
    assert separation_m(first, second) == pytest.approx(expected)
    assert separation_m(second, first) == pytest.approx(expected)


def judged(scenario, **spoiled):
    """A drive along the reference while the world goes on."""
    recording = RecordedDrive(scenario, VEHICLE, **spoiled).recording
    world = World(scenario, VEHICLE, recording.start_ns)
    for k, sample in enumerate(recording.samples("world")):
        recording.add(world.sample(sample.t_ns, k, car_at(sample.x_m, sample.y_m, sample.vx_mps)))
    verdict = evaluate(recording, scenario, VEHICLE, Stage.HIL)
    return recording, verdict, next(m for m in verdict.metrics if m.name.startswith("clearance to"))


def test_a_car_that_drives_into_an_object_fails_and_is_told_so():
    _, verdict, clearance = judged(load_scenario("cut-in"))
    assert clearance.value < 0.0
    assert not verdict.passed
    assert verdict.reason.startswith("slow car touched at t = ")


def test_a_car_that_passes_too_near_fails_and_one_that_keeps_clear_does_not(tmp_path):
    standing = cut_in(tmp_path, ("speed_kmh = 20.0", "speed_kmh = 0.0"), ("offset_m = 0.0\nlength", "offset_m = -1.0\nlength"))
    for left_m, passes in ((0.8, False), (1.2, True)):
        _, verdict, clearance = judged(standing, left_of_reference_m=lambda s, left_m=left_m: left_m)
        assert clearance.value == pytest.approx(left_m + 1.0 - 0.9 - VEHICLE.body.width_m / 2, abs=0.02)
        assert clearance.passed is passes
    assert verdict.passed, verdict.reason


def test_an_object_that_never_appeared_fails_the_run(tmp_path):
    _, verdict, clearance = judged(cut_in(tmp_path, ("appears_at_m = 0.0", "appears_at_s = 500.0")))
    assert clearance.value is None
    assert verdict.reason == "slow car did not appear"


def stopped(stop_m, scenario=None, **spoiled):
    """The verdict on a drive that ends before the pedestrian who stays."""
    scenario = scenario or load_scenario("pedestrian-stays")
    speed = scenario.speed.model_copy(update={"stop_m": stop_m})
    recording = RecordedDrive(scenario.model_copy(update={"speed": speed}), VEHICLE, **spoiled).recording
    world = World(scenario, VEHICLE, recording.start_ns)
    for k, sample in enumerate(recording.samples("world")):
        recording.add(world.sample(sample.t_ns, k, car_at(sample.x_m, sample.y_m, sample.vx_mps)))
    return evaluate(recording, scenario, VEHICLE, Stage.HIL)


def test_a_car_that_stands_before_the_object_passes():
    verdict = stopped(25.0)
    assert verdict.passed, verdict.reason
    gap_m = next(m.value for m in verdict.metrics if m.name == "final distance to pedestrian")
    assert gap_m == pytest.approx(30.0 - 0.25 - 2.01 - 25.0, abs=0.1)


@pytest.mark.parametrize(
    ("stop_m", "reason"),
    [
        (10.0, "the car ended 17.7 m before pedestrian, it was to stand within 6 m"),
        (27.6, "pedestrian passed at 0.140 m, limit 0.3 m, at t = "),
        (60.0, "pedestrian touched at t = "),
    ],
)
def test_a_car_that_stands_too_early_too_near_or_behind_the_object_fails(stop_m, reason):
    verdict = stopped(stop_m)
    assert not verdict.passed
    assert verdict.reason.startswith(reason)


def test_a_car_that_drives_round_the_object_that_it_was_to_stand_before_fails():
    wide = load_scenario("pedestrian-stays")
    wide = wide.model_copy(update={"road": wide.road.model_copy(update={"left_m": 6.0})})
    verdict = stopped(60.0, wide, left_of_reference_m=lambda station_m: 3.0)
    assert verdict.reason == "the car was to stand before pedestrian, it ended beside or behind it"


def test_a_gateway_that_ends_the_drive_before_the_car_stands_fails_it():
    verdict = stopped(25.0, leaves_engaged=(6.0, "SAFE_STOP", "controller silent"))
    assert verdict.reason == "controller silent at t = 6.00 s, the car stopped"


def test_nothing_but_an_object_can_be_stood_before(tmp_path):
    with pytest.raises(ScenarioError, match=r"judge\.stands_before only with the name of an object"):
        cut_in(tmp_path, ("object_clearance_m = 0.3", 'object_clearance_m = 0.3\nstands_before = "somebody"'))


def test_the_map_shows_the_object_where_the_car_was_closest():
    scenario = load_scenario("cut-in")
    recording, _, clearance = judged(scenario)
    course = scenario.course(VEHICLE)
    drive = trace(recording, course, Stage.HIL)
    (drawn,) = draw_map(course, drive, [closest(recording, "slow car", course, drive)]).objects
    assert drawn.is_touched
    assert drawn.label.startswith("slow car: \N{MINUS SIGN}")
    assert clearance.value < 0.0


WAITS_M, DRIVES_ROUND_M = (1.5, 15.0), (0.4, 1.5)
"""Clearance to who crosses, stays or cuts in, and to what is passed."""


@pytest.mark.parametrize(
    ("name", "between_m"),
    [
        ("pedestrian", WAITS_M), ("pedestrian-stays", WAITS_M), ("cut-in-lane-change", WAITS_M),
        ("parking", DRIVES_ROUND_M), ("cut-in", DRIVES_ROUND_M),
    ],
)  # fmt: skip
def test_the_car_waits_for_who_crosses_stays_or_cuts_in_and_drives_round_what_it_may_pass(tmp_path, name, between_m):
    finished = xilgate("drive", name, "--stage", "sil", "--solver", "riccati", "--out", str(tmp_path / "run"))
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert finished.returncode == 0, summary["reason"]
    (clearance,) = [m["value"] for m in summary["metrics"] if m["name"].startswith("clearance to")]
    assert between_m[0] < clearance < between_m[1]
