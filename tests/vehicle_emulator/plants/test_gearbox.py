"""The gearbox's controller: schedule, shifts, lever, lock-up, and that it does not hunt."""

import random
import tomllib
from itertools import pairwise

import pytest

from dbc.powertrain import PowertrainParameters
from dbc.vehicle import FOCUS, VehicleError, load_vehicle
from tests.vehicle_emulator.plants.powertrain_rig import STEP_S, Rig, step_function
from vehicle_emulator.plants.interface import PlantInputs, Selector
from vehicle_emulator.plants.multibody.gearbox import Gearbox, GearboxState
from vehicle_emulator.plants.multibody.plant import MultibodyPlant
from vehicle_emulator.road import RoadDescription, make_road

IDLE_RADPS = 65.0


@pytest.fixture(scope="module")
def p(vehicle) -> PowertrainParameters:
    return vehicle.powertrain


def gearbox(p: PowertrainParameters) -> Gearbox:
    return Gearbox(p.gearbox, p.pedal.wheel_radius_m)


def drive(box: Gearbox, p: PowertrainParameters, duration_s: float, speed_mps: float, pedal: float = 0.1, **held) -> list[GearboxState]:
    """Steps at a speed, with an engine that is as fast as its turbine."""
    states = []
    for _ in range(round(duration_s / STEP_S)):
        wheels_radps = speed_mps / p.pedal.wheel_radius_m
        engine_radps = held.get("engine_radps", max(box.state.ratio * wheels_radps, IDLE_RADPS))
        states.append(box.step(STEP_S, held.get("selector", Selector.DRIVE), pedal, wheels_radps, engine_radps))
    return states


def sweep(box, p, speeds_mps: tuple[float, float], rate_mps2: float, pedal: float) -> list[tuple[float, GearboxState]]:
    """Steps through speeds at a constant rate."""
    start_mps, end_mps = speeds_mps
    count = round(abs(end_mps - start_mps) / rate_mps2 / STEP_S)
    speeds = [start_mps + (end_mps - start_mps) * i / count for i in range(count)]
    return [(speed_mps, drive(box, p, STEP_S, speed_mps, pedal)[0]) for speed_mps in speeds]


def shifts(states: list[tuple[float, GearboxState]]) -> list[tuple[int, int, float]]:
    return [(before.gear, after.gear, speed_mps) for (_, before), (speed_mps, after) in pairwise(states) if before.gear != after.gear]


PEDALS = [0.05 * i for i in range(21)]


def test_schedule_is_monotone_and_has_hysteresis_at_every_pedal(p):
    box, gears = gearbox(p), range(1, len(p.gearbox.ratios))
    for pedal in PEDALS:
        ups = [box.upshift_mps(gear, pedal) for gear in gears]
        downs = [box.downshift_mps(gear + 1, pedal) for gear in gears]
        assert all(left < right for left, right in pairwise(ups))
        assert all(left < right for left, right in pairwise(downs))
        assert all(down < 0.9 * up for down, up in zip(downs, ups, strict=True))
    for gear in gears:
        assert all(box.upshift_mps(gear, left) < box.upshift_mps(gear, right) for left, right in pairwise(PEDALS))
        assert all(box.downshift_mps(gear + 1, left) < box.downshift_mps(gear + 1, right) for left, right in pairwise(PEDALS))


def test_schedule_is_the_table_at_its_pedals_and_linear_between(p):
    box, g = gearbox(p), p.gearbox
    for pedal, up, down in (
        (0.0, g.upshift_light_mps, g.downshift_light_mps),
        (0.25, g.upshift_quarter_mps, g.downshift_quarter_mps),
        (0.5, g.upshift_half_mps, g.downshift_half_mps),
        (1.0, g.upshift_full_mps, g.downshift_full_mps),
    ):
        assert box.upshift_mps(2, pedal) == pytest.approx(up[1])
        assert box.downshift_mps(3, pedal) == pytest.approx(down[1])
    assert box.upshift_mps(1, 0.75) == pytest.approx(0.5 * (g.upshift_half_mps[0] + g.upshift_full_mps[0]))
    assert box.upshift_mps(1, -1.0) == g.upshift_light_mps[0]
    assert box.upshift_mps(1, 2.0) == g.upshift_full_mps[0]


@pytest.mark.parametrize("pedal", [0.0, 0.2])
def test_shifts_through_all_gears_up_and_down_where_the_schedule_says(p, pedal):
    box, top = gearbox(p), len(p.gearbox.ratios)
    drive(box, p, 5.0, 0.0, pedal)
    up = shifts(sweep(box, p, (0.0, 40.0), 2.0, pedal))
    down = shifts(sweep(box, p, (40.0, 0.0), 2.0, pedal))
    assert [(old, new) for old, new, _ in up] == [(gear, gear + 1) for gear in range(1, top)]
    assert [(old, new) for old, new, _ in down] == [(gear, gear - 1) for gear in range(top, 1, -1)]
    assert [speed for *_, speed in up] == pytest.approx([box.upshift_mps(gear, pedal) for gear in range(1, top)], abs=0.05)
    assert [speed for *_, speed in down] == pytest.approx([box.downshift_mps(gear, pedal) for gear in range(top, 1, -1)], abs=0.05)


def test_a_shift_is_a_torque_hole_without_a_step(p):
    box = gearbox(p)
    drive(box, p, 2.0, 5.0, 0.25)
    states = [state for _, state in sweep(box, p, (5.0, 40.0), 1.5, 0.25)]
    ratio_range = p.gearbox.final_drive * (p.gearbox.ratios[0] - p.gearbox.ratios[1])
    assert max(abs(after.ratio - before.ratio) for before, after in pairwise(states)) < 0.02 * ratio_range
    assert max(abs(after.clutch_norm - before.clutch_norm) for before, after in pairwise(states)) < 0.025
    assert min(state.clutch_norm for state in states) == pytest.approx(p.gearbox.shift_clutch_norm, abs=0.01)
    open_s = STEP_S * sum(state.clutch_norm < 0.99 for state in states) / 5
    assert 0.5 * p.gearbox.shift_s < open_s < p.gearbox.shift_s


def test_a_shift_waits_for_the_engine_but_not_for_ever(p):
    opened_s = []
    for engine_radps in (140.0, 400.0):
        box = gearbox(p)
        box.start(4)
        states = drive(box, p, 2.0, p.gearbox.upshift_quarter_mps[3] + 0.5, 0.25, engine_radps=engine_radps)
        assert states[-1].gear == 5
        opened_s.append(STEP_S * sum(state.clutch_norm < 0.99 for state in states))
    assert opened_s[0] < p.gearbox.shift_s
    assert p.gearbox.shift_s < opened_s[1] < 2.5 * p.gearbox.shift_s


def test_noise_at_the_shift_speed_makes_one_shift(p):
    box, rng = gearbox(p), random.Random(3)
    box.start(3)
    border_mps = box.upshift_mps(3, 0.1)
    drive(box, p, 1.0, border_mps - 2.0)
    drive(box, p, 0.5, border_mps - 0.5)
    assert box.state.gear == 3
    states = [(0.0, drive(box, p, 0.005, border_mps + rng.gauss(0.0, 0.15), 0.1)[-1]) for _ in range(2000)]
    assert len(shifts(states)) == 1


@pytest.mark.parametrize("speed_mps", [2.8, 5.0, 9.0, 14.0, 22.2, 30.0])
@pytest.mark.parametrize("noise_norm", [0.04, 0.1])
def test_it_does_not_hunt_while_a_controller_holds_the_speed_with_a_noisy_pedal(focus, speed_mps, noise_norm):
    powertrain, rng = focus.powertrain, random.Random(round(10 * speed_mps))
    gear = gearbox(powertrain).gear_at(speed_mps)
    rig = Rig(powertrain, step_function(powertrain), 1554.0, (170.0, 0.41), speed_mps=speed_mps, gear=gear)
    gears, integral, pedal = [], 0.08, 0.0
    for i in range(15000):
        if i % 40 == 0:  # 25 Hz
            error_mps = speed_mps - rig.speed_mps
            integral = min(max(integral + 0.0008 * error_mps, 0.0), 1.0)
            pedal = min(max(integral + 0.15 * error_mps + rng.uniform(-noise_norm, noise_norm), 0.0), 1.0)
        rig.step(pedal)
        gears.append(rig.state.gear)
    settled = gears[6000:]
    assert sum(left != right for left, right in pairwise(settled)) <= 1
    assert rig.speed_mps == pytest.approx(speed_mps, abs=0.6)


@pytest.mark.parametrize("half_period_s", [0.04, 0.5])
def test_a_pedal_that_jumps_between_none_and_two_fifths_does_not_make_it_hunt(p, half_period_s):
    box, states = gearbox(p), []
    for i in range(round(12.0 / half_period_s)):
        states += [(0.0, state) for state in drive(box, p, half_period_s, 22.2, 0.4 * (i % 2))]
    assert len(shifts(states[4000:])) == 0


def test_at_80_kmh_it_is_in_fourth_to_sixth(p):
    assert 4 <= gearbox(p).gear_at(22.2) <= 6
    assert gearbox(p).gear_at(0.0) == 1


def test_kick_down_skips_gears_at_once_and_never_overspeeds_the_engine(p):
    for speed_mps in (10.0, 14.0, 18.0, 22.2, 30.0):
        box = gearbox(p)
        before = drive(box, p, 3.0, speed_mps, 0.1)[-1].gear
        after = drive(box, p, 0.05, speed_mps, 1.0)[-1].gear
        settled = drive(box, p, 2.0, speed_mps, 1.0)[-1]
        assert after == settled.gear < before
        assert settled.ratio * speed_mps / p.pedal.wheel_radius_m < 0.97 * p.engine.rev_limit_radps


def test_kick_down_on_the_road(focus):
    rig = Rig(focus.powertrain, step_function(focus.powertrain), 1554.0, (170.0, 0.41), speed_mps=22.2, gear=5).run(2.0, 0.1)
    least_n = min(rig.run(STEP_S, 1.0).drive_n for _ in range(900))
    assert rig.state.gear == 2
    assert rig.drive_n > 4000.0
    assert least_n > -700.0  # the engine does not brake the car while it speeds up


def test_opposite_shifts_keep_their_distance_in_time(p):
    box = gearbox(p)
    drive(box, p, 3.0, 0.0)
    up_mps, down_mps = box.upshift_mps(2, 0.1) + 1.0, box.downshift_mps(3, 0.1) - 1.0
    states = []
    for i in range(5000):
        speed_mps = up_mps if i // 700 % 2 == 0 else down_mps
        states.append((i * STEP_S, drive(box, p, STEP_S, speed_mps)[0]))
    found = shifts(states)
    assert len(found) >= 2
    for (old, new, when_s), (next_old, next_new, next_s) in pairwise(found):
        if (new > old) != (next_new > next_old):
            assert next_s - when_s >= p.gearbox.dwell_s - STEP_S


def test_a_racing_engine_shifts_up_whatever_the_schedule_says(p):
    box = gearbox(p)
    drive(box, p, 2.0, 1.0, 1.0)
    assert drive(box, p, 0.01, 1.0, 1.0, engine_radps=p.gearbox.upshift_radps - 1.0)[-1].gear == 1
    assert drive(box, p, 0.01, 1.0, 1.0, engine_radps=p.gearbox.upshift_radps + 1.0)[-1].gear == 2


def test_wheels_that_lock_or_spin_do_not_shift_it_through(p):
    box = gearbox(p)
    before = drive(box, p, 3.0, 22.0)[-1].gear
    assert drive(box, p, 0.4, 0.0)[-1].gear >= before - 1
    box = gearbox(p)
    drive(box, p, 3.0, 2.0)
    assert drive(box, p, 0.3, 30.0, engine_radps=300.0)[-1].gear <= 2


def test_lock_up_closes_at_speed_in_a_high_gear_and_opens_before_the_engine_stalls(p):
    box, g = gearbox(p), p.gearbox
    assert drive(box, p, 4.0, 22.0)[-1].lockup_norm == 1.0
    assert drive(box, p, g.lockup_open_s + 2 * STEP_S, 0.0)[-1].lockup_norm == 0.0
    box = gearbox(p)
    assert max(state.lockup_norm for state in drive(box, p, 4.0, 2.0, 0.3)) == 0.0


def test_lock_up_has_hysteresis(p):
    g = p.gearbox
    between_mps = 0.5 * (g.lockup_open_radps + g.lockup_close_radps) / (g.ratios[3] * g.final_drive) * p.pedal.wheel_radius_m
    closed, opened = gearbox(p), gearbox(p)
    closed.start(4)
    opened.start(4)
    drive(opened, p, 0.1, 0.85 * between_mps, 0.0)
    assert closed.upshift_mps(4, 0.1) > between_mps > closed.downshift_mps(4, 0.1)
    assert drive(closed, p, 2.0, between_mps)[-1].lockup_norm == 1.0
    assert drive(opened, p, 2.0, between_mps)[-1].lockup_norm == 0.0


def test_lock_up_opens_in_a_shift(p):
    box = gearbox(p)
    box.start(4)
    states = drive(box, p, 0.5, p.gearbox.upshift_quarter_mps[3] + 1.0)
    shifting = [state for state in states if state.ratio not in {p.gearbox.final_drive * ratio for ratio in p.gearbox.ratios}]
    assert shifting
    assert max(state.lockup_norm for state in shifting[20:]) == 0.0


def test_the_lever(p):
    box, g = gearbox(p), p.gearbox
    parked = drive(box, p, 0.5, 0.0, 0.0, selector=Selector.PARK)[-1]
    assert parked == GearboxState(0, 0.0, 0.0, 0.0, True)
    driving = drive(box, p, 1.0, 0.0, 0.0)[-1]
    assert driving == GearboxState(1, g.ratios[0] * g.final_drive, pytest.approx(g.creep_clutch_norm), 0.0, False)
    reversing = drive(box, p, 1.0, 0.0, 0.0, selector=Selector.REVERSE)
    assert reversing[-1].gear == -1
    assert reversing[-1].ratio == pytest.approx(-g.reverse_ratio * g.final_drive)
    turn = next(i for i, state in enumerate(reversing) if state.gear == -1)
    assert reversing[turn - 1].clutch_norm == 0.0
    assert drive(box, p, 1.0, 0.0, 0.0, selector=Selector.NEUTRAL)[-1] == GearboxState()


def test_the_clutch_of_a_standing_car_closes_with_the_pedal_or_the_speed(p):
    box, g = gearbox(p), p.gearbox
    drive(box, p, 1.0, 0.0, 0.0)
    assert drive(box, p, 1.0, 0.0, 0.5 * g.creep_pedal_norm)[-1].clutch_norm == pytest.approx(0.5 * (1.0 + g.creep_clutch_norm))
    assert drive(box, p, 1.0, 0.0, g.creep_pedal_norm)[-1].clutch_norm == 1.0
    assert drive(box, p, 1.0, g.creep_mps, 0.0)[-1].clutch_norm == 1.0


@pytest.mark.parametrize(("selector", "speed_mps"), [(Selector.REVERSE, 5.0), (Selector.DRIVE, -5.0)])
def test_a_direction_against_the_motion_is_refused_until_the_car_is_slow(p, selector, speed_mps):
    box = gearbox(p)
    assert drive(box, p, 1.0, speed_mps, selector=selector)[-1].gear == 0
    assert drive(box, p, 1.5, 0.2 * speed_mps, selector=selector)[-1].gear == (1 if selector is Selector.DRIVE else -1)


@pytest.mark.parametrize(("selector", "gear"), [(Selector.REVERSE, -1), (Selector.DRIVE, 1)])
def test_a_gear_that_is_engaged_stays_when_the_car_rolls_the_other_way(p, selector, gear):
    box = gearbox(p)
    for speed_mps in (0.0, -gear * 1.0, -gear * 3.0, -gear * 5.0):
        state = drive(box, p, 1.5, speed_mps, selector=selector)[-1]
        assert (state.gear, state.clutch_norm > 0.0) == (gear, True)


def test_a_car_that_has_rolled_back_drives_up_again(focus):
    plant = MultibodyPlant(focus, make_road(RoadDescription(grade_percent=15.0)))
    for _ in range(6000):
        if plant.step(STEP_S, PlantInputs()).vx_mps < -2.0:
            break
    assert plant.state.vx_mps < -2.0
    for _ in range(3000):
        state = plant.step(STEP_S, PlantInputs(accelerator_norm=1.0))
    assert (state.gear, state.vx_mps > 1.0) == (1, True)


def test_the_pawl_ratchets_at_speed_and_holds_once_it_is_in(p):
    box = gearbox(p)
    assert not drive(box, p, 1.0, 3.0, selector=Selector.PARK)[-1].is_park_locked
    assert drive(box, p, 1.0, 0.3, selector=Selector.PARK)[-1].is_park_locked
    assert drive(box, p, 1.0, 1.2, selector=Selector.PARK)[-1].is_park_locked
    assert not drive(box, p, 0.1, 0.0, selector=Selector.NEUTRAL)[-1].is_park_locked


def test_a_start_at_speed_is_in_gear_from_the_first_step(p):
    box = gearbox(p)
    box.start(box.gear_at(22.2))
    states = drive(box, p, 1.0, 22.2)
    assert {state.gear for state in states} == {box.gear_at(22.2)}
    assert {(state.clutch_norm, state.lockup_norm) for state in states} == {(1.0, 1.0)}


def test_same_inputs_same_states(p):
    def states() -> list[GearboxState]:
        box, rng = gearbox(p), random.Random(5)
        return [drive(box, p, 0.02, rng.uniform(0.0, 30.0), rng.random())[-1] for _ in range(300)]

    assert states() == states()


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("ratios", "[4.484, 2.872, 1.842, 1.414, 1.000, 1.2]", "ratios, last first increasing"),
        ("ratios", "[4.484, 2.872]", "1 entries, one per shift"),
        ("ratios", "[4.484, -2.872, 1.842, 1.414, 1.000, 0.742]", "powertrain.gearbox.ratios.1 = -2.872"),
        ("downshift_half_mps", "[4.0, 17.0, 24.0, 32.0, 36.0]", "downshift_half_mps, upshift_half_mps increasing, not 17, 16"),
        ("upshift_light_mps", "[2.8, 9.6, 9.5, 13.5, 24.0]", "upshift_light_mps increasing"),
        ("lockup_open_radps", "130.0", "lockup_open_radps, lockup_close_radps increasing"),
        ("full_load_radps", "[75.0, 105.0]", "powertrain.engine.full_load_radps"),
        ("full_load_radps", "[75.0, 105.0, 157.0, 262.0, 262.0, 466.0, 580.0, 691.0]", "full_load_radps increasing"),
        ("idle_radps", "50.0", "stall_radps, fire_radps, idle_radps, rev_limit_radps increasing, not 20, 60, 50, 705"),
        ("stall_torque_ratio", "3.9", "coupling_speed_ratio so low"),
        ("lag_s", "0.001", "greater than or equal to 0.01"),
    ],
)
def test_mistakes_in_the_vehicle_file_are_named(tmp_path, key, value, told):
    text = FOCUS.read_text()
    start = text.index(f"\n{key} = {{ value = ", text.index("[powertrain.engine]")) + len(f"\n{key} = {{ value = ")
    path = tmp_path / "car.toml"
    path.write_text(f"{text[:start]}{value}{text[text.index(', source', start) :]}")
    tomllib.loads(path.read_text())
    with pytest.raises(VehicleError) as caught:
        load_vehicle(path)
    assert told in str(caught.value)
    assert "car.toml" in str(caught.value)
