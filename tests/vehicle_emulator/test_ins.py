"""The navigation system as an instrument: latency, place, noise, cycles and time base."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from random import Random
from statistics import correlation, fmean, pstdev

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load
from dbc.frame import CanFrame
from dbc.ins import InsParameters
from dbc.vehicle import FOCUS, VehicleError, load_vehicle
from vehicle_emulator import ins
from vehicle_emulator.ins import NavigationSystem, Solution
from vehicle_emulator.plants.interface import PlantState

CATALOGUE = load()
P = load_vehicle().ins
QUIET = P.model_copy(update={key: 0.0 for key in InsParameters.model_fields if "sigma" in key})
HERE = (0.0, 0.0, 0.0)
MS_NS = 1_000_000
CYCLE_NS = 10 * MS_NS
REST = PlantState()
LEFT_TURN = PlantState(
    x_m=120.5, y_m=-33.25, z_m=0.4, roll_rad=0.05, pitch_rad=-0.02, yaw_rad=0.4, vx_mps=18.0, vy_mps=0.3, vz_mps=-0.1,
    roll_rate_radps=0.1, pitch_rate_radps=-0.05, yaw_rate_radps=0.25, ax_mps2=-1.5, ay_mps2=4.5, az_mps2=0.2,
)  # fmt: skip


def instrument(parameters: InsParameters, state: PlantState = REST, seed: int = 1, start_ns: int = 0) -> NavigationSystem:
    return NavigationSystem(parameters, CATALOGUE, Random(seed), period_ns=MS_NS, start_ns=start_ns, state=state)


def received(system: NavigationSystem, name: str, now_ns: int = CYCLE_NS) -> dict[str, float]:
    """A message after the wire: encoded and decoded by the DBC."""
    spec = CATALOGUE.by_name[name]
    payload = CATALOGUE.encode(name, system.message(name, now_ns))
    return CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, payload, now_ns))


@pytest.mark.parametrize("turns", [-2.3, -0.5, -0.25, 0.0, 0.499999, 0.5, 0.75, 7.1])
def test_angles_stay_in_range_however_often_the_car_has_turned(turns: float):
    state = PlantState(yaw_rad=2 * math.pi * turns, vx_mps=10.0)
    system = instrument(QUIET, state)
    yaw_deg = received(system, "VelYawLocal")["AngleLocalYaw"]
    heading_deg = system.message("HeadingPitchRoll", CYCLE_NS)["AngleHeading"]
    assert -180.0 <= yaw_deg <= 180.0
    assert 0.0 <= heading_deg < 360.0
    assert math.cos(math.radians(yaw_deg)) == pytest.approx(math.cos(state.yaw_rad), abs=1e-3)
    assert math.sin(math.radians(90.0 - heading_deg)) == pytest.approx(math.sin(state.yaw_rad), abs=1e-4)


@pytest.mark.parametrize("error_deg", [-1e-12, 0.004, 0.0049, 0.0051, -0.004, -0.0051])
def test_north_is_never_360_degrees(error_deg: float):
    system = instrument(QUIET, PlantState(yaw_rad=math.radians(90.0 + error_deg), vx_mps=10.0))
    assert received(system, "HeadingPitchRoll")["AngleHeading"] in (0.0, 359.99, 0.01)
    assert received(system, "TrackSlipCurvature")["AngleTrack"] in (0.0, 359.99, 0.01)


def test_every_signal_is_within_half_a_bit_of_the_solution():
    system = instrument(P, LEFT_TURN)
    motion = system.solution(CYCLE_NS).motion
    local, rates = received(system, "PosLocal"), received(system, "RateVehicle")
    assert local["PosLocalX"] == pytest.approx(motion.position_m[0], abs=0.51e-4)
    assert local["PosLocalY"] == pytest.approx(motion.position_m[1], abs=0.51e-4)
    assert math.radians(rates["AngRateX"]) == pytest.approx(motion.rates_radps[0], abs=0.9e-4)
    assert received(system, "AccelVehicle")["AccelX"] == pytest.approx(motion.specific_force_mps2[0], abs=0.51e-2)


@pytest.mark.parametrize("latency_s", [0.0, 0.001, 0.0035, 0.004, 0.0123])
def test_latency_is_in_the_data_and_in_the_time_of_validity(latency_s: float):
    start_ns, steps = 123 * MS_NS, math.ceil(round(1e3 * latency_s, 6))
    system = instrument(QUIET.model_copy(update={"latency_s": latency_s}), start_ns=start_ns)
    first_ms = received(system, "MilliTime", start_ns)["MilliTime"]
    for k in range(1, 51):
        system.observe(REST._replace(x_m=0.02 * k))  # 20 m/s
    now_ns = start_ns + 50 * MS_NS
    assert received(system, "PosLocal", now_ns)["PosLocalX"] == pytest.approx(0.02 * (50 - steps), abs=1e-6)
    assert received(system, "MilliTime", now_ns)["MilliTime"] - first_ms == 50
    assert first_ms == (ins.START - datetime(1980, 1, 6)) / timedelta(milliseconds=1) - steps


def test_date_and_status_agree_with_the_time_of_validity():
    system = instrument(QUIET)
    now_ns = 3_723_450 * MS_NS
    valid = datetime(1980, 1, 6) + timedelta(milliseconds=received(system, "MilliTime", now_ns)["MilliTime"])
    date = received(system, "DateTime", now_ns)
    seconds = date["TimeSecond"] + date["TimeHSecond"]
    sent = datetime(int(date["TimeCentury"] + date["TimeYear"]), int(date["TimeMonth"]), int(date["TimeDay"]))
    sent += timedelta(hours=date["TimeHour"], minutes=date["TimeMinute"], seconds=seconds)
    assert timedelta() <= valid - sent < timedelta(milliseconds=10)
    minutes = received(system, "NcomStatus00", now_ns)["GpsMinutes"]
    assert timedelta() <= valid - datetime(1980, 1, 6) - timedelta(minutes=minutes) < timedelta(minutes=1)


def test_a_start_whose_leap_seconds_are_unknown_is_refused():
    with pytest.raises(ValueError, match=r"start_time 2016-12-31 .* before 2017-01-01"):
        NavigationSystem(P, CATALOGUE, Random(1), period_ns=MS_NS, start_ns=0, state=REST, start_time=datetime(2016, 12, 31))


def ecef_m(latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
    """Earth-centred coordinates by the closed formula of the WGS-84 ellipsoid, from its semi-axes."""
    a, b = 6_378_137.0, 6_356_752.314245
    phi, lam = math.radians(latitude_deg), math.radians(longitude_deg)
    n = a * a / math.hypot(a * math.cos(phi), b * math.sin(phi))
    r = (n + altitude_m) * math.cos(phi)
    return r * math.cos(lam), r * math.sin(lam), (b * b / (a * a) * n + altitude_m) * math.sin(phi)


def east_north_up_m(x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
    """Where a car at this place of the local frame is, from the origin, as its latitude, longitude and altitude tell."""

    def geodetic(state: PlantState) -> tuple[float, float, float]:
        system = instrument(QUIET, state)
        place = received(system, "LatitudeLongitude")
        return place["PosLat"], place["PosLon"], received(system, "Altitude")["Altitude"]

    origin, here = geodetic(REST), geodetic(PlantState(x_m=x_m, y_m=y_m, z_m=z_m))
    dx, dy, dz = (b - a for a, b in zip(ecef_m(*origin), ecef_m(*here), strict=True))
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    return (
        -math.sin(lam) * dx + math.cos(lam) * dy,
        -math.sin(phi) * (math.cos(lam) * dx + math.sin(lam) * dy) + math.cos(phi) * dz,
        math.cos(phi) * (math.cos(lam) * dx + math.sin(lam) * dy) + math.sin(phi) * dz,
    )


@pytest.mark.parametrize("place_m", [(200.0, 150.0, 5.0), (-250.0, 30.0, -2.0), (0.0, -300.0, 40.0), (3.0, 4.0, 0.0)])
def test_latitude_longitude_and_altitude_lead_back_to_the_local_position(place_m: tuple[float, float, float]):
    # One bit is 1.1 cm; the earth is not flat by 1.5 cm at this distance.
    assert east_north_up_m(*place_m) == pytest.approx(place_m, abs=0.02)


def test_metres_are_those_of_the_ellipsoid_at_the_height_of_the_origin():
    # Straight north and straight east the curvature of the earth shows in the height alone; at height 0 it would be 6 cm less.
    assert east_north_up_m(0.0, 3000.0, 0.0)[1] == pytest.approx(3000.0, abs=0.025)
    assert east_north_up_m(3000.0, 0.0, 0.0)[0] == pytest.approx(3000.0, abs=0.025)


def circle(t_s: float, lever_m: tuple[float, float, float] = HERE) -> tuple[float, float, float]:
    """Place of a point of a banked car that turns left at a growing rate around the origin."""
    angle = 0.3 * t_s + 0.1 * t_s * t_s
    forward, left, up = lever_m
    level_left, level_up = left * math.cos(0.1) - up * math.sin(0.1), left * math.sin(0.1) + up * math.cos(0.1)
    cosine, sine = math.cos(angle + math.pi / 2), math.sin(angle + math.pi / 2)
    x_m, y_m = 40.0 * math.cos(angle), 40.0 * math.sin(angle)
    return x_m + cosine * forward - sine * level_left, y_m + sine * forward + cosine * level_left, level_up


def derivative(of: Callable[[float], tuple[float, float, float]], t_s: float, h: float = 1e-4) -> tuple[float, ...]:
    return tuple((b - a) / (2 * h) for a, b in zip(of(t_s - h), of(t_s + h), strict=True))


def circling(t_s: float) -> PlantState:
    """The same car, as the plant tells it: its reference point moves on the circle, its roll is constant."""
    angle, rate, spin = 0.3 * t_s + 0.1 * t_s * t_s, 0.3 + 0.2 * t_s, 0.2
    to_left_mps2, forward_mps2 = 40.0 * rate * rate, 40.0 * spin
    return PlantState(
        x_m=40.0 * math.cos(angle), y_m=40.0 * math.sin(angle), yaw_rad=angle + math.pi / 2, roll_rad=0.1,
        vx_mps=40.0 * rate, pitch_rate_radps=rate * math.sin(0.1), yaw_rate_radps=rate * math.cos(0.1),
        ax_mps2=forward_mps2, ay_mps2=to_left_mps2 * math.cos(0.1), az_mps2=-to_left_mps2 * math.sin(0.1),
    )  # fmt: skip


@pytest.mark.parametrize("mounted_m", [HERE, (-0.45, 0.1, 0.05), (2.0, -0.5, 0.6)])
@pytest.mark.parametrize("output_m", [HERE, (1.5, 0.4, -0.3)])
def test_the_solution_is_that_of_the_output_point_wherever_the_instrument_is_mounted(mounted_m, output_m):
    system = instrument(QUIET.model_copy(update={"lever_arm_m": mounted_m, "output_lever_m": output_m, "latency_s": 0.0}), circling(0.0))
    for k in range(1, 1001):
        system.observe(circling(1e-3 * k))
        if k % 10 == 0:
            system.solution(k * MS_NS)
    motion = system.solution(1000 * MS_NS).motion
    assert motion.position_m == pytest.approx(circle(1.0, output_m), abs=1e-9)
    assert motion.velocity_mps == pytest.approx(derivative(lambda t: circle(t, output_m), 1.0), abs=1e-6)
    moved = received(system, "IsoEfsAcceleration", 1000 * MS_NS)
    expected = derivative(lambda t: derivative(lambda u: circle(u, output_m), t), 1.0)  # type: ignore[arg-type, return-value]
    assert tuple(moved.values()) == pytest.approx(expected, abs=0.02)


def solutions(parameters: InsParameters, seed: int, count: int, state: PlantState = REST) -> Iterator[Solution]:
    system = instrument(parameters, state, seed)
    for k in range(1, count + 1):
        yield system.solution(k * CYCLE_NS)


def test_white_noise_has_the_spread_of_the_vehicle_file():
    alone = P.model_copy(update={"lever_arm_m": HERE, "gyro_bias_sigma_radps": 0.0, "acceleration_bias_sigma_mps2": 0.0})
    samples = [s.motion for s in solutions(alone, seed=3, count=4000)]
    for axis in range(3):
        assert pstdev(m.velocity_mps[axis] for m in samples) == pytest.approx(P.velocity_sigma_mps, rel=0.06)
        assert pstdev(m.rates_radps[axis] for m in samples) == pytest.approx(P.yaw_rate_sigma_radps, rel=0.06)
        assert pstdev(m.specific_force_mps2[axis] for m in samples) == pytest.approx(P.acceleration_sigma_mps2, rel=0.06)
        assert abs(fmean(m.rates_radps[axis] for m in samples)) < 0.1 * P.yaw_rate_sigma_radps


def test_output_away_from_the_instrument_is_noisier_in_acceleration():
    def spread(lever_m: tuple[float, float, float]) -> float:
        away = P.model_copy(update={"lever_arm_m": HERE, "output_lever_m": lever_m})
        return pstdev(s.motion.specific_force_mps2[1] for s in solutions(away, seed=3, count=3000))

    assert spread((3.0, 0.0, 0.0)) > 1.5 * spread(HERE)


def test_position_error_wanders_with_its_correlation_time():
    fast = P.model_copy(update={"position_correlation_s": 0.5, "position_white_sigma_m": 0.0, "lever_arm_m": HERE})
    errors_m = list(zip(*(s.motion.position_m for s in solutions(fast, seed=5, count=20_000)), strict=True))
    for axis_m, sigma_m in zip(errors_m, (P.position_sigma_m, P.position_sigma_m, 1.5 * P.position_sigma_m), strict=True):
        assert pstdev(axis_m) == pytest.approx(sigma_m, rel=0.1)
        one_correlation_time = 50
        assert correlation(axis_m[:-one_correlation_time], axis_m[one_correlation_time:]) == pytest.approx(math.exp(-1.0), abs=0.1)
    assert abs(correlation(errors_m[0], errors_m[1])) < 0.1


def test_initial_errors_have_the_stationary_spread():
    first = [next(solutions(P.model_copy(update={"lever_arm_m": HERE}), seed, 1)).motion for seed in range(400)]
    assert pstdev(m.position_m[0] for m in first) == pytest.approx(math.hypot(P.position_sigma_m, P.position_white_sigma_m), rel=0.12)
    assert pstdev(m.yaw_rad for m in first) == pytest.approx(math.hypot(P.heading_sigma_rad, P.heading_white_sigma_rad), rel=0.12)
    assert pstdev(m.roll_rad for m in first) == pytest.approx(math.hypot(P.tilt_sigma_rad, P.tilt_white_sigma_rad), rel=0.12)


def test_biases_differ_between_runs_and_hardly_move_within_one():
    still = P.model_copy(update={"lever_arm_m": HERE, "acceleration_sigma_mps2": 0.0, "yaw_rate_sigma_radps": 0.0})
    runs = [[s.motion for s in solutions(still, seed, 200)] for seed in range(150)]
    assert pstdev(run[0].specific_force_mps2[0] for run in runs) == pytest.approx(P.acceleration_bias_sigma_mps2, rel=0.2)
    assert pstdev(run[0].rates_radps[2] for run in runs) == pytest.approx(P.gyro_bias_sigma_radps, rel=0.2)
    moved = [run[-1].specific_force_mps2[0] - run[0].specific_force_mps2[0] for run in runs]
    assert 0.0 < pstdev(moved) < 0.15 * P.acceleration_bias_sigma_mps2  # 2 s of a correlation time of 600 s


def test_seed_decides_the_noise():
    def run(seed: int) -> list[Solution]:
        return list(solutions(P, seed, 20, LEFT_TURN))

    assert run(7) == run(7)
    assert run(7) != run(8)


def test_all_messages_of_a_cycle_are_views_of_one_solution():
    system = instrument(P, LEFT_TURN)
    level, local = system.message("VelocityLevel", CYCLE_NS), system.message("VelYawLocal", CYCLE_NS)
    yaw_rad = math.radians(local["AngleLocalYaw"])
    assert level["VelForward"] == pytest.approx(math.cos(yaw_rad) * local["VelLocalX"] + math.sin(yaw_rad) * local["VelLocalY"])
    assert system.message("PosLocal", CYCLE_NS) == system.message("PosLocal", CYCLE_NS)
    assert system.message("PosLocal", CYCLE_NS) != system.message("PosLocal", 2 * CYCLE_NS)


@pytest.mark.parametrize(("rate_hz", "cycle_ms"), [(100.0, 10), (250.0, 4)])
def test_sends_its_set_every_cycle_and_one_status_channel_in_turn(rate_hz: float, cycle_ms: int):
    start_ns = 7_000_000_003
    system = instrument(P.model_copy(update={"output_rate_hz": rate_hz}), start_ns=start_ns)
    batches = {k: names for k in range(1, 401) if (names := system.due(start_ns + k * MS_NS))}
    assert list(batches) == list(range(cycle_ms, 401, cycle_ms))
    sent = Counter(name for names in batches.values() for name in names)
    assert sent.keys() == set(ins.CORE_MESSAGES)
    assert {sent[name] for name in ins.CORE_MESSAGES if name not in ins.STATUS_MESSAGES} == {400 // cycle_ms}
    channels = [[name for name in names if name in ins.STATUS_MESSAGES] for names in batches.values()]
    assert channels[:5] == [["NcomStatus00"], ["NcomStatus03"], ["NcomStatus04"], ["NcomStatus05"], ["NcomStatus00"]]
    assert {len(names) for names in channels} == {1}
    ids = [CATALOGUE.by_name[name].arbitration_id for name in batches[cycle_ms]]
    assert ids == sorted(ids)


def test_a_stall_of_the_caller_brings_no_burst():
    system = instrument(P)
    assert len(system.due(10 * MS_NS)) == 12
    assert len(system.due(1_003 * MS_NS)) == 12
    assert system.due(1_009 * MS_NS) == ()
    assert len(system.due(1_010 * MS_NS)) == 12


def test_the_dbc_says_what_is_sent(tmp_path: Path):
    path = tmp_path / "site.dbc"
    text = GNSS_IMU_DBC.read_text().replace('BA_ "GenMsgCycleTime" BO_ 1538 10;', 'BA_ "GenMsgCycleTime" BO_ 1538 0;')
    added = 'BA_ "GenMsgCycleTime" BO_ 1547 100;\nBA_ "GenMsgCycleTime" BO_ 1545 10;\nBA_ "GenMsgCycleTime" BO_ 1358 50;\n'
    path.write_text(text.replace("VAL_ 1280 PosMode", f"{added}VAL_ 1280 PosMode"))
    system = NavigationSystem(P, load([ROBOTS_DBC, path]), Random(1), period_ns=MS_NS, start_ns=0, state=REST)
    sent = Counter(name for k in range(1, 101) for name in system.due(k * CYCLE_NS))
    assert "Altitude" not in sent
    assert (sent["RateLevel"], sent["Distance"], sent["DateTime"]) == (100, 10, 100)
    assert {sent[name] for name in ins.STATUS_MESSAGES} == {20}  # five take turns now


def test_a_dbc_without_a_kind_of_fix_is_refused_with_one_line(tmp_path: Path):
    path = tmp_path / "site.dbc"
    path.write_text(GNSS_IMU_DBC.read_text().replace('6 "RTKInteger" ', "").replace('11 "Blanked" ', ""))
    with pytest.raises(CatalogueError, match=r"^robots\.dbc, site\.dbc: NcomStatus00\.PosMode has no value Blanked, RTKInteger$"):
        NavigationSystem(P, load([ROBOTS_DBC, path]), Random(1), period_ns=MS_NS, start_ns=0, state=REST)


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("output_rate_hz = { value = 100", "output_rate_hz = { value = 50", r"focus\.toml: ins\.output_rate_hz = 50.*allowed: 100 or 250"),
        ("lever_arm_m = { value = [-0.45,", "lever_arm_m = { value = [-45.0,", r"focus\.toml: ins\.lever_arm_m\.0 = -45.*-10 to 10"),
        ("output_lever_m = { value = [0.0, 0.0, 0.0]", "output_lever_m = { value = [0.0, 0.0]", r"focus\.toml: ins\.output_lever_m"),
        ("latency_s = { value = 0.0035", "latency_s = { value = nan", r"focus\.toml: ins\.latency_s = nan"),
        ("ambiguity_s = { value = 8.0", "ambiguity_s = { value = -1.0", r"focus\.toml: ins\.ambiguity_s = -1.0"),
    ],
)
def test_a_mistake_in_the_vehicle_file_is_named(tmp_path: Path, before: str, after: str, named: str):
    path = tmp_path / "focus.toml"
    assert before in FOCUS.read_text()
    path.write_text(FOCUS.read_text().replace(before, after))
    with pytest.raises(VehicleError, match=named):
        load_vehicle(path)
