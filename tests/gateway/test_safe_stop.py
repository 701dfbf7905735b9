"""The stop that the gateway drives by itself: deceleration, steering, standstill."""

import math

import pytest

from gateway.limits import COMFORT_STOP, EMERGENCY_STOP, StopGrade
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS, CommandStatus, ControlCommand
from gateway.safe_stop import SafeStop, StopDemand, plan_index

pytestmark = pytest.mark.req("F1")

START_NS = 7_000_000_000
MS = 1_000_000


def command(t_ns=START_NS, plan=None):
    plan = plan or tuple(0.001 * k for k in range(HORIZON_STEPS))
    return ControlCommand(
        boot_id=1, seq=1, state_seq=1, t_ns=t_ns, status=CommandStatus.OK, solve_time_ns=0, lateral_error_m=0.0, heading_error_rad=0.0,
        steer_rad=plan[0], drive_norm=0.0, plan_steer_rad=plan, plan_drive_norm=(0.0,) * HORIZON_STEPS,
    )  # fmt: skip


def stop(grade=EMERGENCY_STOP, *, start_ns=START_NS, last_command=None, steer_rad=0.02, speed_mps=20.0, deceleration_mps2=0.0):
    return SafeStop(
        start_ns, last_command, grade, steer_rad=steer_rad, speed_mps=speed_mps, deceleration_mps2=deceleration_mps2
    )  # fmt: skip


@pytest.mark.parametrize(
    ("after_ns", "k"),
    [(-1, 0), (-PLAN_PERIOD_NS, 0), (0, 0), (PLAN_PERIOD_NS - 1, 0), (PLAN_PERIOD_NS, 1), (29 * PLAN_PERIOD_NS - 1, 28),
     (29 * PLAN_PERIOD_NS, 29), (30 * PLAN_PERIOD_NS, 29), (10**12, 29)],
)  # fmt: skip
def test_the_entry_of_the_plan_that_holds(after_ns, k):
    assert plan_index(command(), START_NS + after_ns) == k


@pytest.mark.parametrize("grade", [COMFORT_STOP, EMERGENCY_STOP, StopGrade(4.0, 10.0)], ids=str)
def test_the_deceleration_grows_with_the_jerk_of_the_grade_up_to_its_deceleration(grade):
    s, full_s = stop(grade), grade.deceleration_mps2 / grade.jerk_mps3
    for share in (0.0, 0.001, 0.3, 0.999, 1.0, 1.001, 20.0):
        demand = s.demand(START_NS + round(share * full_s * 1e9), 20.0)
        assert demand.deceleration_mps2 == pytest.approx(grade.jerk_mps3 * min(share, 1.0) * full_s, abs=1e-8)
        assert demand.deceleration_mps2 <= grade.deceleration_mps2
        assert not demand.is_standing


def test_a_car_that_brakes_goes_on_from_there():
    s = stop(deceleration_mps2=1.0)
    assert s.demand(START_NS, 20.0).deceleration_mps2 == 1.0
    assert s.demand(START_NS + 500 * MS, 20.0).deceleration_mps2 == pytest.approx(1.75)
    assert s.demand(START_NS + 1_000 * MS, 20.0).deceleration_mps2 == 2.5
    assert s.demand(START_NS + 9_000 * MS, 20.0).deceleration_mps2 == 2.5


def test_a_car_that_brakes_harder_than_the_stop_is_not_let_go():
    s = stop(deceleration_mps2=6.0)
    for after_ms in (0, 100, 5_000):
        assert s.demand(START_NS + after_ms * MS, 20.0).deceleration_mps2 == 6.0


def test_a_car_that_accelerates_begins_without_brakes():
    assert stop(deceleration_mps2=-2.0).demand(START_NS, 20.0).deceleration_mps2 == 0.0
    assert stop(deceleration_mps2=-2.0).demand(START_NS + 1_000 * MS, 20.0).deceleration_mps2 == pytest.approx(1.5)


def test_a_comfort_stop_that_becomes_an_emergency_stop_goes_on_from_its_deceleration():
    comfort = stop(COMFORT_STOP)
    reached_mps2 = comfort.demand(START_NS + 2_000 * MS, 20.0).deceleration_mps2
    assert reached_mps2 == pytest.approx(0.6)
    emergency = stop(start_ns=START_NS + 2_000 * MS, deceleration_mps2=reached_mps2)
    assert emergency.demand(START_NS + 2_000 * MS, 20.0).deceleration_mps2 == pytest.approx(0.6)
    assert emergency.demand(START_NS + 2_010 * MS, 20.0).deceleration_mps2 == pytest.approx(0.615)


def test_steering_follows_the_tail_of_the_plan_and_then_holds_its_end():
    s = stop(last_command=command(), steer_rad=0.5)
    for after_ms, k in ((0, 0), (39, 0), (40, 1), (500, 12), (1_159, 28), (1_160, 29), (1_200, 29), (60_000, 29)):
        assert s.demand(START_NS + after_ms * MS, 20.0).steer_rad == pytest.approx(0.001 * k)


def test_the_plan_is_as_old_as_its_command():
    s = stop(last_command=command(START_NS - 100 * MS))
    assert s.demand(START_NS, 20.0).steer_rad == pytest.approx(0.002)
    assert s.demand(START_NS + 60 * MS, 20.0).steer_rad == pytest.approx(0.004)


def test_without_any_command_the_angle_is_held():
    s = stop(steer_rad=-0.03)
    for after_ms in (0, 1_000, 60_000):
        assert s.demand(START_NS + after_ms * MS, 20.0).steer_rad == -0.03


@pytest.mark.parametrize(
    ("vx_mps", "is_standing"),
    [(0.1, False), (-0.1, False), (math.nextafter(0.1, 0.0), True), (-math.nextafter(0.1, 0.0), True), (0.0, True), (5.0, False)],
)
def test_standstill(vx_mps, is_standing):
    assert stop().demand(START_NS, vx_mps).is_standing is is_standing


def test_a_car_that_has_stood_is_held_whatever_the_speed_says():
    s = stop()
    assert not s.demand(START_NS, 0.2).is_standing
    assert s.demand(START_NS + 10 * MS, 0.0).is_standing
    assert s.demand(START_NS + 20 * MS, 3.0).is_standing


@pytest.mark.parametrize("deceleration_mps2", [-1.0, 0.0, 0.4, 1.0, 3.0])
@pytest.mark.parametrize("grade", [COMFORT_STOP, EMERGENCY_STOP], ids=str)
def test_a_car_that_slows_down_has_lost_half_of_what_was_asked_for(grade, deceleration_mps2):
    s, asked_mps = stop(grade, speed_mps=30.0, deceleration_mps2=deceleration_mps2), 0.0
    for after_ms in range(1, 8_001):
        asked_mps2 = s.demand(START_NS + after_ms * MS - MS // 2, 20.0).deceleration_mps2
        asked_mps += min(asked_mps2, grade.deceleration_mps2) * 1e-3  # one who brakes harder may be on ice
        assert s.allowed_mps(START_NS + after_ms * MS) == pytest.approx(30.0 + 2.0 - 0.5 * asked_mps, abs=1e-6)


def test_a_car_that_stands_is_never_too_fast():
    s = stop(COMFORT_STOP, speed_mps=5.0)
    assert s.allowed_mps(START_NS + 100_000 * MS) == 0.5


def test_a_demand_is_a_value():
    assert stop(steer_rad=0.1).demand(START_NS, 1.0) == StopDemand(steer_rad=0.1, deceleration_mps2=0.0, is_standing=False)
