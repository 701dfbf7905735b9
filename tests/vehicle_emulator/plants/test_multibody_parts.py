"""The parts of the car, each against what its source says of it, and the vectors they share."""

import math

import casadi as ca
import numpy as np
import pytest

from dbc.vehicle import FOCUS, VehicleError, load_vehicle
from vehicle_emulator.plants.multibody import brake, chassis, tyre
from vehicle_emulator.plants.multibody.bristle import Bristle
from vehicle_emulator.plants.multibody.equations import build_functions
from vehicle_emulator.plants.multibody.layout import FELT, INPUTS, MOTION, STATE, leaves, numbers, slices
from vehicle_emulator.plants.multibody.library import MOTIONS, OUTPUTS, STATES, CompiledCar, build
from vehicle_emulator.plants.multibody.parameters import car_parameters
from vehicle_emulator.plants.multibody.symbols import parameter_symbols


def on_the_road(load_n, rolling_mps=20.0, slide_x_mps=0.0, slide_y_mps=0.0):
    return tyre.Contact(ca.DM([1, 0, 0]), ca.DM([0, 1, 0]), ca.DM([0, 0, 1]), 0.3, load_n, rolling_mps, slide_x_mps, slide_y_mps)


def forces(p, load_n, slip_x, slip_y, friction=1.0, **motion):
    found = tyre.forces(p, on_the_road(load_n, **motion), friction, slip_x, slip_y)
    return tuple(float(value) for value in found)


@pytest.fixture(scope="module")
def focus_tyre(focus):
    return focus.multibody.tyre


# --- tyre ---


def test_slip_stiffness_and_peak_are_those_of_the_coefficients(focus_tyre):
    f, load_n = focus_tyre.formula, focus_tyre.formula.nominal_load_n
    x_n, _, _ = forces(focus_tyre, load_n, 1e-6, 0.0)
    _, y_n, _ = forces(focus_tyre, load_n, 0.0, 1e-6)
    assert x_n / 1e-6 == pytest.approx(f.p_kx1 * load_n, rel=1e-4)
    assert y_n / 1e-6 == pytest.approx(f.p_ky1 * math.sin(2.0 * math.atan(1.0 / f.p_ky2)) * load_n, rel=1e-4)
    slips = np.linspace(0.0, 0.6, 601)
    grip_n = focus_tyre.friction * load_n
    assert max(forces(focus_tyre, load_n, slip, 0.0)[0] for slip in slips) == pytest.approx(f.p_dx1 * grip_n, rel=1e-3)
    assert max(forces(focus_tyre, load_n, 0.0, slip)[1] for slip in slips) == pytest.approx(f.p_dy1 * grip_n, rel=1e-3)


def test_pure_lateral_force_is_the_magic_formula_written_out(focus_tyre):
    f, load_n, slip = focus_tyre.formula, 3000.0, 0.05
    overload = load_n / f.nominal_load_n - 1.0
    shape, peak_n = f.p_cy1, focus_tyre.friction * (f.p_dy1 + f.p_dy2 * overload) * load_n
    stiffness_n = f.p_ky1 * f.nominal_load_n * math.sin(2.0 * math.atan(load_n / (f.p_ky2 * f.nominal_load_n)))
    b, e = stiffness_n / (shape * peak_n), f.p_ey1 + f.p_ey2 * overload
    expected_n = peak_n * math.sin(shape * math.atan(b * slip - e * (b * slip - math.atan(b * slip))))
    assert forces(focus_tyre, load_n, 0.0, slip)[1] == pytest.approx(expected_n, rel=1e-12)


def test_grip_per_load_falls_with_load_and_follows_the_road(focus_tyre):
    light, heavy = (forces(focus_tyre, load_n, 0.0, 0.2)[1] / load_n for load_n in (2000.0, 6000.0))
    assert light > 1.1 * heavy
    dry_n, wet_n = (max(forces(focus_tyre, 4000.0, 0.002 * k, 0.0, friction)[0] for k in range(300)) for friction in (1.0, 0.3))
    assert wet_n == pytest.approx(0.3 * dry_n, rel=1e-3)


def test_forces_share_the_grip(focus_tyre):
    alone_n = forces(focus_tyre, 4000.0, 0.0, 0.08)[1]
    braked_x_n, braked_y_n, _ = forces(focus_tyre, 4000.0, -0.15, 0.08)
    assert braked_y_n < 0.8 * alone_n
    assert math.hypot(braked_x_n, braked_y_n) < 1.2 * focus_tyre.friction * 4000.0 * 1.1


@pytest.mark.parametrize("load_n", [0.0, 1e-9, 300.0, 4000.0, 60_000.0])
@pytest.mark.parametrize("friction", [0.0, 0.01, 1.2])
def test_forces_oppose_the_slip_and_stay_within_the_grip(focus_tyre, load_n, friction):
    for slip_x in (-1.2, -0.1, 0.0, 0.3):
        for slip_y in (-2.0, 0.0, 0.05, 1.5):
            x_n, y_n, aligning_nm = forces(focus_tyre, load_n, slip_x, slip_y, friction)
            assert math.isfinite(x_n + y_n + aligning_nm)
            assert x_n * slip_x >= -1e-9
            assert y_n * slip_y >= -1e-9
            assert math.hypot(x_n, y_n) <= 2.0 * load_n * max(friction, 0.01)


def test_small_slip_angles_turn_the_wheel_back(focus_tyre):
    _, y_n, aligning_nm = forces(focus_tyre, 4000.0, 0.0, 0.02)
    assert aligning_nm < 0.0
    assert 0.02 < -aligning_nm / y_n < 0.045
    assert abs(forces(focus_tyre, 4000.0, 0.0, 0.3)[2]) < abs(aligning_nm)


def test_slips_relax_to_their_steady_values(focus_tyre):
    at = on_the_road(4000.0, rolling_mps=20.0, slide_x_mps=1.0, slide_y_mps=-0.8)
    rate_x, rate_y = tyre.slip_rates(focus_tyre, at, -0.05, 0.04, 0.0)
    assert float(rate_x) == pytest.approx(0.0, abs=1e-2)
    assert float(rate_y) == pytest.approx(0.0, abs=1e-2)
    rate_x, rate_y = tyre.slip_rates(focus_tyre, at, 0.0, 0.0, 0.01)
    assert float(rate_x) == pytest.approx(-1.0 / focus_tyre.relaxation_x_m)
    assert float(rate_y) == pytest.approx((0.8 + 0.01 * 20.0) / focus_tyre.relaxation_y_m)


def test_a_standing_tyre_is_a_damped_spring_and_a_sliding_one_winds_up_no_further(focus_tyre):
    standing = on_the_road(4000.0, rolling_mps=0.0, slide_y_mps=0.001)
    _, still_n, _ = forces(focus_tyre, 4000.0, 0.0, 0.01, rolling_mps=0.0)
    _, moving_n, _ = forces(focus_tyre, 4000.0, 0.0, 0.01, rolling_mps=0.0, slide_y_mps=0.001)
    expected_n = focus_tyre.standstill_damping_nspm * 4000.0 / focus_tyre.formula.nominal_load_n * 0.001
    assert still_n - moving_n == pytest.approx(expected_n, rel=0.1)
    assert float(tyre.slip_rates(focus_tyre, standing, 0.0, 0.01, 0.0)[1]) == pytest.approx(-0.001 / focus_tyre.relaxation_y_m)
    sliding = on_the_road(4000.0, rolling_mps=0.0, slide_y_mps=-5.0)
    assert float(tyre.slip_rates(focus_tyre, sliding, 0.0, 0.9, 0.0)[1]) > 0.0
    assert float(tyre.slip_rates(focus_tyre, sliding, 0.0, 1.1, 0.0)[1]) < 0.0


def contact(p, height_m, *, falling_mps=0.0, spin_radps=0.0, speed_mps=0.0):
    left, up, still, hub_mps = ca.DM([0, 1, 0]), ca.DM([0, 0, 1]), ca.DM.zeros(3), ca.DM([speed_mps, 0.0, -falling_mps])
    wheel = {"axle": left, "normal": up, "height_m": height_m, "hub_mps": hub_mps, "rates_radps": still, "spin_radps": spin_radps}
    return tyre.contact(p, **wheel, load_share=1.0)


def test_the_road_pushes_and_never_pulls(focus_tyre):
    radius_m, stiffness_npm = focus_tyre.radius_m, focus_tyre.stiffness_npm
    assert float(contact(focus_tyre, radius_m - 0.02).load_n) == pytest.approx(0.02 * stiffness_npm)
    assert float(contact(focus_tyre, radius_m - 0.001, falling_mps=-50.0).load_n) == 0.0
    assert float(contact(focus_tyre, radius_m + 0.001, falling_mps=50.0).load_n) == 0.0
    assert float(contact(focus_tyre, radius_m + 1000.0).radius_m) == radius_m


def test_a_wheel_that_rolls_does_not_slide(focus_tyre):
    at = contact(focus_tyre, focus_tyre.radius_m - 0.018, spin_radps=100.0, speed_mps=(focus_tyre.radius_m - 0.006) * 100.0)
    assert float(at.slide_x_mps) == pytest.approx(0.0, abs=1e-6)
    faster = contact(focus_tyre, focus_tyre.radius_m - 0.018, spin_radps=110.0, speed_mps=30.0)
    assert float(faster.slide_x_mps) < 0.0


# --- suspension ---


def reaction(p, force_n):
    """What a force at one front left wheel does along its axis, over the vertical force."""
    return float(ca.dot(chassis.design(p).axes[0], ca.DM(force_n)))


def test_roll_centre_and_anti_dive_take_their_share_of_the_forces(focus):
    p = focus.multibody
    # In a left turn the left wheel is inside: the links press it up and the body down there.
    assert reaction(p, (0.0, 1000.0, 0.0)) == pytest.approx(1000.0 * 2.0 * p.front.roll_centre_m / p.front.track_m)
    design = chassis.design(p)
    assert float(design.axes[1][1]) == -float(design.axes[0][1])
    assert float(design.reference_m[2]) < 0.0


@pytest.mark.parametrize(("key", "values", "measure"), [("roll_centre_m", (0.0, 0.15), "roll"), ("braking_slope", (0.0, 0.1), "dive")])
def test_kinematics_act_in_the_right_direction(focus, compiled, key, values, measure):
    """More roll centre, less roll; more anti-dive in front, less travel of the front under braking."""
    s, u = slices(STATE), slices(INPUTS)
    travels = []
    for value in values:
        multibody = focus.multibody.model_copy(update={"front": focus.multibody.front.model_copy(update={key: value})})
        car = compiled(focus.model_copy(update={"multibody": multibody}))
        car.state[s.attitude], car.state[s.velocity_mps] = (1.0, 0.0, 0.0, 0.0), (20.0, 0.0, 0.0)
        car.state[s.spin_radps] = (20.0 / 0.31,) * 4
        car.advance(0.0, 0)
        car.state[2] = -car.outputs[2]
        car.inputs[u.brake_share], car.inputs[u.torque_limit_nm], car.inputs[u.road] = (1.0,), (60.0,), (0.0, 0.0, 0.0, 1.0) * 4
        car.inputs[u.demand_rad], car.inputs[u.brake] = ((0.6,), (0.0,)) if measure == "roll" else ((0.0,), (0.4,))
        car.advance(0.001, 900)
        travel_m = car.state[s.travel_m]
        travels.append(travel_m[1] - travel_m[0] if measure == "roll" else travel_m[0])
    assert travels[0] > travels[1] + 0.001 > 0.001


def test_aligning_moments_turn_the_car(focus):
    """With the pneumatic trail, the yaw acceleration of a car that slips sideways is less by sum of the moments over the inertia."""
    parameters, states = car_parameters(focus), slices(STATE)
    derivatives, p, masses = build_functions(parameters).derivatives, focus.multibody, focus.multibody.masses
    x, u = np.zeros(STATES), np.zeros(sum(INPUTS))
    x[states.attitude.start], x[states.velocity_mps.start], x[states.slip_y] = 1.0, 20.0, 0.03
    x[2] = masses.cog_height_m - float(chassis.design(p).reference_m[2])
    u[slices(INPUTS).road] = (0.0, 0.0, 0.0, 1.0) * 4
    accelerations = []
    for trail in (p.tyre.formula.q_dz1, 0.0):
        formula = p.tyre.formula.model_copy(update={"q_dz1": trail, "q_dz2": 0.0})
        changed = p.model_copy(update={"tyre": p.tyre.model_copy(update={"formula": formula})})
        rate, _ = derivatives(x, u, numbers(parameters.model_copy(update={"multibody": changed})))
        accelerations.append(float(rate[states.rates_radps][2]))
    tyres = p.tyre.model_copy(update={"formula": p.tyre.formula.model_copy(update={"q_dz2": 0.0})})
    moment_nm = sum(forces(tyres, float(load_n), 0.0, 0.03)[2] for load_n in chassis.design(p).loads_n)
    arms = ((p.front, masses.cog_to_front_m), (p.rear, -masses.cog_to_rear_m))
    inertia_kgm2 = masses.sprung_yaw_inertia_kgm2 + sum(2.0 * a.wheel_kg * (x_m**2 + 0.25 * a.track_m**2) for a, x_m in arms)
    assert accelerations[0] - accelerations[1] == pytest.approx(moment_nm / inertia_kgm2, rel=0.03)
    assert moment_nm < -100.0


# --- brakes and friction ---


def test_anti_lock_lets_pressure_off_with_slip_at_speed_only(focus):
    p = focus.multibody.brakes
    share = lambda speed_mps, slip, q=p: float(brake.pressure_share(q, speed_mps, slip))  # noqa: E731
    assert share(20.0, -0.05) == 1.0
    assert share(20.0, -0.8) == 0.0
    assert 0.0 < share(20.0, -0.15) < 1.0
    assert share(-20.0, 0.8) == 0.0
    assert share(20.0, 0.8) == 1.0
    assert share(0.9 * p.abs_mps, -1.0) == 1.0
    assert share(20.0, -0.8, p.model_copy(update={"has_abs": False})) == 1.0


def test_a_bristle_holds_at_rest_and_slides_beyond_its_way():
    bristle = Bristle(way=0.01, way_s=0.002, damping_s=0.0)
    assert float(bristle.rate(0.0, 0.7)) == 0.0
    bend = 0.0
    for _ in range(2000):
        bend += 1e-4 * float(bristle.rate(0.5, bend))
    assert bend == pytest.approx(1.0, abs=1e-3)
    assert float(bristle.rate(1.0, 1.0)) == pytest.approx(0.0)
    assert float(bristle.rate(-1.0, 1.0)) < 0.0


# --- vectors ---


def test_every_number_has_its_symbol(vehicle):
    car = car_parameters(vehicle)
    symbolic, vector = parameter_symbols(car)
    assert vector.numel() == len(numbers(car)) == sum(len(values) for _, values in leaves(car))
    names = [str(symbol) for symbol in ca.vertsplit(vector)]
    assert names == [name.rpartition(".")[2] for name, values in leaves(car) for _ in values]
    ratios = ca.Function("f", [vector], [symbolic.powertrain.gearbox.ratios[1] * symbolic.multibody.rear.track_m])
    assert float(ratios(numbers(car))) == vehicle.powertrain.gearbox.ratios[1] * vehicle.multibody.rear.track_m


def test_tables_fill_their_vectors(focus):
    functions = build_functions(car_parameters(focus))
    assert functions.derivatives.size1_in(0) == functions.derivatives.size1_out(0) == STATES == sum(STATE)
    assert functions.derivatives.size1_in(1) == sum(INPUTS)
    assert functions.motion.size1_out(0) == MOTIONS == sum(MOTION)
    assert functions.derivatives.size1_out(1) == OUTPUTS - MOTIONS == sum(FELT)
    places = slices(STATE)
    assert places.position_m == slice(0, 3)
    assert [place.start for place in places[1:]] == [place.stop for place in places[:-1]]


def test_one_library_serves_cars_of_the_same_shape(focus):
    other = focus.model_copy(update={"multibody": focus.multibody.model_copy(update={"drag_area_m2": 2.0})})
    builds = [build(car_parameters(car), lambda _: None) for car in (focus, other)]
    assert builds[0].library == builds[1].library
    assert builds[1].was_cached


def test_the_compiled_equations_are_those_of_casadi(focus):
    parameters = car_parameters(focus)
    car, derivatives = CompiledCar(build(parameters, lambda _: None), parameters), build_functions(parameters).derivatives
    random = np.random.default_rng(1)
    state = random.normal(0.0, 0.1, STATES)
    state[3:11] += (1.0, 0.0, 0.0, 0.0, 15.0, 0.0, 0.0, 0.0)
    car.state[:] = state
    car.inputs[:] = random.normal(0.0, 0.1, sum(INPUTS))
    step_s = 1e-9
    car.advance(step_s)
    rate, _ = derivatives(state, np.array(car.inputs), numbers(parameters))
    assert np.allclose((np.array(car.state) - state) / step_s, np.array(rate).ravel(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("line", "by", "message"),
    [
        ("track_m = { value = 1.559", "track_m = { value = -1.0", "multibody.front.track_m = -1.0"),
        ("has_abs = { value = true", "has_abs = { value = 1.0", "multibody.brakes.has_abs = 1.0"),
        ("p_kx1 = { value", "p_kx9 = { value", "multibody.tyre.formula.p_kx9"),
        ("radius_m = { value = 0.316", "radius_m = { value = nan", "multibody.tyre.radius_m"),
    ],
)
def test_a_wrong_number_is_named(tmp_path, line, by, message):
    text = FOCUS.read_text(encoding="utf-8")
    assert text.count(line) == 1
    path = tmp_path / "car.toml"
    path.write_text(text.replace(line, by), encoding="utf-8")
    with pytest.raises(VehicleError, match=message) as refused:
        load_vehicle(path)
    assert str(path) in str(refused.value)
