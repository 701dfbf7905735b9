import math
from collections.abc import Iterator
from datetime import datetime, timedelta
from random import Random
from statistics import correlation, fmean, pstdev

import pytest

from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.vehicle import InsParameters, load_vehicle
from vehicle_emulator import ins
from vehicle_emulator.ins import NavigationSystem
from vehicle_emulator.plant import PlantState

CATALOGUE = load()
P = load_vehicle().ins
QUIET = P.model_copy(update={key: 0.0 for key in InsParameters.model_fields if "sigma" in key})
MS_NS = 1_000_000
CYCLE_NS = 10 * MS_NS
REST = PlantState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
LEFT_TURN = PlantState(120.5, -33.25, 0.4, 18.0, 0.3, 0.25, -1.5, 4.5)


def instrument(parameters: InsParameters, state: PlantState = REST, seed: int = 1, start_ns: int = 0) -> NavigationSystem:
    system = NavigationSystem(parameters, CATALOGUE, Random(seed), period_ns=MS_NS, start_ns=start_ns, state=state)
    for _ in range(10):
        system.observe(state)
    return system


def received(system: NavigationSystem, name: str, now_ns: int = CYCLE_NS) -> dict[str, float]:
    """A message after the wire: encoded and decoded by the DBC."""
    spec = CATALOGUE.by_name[name]
    payload = CATALOGUE.encode(name, system.message(name, now_ns))
    return CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, payload, now_ns))


@pytest.mark.parametrize(
    ("message", "signal", "expected", "half_lsb"),
    [
        ("PosLocal", "PosLocalX", 120.5, 5e-5),
        ("PosLocal", "PosLocalY", -33.25, 5e-5),
        ("VelocityLevel", "VelForward", 18.0, 5e-3),
        ("VelocityLevel", "VelLateral", -0.3, 5e-3),  # positive to the right
        ("VelYawLocal", "AngleLocalYaw", math.degrees(0.4), 5e-3),  # counter-clockwise from east
        ("VelYawLocal", "VelLocalX", 18.0 * math.cos(0.4) - 0.3 * math.sin(0.4), 5e-3),
        ("VelYawLocal", "VelLocalY", 18.0 * math.sin(0.4) + 0.3 * math.cos(0.4), 5e-3),
        ("VelYawLocal", "AngleLocalTrack", math.degrees(0.4 + math.atan2(0.3, 18.0)), 5e-3),
        ("HeadingPitchRoll", "AngleHeading", 90.0 - math.degrees(0.4), 5e-3),  # clockwise from north
        ("RateVehicle", "AngRateZ", -math.degrees(0.25), 5e-3),  # about the axis that points down
        ("AccelVehicle", "AccelX", -1.5, 5e-3),
        ("AccelVehicle", "AccelY", -4.5, 5e-3),  # positive to the right
        ("Velocity", "VelEast", 18.0 * math.cos(0.4) - 0.3 * math.sin(0.4), 5e-3),
        ("Velocity", "VelNorth", 18.0 * math.sin(0.4) + 0.3 * math.cos(0.4), 5e-3),
        ("Velocity", "Speed2D", math.hypot(18.0, 0.3), 5e-3),
    ],
)
def test_a_left_turn_in_the_conventions_of_the_instrument(message: str, signal: str, expected: float, half_lsb: float):
    assert received(instrument(QUIET, LEFT_TURN), message)[signal] == pytest.approx(expected, abs=half_lsb * 1.001)


@pytest.mark.parametrize("turns", [-2.3, -0.5, -0.25, 0.0, 0.499999, 0.5, 0.75, 7.1])
def test_angles_stay_in_range_however_often_the_car_has_turned(turns: float):
    state = PlantState(0.0, 0.0, 2 * math.pi * turns, 10.0, 0.0, 0.0, 0.0, 0.0)
    system = instrument(QUIET, state)
    yaw_deg = received(system, "VelYawLocal")["AngleLocalYaw"]
    heading_deg = system.message("HeadingPitchRoll", CYCLE_NS)["AngleHeading"]
    assert -180.0 <= yaw_deg <= 180.0
    assert 0.0 <= heading_deg < 360.0
    assert math.cos(math.radians(yaw_deg)) == pytest.approx(math.cos(state.yaw_rad), abs=1e-3)
    assert math.sin(math.radians(90.0 - heading_deg)) == pytest.approx(math.sin(state.yaw_rad), abs=1e-9)


def test_every_message_encodes_with_full_noise():
    for name in ins.MESSAGES:
        assert set(received(instrument(P, LEFT_TURN), name)) == set(CATALOGUE.signals(name))


def test_latency_is_in_the_data_and_in_the_time_of_validity():
    start_ns = 123 * MS_NS
    system = NavigationSystem(QUIET, CATALOGUE, Random(1), period_ns=MS_NS, start_ns=start_ns, state=REST)
    first_ms = received(system, "MilliTime", start_ns)["MilliTime"]
    for k in range(1, 51):
        system.observe(REST._replace(x_m=0.02 * k))  # 20 m/s
    now_ns = start_ns + 50 * MS_NS
    age_ms = math.ceil(1e3 * P.latency_s)
    assert age_ms == 4
    assert received(system, "PosLocal", now_ns)["PosLocalX"] == pytest.approx(0.02 * (50 - age_ms), abs=1e-4)
    assert received(system, "MilliTime", now_ns)["MilliTime"] - first_ms == 50


def test_date_and_status_agree_with_the_time_of_validity():
    system = instrument(QUIET)
    now_ns = 3_723_450 * MS_NS
    valid = datetime(1980, 1, 6) + timedelta(milliseconds=received(system, "MilliTime", now_ns)["MilliTime"])
    date = received(system, "DateTime", now_ns)
    seconds = date["TimeSecond"] + date["TimeHSecond"]
    sent = datetime(int(date["TimeCentury"] + date["TimeYear"]), int(date["TimeMonth"]), int(date["TimeDay"]))
    sent += timedelta(hours=date["TimeHour"], minutes=date["TimeMinute"], seconds=seconds)
    assert abs(sent - valid) < timedelta(milliseconds=10)
    minutes = received(system, "NcomStatus00", now_ns)["GpsMinutes"]
    assert timedelta() <= valid - datetime(1980, 1, 6) - timedelta(minutes=minutes) < timedelta(minutes=1)


def test_status_says_rtk_integer_with_the_accuracy_of_the_vehicle_file():
    system = instrument(P)
    status = received(system, "NcomStatus00")
    integer = CATALOGUE.enumeration("NcomStatus00", "PosMode")["RTKInteger"]
    assert status["PosMode"] == status["VelMode"] == status["OriMode"] == integer
    assert received(system, "NcomStatus03")["PosAccEast"] == pytest.approx(P.position_sigma_m, abs=1e-3)
    assert received(system, "NcomStatus04")["VelAccNorth"] == pytest.approx(P.velocity_sigma_mps, abs=1e-3)
    assert math.radians(received(system, "NcomStatus05")["OriAccHeading"]) == pytest.approx(P.heading_sigma_rad, rel=0.05)


def test_latitude_and_longitude_follow_the_local_position():
    here, there = (
        received(instrument(QUIET, REST._replace(x_m=x_m, y_m=y_m)), "LatitudeLongitude") for x_m, y_m in ((0.0, 0.0), (500.0, 800.0))
    )
    metres_per_degree = 111_230.0  # of the meridian at 51 degrees north
    assert (there["PosLat"] - here["PosLat"]) * metres_per_degree == pytest.approx(800.0, abs=2.0)
    east_m = (there["PosLon"] - here["PosLon"]) * 111_320.0 * math.cos(math.radians(50.88))
    assert east_m == pytest.approx(500.0, abs=2.0)


def solutions(parameters: InsParameters, seed: int, count: int) -> Iterator[ins.Solution]:
    system = instrument(parameters, seed=seed)
    for k in range(1, count + 1):
        yield system.solution(k * CYCLE_NS)


def test_white_noise_has_the_spread_of_the_vehicle_file():
    samples = list(solutions(P, seed=3, count=4000))
    assert pstdev(s.v_east_mps for s in samples) == pytest.approx(P.velocity_sigma_mps, rel=0.06)
    assert pstdev(s.yaw_rate_radps for s in samples) == pytest.approx(P.yaw_rate_sigma_radps, rel=0.06)
    assert pstdev(s.ax_mps2 for s in samples) == pytest.approx(P.acceleration_sigma_mps2, rel=0.06)
    assert abs(fmean(s.yaw_rate_radps for s in samples)) < 0.1 * P.yaw_rate_sigma_radps


def test_position_error_wanders_with_its_correlation_time():
    fast = P.model_copy(update={"position_correlation_s": 0.5, "position_white_sigma_m": 0.0})
    errors_m = [s.x_m for s in solutions(fast, seed=5, count=20_000)]
    assert pstdev(errors_m) == pytest.approx(P.position_sigma_m, rel=0.1)
    one_correlation_time = 50
    assert correlation(errors_m[:-one_correlation_time], errors_m[one_correlation_time:]) == pytest.approx(math.exp(-1.0), abs=0.1)


def test_initial_error_has_the_stationary_spread():
    first_m = [next(solutions(P, seed, 1)).x_m for seed in range(400)]
    assert pstdev(first_m) == pytest.approx(math.hypot(P.position_sigma_m, P.position_white_sigma_m), rel=0.12)


def test_seed_decides_the_noise():
    def run(seed: int) -> list[float]:
        return [s.x_m for s in solutions(P, seed, 20)]

    assert run(7) == run(7)
    assert run(7) != run(8)


def test_all_messages_of_a_cycle_are_views_of_one_solution():
    system = instrument(P, LEFT_TURN)
    level, local = system.message("VelocityLevel", CYCLE_NS), system.message("VelYawLocal", CYCLE_NS)
    yaw_rad = math.radians(local["AngleLocalYaw"])
    assert level["VelForward"] == pytest.approx(math.cos(yaw_rad) * local["VelLocalX"] + math.sin(yaw_rad) * local["VelLocalY"])
    assert system.message("PosLocal", CYCLE_NS) == system.message("PosLocal", CYCLE_NS)
    assert system.message("PosLocal", CYCLE_NS) != system.message("PosLocal", 2 * CYCLE_NS)
