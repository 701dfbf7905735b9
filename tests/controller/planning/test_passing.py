"""Objects on the road: passed without touching, on one side, by a smooth reference; else the car stops or follows."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import Phase, assume, example, given, settings
from hypothesis import strategies as st

from controller.planning.obstacles import Obstacle
from controller.planning.planner import Planner, PlannerError, PlannerOptions
from controller.planning.reference_sources import reference_from_curvature
from controller.problem import OcpOptions
from dbc.vehicle import load_vehicle
from xil.course import Outline, separation_m

VEHICLE = load_vehicle()
OUTLINE = Outline.of(VEHICLE)
CAR = Obstacle("car", 80.0, 0.0, 0.0, 4.4, 1.8)
PERIOD_S = 0.04
STEEPEST_MPS2 = 3.0
DRIVES = settings(max_examples=6, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
"""Whole drives take time: few of them, always the same, and no shrinking of one that fails."""


def road(speed_mps=16.0, left_m=5.0, right_m=1.0, curvature=0.0, length_m=260.0):
    path = reference_from_curvature([0.0, length_m], [curvature] * 2, [speed_mps] * 2, 1.0)
    return replace(path, left_m=np.full(path.x_m.size, left_m), right_m=np.full(path.x_m.size, right_m))


def planner_on(path, **options):
    return Planner(path, VEHICLE.model, OcpOptions(), PlannerOptions(**options), VEHICLE.body)


@dataclass
class Drive:
    """What an ideal car did that follows each reference exactly, as far as brakes and engine can."""

    states: np.ndarray
    clearance_m: float
    sides: list
    blockers: list
    horizons: list
    shifts: list


def drive(planner, path, objects, duration_s, speed_mps=None, noise_m=0.0, seed=0):
    rng = np.random.default_rng(seed)
    state = np.array((float(path.speed_mps[0]) if speed_mps is None else speed_mps, 0, 0, path.x_m[0], path.y_m[0], path.yaw_rad[0]))
    done, clearance = Drive(np.empty(0), np.inf, [], [], [], []), np.inf
    states = []
    for cycle in range(round(duration_s / PERIOD_S)):
        t = cycle * PERIOD_S
        true = [replace(o, x_m=o.x_m + o.vx_mps * t, y_m=o.y_m + o.vy_mps * t) for o in objects]
        clearance = min([clearance, *(gap_m(state, o) for o in true)])
        seen = [replace(o, x_m=o.x_m + noise_m * rng.standard_normal(), y_m=o.y_m + noise_m * rng.standard_normal()) for o in true]
        horizon = planner.horizon(state, PERIOD_S, seen)
        states.append(state)
        done.horizons.append(horizon)
        done.shifts.append(planner.decision.shift)
        done.sides.append({m.track.name: gap.sides[m.track.name] for m, gap in planner.decision.passed})
        done.blockers.append({m.track.name for m in planner.decision.blockers})
        state = followed(state, horizon.reference)
    done.states, done.clearance_m = np.array(states), clearance
    return done


def followed(state, reference):
    speed = state[0] + np.clip(reference[1, 0] - state[0], -STEEPEST_MPS2 * PERIOD_S, STEEPEST_MPS2 * PERIOD_S)
    way = reference[1, 3:5] - reference[0, 3:5]
    length = np.hypot(*way)
    if length < 1e-6:
        return np.array((speed, 0, 0, *state[3:6]))
    return np.array((speed, 0, 0, *(reference[0, 3:5] + speed * PERIOD_S * way / length), math.atan2(way[1], way[0])))


def gap_m(state, thing):
    box = Outline(thing.length_m / 2, thing.length_m / 2, thing.width_m / 2)
    pose = (np.array([v]) for v in (state[3], state[4], state[5]))
    return float(separation_m(OUTLINE.corners_m(*pose), box.corners_m(*(np.array([v]) for v in (thing.x_m, thing.y_m, thing.yaw_rad))))[0])


def assert_is_smooth(done):
    """On a straight path: the shift has no step along the way, and none at the car from cycle to cycle."""
    for was, now, x in zip(done.shifts, done.shifts[1:], done.states[1:, 3], strict=False):
        before, after = was.at(x), now.at(x)
        for name in ("offset_m", "slope", "bend_radpm"):
            assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-6)
    for shift in {id(shift): shift for shift in done.shifts}.values():
        fine = np.linspace(shift.knots[0].station_m, shift.knots[-1].station_m + 1.0, 2000)
        offset, slope, bend = shift.sample(fine)
        step = fine[1] - fine[0]
        assert np.abs(np.diff(offset)).max() <= np.abs(slope).max() * step * 1.01 + 1e-9
        assert np.abs(np.diff(slope)).max() <= np.abs(bend).max() * step * 1.01 + 1e-9
        assert np.abs(np.diff(bend)).max() < 0.05


def assert_corridors_are_open(done):
    for horizon in done.horizons:
        assert np.isfinite(horizon.reference).all()
        assert (horizon.left_m >= 0.0).all()
        assert (horizon.right_m >= 0.0).all()
        assert (horizon.left_m + horizon.right_m > 0.0).all()


def test_a_standing_car_is_passed_where_there_is_room_and_the_path_taken_up_again():
    path = road()
    done = drive(planner_on(path), path, [CAR], 14.0)
    assert done.clearance_m >= 0.4
    assert (done.states[:, 0] == 16.0).all()
    assert {name: int(side) for sides in done.sides for name, side in sides.items()} == {"car": 1}
    assert abs(done.states[-1, 4]) < 1e-6
    assert_is_smooth(done)
    assert_corridors_are_open(done)
    bends = [shift.at(x).bend_radpm for shift, x in zip(done.shifts, done.states[:, 3], strict=True)]
    assert np.abs(bends).max() * 16.0**2 <= 4.0 * 1.01


def test_an_object_that_appears_late_moves_the_reference_from_where_it_is():
    path = road(right_m=5.0)
    planner = planner_on(path)
    state = np.array((16.0, 0, 0, 30.0, 0.0, 0.0))
    before = planner.horizon(state, PERIOD_S)
    after = planner.horizon(np.array((16.0, 0, 0, 30.64, 0.0, 0.0)), PERIOD_S, [replace(CAR, x_m=70.0, y_m=-0.8)])
    assert planner.decision.passed
    assert abs(after.reference[0, 4]) < 1e-9
    assert abs(after.reference[0, 5]) < 1e-3
    assert np.abs(np.diff(after.reference[:, 5])).max() < 0.02
    assert after.reference[-1, 4] > 0.5
    assert abs(before.reference[-1, 4]) < 1e-12


def test_before_a_wall_the_car_stops_at_the_safe_distance():
    path = road(left_m=1.0)
    done = drive(planner_on(path), path, [replace(CAR, width_m=8.0)], 16.0)
    assert done.states[-1, 0] == 0.0
    assert done.clearance_m == pytest.approx(2.0, abs=0.15)
    assert max(h.reference[0, 0] - h.reference[-1, 0] for h in done.horizons) <= 2.8 * 30 * PERIOD_S
    assert done.horizons[-1].reference[:, 0].max() < 0.2
    assert_corridors_are_open(done)


def test_the_car_goes_on_when_the_wall_is_gone():
    path, planner = road(left_m=1.0), planner_on(road(left_m=1.0))
    stopped = drive(planner, path, [replace(CAR, width_m=8.0)], 16.0).states[-1]
    assert planner.horizon(stopped, PERIOD_S, []).reference[-1, 0] > 1.0


@pytest.mark.parametrize("speed_mps", [3.0, 8.0, 12.0])
def test_a_slower_car_that_cannot_be_passed_is_followed_with_the_time_gap(speed_mps):
    path = road(left_m=1.0, length_m=600.0)
    done = drive(planner_on(path), path, [replace(CAR, x_m=50.0, vx_mps=speed_mps)], 25.0)
    assert done.states[-1, 0] == pytest.approx(speed_mps, abs=0.05)
    gap = 50.0 + 25.0 * speed_mps - 2.2 - done.states[-1, 3] - OUTLINE.front_m
    assert gap == pytest.approx(2.0 + 1.2 * speed_mps, abs=0.8)
    assert done.clearance_m > 2.0


def test_a_slower_car_is_overtaken_where_there_is_room():
    path = road(length_m=600.0)
    done = drive(planner_on(path), path, [replace(CAR, x_m=50.0, vx_mps=7.0)], 24.0)
    assert done.clearance_m >= 0.4
    assert (done.states[:, 0] == 16.0).all()


def test_oncoming_traffic_is_let_through_before_a_standing_car_is_passed():
    path = road(speed_mps=10.0, left_m=4.5, length_m=300.0)
    oncoming = Obstacle("oncoming", 190.0, 3.2, math.pi, 4.4, 1.8, -10.0, 0.0)
    done = drive(planner_on(path, detection_range_m=150.0), path, [CAR, oncoming], 30.0)
    assert done.clearance_m > 0.2
    assert done.states[-1, 3] > 100.0


def test_a_pedestrian_who_crosses_is_waited_for():
    path = road(speed_mps=8.0, left_m=2.5, right_m=2.5)
    done = drive(planner_on(path), path, [Obstacle("pedestrian", 45.0, -6.0, 0.0, 0.5, 0.6, 0.0, 1.4)], 25.0)
    assert done.clearance_m > 0.4
    assert done.states[-1, 3] > 100.0


def test_several_objects_are_passed_in_turn():
    path = road(speed_mps=8.0, left_m=2.5, right_m=2.5)
    things = [Obstacle(str(k), 40.0 + 22.0 * k, (-1.0) ** k, 0.0, 1.0, 1.6) for k in range(3)]
    done = drive(planner_on(path), path, things, 30.0)
    assert done.clearance_m >= 0.3
    assert done.states[-1, 3] > 150.0
    assert {name: int(side) for sides in done.sides for name, side in sides.items()} == {"0": -1, "1": 1, "2": -1}


def test_an_object_beyond_the_detection_range_does_not_exist():
    path = road()
    planner = planner_on(path, detection_range_m=20.0)
    far = CAR.x_m - 2.2 - OUTLINE.front_m - 20.0
    for x, is_seen in ((far - 0.5, False), (far + 0.5, True)):
        planner.reset()
        planner.horizon(np.array((16.0, 0, 0, x, 0.0, 0.0)), PERIOD_S, [CAR])
        assert bool(planner.decision.passed or planner.decision.blockers) is is_seen


def test_safe_distances_change_while_driving():
    planner, state = planner_on(road()), np.array((16.0, 0, 0, 20.0, 0.0, 0.0))
    targets = []
    for options in (PlannerOptions(safe_lateral_m=0.3), PlannerOptions(safe_lateral_m=1.2)):
        planner.options = options
        planner.horizon(state, PERIOD_S, [CAR])
        targets.append(planner.decision.shift.at(80.0).offset_m)
    assert targets[1] - targets[0] == pytest.approx(0.9, abs=0.01)
    planner.options = PlannerOptions(safe_time_s=0.2)
    planner.reset()
    planner.horizon(state, PERIOD_S, [CAR])
    assert planner.decision.shift.at(57.0).offset_m < targets[1]


def test_the_corridor_of_the_horizon_ends_at_the_object():
    planner = planner_on(road())
    for x in np.arange(20.0, 76.0, 0.64):
        horizon = planner.horizon(np.array((16.0, 0, 0, x, planner.decision.shift.at(x).offset_m, 0.0)), PERIOD_S, [CAR])
    beside = horizon.reference[:, 3] < 84.0
    lowest = horizon.reference[beside, 4] - horizon.right_m[beside]
    np.testing.assert_allclose(lowest, 0.9 + OUTLINE.half_width_m + 0.4, atol=1e-3)
    np.testing.assert_allclose(horizon.reference[:, 4] + horizon.left_m, 5.0, atol=1e-9)


def test_a_bend_is_no_reason_to_touch():
    path = road(speed_mps=8.0, left_m=3.5, right_m=1.5, curvature=1 / 30, length_m=140.0)
    x, y, yaw = (float(np.interp(50.0, path.arc_length_m, values)) for values in (path.x_m, path.y_m, path.yaw_rad))
    done = drive(planner_on(path), path, [replace(CAR, x_m=x, y_m=y, yaw_rad=yaw)], 15.0)
    assert done.clearance_m >= 0.35
    assert (done.states[:, 0] == 8.0).all()


def test_what_is_no_object_is_ignored_and_counted():
    planner, state = planner_on(road()), np.array((16.0, 0, 0, 20.0, 0.0, 0.0))
    empty = planner.horizon(state, PERIOD_S)
    horizon = planner.horizon(state, PERIOD_S, [replace(CAR, x_m=math.nan), replace(CAR, width_m=-1.0)])
    np.testing.assert_array_equal(horizon.reference, empty.reference)
    assert planner.objects_ignored == 2


def test_objects_need_the_outline_of_the_car():
    planner = Planner(road(), VEHICLE.model, OcpOptions(), PlannerOptions())
    with pytest.raises(ValueError, match="outline"):
        planner.horizon(np.array((16.0, 0, 0, 20.0, 0.0, 0.0)), PERIOD_S, [CAR])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"safe_time_s": -0.1}, "safe_time_s = -0.1: allowed: 0 to 5"),
        ({"safe_lateral_m": math.nan}, "safe_lateral_m = nan: allowed: 0 to 5"),
        ({"detection_range_m": "far"}, "detection_range_m = 'far': allowed: 0 to 200"),
        ({"safe_longitudinal_m": True}, "safe_longitudinal_m = True: allowed"),
        ({"acceleration_mps2": 3.0, "hardest_deceleration_mps2": 2.5}, "acceleration_mps2 = 3: allowed: at most hardest_deceleration_mps2"),
    ],
)
def test_a_number_out_of_range_is_refused_in_one_line(change, named):
    with pytest.raises(PlannerError, match=named) as caught:
        PlannerOptions(**change)
    assert "\n" not in str(caught.value)


boxes = st.builds(
    *(Obstacle, st.sampled_from("abc"), st.floats(75.0, 150.0), st.floats(-3.0, 4.0), st.floats(-0.3, 0.3)),
    *(st.floats(0.5, 6.0), st.floats(0.5, 3.0)),
)


@DRIVES
@given(st.lists(boxes, min_size=1, max_size=3, unique_by=lambda o: o.name), st.floats(4.0, 16.0), st.floats(1.0, 5.0), st.floats(1.0, 5.0))
def test_standing_objects_are_passed_or_stopped_for_and_never_touched(things, speed_mps, left_m, right_m):
    path = road(speed_mps, left_m, right_m)
    done = drive(planner_on(path), path, things, min(200.0 / speed_mps, 25.0))
    assert done.clearance_m > 0.0
    assert_corridors_are_open(done)
    assert_is_smooth(done)
    for state, blockers in zip(done.states, done.blockers, strict=True):
        assert -right_m - 0.02 <= state[4] <= left_m + 0.02
        assert state[0] > 0.0 or blockers


@DRIVES
@given(st.floats(40.0, 60.0), st.floats(-2.0, 3.5), st.floats(1.0, 12.0), st.floats(6.0, 16.0))
def test_moving_objects_are_passed_or_followed_and_never_touched(x_m, y_m, slow_mps, speed_mps):
    path = road(speed_mps, 4.5, 1.5, length_m=500.0)
    done = drive(planner_on(path), path, [replace(CAR, x_m=x_m, y_m=y_m, vx_mps=min(slow_mps, speed_mps))], 16.0)
    assert done.clearance_m > 0.0
    assert_corridors_are_open(done)
    assert_is_smooth(done)


@DRIVES
@given(st.lists(boxes, min_size=1, max_size=3, unique_by=lambda o: o.name), st.floats(1.5, 5.0), st.floats(1.5, 5.0))
def test_a_mirrored_world_gives_the_mirrored_answer(things, left_m, right_m):
    assume(abs(left_m - right_m) > 0.1 and all(abs(o.y_m) > 0.1 for o in things))  # of two ways alike both worlds take the left
    mirrored = [replace(o, y_m=-o.y_m, yaw_rad=-o.yaw_rad) for o in things]
    answers = []
    for objects, left, right in ((things, left_m, right_m), (mirrored, right_m, left_m)):
        planner = planner_on(road(12.0, left, right))
        answers.append((planner.horizon(np.array((12.0, 0, 0, 55.0, 0.0, 0.0)), PERIOD_S, objects), planner.decision))
    (one, decision), (other, opposite) = answers
    sides = [{m.track.name: int(g.sides[m.track.name]) for m, g in d.passed} for d in (decision, opposite)]
    assert sides[1] == {name: -side for name, side in sides[0].items()}
    np.testing.assert_allclose(other.reference * (1, 1, 1, 1, -1, -1), one.reference, atol=1e-9)
    np.testing.assert_allclose(other.left_m, one.right_m, atol=1e-9)
    np.testing.assert_allclose(other.right_m, one.left_m, atol=1e-9)


@DRIVES
@given(st.integers(0, 10_000), st.floats(-1.0, 1.0))
@example(1, 0.0)
def test_noise_on_an_object_does_not_change_the_side(seed, y_m):
    path = road(right_m=5.0)
    done = drive(planner_on(path), path, [replace(CAR, y_m=y_m)], 9.0, noise_m=0.1, seed=seed)
    assert len({int(side) for sides in done.sides for side in sides.values()}) == 1
    assert not any(done.blockers)
    assert done.clearance_m > 0.2
