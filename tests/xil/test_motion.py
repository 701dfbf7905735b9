"""How objects of scenarios move: their lines, their speeds, what sets them off, and that their velocities are true."""

import math
from itertools import pairwise

import numpy as np
import pytest

from dbc.vehicle import load_vehicle
from xil.course import Pose
from xil.scenario import SCENARIO_FOLDER, ScenarioError, load_scenario
from xil.scenario_objects import RoadObject
from xil.world import World

VEHICLE = load_vehicle()
STRAIGHT = load_scenario("cut-in")
CURVED = load_scenario("lane-keeping")
FRONT_M = STRAIGHT.course(VEHICLE).outline.front_m
HALF_WIDTH_M = VEHICLE.body.width_m / 2.0
STEP_S = 0.02


def thing(**fields):
    return RoadObject.model_validate({"name": "thing", "kind": "car", "station_m": 0.0, "offset_m": 0.0} | fields)


def seen(spec, seconds, *, scenario=STRAIGHT, car_m=-90.0, car_kmh=0.0):
    """The object every 20 ms while the car drives along the base line at one speed; None while it is not there."""
    world, found = World(scenario.model_copy(update={"objects": [spec]}), VEHICLE, 0), []
    for k in range(round(seconds / STEP_S) + 1):
        pose = Pose(car_m + k * STEP_S * car_kmh / 3.6, 0.0, 0.0, car_kmh / 3.6)
        objects = world.sample(round(k * STEP_S * 1e9), k, pose).objects
        found.append(objects[0] if objects else None)
    return found


def speeds(samples):
    return np.array([math.hypot(sample.vx_mps, sample.vy_mps) for sample in samples])


CROSSING = {"kind": "adult", "station_m": 30.0, "offset_m": -4.0, "crossing": {"speed_kmh": 5.0, "run_up_m": 1.0, "after_s": 1.0}}


@pytest.mark.parametrize(
    ("scenario", "fields"),
    [
        (STRAIGHT, {"speed_kmh": 40.0, "heading_deg": 30.0}),
        (CURVED, {"speed_kmh": 60.0, "motion": "lane", "offset_m": -3.0, "station_m": 100.0}),
        (CURVED, {"speed_kmh": 50.0, "motion": "lane", "offset_m": 3.5, "station_m": 300.0, "heading_deg": 180.0}),
        (CURVED, {
            "speed_kmh": 50.0, "motion": "lane", "offset_m": 3.5, "station_m": 150.0,
            "lane_change": {"offset_m": -3.5, "duration_s": 3.0, "after_s": 1.0},
            "speed_changes": [{"to_kmh": 20.0, "acceleration_mps2": 4.0, "after_s": 2.0}],
        }),
        (STRAIGHT, CROSSING),
    ],
)  # fmt: skip
def test_velocities_and_headings_are_those_of_the_motion(scenario, fields):
    samples = seen(thing(**fields), 8.0, scenario=scenario)
    steps = [i for i in range(1, len(samples) - 1) if abs(speeds(samples)[i + 1] - speeds(samples)[i - 1]) < 0.5]
    assert len(steps) > 380
    for i in steps:
        before, now, after = samples[i - 1 : i + 2]
        difference = ((after.x_m - before.x_m) / (2 * STEP_S), (after.y_m - before.y_m) / (2 * STEP_S))
        assert (now.vx_mps, now.vy_mps) == pytest.approx(difference, abs=0.06)
        if math.hypot(*difference) > 0.5:
            assert math.remainder(now.yaw_rad - math.atan2(now.vy_mps, now.vx_mps), 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_along_the_lane_an_object_keeps_its_offset_and_its_speed():
    samples = seen(thing(speed_kmh=60.0, motion="lane", offset_m=-1.0, station_m=100.0), 8.0, scenario=CURVED)
    course = CURVED.course(VEHICLE)
    along = course.project(np.array([s.x_m for s in samples]), np.array([s.y_m for s in samples]))
    assert along.lateral_error_m == pytest.approx(-1.0, abs=2e-3)
    assert speeds(samples) == pytest.approx(60.0 / 3.6)
    way_m = sum(math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) for a, b in pairwise(samples))
    assert way_m == pytest.approx(8.0 * 60.0 / 3.6, rel=1e-4)


def test_behind_the_end_of_the_base_line_an_object_drives_straight_on():
    last = seen(thing(speed_kmh=100.0, motion="lane", station_m=270.0), 3.0)[-1]
    assert (last.x_m, last.y_m) == pytest.approx((270.0 + 300.0 / 3.6, 0.0))


def test_a_lane_change_takes_its_time_and_ends_on_the_other_lane():
    change = {"offset_m": -3.5, "duration_s": 3.0, "after_s": 1.0}
    samples = seen(thing(speed_kmh=50.0, motion="lane", offset_m=3.5, lane_change=change), 6.0)
    offsets = [sample.y_m for sample in samples]
    assert offsets[:50] == [3.5] * 50
    assert offsets[round(2.5 / STEP_S)] == pytest.approx(1.75, abs=0.1)
    assert offsets[round(4.1 / STEP_S) :] == pytest.approx([0.0] * len(offsets[round(4.1 / STEP_S) :]), abs=1e-6)
    assert speeds(samples) == pytest.approx(50.0 / 3.6)


def test_an_object_brakes_when_it_is_told_and_stands():
    brake = {"to_kmh": 0.0, "acceleration_mps2": 6.0, "after_s": 1.0}
    samples = seen(thing(speed_kmh=50.0, speed_changes=[brake]), 5.0)
    v_mps = 50.0 / 3.6
    assert speeds(samples)[50] == pytest.approx(v_mps)
    assert speeds(samples)[100] == pytest.approx(v_mps - 6.0)
    assert samples[-1].x_m == pytest.approx(v_mps + v_mps**2 / 12.0, abs=1e-9)
    assert speeds(samples)[-1] == 0.0


def test_a_later_change_of_speed_replaces_the_one_before():
    changes = [{"to_kmh": 0.0, "acceleration_mps2": 2.0, "after_s": 1.0}, {"to_kmh": 72.0, "acceleration_mps2": 4.0, "after_s": 2.0}]
    samples = seen(thing(speed_kmh=36.0, speed_changes=changes), 8.0)
    assert [speeds(samples)[round(t / STEP_S)] for t in (1.0, 2.0, 3.0, 8.0)] == pytest.approx([10.0, 8.0, 12.0, 20.0])


@pytest.mark.parametrize(("moment", "due_s"), [({"at_car_m": 10.0}, 1.0), ({"at_ttc_s": 4.0}, None)])
def test_the_car_sets_a_change_off_by_its_station_or_its_time_to_collision(moment, due_s):
    brake = {"to_kmh": 0.0, "acceleration_mps2": 5.0} | moment
    samples = seen(thing(station_m=60.0, speed_kmh=18.0, speed_changes=[brake]), 8.0, car_m=0.0, car_kmh=36.0)
    begun = next(k for k, speed in enumerate(speeds(samples)) if speed < 4.999) - 1
    gap_m = 60.0 - 2.0 - FRONT_M
    expected_s = due_s if due_s is not None else gap_m / 5.0 - 4.0
    assert begun * STEP_S == pytest.approx(expected_s, abs=1.5 * STEP_S)


@pytest.mark.parametrize("percent", [25.0, 50.0, 75.0])
@pytest.mark.parametrize("offset_m", [-4.0, 6.0])
def test_a_pedestrian_meets_the_car_where_it_was_told(percent, offset_m):
    crossing = {"speed_kmh": 5.0, "run_up_m": 1.0, "meets_car_percent": percent}
    samples = seen(thing(kind="adult", station_m=40.0, offset_m=offset_m, crossing=crossing), 14.0, car_m=-60.0, car_kmh=30.0)
    meets_s = (40.0 - 0.25 - FRONT_M + 60.0) / (30.0 / 3.6)
    there = samples[round(meets_s / STEP_S)]
    from_side = math.copysign(1.0, offset_m)
    assert there.y_m == pytest.approx(from_side * HALF_WIDTH_M * (1.0 - 2.0 * percent / 100.0), abs=0.05)
    assert speeds([there]) == pytest.approx([5.0 / 3.6])


def test_a_pedestrian_stands_runs_up_walks_across_and_stands_again():
    samples = seen(thing(**CROSSING), 8.0)
    assert {(sample.x_m, sample.y_m) for sample in samples[:51]} == {(30.0, -4.0)}
    assert samples[0].yaw_rad == pytest.approx(math.pi / 2)
    v_mps = 5.0 / 3.6
    assert samples[round((1.0 + 2.0 / v_mps) / STEP_S)].y_m == pytest.approx(-3.0, abs=0.02)
    assert (samples[-1].y_m, *speeds(samples[-1:])) == (4.0, 0.0)
    short = seen(thing(**(CROSSING | {"crossing": CROSSING["crossing"] | {"to_offset_m": 0.5}})), 8.0)
    assert short[-1].y_m == pytest.approx(0.5)


def test_an_object_disappears_by_time_or_by_the_station_of_the_car():
    by_time = seen(thing(disappears_after_s=2.0, appears_at_s=1.0), 5.0)
    assert [sample is not None for sample in by_time] == [1.0 <= k * STEP_S < 3.0 for k in range(251)]
    by_place = seen(thing(disappears_at_m=20.0), 4.0, car_m=0.0, car_kmh=36.0)
    assert [sample is not None for sample in by_place] == [k * STEP_S * 10.0 < 20.0 for k in range(201)]


def test_sizes_come_from_the_kind_unless_they_are_given():
    assert thing(kind="car").size_m == (4.0, 1.712)
    assert thing(kind="adult", width_m=0.7).size_m == (0.6, 0.7)
    assert thing(kind=None, length_m=2.0, width_m=1.0).size_m == (2.0, 1.0)


BRAKE = 'kind = "car"\nspeed_changes = [{ to_kmh = 0.0, acceleration_mps2 = '
CROSS = 'kind = "adult"\ncrossing = { speed_kmh = 5.0, after_s = 1.0'


@pytest.mark.parametrize(
    ("block", "named"),
    [
        ('kind = "lorry"', "objects.0: allowed: kind one of car, adult, child, cyclist"),
        ('kind = "car"\nmotion = "sideways"', "objects.0.motion = 'sideways'"),
        ('kind = "car"\nmotion = "lane"\nheading_deg = 90.0', 'objects.0: allowed: heading_deg 0 or 180 with motion "lane"'),
        ('kind = "car"\nlane_change = { offset_m = 3.5, duration_s = 3.0, after_s = 1.0 }', 'lane_change only with motion "lane"'),
        (BRAKE + "2.0 }]", "speed_changes.0: allowed: one of after_s, at_car_m, at_ttc_s"),
        (BRAKE + "20.0, after_s = 1.0 }]", "acceleration_mps2 = 20.0: allowed: 0.1 to 10"),
        ("speed_kmh = 5.0\n" + CROSS + " }", "crossing without motion, heading_deg, speed_kmh"),
        (CROSS + ", at_car_m = 3.0 }", "one of after_s, at_car_m, at_ttc_s, meets_car_percent"),
        (CROSS + ", to_offset_m = -2.0 }", "offset_m other than where it ends"),
        ('kind = "car"\ndisappears_at_m = 3.0\ndisappears_after_s = 3.0', "one of disappears_at_m and disappears_after_s"),
    ],
)
def test_a_mistake_about_a_motion_is_named(tmp_path, block, named):
    text, path = (SCENARIO_FOLDER / "cut-in.toml").read_text(encoding="utf-8"), tmp_path / "mine.toml"
    start, end = text.index("[[objects]]"), text.index("[judge]")
    mine = f'[[objects]]\nname = "thing"\nstation_m = 45.0\noffset_m = -2.0\n{block}\n\n'
    path.write_text(text[:start] + mine + text[end:], encoding="utf-8")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(path))
    assert named in str(caught.value)
