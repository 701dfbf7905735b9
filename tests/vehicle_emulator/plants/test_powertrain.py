"""Engine, converter and pedal map: against hand calculation, and what they must never do."""

import math
import random

import casadi as ca
import numpy as np
import pytest

from dbc.powertrain import PowertrainParameters
from tests.vehicle_emulator.plants.powertrain_rig import HELD_KG, STEP_S, Rig, step_function
from vehicle_emulator.plants.interface import Selector
from vehicle_emulator.plants.multibody import powertrain
from vehicle_emulator.plants.multibody.layout import numbers
from vehicle_emulator.plants.multibody.symbols import parameter_symbols

RPM = math.pi / 30.0
ROAD = {"focus": (1554.0, (170.0, 0.41)), "van": (2500.0, (245.0, 0.96))}
WHEELS_KGM2 = {"focus": 2.3, "van": 4.0}


@pytest.fixture(scope="module")
def p(vehicle) -> PowertrainParameters:
    return vehicle.powertrain


@pytest.fixture(scope="module")
def step(p):
    return step_function(p)


@pytest.fixture(scope="module")
def focus_step(focus):
    return step_function(focus.powertrain)


def on_the_road(vehicle, step, **start) -> Rig:
    mass_kg, resistance = ROAD[vehicle.name]
    return Rig(vehicle.powertrain, step, mass_kg, resistance, **start)


def on_the_lift(vehicle, step) -> Rig:
    radius_m = vehicle.powertrain.pedal.wheel_radius_m
    return Rig(vehicle.powertrain, step, WHEELS_KGM2[vehicle.name] / radius_m**2, is_lifted=True)


def held(p, step, speed_mps: float, gear: int, pedal: float, lockup: float = 0.0) -> Rig:
    """A car that keeps its speed in a gear, whatever its engine does, until all is steady."""
    rig = Rig(p, step, HELD_KG, speed_mps=speed_mps, gear=gear)
    return rig.run(1.8, pedal, ratio=p.gearbox.ratios[gear - 1] * p.gearbox.final_drive, clutch=1.0, lockup=lockup)


def drag_n(p, speed_mps: float) -> float:
    wheels_radps = speed_mps / p.pedal.wheel_radius_m
    return (p.driveline.drag_nm * min(wheels_radps / 5.0, 1.0) + p.driveline.drag_nms * wheels_radps) / p.pedal.wheel_radius_m


def test_full_load_curve_goes_through_its_points_and_no_further(p):
    for speed_radps, torque_nm in zip(p.engine.full_load_radps, p.engine.full_load_nm, strict=True):
        assert float(powertrain.full_load_nm(p.engine, speed_radps)) == pytest.approx(torque_nm)
    assert float(powertrain.full_load_nm(p.engine, 0.0)) == p.engine.full_load_nm[0]
    assert float(powertrain.full_load_nm(p.engine, 2000.0)) == pytest.approx(p.engine.full_load_nm[-1])


def test_the_engines_are_those_of_the_data_sheets(focus, van):
    petrol, diesel = focus.powertrain.engine, van.powertrain.engine
    assert float(powertrain.full_load_nm(petrol, 6600 * RPM)) * 6600 * RPM == pytest.approx(125e3, rel=0.01)
    assert float(powertrain.full_load_nm(petrol, 4450 * RPM)) == pytest.approx(202.0, rel=0.01)
    assert float(powertrain.full_load_nm(diesel, 3000 * RPM)) * 3000 * RPM == pytest.approx(138e3, rel=0.01)
    assert float(powertrain.full_load_nm(diesel, 2000 * RPM)) == pytest.approx(475.0, rel=0.01)


@pytest.mark.parametrize(
    ("speed_mps", "gear", "lockup"),
    [(0.0, 1, 0.0), (4.0, 1, 0.0), (7.0, 1, 0.0), (11.0, 2, 0.0), (22.0, 3, 1.0), (25.0, 4, 1.0), (33.0, 5, 1.0)],
)
def test_force_at_full_pedal_is_the_least_of_pedal_power_and_engine(p, step, speed_mps, gear, lockup):
    rig = held(p, step, speed_mps, gear, 1.0, lockup)
    speed_ratio = min(p.gearbox.ratios[gear - 1] * p.gearbox.final_drive * rig.wheels_radps / rig.engine_radps, 1.0)
    gain = 1.0 + (p.converter.stall_torque_ratio - 1.0) * max(1.0 - speed_ratio / p.converter.coupling_speed_ratio, 0.0)
    if lockup:
        assert gain == 1.0
    engine_nm = float(powertrain.full_load_nm(p.engine, rig.engine_radps)) * gain
    engine_n = engine_nm * p.gearbox.ratios[gear - 1] * p.gearbox.final_drive * p.driveline.efficiency / p.pedal.wheel_radius_m
    expected_n = min(p.pedal.full_force_n, p.pedal.full_power_w / max(speed_mps, 0.1), engine_n)
    assert rig.drive_n == pytest.approx(expected_n - drag_n(p, speed_mps), rel=0.01)


def test_the_focus_pulls_with_what_the_gateway_believes_but_for_seven_per_cent(focus, focus_step):
    for speed_mps, gear in ((0.0, 1), (5.0, 1), (14.0, 2), (22.0, 2)):
        force_n = held(focus.powertrain, focus_step, speed_mps, gear, 1.0).drive_n
        assert 0.93 * focus.pedals.full_drive_force_n < force_n < focus.pedals.full_drive_force_n


def test_pedal_is_linear_from_the_first_per_cent_on(focus, focus_step):
    forces_n = [held(focus.powertrain, focus_step, 22.2, 5, 0.05 * i, 1.0).drive_n for i in range(6)]
    span_n = focus.powertrain.pedal.full_force_n - forces_n[0]
    assert np.diff(forces_n) == pytest.approx([0.05 * span_n] * 5, rel=0.15)  # losses count twice from pulling to braking


def test_ten_per_cent_of_pedal_at_80_kmh_is_450_newtons_within_200_ms_without_a_shift(focus, focus_step):
    rig = on_the_road(focus, focus_step, speed_mps=22.2, gear=5).run(3.0, 0.12)
    before_n, gear = rig.drive_n, rig.state.gear
    rig.run(0.2, 0.22)
    assert 4 <= gear <= 6
    assert rig.state.gear == gear
    assert rig.drive_n - before_n > 440.0
    assert rig.run(0.5, 0.22).drive_n - before_n < 520.0


def test_rolling_pedal_to_force_lag(focus, focus_step):
    for speed_mps, gear in ((8.0, 3), (12.0, 4), (22.0, 5)):
        rig = on_the_road(focus, focus_step, speed_mps=speed_mps, gear=gear).run(2.0, 0.1)
        before_n, start_s = rig.drive_n, rig.time_s
        while rig.drive_n - before_n < 0.63 * 0.1 * focus.powertrain.pedal.full_force_n:
            rig.step(0.2)
        assert 0.05 < rig.time_s - start_s < 0.15


@pytest.mark.parametrize("load_nm", [5.0, 10.0])
def test_idle_holds_within_20_rpm_under_a_step_load(p, step, load_nm):
    rig = Rig(p, step, HELD_KG).run(3.0, selector=Selector.NEUTRAL)
    deviations_radps = []
    for i in range(2000):
        rig.step(0.0, selector=Selector.NEUTRAL, load_nm=load_nm if i < 1000 else 0.0)
        deviations_radps.append(rig.engine_radps - p.engine.idle_radps)
    assert max(map(abs, deviations_radps)) < 20.0 * RPM
    assert min(deviations_radps) < -1.0 * RPM


def test_engaging_drive_and_reverse_leaves_the_idle_speed_within_20_rpm(p, step):
    rig = Rig(p, step, HELD_KG).run(2.0, selector=Selector.NEUTRAL)
    for selector in (Selector.DRIVE, Selector.REVERSE, Selector.PARK):
        for _ in range(1500):
            rig.step(0.0, selector=selector)
            assert abs(rig.engine_radps - p.engine.idle_radps) < 20.0 * RPM


def test_creep(focus, focus_step):
    push_n = Rig(focus.powertrain, focus_step, HELD_KG).run(2.0).drive_n
    assert 300.0 < push_n < 500.0
    rig = on_the_road(focus, focus_step).run(25.0)
    assert rig.speed_mps == pytest.approx(1.4, abs=0.15)
    assert rig.engine_radps == pytest.approx(focus.powertrain.engine.idle_radps, abs=20.0 * RPM)


def test_force_of_a_standing_car_grows_evenly_with_the_pedal(p, step):
    forces_n = [Rig(p, step, HELD_KG).run(2.0, 0.1 * tenths).drive_n for tenths in range(11)]
    line_n = np.linspace(forces_n[0], p.pedal.full_force_n, 11)
    assert np.all(np.diff(forces_n) > 0.5 * (line_n[1] - line_n[0]))
    assert forces_n == pytest.approx(line_n, abs=0.04 * p.pedal.full_force_n)


def test_converter_at_stall_and_at_its_coupling_point(p):
    c = p.converter
    assert float(powertrain.pump_nm(c, 200.0, 0.0)) == pytest.approx(c.capacity_nms2 * 200.0**2)
    assert float(powertrain.torque_ratio(c, 0.0)) == pytest.approx(c.stall_torque_ratio)
    assert float(powertrain.torque_ratio(c, c.coupling_speed_ratio)) == 1.0
    assert float(powertrain.pump_nm(c, 200.0, 200.0)) == 0.0
    assert float(powertrain.pump_nm(c, 180.0, 200.0)) < 0.0


def test_speed_ratio_stays_below_one_while_the_engine_pulls(focus, focus_step):
    rig = on_the_road(focus, focus_step)
    ratios = []
    for _ in range(5000):
        rig.step(0.4)
        if rig.drive_n > 300.0 and rig.state.clutch_norm == 1.0 and not rig.state.lockup_norm:
            ratios.append(rig.state.ratio * rig.wheels_radps / rig.engine_radps)
    assert min(ratios) < 0.1
    assert 0.85 < max(ratios) < 1.0


def test_lock_up_takes_the_slip_away(p, step):
    open_rig, closed_rig = (held(p, step, 22.0, 5, 0.25, lockup) for lockup in (0.0, 1.0))
    turbine_radps = p.gearbox.ratios[4] * p.gearbox.final_drive * open_rig.wheels_radps
    assert open_rig.engine_radps - turbine_radps > 15.0
    assert 0.5 < closed_rig.engine_radps - turbine_radps < 10.0


def test_neutral_revs_to_the_limiter_and_no_further(p, step):
    rig, greatest_radps = Rig(p, step, HELD_KG), 0.0
    for _ in range(4000):
        rig.step(1.0, selector=Selector.NEUTRAL)
        greatest_radps = max(greatest_radps, rig.engine_radps)
    assert p.engine.rev_limit_radps < greatest_radps < p.engine.rev_limit_radps + p.engine.rev_fade_radps
    assert rig.drive_n == 0.0


def test_fuel_is_cut_on_the_overrun_and_the_engine_brakes(p, step):
    rig = held(p, step, 30.0, 4, 0.0, 1.0)
    ratio, efficiency = p.gearbox.ratios[3] * p.gearbox.final_drive, p.driveline.efficiency
    friction_nm = p.engine.friction_nm + p.engine.friction_nms * rig.engine_radps
    assert rig.gas_nm == pytest.approx(0.0, abs=1e-3)
    assert rig.drive_n == pytest.approx(-friction_nm * ratio / efficiency / p.pedal.wheel_radius_m - drag_n(p, 30.0), rel=0.01)
    assert 250.0 < -rig.drive_n < 1300.0


def test_an_overloaded_engine_stalls_and_its_starter_brings_it_back(p, step):
    rig = Rig(p, step, HELD_KG).run(1.0, selector=Selector.NEUTRAL)
    rig.run(0.8, selector=Selector.NEUTRAL, load_nm=1.3 * max(p.engine.full_load_nm))
    assert rig.engine_radps < p.engine.stall_radps
    rig.x[0] = 0.0
    rig.run(1.0, selector=Selector.NEUTRAL)
    assert rig.engine_radps > 0.9 * p.engine.idle_radps
    assert rig.run(2.0, selector=Selector.NEUTRAL).engine_radps == pytest.approx(p.engine.idle_radps, abs=20.0 * RPM)


def test_combustion_collapses_below_idle(p):
    def burnt_nm(engine_radps: float) -> float:
        with_gas, without = (float(powertrain.flywheel_nm(p.engine, engine_radps, gas_nm)) for gas_nm in (100.0, 0.0))
        return with_gas - without

    assert burnt_nm(p.engine.idle_radps) == pytest.approx(100.0)
    assert burnt_nm(0.5 * (p.engine.stall_radps + p.engine.fire_radps)) == pytest.approx(50.0)
    assert burnt_nm(p.engine.stall_radps) == 0.0


def test_wheels_that_lock_at_speed_do_not_stall_the_engine(p, step):
    rig = Rig(p, step, 1554.0, speed_mps=22.0, gear=5).run(2.0, 0.1)
    assert rig.state.lockup_norm == 1.0
    least_radps = math.inf
    for _ in range(3000):
        rig.x[2] = max(rig.x[2] - 0.73, 0.0)
        rig.step(0.0)
        assert all(map(math.isfinite, rig.x))
        least_radps = min(least_radps, rig.engine_radps)
    assert least_radps > 0.8 * p.engine.idle_radps


def test_reverse_pulls_backwards(vehicle, p, step):
    assert Rig(p, step, HELD_KG).run(2.5, 1.0, selector=Selector.REVERSE).drive_n == pytest.approx(-p.pedal.full_force_n, rel=0.03)
    rig = on_the_road(vehicle, step).run(4.0, 0.2, selector=Selector.REVERSE)
    assert rig.speed_mps < -1.5
    assert rig.state.gear == -1


def test_the_wheels_of_a_lifted_car_turn_at_a_moderate_speed(vehicle, step):
    assert 3.0 < on_the_lift(vehicle, step).run(8.0).wheels_radps < 15.0
    assert on_the_lift(vehicle, step).run(8.0, 0.2).wheels_radps < 20.0
    assert on_the_lift(vehicle, step).run(8.0, 1.0).wheels_radps < 50.0


def test_free_wheels_on_rollers_are_bounded_by_the_schedule_and_the_limiter(p, step, vehicle):
    rig = on_the_lift(vehicle, step)
    rig.car_share = 1.0
    for _ in range(8000):
        rig.step(1.0)
        assert rig.engine_radps < p.engine.rev_limit_radps * 1.05
        assert math.isfinite(rig.drive_n)


def test_time_to_100_kmh(vehicle, step):
    rig = on_the_road(vehicle, step).run(1.0, push_n=-600.0)
    rig.x[2], start_s = 0.0, rig.time_s
    while rig.speed_mps < 27.78 and rig.time_s < 25.0:
        rig.step(1.0)
    low_s, high_s = {"focus": (10.0, 12.5), "van": (13.0, 17.0)}[vehicle.name]
    assert low_s < rig.time_s - start_s < high_s


def test_the_transmission_never_gives_more_power_than_it_takes(p):
    at = ca.SX.sym("at", 5)
    flow = powertrain.transmission(p, powertrain.Shafts(*ca.vertsplit(at)))
    loss = ca.Function("loss", [at], [flow.pump_nm * at[0] - flow.axle_nm * at[4], flow.axle_nm * at[4]])
    rng = random.Random(11)
    ratios = [*p.gearbox.ratios, -p.gearbox.reverse_ratio, 0.0]
    states = [
        (rng.uniform(0, 750), rng.choice(ratios) * p.gearbox.final_drive, rng.random(), rng.choice([0, 1, 0.3]), rng.uniform(-60, 200))
        for _ in range(20000)
    ]
    lost_w, given_w = (np.array(values).ravel() for values in loss(np.array(states).T))
    assert lost_w.min() >= -1e-6
    assert given_w.max() > 1e4
    assert given_w.min() < -1e4


def poles_radps(p: PowertrainParameters, inertia_kgm2: float) -> float:
    """Fastest pole over states that the powertrain can be in, with the driven wheels and all they drag along as one inertia."""
    s, u = ca.SX.sym("s", 3), ca.SX.sym("u", 5)
    rates = powertrain.derivatives(p, s[0], s[1], u[0], u[1], u[2], u[3], s[2], u[4])
    jacobian = ca.Function("jacobian", [s, u], [ca.jacobian(ca.vertcat(rates[0], rates[1], rates[2] / inertia_kgm2), s)])
    rng, fastest = random.Random(7), 0.0
    for _ in range(1500):
        gear = rng.randrange(-1, len(p.gearbox.ratios)) + 1
        ratio = (p.gearbox.ratios[gear - 1] if gear else -p.gearbox.reverse_ratio) * p.gearbox.final_drive
        is_locked = gear >= p.gearbox.lockup_gear and rng.random() < 0.5
        engine_radps = rng.uniform(0.0, p.engine.rev_limit_radps + p.engine.rev_fade_radps)
        turbine_radps = engine_radps + rng.uniform(-15.0, 15.0) if is_locked else engine_radps * rng.uniform(-0.2, 1.15)
        state = [engine_radps, rng.uniform(0.0, 250.0), turbine_radps / ratio]
        inputs = [rng.random(), ratio, rng.choice([0.2, 1.0]), float(is_locked), state[2] * p.pedal.wheel_radius_m]
        fastest = max(fastest, np.abs(np.linalg.eigvals(np.array(jacobian(state, inputs)))).max())
    return fastest


def test_poles_leave_room_for_a_step_of_1_ms(p, vehicle):
    car_kgm2 = ROAD[vehicle.name][0] * p.pedal.wheel_radius_m**2
    assert 20.0 < poles_radps(p, car_kgm2) < 250.0
    assert STEP_S * poles_radps(p, WHEELS_KGM2[vehicle.name]) < 0.8


@pytest.mark.parametrize("swept", range(8))
def test_derivatives_are_continuous(focus, swept):
    p = focus.powertrain
    x = ca.SX.sym("x", 8)
    rates = ca.Function("rates", [x], [ca.vertcat(*powertrain.derivatives(p, *ca.vertsplit(x)))])
    low = [0.0, 0.0, 0.0, -10.0, 0.0, 0.0, -30.0, -10.0][swept]
    high = [750.0, 250.0, 1.0, 14.0, 1.0, 1.0, 100.0, 40.0][swept]
    middle = np.tile([[150.0], [60.0], [0.3], [5.1], [1.0], [0.5], [25.0], [8.0]], 20001)
    middle[swept] = np.linspace(low, high, 20001)
    values = np.array(rates(middle))
    jumps = np.abs(np.diff(values, axis=1)).max(axis=1)
    spans = np.ptp(values, axis=1)
    assert np.all(jumps <= 0.01 * spans + 1e-9)


def test_parameters_may_be_symbols(p):
    symbolic, vector = parameter_symbols(p)
    x = ca.SX.sym("x", 8)
    with_symbols = ca.Function("f", [vector, x], [ca.vertcat(*powertrain.derivatives(symbolic, *ca.vertsplit(x)))])
    with_numbers = ca.Function("f", [x], [ca.vertcat(*powertrain.derivatives(p, *ca.vertsplit(x)))])
    at = [210.0, 80.0, 0.4, 5.1, 0.9, 0.3, 30.0, 9.0]
    assert np.array(with_symbols(numbers(p), at)) == pytest.approx(np.array(with_numbers(at)))
