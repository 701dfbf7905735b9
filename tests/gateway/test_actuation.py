"""The gate: whatever is asked for, the wire keeps every limit to the last bit, and every intervention is told."""

import dataclasses
import math
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.vehicle import FOCUS, load_vehicle
from gateway.actuation import NEUTRAL, UNITS, Activation, Actuation
from gateway.limits import BENCH, NOMINAL, PROFILES, PROVING_GROUND, Demand, Resolution, coarsest, lateral_acceleration_mps2

TICK_NS, TICK_S = 10_000_000, 0.01
CAR = load_vehicle()
CARS = {"focus": CAR, "van": load_vehicle(FOCUS.with_name("van.toml"))}
STEP_DEG = 0.05
EPSILON = 1e-9


def actuation(profile=NOMINAL, *, steer_rad=0.0, accelerator=0.0, brake=0.0):
    gate = Actuation(CAR, profile, TICK_NS, Resolution())
    if steer_rad or accelerator or brake:
        gate.start_from(Demand(steer_rad * CAR.steering.ratio, accelerator, brake))
    return gate


class Wire:
    """What is on the bus, counted in bits, and judged by arithmetic of its own."""

    def __init__(self, profile, car):
        self.profile, self.car = profile, car
        self.wheelbase_m = car.model.cog_to_front_m + car.model.cog_to_rear_m
        self.drive_mps2 = car.pedals.full_drive_force_n / car.model.mass_kg
        self.brake_mps2 = car.pedals.full_brake_force_n / car.model.mass_kg

    def read(self, demand):
        counts = math.degrees(demand.steering_wheel_rad) / STEP_DEG, demand.accelerator_norm * 1e4, demand.brake_norm * 1e4
        assert all(abs(count - round(count)) < 1e-6 for count in counts), "not on the steps of the bus"
        return tuple(map(round, counts))

    def lateral_mps2(self, steps, speed_mps):
        return speed_mps**2 * math.tan(math.radians(steps * STEP_DEG) / self.car.steering.ratio) / self.wheelbase_m

    def judge(self, before, after, speed_mps, *, is_held=False):
        p, (was, was_accelerator, was_brake), (now, accelerator, brake) = self.profile, before, after
        end_deg = math.degrees(min(p.steering_wheel_limit_rad, self.car.steering.road_wheel_limit_rad * self.car.steering.ratio))
        if is_held:
            assert now == was
        elif abs(now) >= abs(was):
            assert abs(now) * STEP_DEG <= end_deg + EPSILON
        assert abs(now - was) * STEP_DEG <= math.degrees(p.steering_wheel_rate_radps) * TICK_S + EPSILON
        if speed_mps >= 1.0:
            is_back = abs(now) < abs(was)
            assert is_back or now == was == 0 or abs(self.lateral_mps2(now, speed_mps)) <= p.lateral_acceleration_mps2 + EPSILON
            change_mps2 = abs(self.lateral_mps2(now, speed_mps) - self.lateral_mps2(was, speed_mps))
            assert change_mps2 <= p.lateral_jerk_mps3 * TICK_S + EPSILON or abs(now - was) == 1
        assert 0 <= accelerator <= 10_000
        assert 0 <= brake <= 10_000
        assert accelerator == 0 or brake == 0
        if accelerator > was_accelerator:
            assert accelerator * 1e-4 * self.drive_mps2 <= p.acceleration_mps2 + EPSILON
            assert was_brake == 0
            assert (accelerator - was_accelerator) * 1e-4 * self.drive_mps2 <= p.drive_jerk_mps3 * TICK_S + EPSILON
        if brake > was_brake:
            assert brake * 1e-4 * self.brake_mps2 <= p.deceleration_mps2 + EPSILON
        assert abs(brake - was_brake) * 1e-4 * self.brake_mps2 <= p.brake_jerk_mps3 * TICK_S + EPSILON


# ---- what passes unchanged


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_what_is_within_every_limit_passes_unchanged(profile):
    gate = actuation(profile)
    for _ in range(100):
        gate.follow(0.001, 0.006, 5.0, 0.0)
    assert gate.steer_rad == pytest.approx(0.001, abs=math.radians(0.5 * STEP_DEG) / 14.7)
    assert gate.demand.accelerator_norm == pytest.approx(0.006, abs=0.5e-4)
    assert gate.demand.brake_norm == 0.0
    assert not gate.limited
    assert not gate.last_limited
    assert (gate.engaged_ticks, gate.held_back_ticks) == (100, 0)


def test_a_brake_demand_becomes_a_brake_pedal():
    gate = actuation(PROVING_GROUND)
    gate.follow(0.0, -0.1, 5.0, 0.0)
    assert gate.demand == Demand(0.0, 0.0, pytest.approx(0.1 * 4838.7 / 15000.0, abs=0.5e-4))
    assert gate.acceleration_mps2 == pytest.approx(-0.1 * 4838.7 / 1500.0, abs=1e-3)


def test_drive_norm_is_the_inverse_of_the_split():
    gate = actuation(PROVING_GROUND)
    for drive_norm in (0.05, -0.05, 0.0):
        gate.release()
        gate.follow(0.0, drive_norm, 5.0, 0.0)
        assert gate.drive_norm(gate.demand.accelerator_norm, gate.demand.brake_norm) == pytest.approx(drive_norm, abs=2e-4)


def test_it_starts_with_nothing_and_releases_to_nothing():
    gate = actuation()
    assert gate.demand == NEUTRAL == Demand(0.0, 0.0, 0.0)
    gate.follow(0.01, 0.5, 5.0, 0.0)
    assert gate.demand != NEUTRAL
    gate.release()
    assert gate.demand == NEUTRAL
    assert (gate.steer_rad, gate.acceleration_mps2) == (0.0, 0.0)


# ---- hand-over


@pytest.mark.parametrize(
    ("measured", "expected"),
    [
        (Demand(0.5, 0.25, 0.0), Demand(0.5, 0.25, 0.0)),
        (Demand(-0.5, 0.0, 0.2), Demand(-0.5, 0.0, 0.2)),
        (Demand(9.9, 1.0, 0.0), Demand(9.9, 1.0, 0.0)),
        (Demand(0.0, 0.0, 1.0), Demand(0.0, 0.0, 1.0)),
        (Demand(0.0, 0.31, 0.1), Demand(0.0, 0.0, 0.1 - 0.31 * 4838.7 / 15000.0)),
    ],
)
def test_a_hand_over_has_no_bump(measured, expected):
    gate = actuation(NOMINAL)
    gate.start_from(measured)
    assert gate.demand.steering_wheel_rad == pytest.approx(expected.steering_wheel_rad, abs=math.radians(0.5 * STEP_DEG))
    assert gate.demand.accelerator_norm == pytest.approx(expected.accelerator_norm, abs=0.5e-4)
    assert gate.demand.brake_norm == pytest.approx(expected.brake_norm, abs=0.5e-4)
    Wire(NOMINAL, CAR).read(gate.demand)


def test_a_hand_over_from_outside_comes_back_at_the_rates():
    gate, wire = actuation(NOMINAL, steer_rad=0.2, brake=0.9), Wire(NOMINAL, CAR)
    before = wire.read(gate.demand)
    for _ in range(800):
        gate.follow(0.2, -1.0, 20.0, 0.0)
        after = wire.read(gate.demand)
        wire.judge(before, after, 20.0)
        assert after[0] <= before[0]
        assert after[2] <= before[2]
        before = after
    assert wire.lateral_mps2(before[0], 20.0) == pytest.approx(3.0, abs=wire.lateral_mps2(1, 20.0))
    assert before[2] * 1e-4 * 10.0 == pytest.approx(4838.7 / 1500.0, abs=1e-3)


@pytest.mark.parametrize(("brake", "reached_mps2"), [(0.3698, -3.5), (0.3699, -3.5), (0.37, -3.5), (0.3701, -3.501), (0.3702, -3.502)])
def test_a_hand_over_from_a_brake_just_outside(brake, reached_mps2):
    gate = actuation(NOMINAL, brake=brake)
    gate.follow(0.0, -4.0, 20.0, 0.0)
    assert gate.acceleration_mps2 == pytest.approx(reached_mps2, abs=1e-9)


def test_a_hand_over_from_a_deep_accelerator_comes_back_at_once():
    gate = actuation(NOMINAL, accelerator=1.0)
    gate.follow(0.0, 1.0, 20.0, 0.0)
    assert gate.acceleration_mps2 == pytest.approx(2.0, abs=4e-4)
    assert gate.acceleration_mps2 <= 2.0


# ---- each limit: exact value, count, and what is told (G4)


def activation(gate, name):
    found = gate.last_limited[name]
    assert isinstance(found, Activation)
    return found.tick, found.asked, found.limit, found.given


@pytest.mark.req("G4")
def test_steering_angle():
    gate = actuation(BENCH)
    for _ in range(200):
        gate.follow(0.2, 0.0, 0.0, 0.0)
    assert gate.demand.steering_wheel_rad == pytest.approx(math.radians(89.95))  # 1.57 rad are 89.954 degrees
    assert gate.limited["steering angle"] == 200
    tick, asked, limit, given = activation(gate, "steering angle")
    assert (tick, limit, given) == (200, 1.57, 1.57)
    assert asked == pytest.approx(0.2 * 14.7)
    assert gate.held_back_ticks == 200
    for _ in range(400):
        gate.follow(-0.2, 0.0, 0.0, 0.0)
    assert gate.demand.steering_wheel_rad == pytest.approx(-math.radians(89.95))
    assert activation(gate, "steering angle")[3] == -1.57


@pytest.mark.req("G4")
def test_a_demand_that_stood_for_less_than_a_tick_may_change_by_less():
    for elapsed_ns, share in ((TICK_NS, 1.0), (6 * TICK_NS // 10, 0.6), (5 * TICK_NS, 1.0), (0, 0.1)):
        gate = actuation(PROVING_GROUND)
        gate.pass_time(elapsed_ns)
        gate.follow(0.2, 1.0, 0.0, 0.0)
        assert gate.demand.steering_wheel_rad == pytest.approx(share * 0.139, abs=math.radians(0.05))
        assert gate.acceleration_mps2 == pytest.approx(share * 0.2, abs=0.001)
        assert activation(gate, "steering rate")[1:] == (
            pytest.approx(0.2 * 14.7 / (share * 0.01), rel=1e-3),
            13.9,
            pytest.approx(13.9, abs=math.radians(0.05) / (share * 0.01)),
        )


def test_the_end_stop_of_the_car_counts_too():
    gate = actuation(PROVING_GROUND)
    for _ in range(200):
        gate.follow(1.0, 0.0, 0.0, 0.0)
    assert math.degrees(gate.demand.steering_wheel_rad) == pytest.approx(463.2)  # 0.55 * 14.7 rad are 463.23 degrees
    assert activation(gate, "steering angle")[2] == pytest.approx(0.55 * 14.7)


@pytest.mark.req("G4")
def test_steering_rate_holds_back_when_a_step_of_the_plan_does_not_suffice():
    gate = actuation(PROVING_GROUND)
    reach = 159  # 13.9 rad/s * 10 ms are 7.964 degrees, 159.28 steps
    for tick in range(1, 11):
        gate.follow(0.2, 0.0, 0.0, 0.0)
        assert math.degrees(gate.demand.steering_wheel_rad) == pytest.approx(tick * reach * STEP_DEG)
        assert gate.limited["steering rate"] == tick
        assert gate.held_back_ticks == max(0, tick - 3)
    tick, asked, limit, given = activation(gate, "steering rate")
    assert (tick, limit) == (10, 13.9)
    assert given == pytest.approx(math.radians(reach * STEP_DEG) / TICK_S)
    target_deg = round(math.degrees(0.2 * 14.7) / STEP_DEG) * STEP_DEG
    assert asked == pytest.approx(math.radians(target_deg - 9 * reach * STEP_DEG) / TICK_S)


@pytest.mark.req("G4")
def test_a_staircase_that_the_rate_can_follow_is_not_held_back():
    gate = actuation(PROVING_GROUND)
    for step in range(20):
        for _ in range(4):
            gate.follow(0.001 * (-1) ** step * 14, 0.0, 0.0, 0.0)  # 24 degrees of steering wheel to and fro: in the third tick it is there
    assert gate.limited == {"steering rate": 20 * 2 - 1}  # the first is half as high
    assert gate.held_back_ticks == 0
    for forget in (gate.release, lambda: gate.start_from(NEUTRAL)):  # what was before does not count
        for _ in range(2):
            forget()
            for _ in range(3):
                gate.follow(0.2, 0.0, 0.0, 0.0)
    assert gate.held_back_ticks == 0


def test_each_step_of_a_plan_has_its_own_ramp():
    gate = actuation(PROVING_GROUND)
    gate.follow(0.0, 0.0, 0.0, 0.0)
    for step in range(1, 5):
        for _ in range(4):
            gate.follow(0.037 * (step % 2), 0.0, 0.0, 0.0)  # 31.2 degrees to and fro: in the fourth tick it is there
        assert gate.limited == {"steering rate": 3 * step}
    assert gate.held_back_ticks == 0


def test_steering_rate_to_the_right():
    gate = actuation(PROVING_GROUND)
    for _ in range(4):
        gate.follow(-0.5, 0.0, 0.0, 0.0)
    assert math.degrees(gate.demand.steering_wheel_rad) == pytest.approx(-4 * 159 * STEP_DEG)
    assert activation(gate, "steering rate")[3] == pytest.approx(-math.radians(159 * STEP_DEG) / TICK_S)


@pytest.mark.req("G4")
@pytest.mark.parametrize("sign", [1, -1])
def test_lateral_acceleration(sign):
    gate, wire = actuation(NOMINAL), Wire(NOMINAL, CAR)
    for _ in range(200):
        gate.follow(sign * 0.05, 0.0, -20.0, 0.0)
    steps = abs(wire.read(gate.demand)[0])
    assert wire.lateral_mps2(steps, 20.0) <= 3.0 < wire.lateral_mps2(steps + 1, 20.0)
    assert gate.limited["lateral acceleration"] == 200
    tick, asked, limit, given = activation(gate, "lateral acceleration")
    assert (tick, limit, given) == (200, 3.0, sign * 3.0)
    assert asked == pytest.approx(sign * 400.0 * math.tan(0.05) / 2.648)


@pytest.mark.req("G4")
def test_lateral_jerk():
    gate, wire = actuation(NOMINAL), Wire(NOMINAL, CAR)
    before = 0
    for tick in range(1, 8):
        gate.follow(0.009, 0.0, 20.0, 0.0)
        steps = wire.read(gate.demand)[0]
        reach_mps2 = wire.lateral_mps2(steps, 20.0) - wire.lateral_mps2(before, 20.0)
        assert reach_mps2 <= 0.05 < reach_mps2 + wire.lateral_mps2(1, 20.0)
        assert gate.limited["lateral jerk"] == tick
        assert gate.held_back_ticks == max(0, tick - 3)
        before = steps
    tick, asked, limit, given = activation(gate, "lateral jerk")
    assert (tick, limit) == (7, 5.0)
    assert given == pytest.approx(reach_mps2 / TICK_S)
    asked_mps2, before_mps2 = (wire.lateral_mps2(count, 20.0) for count in (round(math.degrees(0.009 * 14.7) / STEP_DEG), 6 * steps // 7))
    assert asked == pytest.approx((asked_mps2 - before_mps2) / TICK_S)
    assert set(gate.limited) == {"lateral jerk"}


@pytest.mark.parametrize(("speed_mps", "is_limited"), [(0.999, False), (1.0, True), (-1.0, True), (-0.999, False)])
def test_lateral_limits_begin_at_walking_pace(speed_mps, is_limited):
    tight = dataclasses.replace(NOMINAL, lateral_acceleration_mps2=0.01, lateral_jerk_mps3=0.05)
    gate = actuation(tight)
    for _ in range(60):
        gate.follow(0.1, 0.0, speed_mps, 0.0)
    assert ("lateral acceleration" in gate.limited) is is_limited
    assert ("lateral jerk" in gate.limited) is is_limited
    assert (gate.steer_rad > 0.09) is not is_limited


@pytest.mark.parametrize("sign", [1, -1])
def test_one_step_of_the_bus_is_always_allowed(sign):
    slow = dataclasses.replace(NOMINAL, lateral_jerk_mps3=0.01)
    gate, wire = actuation(slow), Wire(slow, CAR)
    for tick in range(1, 5):
        gate.follow(sign * 0.01, 0.0, 36.0, 0.0)
        assert wire.read(gate.demand)[0] == sign * tick
    for tick in range(3, -1, -1):
        gate.follow(0.0, 0.0, 36.0, 0.0)
        assert wire.read(gate.demand)[0] == sign * tick


@pytest.mark.req("G4")
def test_acceleration():
    gate = actuation(NOMINAL)
    for _ in range(30):
        gate.follow(0.0, 0.7, 10.0, 0.0)
    assert 2.0 - 4e-4 < gate.acceleration_mps2 <= 2.0
    assert gate.limited["acceleration"] == 30
    assert activation(gate, "acceleration") == (30, pytest.approx(0.7 * 4838.7 / 1500.0), 2.0, 2.0)


def test_acceleration_ends_where_the_pedal_does():
    gate = actuation(PROVING_GROUND)
    for _ in range(30):
        gate.follow(0.0, 4.0, 10.0, 0.0)
    assert gate.demand.accelerator_norm == pytest.approx(1.0, abs=1e-12)
    assert activation(gate, "acceleration")[2] == pytest.approx(4838.7 / 1500.0)


@pytest.mark.req("G4")
def test_deceleration():
    gate = actuation(NOMINAL)
    for _ in range(30):
        gate.follow(0.0, -4.0, 10.0, 0.0)
    assert gate.acceleration_mps2 == pytest.approx(-3.5)
    assert gate.limited["deceleration"] == 30
    assert activation(gate, "deceleration") == (30, pytest.approx(-4.0 * 4838.7 / 1500.0), -3.5, -3.5)


def test_deceleration_ends_where_the_pedal_does():
    strong = dataclasses.replace(PROVING_GROUND, deceleration_mps2=99.0)
    gate = actuation(strong)
    for _ in range(60):
        gate.follow(0.0, -4.0, 10.0, 0.0)
    assert gate.demand.brake_norm == pytest.approx(1.0, abs=1e-12)


@pytest.mark.req("G4")
def test_drive_jerk_limits_the_accelerator_and_releases_it_at_once():
    gate, wire = actuation(NOMINAL), Wire(NOMINAL, CAR)
    for tick in range(1, 11):
        gate.follow(0.0, 0.5, 10.0, 0.0)
        reach = tick * 0.1 / wire.drive_mps2 * 1e4
        assert reach - tick <= wire.read(gate.demand)[1] <= reach
        assert gate.limited["drive jerk"] == tick
        assert gate.held_back_ticks == max(0, tick - 3)
    tick, asked, limit, given = activation(gate, "drive jerk")
    assert (tick, limit, given) == (10, pytest.approx(10.0), pytest.approx(10.0))
    assert asked == pytest.approx((0.5 * wire.drive_mps2 - 0.9) / TICK_S, abs=1.0)
    gate.follow(0.0, 0.0, 10.0, 0.0)
    assert gate.demand.accelerator_norm == 0.0
    assert "brake jerk" not in gate.limited


@pytest.mark.req("G4")
def test_brake_jerk_limits_pressing_from_any_accelerator():
    gate = actuation(NOMINAL, accelerator=0.5)
    for tick in range(1, 11):
        gate.follow(0.0, -1.0, 10.0, 0.5)
        assert gate.acceleration_mps2 == pytest.approx(-0.2 * tick)
        assert gate.limited["brake jerk"] == tick
        assert gate.held_back_ticks == max(0, tick - 3)
    tick, asked, limit, given = activation(gate, "brake jerk")
    assert (tick, limit, given) == (10, pytest.approx(-20.0), pytest.approx(-20.0))
    assert asked == pytest.approx((-4838.7 / 1500.0 + 1.8) / TICK_S, abs=0.05)  # half a step of the bus
    assert set(gate.limited) == {"brake jerk"}


def test_brake_is_released_at_its_rate_and_then_the_accelerator_pressed():
    gate = actuation(NOMINAL, brake=0.05)
    expected = [-0.3, -0.1, 0.0, 0.1, 0.2]
    for tick, acceleration_mps2 in enumerate(expected, start=1):
        gate.follow(0.0, 0.5, 10.0, 0.0)
        assert gate.acceleration_mps2 == pytest.approx(acceleration_mps2, abs=1e-3)
        assert gate.limited["drive jerk"] == tick
        assert gate.held_back_ticks == max(0, tick - 3)
    gate.release()
    gate.start_from(Demand(0.0, 0.0, 0.3))
    for _ in range(4):
        gate.follow(0.0, 0.0, 10.0, 0.0)
    assert activation(gate, "drive jerk")[2:] == (pytest.approx(20.0), pytest.approx(20.0))


@pytest.mark.parametrize(("brake_norm", "may_drive"), [(0.0199, True), (0.02, False), (0.5, False)])
def test_the_accelerator_waits_for_the_brake_pedal(brake_norm, may_drive):
    gate = actuation(PROVING_GROUND)
    for _ in range(10):
        gate.follow(0.0, 0.5, 10.0, brake_norm)
    assert (gate.demand.accelerator_norm > 0.4) is may_drive
    assert (gate.demand.accelerator_norm == 0.0) is not may_drive
    assert not gate.demand.brake_norm
    gate.follow(0.0, 0.5, 10.0, 0.02)
    assert gate.demand.accelerator_norm == 0.0
    gate.follow(0.0, 0.5, 10.0, 0.0)
    assert gate.acceleration_mps2 == pytest.approx(0.2, abs=4e-4)  # it begins anew
    gate.follow(0.0, -0.05, 10.0, 0.5)
    assert gate.demand.brake_norm > 0.0  # brakes at any time


def test_waiting_for_the_brake_pedal_is_no_activation():
    gate = actuation(PROVING_GROUND)
    for _ in range(100):
        gate.follow(0.0, 0.1, 10.0, 0.5)
    assert not gate.limited


def test_decelerate_asks_for_that_deceleration():
    gate = actuation(NOMINAL)
    for _ in range(20):
        gate.decelerate(0.01, 2.5, 5.0, 0.0)
    assert gate.acceleration_mps2 == pytest.approx(-2.5)
    assert gate.demand.brake_norm == pytest.approx(2.5 * 1500.0 / 15000.0)
    assert gate.steer_rad == pytest.approx(0.01, abs=1e-4)
    assert gate.engaged_ticks == 20


def test_hold_still_presses_the_brake_at_its_rate_and_leaves_the_steering():
    gate = actuation(NOMINAL, steer_rad=0.2)
    steering_wheel_rad = gate.demand.steering_wheel_rad
    for tick in range(1, 16):
        gate.hold_still()
        assert gate.acceleration_mps2 == pytest.approx(-0.2 * tick)
    for _ in range(10):
        gate.hold_still()
    assert gate.held_back_ticks == 14 - 3  # the last of 15 ticks reaches it
    assert gate.demand == Demand(steering_wheel_rad, 0.0, pytest.approx(0.3))
    assert gate.engaged_ticks == 25


@pytest.mark.req("G4")
def test_a_tick_is_held_back_once():
    gate = actuation(NOMINAL)
    gate.follow(1.0, 4.0, 30.0, 0.0)  # steering angle, lateral acceleration and acceleration
    rates = {"steering rate": 0, "lateral jerk": 1, "drive jerk": 1}
    assert +gate.limited == +Counter(rates | {"steering angle": 1, "lateral acceleration": 1, "acceleration": 1})
    assert (gate.engaged_ticks, gate.held_back_ticks) == (1, 1)
    assert gate.held_back == {"steering angle", "lateral acceleration", "acceleration"}
    gate.follow(0.0, 0.0, 30.0, 0.0)
    assert (gate.engaged_ticks, gate.held_back_ticks) == (2, 1)
    assert gate.held_back == set()


def test_every_limit_has_a_unit():
    gate = actuation(NOMINAL)
    for k in range(60):
        gate.follow((-1.0) ** (k // 30), 4.0 * (-1.0) ** (k // 30), 20.0, 0.0)
        gate.follow((-1.0) ** (k // 30), 4.0 * (-1.0) ** (k // 30), 0.0, 0.0)
    assert set(gate.limited) <= set(UNITS)
    assert set(UNITS.values()) == {"rad", "rad/s", "m/s2", "m/s3"}
    assert [name for name, unit in UNITS.items() if unit == "m/s3"] == ["lateral jerk", "drive jerk", "brake jerk"]


def test_other_steps_of_the_bus():
    coarse = Resolution(math.radians(0.5), accelerator_norm=0.004, brake_norm=0.003)
    gate = Actuation(CAR, NOMINAL, TICK_NS, coarse)
    for _ in range(200):
        gate.follow(0.05, 1.0, 20.0, 0.0)
        assert math.remainder(math.degrees(gate.demand.steering_wheel_rad), 0.5) == pytest.approx(0.0, abs=1e-9)
    assert math.degrees(gate.demand.steering_wheel_rad) == pytest.approx(16.5)  # 3 m/s2 are 16.72 degrees
    assert gate.demand.accelerator_norm == pytest.approx(0.62)  # 2 m/s2 are 62.0 %
    assert gate.acceleration_mps2 <= 2.0
    for _ in range(100):
        gate.follow(0.0, -1.0, 20.0, 0.0)
        assert math.remainder(gate.demand.brake_norm, 0.003) == pytest.approx(0.0, abs=1e-9)
    assert gate.demand.brake_norm > 0.1


@pytest.mark.req("G1")
@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_the_coarsest_steps_that_are_allowed_keep_every_rate(profile, car):
    vehicle = CARS[car]
    wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
    full_mps2 = vehicle.pedals.full_drive_force_n / vehicle.model.mass_kg
    for speed_mps in (0.5 * profile.max_speed_mps, profile.max_speed_mps):
        gate = Actuation(vehicle, profile, TICK_NS, coarsest(vehicle, profile, 0.006))
        before_rad, before_mps2, moved = 0.0, 0.0, 0.0
        for k in range(400):
            elapsed_s = (0.006, 0.01)[k % 2]
            gate.pass_time(round(elapsed_s * 1e9))
            gate.follow(math.copysign(0.2, k % 200 - 100), math.copysign(1.0, 100 - k % 200), speed_mps, 0.0)
            lateral_mps2 = [
                lateral_acceleration_mps2(angle_rad / vehicle.steering.ratio, wheelbase_m, speed_mps)
                for angle_rad in (before_rad, gate.demand.steering_wheel_rad)
            ]
            assert abs(lateral_mps2[1] - lateral_mps2[0]) <= profile.lateral_jerk_mps3 * elapsed_s + EPSILON
            assert abs(gate.demand.steering_wheel_rad - before_rad) <= profile.steering_wheel_rate_radps * elapsed_s + EPSILON
            drive_mps2 = gate.demand.accelerator_norm * full_mps2
            assert drive_mps2 - before_mps2 <= profile.drive_jerk_mps3 * elapsed_s + EPSILON
            moved = max(moved, abs(gate.demand.steering_wheel_rad))
            before_rad, before_mps2 = gate.demand.steering_wheel_rad, drive_mps2
        assert moved > 0.0


# ---- no frame ever breaks a limit


@pytest.mark.req("G1")
@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
@pytest.mark.parametrize("speed_mps", [0.0, 0.99, 1.0, 3.7, 8.4, 22.2, 36.0])
def test_five_steps_on_both_sides_of_every_steering_bound(profile, car, speed_mps):
    vehicle = CARS[car]
    wire, gate = Wire(profile, vehicle), Actuation(vehicle, profile, TICK_NS, Resolution())
    step_rad = math.radians(STEP_DEG) / vehicle.steering.ratio
    ends_rad = [profile.steering_wheel_limit_rad / vehicle.steering.ratio, vehicle.steering.road_wheel_limit_rad]
    if speed_mps >= 1.0:
        ends_rad.append(math.atan(profile.lateral_acceleration_mps2 * wire.wheelbase_m / speed_mps**2))
    for asked_rad in (sign * end + k * step_rad for end in ends_rad for sign in (1, -1) for k in range(-5, 6)):
        end_rad = min(ends_rad)
        within_rad = min(max(asked_rad, -end_rad), end_rad)
        gate.start_from(Demand((within_rad - math.copysign(6 * step_rad, within_rad)) * vehicle.steering.ratio, 0.0, 0.0))
        before = wire.read(gate.demand)
        for _ in range(20):
            gate.follow(asked_rad, 0.0, speed_mps, 0.0)
            after = wire.read(gate.demand)
            wire.judge(before, after, speed_mps)
            before = after
        # As near as the bus can say it, and never beyond.
        assert abs(before[0] * step_rad) <= end_rad + 1e-12
        assert abs(before[0] * step_rad - within_rad) < step_rad


@pytest.mark.req("G1")
@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_five_steps_on_both_sides_of_every_pedal_bound(profile, car):
    vehicle = CARS[car]
    wire, gate = Wire(profile, vehicle), Actuation(vehicle, profile, TICK_NS, Resolution())
    low_mps2, high_mps2 = -min(profile.deceleration_mps2, wire.brake_mps2), min(profile.acceleration_mps2, wire.drive_mps2)
    for bound_mps2, step_mps2 in ((high_mps2, wire.drive_mps2 * 1e-4), (low_mps2, wire.brake_mps2 * 1e-4)):
        for k in range(-5, 6):
            asked_mps2 = bound_mps2 + k * step_mps2
            gate.start_from(Demand(0.0, max(bound_mps2, 0.0) / wire.drive_mps2 * 0.99, max(-bound_mps2, 0.0) / wire.brake_mps2 * 0.99))
            before = wire.read(gate.demand)
            for _ in range(6):
                gate.follow(0.0, asked_mps2 / wire.drive_mps2, 10.0, 0.0)
                after = wire.read(gate.demand)
                wire.judge(before, after, 10.0)
                before = after
            assert abs(gate.acceleration_mps2 - min(max(asked_mps2, low_mps2), high_mps2)) < step_mps2
            assert low_mps2 - 1e-12 <= gate.acceleration_mps2 <= high_mps2 + 1e-12


sequences = {
    "profile": st.sampled_from(list(PROFILES.values())),
    "car": st.sampled_from(list(CARS.values())),
    "start": st.tuples(st.floats(-8.0, 8.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    "asked": st.lists(
        st.tuples(st.floats(-1.0, 1.0), st.floats(-4.0, 4.0), st.floats(-36.0, 36.0), st.sampled_from((0.0, 0.0, 0.019, 0.02, 1.0))),
        min_size=1,
        max_size=12,
    ),
    "hold": st.integers(1, 5),
    "then": st.sampled_from(("follow", "decelerate", "hold_still")),
}


def drive_and_judge(profile, car, start, asked, hold, then):
    gate, wire = Actuation(car, profile, TICK_NS, Resolution()), Wire(profile, car)
    gate.start_from(Demand(*start))
    before = wire.read(gate.demand)
    for k, (steer_rad, drive_norm, vx_mps, brake_norm) in enumerate(asked):
        act = "follow" if k < len(asked) // 2 else then
        for _ in range(hold):
            if act == "follow":
                gate.follow(steer_rad, drive_norm, vx_mps, brake_norm)
            elif act == "decelerate":
                gate.decelerate(steer_rad, abs(drive_norm), vx_mps, brake_norm)
            else:
                gate.hold_still()
            after = wire.read(gate.demand)
            wire.judge(before, after, 0.0 if act == "hold_still" else abs(vx_mps), is_held=act == "hold_still")
            before = after
    assert gate.held_back_ticks <= gate.engaged_ticks == hold * len(asked)


@pytest.mark.req("G1")
@given(**sequences)
@settings(max_examples=60, deadline=None)
def test_no_sequence_of_demands_breaks_a_limit(profile, car, start, asked, hold, then):
    drive_and_judge(profile, car, start, asked, hold, then)


@pytest.mark.long
@pytest.mark.timeout(1800)  # a minute of processor time, on a shared machine
@pytest.mark.req("G1")
@given(**sequences)
@settings(max_examples=20_000, deadline=None)
def test_20000_sequences_of_demands_break_no_limit(profile, car, start, asked, hold, then):
    drive_and_judge(profile, car, start, asked, hold, then)


@pytest.mark.req("G1")
def test_a_long_drive_does_not_drift():
    gate, wire = actuation(NOMINAL), Wire(NOMINAL, CAR)
    before = wire.read(gate.demand)
    for k in range(20_000):
        gate.follow(0.3 * math.sin(0.7 * k), math.sin(1.3 * k), 12.0, 0.0)
        after = wire.read(gate.demand)
        wire.judge(before, after, 12.0)
        before = after
