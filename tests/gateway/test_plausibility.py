"""Plausibility: honest signals of a driving car say nothing, and every lie is found in time."""

import math
import random
from dataclasses import replace
from itertools import pairwise

import pytest

from dbc.vehicle import load_vehicle
from gateway.causes import Cause, Finding
from gateway.codec import Measurement
from gateway.limits import Demand
from gateway.plausibility import Plausibility

pytestmark = pytest.mark.req("F8")

CAR = load_vehicle()
RADIUS_M = CAR.model.wheel_radius_m
MS = 1_000_000
TICK_NS = 10 * MS
BEGIN_MS = 500_000
DETECTION_NS = 200 * MS


class Drive:
    """A car that weaves at a constant speed; `lie` changes what is measured from the time on at which it is set.

    The robot follows its demand after 40 ms. Nothing is random: noise has its own test.
    """

    def __init__(self, speed_mps=15.0, *, is_driving=True, is_on_lift=False, steering_rad=1.0, turn_radps=0.3):
        self.speed_mps, self.is_driving = speed_mps, is_driving
        self.steering_rad, self.turn_radps = steering_rad, turn_radps
        self.plausibility = Plausibility(CAR, is_on_lift=is_on_lift)
        self.now_ns = 10_000 * MS
        self.tick = 0
        self.x_m = self.y_m = self.yaw_rad = 0.0
        self.demands = [0.0] * 5
        self.lie = lambda m: None
        self.found = []

    def measurement(self):
        t_s = self.tick * 0.01
        yaw_rate = self.turn_radps * math.sin(1.3 * t_s)
        self.yaw_rad += yaw_rate * 0.01
        self.x_m += self.speed_mps * math.cos(self.yaw_rad) * 0.01
        self.y_m += self.speed_mps * math.sin(self.yaw_rad) * 0.01
        return Measurement(
            x_m=self.x_m, y_m=self.y_m, yaw_rad=math.remainder(self.yaw_rad, math.tau), vx_mps=self.speed_mps, yaw_rate_radps=yaw_rate,
            navigation_time_ms=BEGIN_MS + 10 * self.tick, steering_wheel_rad=self.demands[-5],
            wheel_speed_radps=(self.speed_mps / RADIUS_M,) * 4,
        )  # fmt: skip

    def step(self, count=1):
        for _ in range(count):
            self.tick += 1
            self.now_ns += TICK_NS
            measurement = self.measurement()
            self.demands.append(self.steering_rad * math.sin(3.0 * self.tick * 0.01))
            self.lie(measurement)
            self.found = self.plausibility.update(self.now_ns, measurement, Demand(self.demands[-1], 0.0, 0.0), self.is_driving)
            if self.found:
                break
        return self

    def until_found(self, limit_ns=1_000 * MS):
        """Time from the first measurement with the lie to what is found."""
        begin_ns = self.now_ns + TICK_NS
        self.step(limit_ns // TICK_NS)
        assert self.found, "nothing found"
        return self.now_ns - begin_ns

    @property
    def causes(self):
        return [finding.cause for finding in self.found]


def freeze(*names):
    """A lie: these stay what they were."""
    kept = {}

    def lie(m):
        for name in names:
            setattr(m, name, kept.setdefault(name, getattr(m, name)))

    return lie


def shift(name, amount):
    """A lie: this is off by an amount."""

    def lie(m):
        value = getattr(m, name)
        setattr(m, name, tuple(v + amount for v in value) if isinstance(value, tuple) else value + amount)

    return lie


NAVIGATION = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps")


def braking(drive, deceleration_mps2, slip, *, is_pressed=True, is_frozen=False):
    """What is measured while the wheels of a car that slows down are slower than it is."""
    frozen_mps = drive.speed_mps

    def lie(m):
        drive.speed_mps = max(drive.speed_mps - 0.01 * deceleration_mps2, 0.0)
        m.wheel_speed_radps = ((1.0 - slip) * m.vx_mps / RADIUS_M,) * 4
        m.brake_pedal_norm = 1.0 if is_pressed else 0.0
        m.vx_mps = frozen_mps if is_frozen else m.vx_mps

    return lie


# ---- honest signals


@pytest.mark.parametrize(("deceleration_mps2", "slip"), [(10.0, 0.12), (9.0, 0.25), (3.0, 0.25), (1.0, 0.29)])
def test_an_anti_lock_brake_is_no_fault_of_a_sensor(deceleration_mps2, slip):
    drive = Drive(34.0, is_driving=False, turn_radps=0.0).step(50)
    drive.lie = braking(drive, deceleration_mps2, slip)
    assert not drive.step(300).found


def test_a_robot_that_brakes_excuses_slip_as_a_foot_does():
    drive = Drive(34.0, is_driving=False, turn_radps=0.0).step(50)
    pressed = braking(drive, 9.0, 0.2, is_pressed=False)

    def lie(m):
        pressed(m)
        m.brake_norm = 0.06

    drive.lie = lie
    assert not drive.step(300).found


@pytest.mark.parametrize("speed_mps", [0.0, 0.3, 2.0, 15.0, 36.0, -2.0])
def test_an_honest_car_says_nothing(speed_mps):
    drive = Drive(speed_mps).step(2_000)
    assert drive.tick == 2_000
    assert not drive.found


def test_the_heading_comes_round():
    drive, headings = Drive(turn_radps=3.0), []
    drive.lie = lambda m: headings.append(m.yaw_rad)
    drive.step(2_000)
    assert not drive.found
    assert max(abs(b - a) for a, b in pairwise(headings)) > 6.0


@pytest.mark.parametrize("lost", [("x_m", "y_m"), ("yaw_rad",), ("steering_wheel_rad",), ("wheel_speed_radps",), ("vx_mps",)])
def test_two_lost_frames_in_a_row_say_nothing(lost):
    drive, rng = Drive(36.0, steering_rad=3.0), random.Random(2)
    drive.step(50)
    for _ in range(200):
        drive.lie = freeze(*lost)
        drive.step(2)
        drive.lie = lambda m: None
        drive.step(rng.randrange(3, 12))
        assert not drive.found, drive.found


def test_noise_says_nothing():
    drive, rng = Drive(), random.Random(1)

    def noise(m):
        m.x_m += rng.gauss(0.0, 0.005)
        m.y_m += rng.gauss(0.0, 0.005)
        m.yaw_rad += rng.gauss(0.0, 0.0004)
        m.vx_mps += rng.gauss(0.0, 0.05)
        m.yaw_rate_radps += rng.gauss(0.0, 0.002)
        m.steering_wheel_rad += rng.gauss(0.0, 0.002)
        m.wheel_speed_radps = tuple(w + rng.gauss(0.0, 0.5) for w in m.wheel_speed_radps)

    drive.lie = noise
    drive.step(3_000)
    assert not drive.found


def test_nothing_is_judged_before_the_navigation_system_speaks():
    drive = Drive()
    drive.lie = lambda m: (setattr(m, "navigation_time_ms", -1), shift("wheel_speed_radps", 99.0)(m), shift("x_m", 99.0 * drive.tick)(m))
    drive.step(100)
    assert not drive.found
    drive.lie = lambda m: None
    drive.step(100)
    assert not drive.found


def test_its_first_time_may_be_zero():
    drive = Drive()
    drive.lie = lambda m: (setattr(m, "navigation_time_ms", 10 * (drive.tick - 1)), shift("wheel_speed_radps", 99.0)(m))
    assert drive.until_found() == 100 * MS


@pytest.mark.parametrize("speed_mps", [3.0, 36.0])
def test_a_time_may_come_before_its_position(speed_mps):
    """The frames of a solution may fall into two steps of the gateway."""
    plausibility = Plausibility(CAR)
    for k in range(200):
        m = Measurement(
            x_m=speed_mps * 0.02 * ((k - 1) // 2), vx_mps=speed_mps, navigation_time_ms=BEGIN_MS + 20 * (k // 2),
            wheel_speed_radps=(speed_mps / RADIUS_M,) * 4,
        )  # fmt: skip
        assert not plausibility.update(k * TICK_NS, m, Demand(0.0, 0.0, 0.0), False)


# ---- speed


@pytest.mark.parametrize(
    "changes",
    [
        {"slip": 0.31},  # more than an anti-lock brake lets happen
        {"is_pressed": False},
        {"deceleration_mps2": 0.4},  # on no road are brakes as weak as that
    ],
)
def test_slip_has_to_be_that_of_brakes(changes):
    drive = Drive(34.0, is_driving=False, turn_radps=0.0).step(50)
    drive.lie = braking(drive, **{"deceleration_mps2": 5.0, "slip": 0.2} | changes)
    drive.step(300)
    assert drive.causes == [Cause.SPEED_IMPLAUSIBLE]
    assert drive.found[0].limit == pytest.approx(max(2.0, 0.3 * drive.speed_mps) if "slip" in changes else 2.0, rel=0.05)


@pytest.mark.parametrize(("brake_norm", "slower_mps", "is_excused"), [(0.06, 0.07, True), (0.05, 0.07, False), (0.06, 0.0625, False)])
def test_what_excuses_slip_exactly(brake_norm, slower_mps, is_excused):
    """One step of the speed, which is remembered for 100 ms: as long as slip is tolerated anyway."""
    drive = Drive(16.0, is_driving=False, turn_radps=0.0).step(50)

    def lie(m):
        m.vx_mps = 16.0 - slower_mps
        m.wheel_speed_radps = (13.0 / RADIUS_M,) * 4
        m.brake_norm = brake_norm

    drive.lie = lie
    assert drive.until_found() == (200 * MS if is_excused else 100 * MS)


def test_brakes_make_no_wheel_faster():
    drive = Drive(34.0, is_driving=False, turn_radps=0.0).step(50)
    drive.lie = braking(drive, 5.0, -0.2)
    assert drive.until_found() == 100 * MS
    assert drive.causes == [Cause.SPEED_IMPLAUSIBLE]


def test_a_speed_that_is_frozen_is_no_slip():
    drive = Drive(20.0, is_driving=False, turn_radps=0.0).step(50)
    drive.lie = braking(drive, 8.0, 0.0, is_frozen=True)
    assert drive.until_found() <= 360 * MS  # after 250 ms the difference is 2 m/s
    assert drive.causes == [Cause.SPEED_IMPLAUSIBLE]


@pytest.mark.parametrize(("jump_mps", "is_found"), [(2.51, True), (-2.51, True), (2.49, False), (-2.49, False)])
def test_no_car_changes_its_speed_at_once(jump_mps, is_found):
    """The wheels jump with it."""
    drive = Drive().step(50)
    both = shift("vx_mps", jump_mps), shift("wheel_speed_radps", jump_mps / RADIUS_M)
    drive.lie = lambda m: [lie(m) for lie in both]
    drive.step(20)
    if is_found:
        assert drive.found == [Finding(Cause.SPEED_IMPLAUSIBLE, pytest.approx(2.51), 2.5, "navigation")]
        assert drive.tick == 50 + 4
    else:
        assert not drive.found


@pytest.mark.parametrize("speed_mps", [0.0, 15.0, 36.0, -3.0])
@pytest.mark.parametrize(("wrong_mps", "is_found"), [(2.001, True), (-2.001, True), (1.999, False), (-1.999, False)])
def test_speeds_of_wheels_and_navigation(speed_mps, wrong_mps, is_found):
    drive = Drive(speed_mps).step(30)
    drive.lie = shift("wheel_speed_radps", wrong_mps / RADIUS_M)
    drive.step(9)
    assert not drive.found
    drive.step(2)
    assert drive.causes == ([Cause.SPEED_IMPLAUSIBLE] if is_found else [])
    if is_found:
        assert drive.tick == 41  # the eleventh: 100 ms
        assert drive.found == [Finding(Cause.SPEED_IMPLAUSIBLE, pytest.approx(2.001), 2.0, "wheels")]


def test_a_speed_of_the_navigation_system_that_is_off():
    drive = Drive().step(30)
    drive.lie = shift("vx_mps", 2.5)
    assert drive.until_found() == 100 * MS
    assert drive.causes == [Cause.SPEED_IMPLAUSIBLE]


@pytest.mark.parametrize(
    ("wheels", "is_found"), [((0, 0, 0, 60), False), ((0, 0, 0, -60), False), ((0, 0, 14, 14), True), ((0, 0, -14, -14), True)]
)
def test_one_wheel_may_slip_or_fail(wheels, is_found):
    drive = Drive().step(30)
    drive.lie = lambda m: setattr(m, "wheel_speed_radps", tuple(a + b for a, b in zip(m.wheel_speed_radps, wheels, strict=True)))
    drive.step(30)
    assert bool(drive.found) is is_found


def test_a_car_is_on_the_road_unless_somebody_says_otherwise():
    plausibility = Plausibility(CAR)
    m = Measurement(navigation_time_ms=BEGIN_MS, wheel_speed_radps=(50.0,) * 4)
    assert [bool(plausibility.update(k * TICK_NS, m, Demand(0.0, 0.0, 0.0), False)) for k in range(11)] == [False] * 10 + [True]


def test_a_moment_of_slip_says_nothing():
    drive = Drive().step(30)
    for _ in range(10):
        drive.lie = shift("wheel_speed_radps", 30.0)
        drive.step(10)
        drive.lie = lambda m: None
        drive.step(1)
    assert not drive.found


def test_on_a_lift_the_wheels_say_nothing_about_the_speed():
    drive = Drive(is_on_lift=True).step(30)
    drive.lie = shift("wheel_speed_radps", -50.0)
    drive.step(100)
    assert not drive.found
    drive.lie = shift("x_m", 3.0)
    assert drive.until_found() == 30 * MS


# ---- position and heading


@pytest.mark.parametrize(("speed_mps", "limit_m"), [(0.0, 0.2), (2.0, 0.2), (4.0, 0.2), (6.0, 0.3), (-6.0, 0.3), (10.0, 0.5), (36.0, 0.5)])
@pytest.mark.parametrize("axis", ["x_m", "y_m"])
def test_a_jump_of_the_position(speed_mps, limit_m, axis):
    for sign in (1, -1):
        drive = Drive(speed_mps, turn_radps=0.0).step(30)
        drive.lie = shift(axis, sign * (limit_m - 0.001))
        drive.step(30)
        assert not drive.found
        drive = Drive(speed_mps, turn_radps=0.0).step(30)
        drive.lie = shift(axis, sign * (limit_m + 0.001))
        assert drive.until_found() == 30 * MS
        assert drive.found == [Finding(Cause.POSITION_IMPLAUSIBLE, pytest.approx(limit_m + 0.001), pytest.approx(limit_m), "navigation")]


def test_a_jump_is_forgotten_after_the_window():
    drive = Drive().step(30)
    drive.lie = shift("x_m", 5.0)
    drive.step(4)
    assert drive.found
    drive.step(1)
    assert drive.found
    for _ in range(5):
        drive.step(1)
    assert drive.found  # 100 ms after the last measurement without it
    drive.step(1)
    assert not drive.found
    drive.step(100)
    assert not drive.found


@pytest.mark.parametrize("speed_mps", [2.5, 5.0, 10.0, 22.0, 36.0])
@pytest.mark.parametrize("frozen", [("x_m", "y_m"), NAVIGATION])
def test_a_position_that_stands_still(speed_mps, frozen):
    for tick in range(30, 160, 13):
        drive = Drive(speed_mps).step(tick)
        drive.lie = freeze(*frozen)
        assert drive.until_found() <= DETECTION_NS
        assert set(drive.causes) <= {Cause.POSITION_IMPLAUSIBLE, Cause.YAW_RATE_IMPLAUSIBLE}


def test_a_position_that_wanders_off_sideways():
    drive = Drive().step(30)
    drive.lie = lambda m: setattr(m, "vy_mps", 6.0)
    assert drive.until_found() <= DETECTION_NS
    assert drive.causes == [Cause.POSITION_IMPLAUSIBLE]


def test_lateral_speed_counts_to_the_left():
    """A car that slides: position, speed and lateral speed agree at every heading."""
    drive = Drive(turn_radps=3.0)
    slid = [0.0, 0.0]

    def slide(m):
        m.vy_mps = 8.0
        slid[0] -= 0.08 * math.sin(m.yaw_rad)
        slid[1] += 0.08 * math.cos(m.yaw_rad)
        m.x_m += slid[0]
        m.y_m += slid[1]

    drive.lie = slide
    drive.step(1_000)
    assert not drive.found


@pytest.mark.parametrize(("jump_rad", "is_found"), [(0.0101, True), (-0.0101, True), (0.0099, False), (-0.0099, False), (0.3, True)])
def test_a_jump_of_the_heading(jump_rad, is_found):
    drive = Drive(turn_radps=0.0).step(30)
    drive.lie = shift("yaw_rad", jump_rad)
    drive.step(30)
    assert Cause.YAW_RATE_IMPLAUSIBLE in drive.causes if is_found else not drive.found
    if is_found:
        assert drive.tick == 34  # 30 ms after the first with the lie
        found = next(finding for finding in drive.found if finding.cause is Cause.YAW_RATE_IMPLAUSIBLE)
        assert (found.value, found.limit, found.source) == (pytest.approx(abs(jump_rad) * 10), 0.1, "navigation")


@pytest.mark.parametrize("wrong_radps", [0.101, -0.101, 0.5])
def test_a_yaw_rate_that_is_off(wrong_radps):
    drive = Drive(turn_radps=0.0).step(30)
    drive.lie = shift("yaw_rate_radps", wrong_radps)
    assert drive.until_found() <= DETECTION_NS
    assert drive.causes == [Cause.YAW_RATE_IMPLAUSIBLE]
    drive = Drive(turn_radps=0.0).step(30)
    drive.lie = shift("yaw_rate_radps", math.copysign(0.099, wrong_radps))
    drive.step(100)
    assert not drive.found


def test_a_heading_that_stands_still_in_a_bend():
    drive = Drive().step(60)
    drive.lie = freeze("yaw_rad")
    assert drive.until_found() <= DETECTION_NS
    assert drive.causes == [Cause.YAW_RATE_IMPLAUSIBLE]


@pytest.mark.parametrize(
    ("gap_ms", "is_judged"), [(1, True), (10, True), (100, True), (101, False), (5_000, False), (0, False), (-1, False), (-5_000, False)]
)
def test_after_a_gap_in_the_navigation_time_it_begins_anew(gap_ms, is_judged):
    plausibility, now_ns, found = Plausibility(CAR), 10_000 * MS, []
    for k in range(36):
        is_moved = k >= 30  # then the time stands still, so that what was found stays
        time_ms = BEGIN_MS + (290 + gap_ms if is_moved else 10 * k)
        m = Measurement(x_m=50.0 * is_moved, yaw_rad=1.0 * is_moved, navigation_time_ms=time_ms)
        found += plausibility.update(now_ns + k * TICK_NS, m, Demand(0.0, 0.0, 0.0), False)
    assert {finding.cause for finding in found} == ({Cause.POSITION_IMPLAUSIBLE, Cause.YAW_RATE_IMPLAUSIBLE} if is_judged else set())


def test_a_slow_navigation_system_is_judged_by_its_own_time():
    plausibility, now_ns = Plausibility(CAR), 10_000 * MS
    for k in range(200):
        new = k - k % 5  # every 50 ms
        m = Measurement(
            vx_mps=20.0, yaw_rad=0.002 * new, yaw_rate_radps=0.2, navigation_time_ms=10 * new, wheel_speed_radps=(20.0 / RADIUS_M,) * 4
        )
        m.x_m, m.y_m = 100.0 * math.sin(0.002 * new), 100.0 * (1.0 - math.cos(0.002 * new))
        assert not plausibility.update(now_ns + k * TICK_NS, m, Demand(0.0, 0.0, 0.0), False)


def test_exactly_the_limit_is_allowed():
    plausibility, now_ns = Plausibility(CAR), 10_000 * MS
    at_limits = Measurement(steering_wheel_rad=0.05, brake_pedal_norm=0.05, accelerator_pedal_norm=0.05)
    for k in range(60):
        m = replace(at_limits, x_m=0.2 * (k >= 30), navigation_time_ms=BEGIN_MS + 10 * k)
        assert not plausibility.update(now_ns + k * TICK_NS, m, Demand(0.0, 0.0, 0.0), True)


# ---- steering


STEERING_LIMIT_RADPS = 1.25 * CAR.robots.steering.rate_limit_radps


def steps_of_the_angle(*angles, ticks=1, is_driving=False):
    """What is found when the angle takes these values, one every `ticks` ticks."""
    plausibility, now_ns, found = Plausibility(CAR), 10_000 * MS, []
    for angle in angles:
        for _ in range(ticks):
            now_ns += TICK_NS
            found += plausibility.update(now_ns, Measurement(steering_wheel_rad=angle), Demand(0.0, 0.0, 0.0), is_driving)
    return found


@pytest.mark.parametrize("sign", [1, -1])
def test_an_angle_that_moves_impossibly_fast_is_found_at_once(sign):
    step_rad = STEERING_LIMIT_RADPS * 0.01
    assert steps_of_the_angle(0.0, sign * (step_rad - 1e-6)) == []
    assert steps_of_the_angle(0.0, sign * (step_rad + 1e-6)) == [
        Finding(Cause.STEERING_IMPLAUSIBLE, pytest.approx(STEERING_LIMIT_RADPS, rel=1e-4), pytest.approx(34.875), "SR")
    ]
    assert len(steps_of_the_angle(0.0, sign, 0.0, sign)) == 3
    exactly_rad = STEERING_LIMIT_RADPS * 0.02
    assert exactly_rad / 0.02 == STEERING_LIMIT_RADPS
    assert steps_of_the_angle(0.0, sign * exactly_rad, ticks=2) == []


def test_the_first_angle_is_no_step():
    assert steps_of_the_angle(5.0, 5.0) == []
    assert len(steps_of_the_angle(5.0, 0.0)) == 1


@pytest.mark.parametrize(("ticks", "factor"), [(1, 1), (2, 2), (3, 3), (4, 3), (50, 3)])
def test_an_angle_that_stood_still_may_have_lost_two_frames(ticks, factor):
    step_rad = STEERING_LIMIT_RADPS * 0.01 * factor
    assert steps_of_the_angle(0.0, step_rad - 1e-6, ticks=ticks) == []
    assert len(steps_of_the_angle(0.0, step_rad + 1e-6, ticks=ticks)) == 1


def test_two_steps_of_the_gateway_at_once_are_one_cycle():
    plausibility = Plausibility(CAR)
    step_rad = STEERING_LIMIT_RADPS * 0.01
    plausibility.update(0, Measurement(steering_wheel_rad=0.0), Demand(0.0, 0.0, 0.0), False)
    assert not plausibility.update(1, Measurement(steering_wheel_rad=step_rad - 1e-6), Demand(0.0, 0.0, 0.0), False)
    assert not plausibility.update(1, Measurement(steering_wheel_rad=0.0), Demand(0.0, 0.0, 0.0), False)
    assert plausibility.update(2, Measurement(steering_wheel_rad=step_rad + 1e-6), Demand(0.0, 0.0, 0.0), False)


def following(error_rad, *, demand_rad=0.5, demand_ticks=30):
    """What is found in each tick when the wheel is beside a demand that has been there for long."""
    plausibility, now_ns = Plausibility(CAR), 10_000 * MS
    for _ in range(demand_ticks):
        now_ns += TICK_NS
        plausibility.update(now_ns, Measurement(steering_wheel_rad=demand_rad), Demand(demand_rad, 0.0, 0.0), True)
    found = []
    for _ in range(12):
        now_ns += TICK_NS
        beside = Measurement(steering_wheel_rad=demand_rad + error_rad)
        found.append(plausibility.update(now_ns, beside, Demand(demand_rad, 0.0, 0.0), True))
    return found


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wheel_beside_everything_demanded(sign):
    assert not any(following(sign * 0.0499))
    found = following(sign * 0.0501)
    assert not any(found[:5])
    assert found[5] == [Finding(Cause.STEERING_NOT_FOLLOWING, pytest.approx(0.0501), 0.05, "SR")]  # 50 ms after the first


def test_every_demand_of_the_last_120_ms_may_still_be_followed():
    plausibility, now_ns, found = Plausibility(CAR), 10_000 * MS, []
    for k in range(60):
        now_ns += TICK_NS
        demand = Demand(0.0 if k < 30 else 0.5, 0.0, 0.0)  # the wheel stays where it was
        found.append(plausibility.update(now_ns, Measurement(steering_wheel_rad=0.0), demand, True))
    # The last demand of 0 is that of tick 29; until tick 41 it counts, and then come 50 ms.
    assert next(k for k, findings in enumerate(found) if findings) == 42 + 5
    assert found[47][0].value == pytest.approx(0.5)


def test_slower_robots_have_more_time():
    steering = CAR.robots.steering.model_copy(update={"dead_time_s": 0.08})
    slow = CAR.model_copy(update={"robots": CAR.robots.model_copy(update={"steering": steering})})
    plausibility, now_ns, found = Plausibility(slow), 10_000 * MS, []
    for k in range(60):
        now_ns += TICK_NS
        found.append(plausibility.update(now_ns, Measurement(), Demand(0.0 if k < 30 else 0.5, 0.0, 0.0), True))
    assert next(k for k, findings in enumerate(found) if findings) == 48 + 5


@pytest.mark.parametrize("at_tick", range(30, 240, 7))
def test_a_frozen_steering_angle_while_the_demand_moves(at_tick):
    drive = Drive(steering_rad=3.0).step(at_tick)
    drive.lie = freeze("steering_wheel_rad")
    kept = drive.demands[-4]
    found_ns = drive.until_found()
    assert drive.causes == [Cause.STEERING_NOT_FOLLOWING]
    # 120 ms and 50 ms after the first demand that is more than 0.05 rad beside the frozen angle for good.
    since_fault = drive.demands[-(found_ns // TICK_NS + 1) :]
    differs_ns = next(k for k in range(len(since_fault)) if all(abs(d - kept) > 0.05 for d in since_fault[k : k + 12])) * TICK_NS
    assert found_ns - differs_ns <= DETECTION_NS


def test_a_robot_is_to_follow_only_while_driving():
    drive = Drive(is_driving=False, steering_rad=3.0).step(30)
    drive.lie = freeze("steering_wheel_rad")
    drive.step(100)
    assert not drive.found
    drive.is_driving = True
    assert drive.until_found() >= 50 * MS


def test_what_was_demanded_before_driving_counts():
    """An engagement with a moving wheel: the robot is behind demands that were there before anything is judged."""
    drive = Drive(is_driving=False, steering_rad=3.0).step(60)
    drive.is_driving = True
    drive.step(300)
    assert not drive.found


# ---- the driver's feet


@pytest.mark.req("E3")
@pytest.mark.parametrize(
    ("pedal", "cause"),
    [("brake", Cause.DRIVER_BRAKES), ("accelerator", Cause.DRIVER_ACCELERATES)],
)
@pytest.mark.parametrize("robot_norm", [0.0, 0.4])
def test_a_foot_that_is_deeper_than_the_robot(pedal, cause, robot_norm):
    def press(deeper_norm):
        return lambda m: (setattr(m, f"{pedal}_norm", robot_norm), setattr(m, f"{pedal}_pedal_norm", robot_norm + deeper_norm))

    drive = Drive().step(30)
    drive.lie = press(0.0499)
    drive.step(50)
    assert not drive.found
    drive.lie = press(-0.3)  # the robot is deeper: a lost frame, no foot
    drive.step(50)
    assert not drive.found
    drive.lie = press(0.0501)
    assert drive.until_found() == 100 * MS
    assert drive.found == [Finding(cause, pytest.approx(0.0501), 0.05, "CAR_Powertrain")]


def test_both_feet():
    drive = Drive().step(30)
    drive.lie = lambda m: (setattr(m, "brake_pedal_norm", 0.5), setattr(m, "accelerator_pedal_norm", 0.5))
    drive.until_found()
    assert drive.causes == [Cause.DRIVER_BRAKES, Cause.DRIVER_ACCELERATES]


@pytest.mark.parametrize("name", ["brake_pedal_norm", "accelerator_pedal_norm"])
def test_feet_count_only_while_driving_and_from_then_on(name):
    drive = Drive(is_driving=False).step(30)
    drive.lie = shift(name, 0.5)
    drive.step(100)
    assert not drive.found
    drive.is_driving = True
    drive.step(9)
    assert not drive.found
    drive.is_driving = False
    drive.step(1)
    drive.is_driving = True
    assert drive.until_found() == 100 * MS


# ---- several at once


def test_findings_of_the_same_tick_come_together():
    drive = Drive().step(30)
    drive.lie = lambda m: (shift("wheel_speed_radps", 20.0)(m), shift("steering_wheel_rad", 5.0 * (drive.tick == 41))(m))
    drive.step(11)
    assert drive.causes == [Cause.STEERING_IMPLAUSIBLE, Cause.SPEED_IMPLAUSIBLE]


def test_findings_come_together():
    drive = Drive().step(30)
    drive.lie = lambda m: (shift("wheel_speed_radps", 20.0)(m), shift("brake_pedal_norm", 0.5)(m))
    assert drive.until_found() == 100 * MS
    assert drive.causes == [Cause.SPEED_IMPLAUSIBLE, Cause.DRIVER_BRAKES]


@pytest.mark.req("F6", "E3")
@pytest.mark.parametrize(
    ("pedal", "demand", "cause"),
    [
        ("brake_pedal_norm", Demand(0.0, 0.0, 0.1), Cause.DRIVER_BRAKES),
        ("accelerator_pedal_norm", Demand(0.0, 0.1, 0.0), Cause.DRIVER_ACCELERATES),
    ],
)
def test_a_pedal_that_the_gateway_presses_is_no_foot_even_when_the_robot_denies_it(pedal, demand, cause):
    judge, measured = Plausibility(CAR), Measurement(**{pedal: 0.1})

    def until(now_ms, start_ms, asked):
        found = [judge.update(t_ms * 1_000_000, measured, asked, is_driving=True) for t_ms in range(start_ms, now_ms, 10)]
        return [finding.cause for findings in found for finding in findings]

    assert cause not in until(1_000, 0, demand)
    assert cause not in until(1_400, 1_000, Demand(0.0, 0.0, 0.0))  # 300 ms since it was asked for last, 100 ms of patience
    assert cause in until(1_410, 1_400, Demand(0.0, 0.0, 0.0))
