"""Golden frames of the navigation system: payloads worked out by hand from the public tables of the RT manuals.

Little endian. Signal = raw number times factor; the comment of each line gives raw numbers and where they come from. Angles of
atan(3/4) = 36.8699 degrees have sine 0.6 and cosine 0.8.
"""

import math
from datetime import datetime
from random import Random

import pytest

from dbc.catalogue import load
from dbc.ins import InsParameters
from dbc.vehicle import load_vehicle
from vehicle_emulator import ins
from vehicle_emulator.ins import NavigationSystem
from vehicle_emulator.plants.interface import PlantState

CATALOGUE = load()
P = load_vehicle().ins
QUIET = P.model_copy(update={key: 0.0 for key in InsParameters.model_fields if "sigma" in key})
MS_NS = 1_000_000
SLOPE_RAD = math.atan(0.75)

STATES = {
    "rest": PlantState(),  # at the origin, facing east
    # Turns left at 20 m/s and brakes, facing east, sliding to the left.
    "left": PlantState(x_m=120.5, y_m=-33.25, z_m=1.5, vx_mps=20.0, vy_mps=0.5, yaw_rate_radps=0.25, ax_mps2=-1.5, ay_mps2=5.0),
    # Turns right, facing south-west.
    "right": PlantState(yaw_rad=math.radians(-135.0), vx_mps=30.0, yaw_rate_radps=-0.25, ax_mps2=1.5, ay_mps2=-7.5),
    # Climbs northwards, nose up by 3 in 4, and gains speed.
    "climb": PlantState(z_m=3.0, pitch_rad=-SLOPE_RAD, yaw_rad=math.pi / 2.0, vx_mps=10.0, ax_mps2=2.0),
    # Descends northwards, nose down, at constant speed; the nose goes on dropping.
    "dive": PlantState(z_m=-3.0, pitch_rad=SLOPE_RAD, yaw_rad=math.pi / 2.0, vx_mps=10.0, pitch_rate_radps=0.5),
    # Stands facing north-east, right side down by 3 in 4, and turns left about its own vertical axis.
    "bank": PlantState(roll_rad=SLOPE_RAD, yaw_rad=math.pi / 4.0, yaw_rate_radps=0.5),
    "rolling": PlantState(roll_rate_radps=0.5),  # the right side goes down
    "sinking": PlantState(vz_mps=-2.0, az_mps2=-1.0),
    "reverse": PlantState(yaw_rad=math.pi, vx_mps=-5.0),  # faces west, moves east
}

GOLDEN = [
    # 16801 days since 1980-01-06 and 8 h = 1451635200000 ms, valid 4 ms before it is sent at 10 ms: ...06 ms = 0x0151FC335006; -18 = 0xEE
    ("rest", "MilliTime", "06 50 33 FC 51 01 EE 00"),
    # 26 = 0x1A; 20; January; 5 = Monday 5th; 0.00 s; 0 s; 0 min; 8 h
    ("rest", "DateTime", "1A 14 01 05 00 00 00 08"),
    # 1451635200 s = 24193920 min = 0x01712B80; 14 satellites; RTK integer = 6 three times
    ("rest", "NcomStatus00", "80 2B 71 01 0E 06 06 06"),
    # 50.88 deg = 508800000 = 0x1E53AC00; 6.29 deg = 62900000 = 0x03BFC720
    ("rest", "LatitudeLongitude", "00 AC 53 1E 20 C7 BF 03"),
    # -33.25 m / 6374044 m = -5.21647e-6 rad = -2988.8e-7 deg: 508797011 = 0x1E53A053
    # 120.5 m / (6391146 m * cos(50.88 deg)) = 2.98814e-5 rad = 17120.8e-7 deg: 62917121 = 0x03C00A01
    ("left", "LatitudeLongitude", "53 A0 53 1E 01 0A C0 03"),
    # 120 m = 120000 = 0x1D4C0
    ("rest", "Altitude", "C0 D4 01 00 00 00 00 00"),
    # 123 m = 123000 = 0x1E078; 117 m = 117000 = 0x1C908
    ("climb", "Altitude", "78 E0 01 00 00 00 00 00"),
    ("dive", "Altitude", "08 C9 01 00 00 00 00 00"),
    # north 50 = 0x32, east 2000 = 0x7D0, down 0, sqrt(20^2 + 0.5^2) = 20.006 = 2001
    ("left", "Velocity", "32 00 D0 07 00 00 D1 07"),
    # north and east -30 / sqrt(2) = -21.21 = -2121 = 0xF7B7; 3000 = 0xBB8
    ("right", "Velocity", "B7 F7 B7 F7 00 00 B8 0B"),
    # north 10 * 0.8 = 800 = 0x320; climbing is negative: down -600 = 0xFDA8
    ("climb", "Velocity", "20 03 00 00 A8 FD 20 03"),
    ("dive", "Velocity", "20 03 00 00 58 02 20 03"),
    # down +2.00 = 200 = 0xC8
    ("sinking", "Velocity", "00 00 00 00 C8 00 00 00"),
    # 2000; moving left is negative: -50 = 0xFFCE
    ("left", "VelocityLevel", "D0 07 CE FF 00 00 00 00"),
    # horizontal: 800
    ("climb", "VelocityLevel", "20 03 00 00 00 00 00 00"),
    # backwards: -500 = 0xFE0C
    ("reverse", "VelocityLevel", "0C FE 00 00 00 00 00 00"),
    # at rest the accelerometers feel -9.81 down: -981 = 0xFC2B
    ("rest", "AccelVehicle", "00 00 00 00 2B FC 00 00"),
    # -150 = 0xFF6A; to the left is negative: -500 = 0xFE0C
    ("left", "AccelVehicle", "6A FF 0C FE 2B FC 00 00"),
    # 150 = 0x96; 750 = 0x2EE
    ("right", "AccelVehicle", "96 00 EE 02 2B FC 00 00"),
    # 2 + 9.81 * 0.6 = 7.886 = 789 = 0x315; -9.81 * 0.8 = -7.848 = -785 = 0xFCEF
    ("climb", "AccelVehicle", "15 03 00 00 EF FC 00 00"),
    # nose down the feet are pushed forward, the IMU backward: -5.886 = -589 = 0xFDB3
    ("dive", "AccelVehicle", "B3 FD 00 00 EF FC 00 00"),
    # right side down: pushed to the left, -5.886
    ("bank", "AccelVehicle", "00 00 B3 FD EF FC 00 00"),
    # falling at 1 m/s2: -8.81 = -881 = 0xFC8F
    ("sinking", "AccelVehicle", "00 00 00 00 8F FC 00 00"),
    # -1.5; -5; -9.81; slip -5 - 20 * -0.25 = 0
    ("left", "AccelLevel", "6A FF 0C FE 2B FC 00 00"),
    # 2 * 0.8 = 160 = 0xA0; 0; -9.81 - 2 * 0.6 = -11.01 = -1101 = 0xFBB3
    ("climb", "AccelLevel", "A0 00 00 00 B3 FB 00 00"),
    ("bank", "AccelLevel", "00 00 00 00 2B FC 00 00"),
    # east is 90.00 = 9000 = 0x2328
    ("rest", "HeadingPitchRoll", "28 23 00 00 00 00 00 00"),
    # south-west is 225.00 = 22500 = 0x57E4
    ("right", "HeadingPitchRoll", "E4 57 00 00 00 00 00 00"),
    # north is 0; nose up is positive: 36.87 = 3687 = 0xE67; nose down: -3687 = 0xF199
    ("climb", "HeadingPitchRoll", "00 00 67 0E 00 00 00 00"),
    ("dive", "HeadingPitchRoll", "00 00 99 F1 00 00 00 00"),
    # north-east is 45.00 = 4500 = 0x1194; right side down is positive
    ("bank", "HeadingPitchRoll", "94 11 00 00 67 0E 00 00"),
    # west is 270.00 = 27000 = 0x6978
    ("reverse", "HeadingPitchRoll", "78 69 00 00 00 00 00 00"),
    # a left turn is negative: -14.324 deg/s = -1432 = 0xFA68; a right turn 1432 = 0x598
    ("left", "RateVehicle", "00 00 00 00 68 FA 00 00"),
    ("right", "RateVehicle", "00 00 00 00 98 05 00 00"),
    # right side going down: 0.5 rad/s = 28.648 = 2865 = 0xB31; nose dropping: -2865 = 0xF4CF
    ("rolling", "RateVehicle", "31 0B 00 00 00 00 00 00"),
    ("dive", "RateVehicle", "00 00 CF F4 00 00 00 00"),
    # 0.5 rad/s about an axis leaning by the bank: 0.3 to the right = 17.189 = 1719 = 0x6B7; 0.4 up = -22.918 down = -2292 = 0xF70C
    ("bank", "RateLevel", "00 00 B7 06 0C F7 00 00"),
    # track atan(0.5 / 20) = 1.432 deg to the left of 90: 88.57 = 8857 = 0x2299; slip -143 = 0xFF71; -0.25 / 20.006 = -125 = 0xFF83
    ("left", "TrackSlipCurvature", "99 22 71 FF 83 FF 00 00"),
    # 225.00; 0; 0.25 / 30 = 83 = 0x53
    ("right", "TrackSlipCurvature", "E4 57 00 00 53 00 00 00"),
    # moves east, heads west: 90.00, -18000 = 0xB9B0
    ("reverse", "TrackSlipCurvature", "28 23 B0 B9 00 00 00 00"),
    # standing: the heading
    ("bank", "TrackSlipCurvature", "94 11 00 00 00 00 00 00"),
    # one cycle of 10 ms at 20.006 m/s: 0.200 m = 200 = 0xC8
    ("left", "Distance", "C8 00 00 00 C8 00 00 00"),
    # 1205000 = 0x126308; -332500 = 0xFFFAED2C
    ("left", "PosLocal", "08 63 12 00 2C ED FA FF"),
    ("left", "PosLocalNE", "2C ED FA FF 08 63 12 00"),
    # 2000; 50; yaw 0; track 143 = 0x8F
    ("left", "VelYawLocal", "D0 07 32 00 00 00 8F 00"),
    # -2121 twice; counter-clockwise from east: -135.00 = -13500 = 0xCB44 twice
    ("right", "VelYawLocal", "B7 F7 B7 F7 44 CB 44 CB"),
    ("climb", "VelYawLocal", "00 00 20 03 28 23 28 23"),
    # nose up is negative, north is 90.00
    ("climb", "IsoOrientation", "28 23 99 F1 00 00 00 00"),
    ("bank", "IsoOrientation", "94 11 00 00 67 0E 00 00"),
    ("right", "IsoOrientation", "44 CB 00 00 00 00 00 00"),
    # left and up are positive
    ("left", "IsoVsVelocity", "D0 07 32 00 00 00 00 00"),
    ("climb", "IsoVsVelocity", "E8 03 00 00 00 00 00 00"),
    ("sinking", "IsoVsVelocity", "00 00 00 00 38 FF 00 00"),
    # no gravity in it: -150, 500 = 0x1F4, 0
    ("left", "IsoVsAcceleration", "6A FF F4 01 00 00 00 00"),
    ("climb", "IsoVsAcceleration", "C8 00 00 00 00 00 00 00"),
    ("left", "IsoVsAngularVelocity", "00 00 00 00 98 05 00 00"),
    ("dive", "IsoVsAngularVelocity", "00 00 31 0B 00 00 00 00"),
    # forward 8, up 6: 800, 600 = 0x258
    ("climb", "IsoIsVelocity", "20 03 00 00 58 02 00 00"),
    # 1.6 and 1.2: 160, 120 = 0x78
    ("climb", "IsoIsAcceleration", "A0 00 00 00 78 00 00 00"),
    # -1719 = 0xF949; 2292 = 0x8F4
    ("bank", "IsoIsAngularVelocity", "00 00 49 F9 F4 08 00 00"),
    ("climb", "IsoEfsVelocity", "00 00 20 03 58 02 00 00"),
    ("climb", "IsoEfsAcceleration", "00 00 A0 00 78 00 00 00"),
    ("left", "IsoEfsAcceleration", "6A FF F4 01 00 00 00 00"),
]


def instrument(state: PlantState, parameters: InsParameters = QUIET, start_time: datetime = ins.START) -> NavigationSystem:
    return NavigationSystem(parameters, CATALOGUE, Random(1), period_ns=MS_NS, start_ns=0, state=state, start_time=start_time)


def payload(system: NavigationSystem, name: str, now_ns: int = 10 * MS_NS) -> str:
    return CATALOGUE.encode(name, system.message(name, now_ns)).hex(" ").upper()


@pytest.mark.parametrize(("state", "message", "expected"), GOLDEN)
def test_golden_frame(state: str, message: str, expected: str):
    system = instrument(STATES[state])
    for _ in range(10):
        system.observe(STATES[state])
    assert payload(system, message) == expected


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        # hypot(10, 2) mm = 10.2 = 10; 1.5 times that = 15; age 0; no robot interface = 255
        ("NcomStatus03", "0A 00 0A 00 0F 00 00 FF"),
        # 14 mm/s; age 0; real time = 1
        ("NcomStatus04", "0E 00 0E 00 0E 00 00 01"),
        # hypot(1.75, 0.17) mrad = 1.758 = 176 = 0xB0; hypot(0.5, 0.09) mrad = 0.508 = 51 = 0x33, twice; age 0
        ("NcomStatus05", "B0 00 33 00 33 00 00 00"),
    ],
)
def test_golden_frame_of_an_accuracy(message: str, expected: str):
    assert payload(instrument(STATES["rest"], P), message) == expected


@pytest.mark.parametrize(
    ("state", "spin_radps2", "message", "expected"),
    [
        # 2 rad/s2 to the left about the car's vertical axis = 114.59 deg/s2: -1146 = 0xFB86 down
        ("rest", (0.0, 0.0, 2.0), "AngAccelVehicle", "00 00 00 00 86 FB 00 00"),
        # right side down 57.30 = 573 = 0x23D; nose up 28.65 = 286 = 0x11E
        ("rest", (1.0, -0.5, 0.0), "AngAccelVehicle", "3D 02 1E 01 00 00 00 00"),
        # 0.6 of it to the right = 68.75 = 688 = 0x2B0; 0.8 of it up = -91.67 down = -917 = 0xFC6B
        ("bank", (0.0, 0.0, 2.0), "AngAccelLevel", "00 00 B0 02 6B FC 00 00"),
        ("rest", (0.0, 0.0, 2.0), "IsoVsAngularAcceleration", "00 00 00 00 7A 04 00 00"),
        # -688 = 0xFD50; 917 = 0x395
        ("bank", (0.0, 0.0, 2.0), "IsoIsAngularAcceleration", "00 00 50 FD 95 03 00 00"),
    ],
)
def test_golden_frame_of_an_angular_acceleration(state: str, spin_radps2: tuple[float, float, float], message: str, expected: str):
    system = instrument(STATES[state])
    for k in range(500):
        p, q, r = (1e-3 * k * spin for spin in spin_radps2)
        system.observe(STATES[state]._replace(roll_rate_radps=p, pitch_rate_radps=q, yaw_rate_radps=r))
        if k % 10 == 9:
            system.solution((k + 1) * MS_NS)
    assert payload(system, message, 500 * MS_NS) == expected


def test_golden_frames_of_the_bus_as_the_instrument_sees_it():
    system = instrument(STATES["rest"])
    for k in range(1, 21):
        assert len(system.due(10 * k * MS_NS)) == 12
    # 20 cycles of 12 messages = 240 = 0xF0; nothing received; 100 % = 0x64 twice; no errors
    assert payload(system, "NcomStatus78", 200 * MS_NS) == "F0 00 00 00 64 64 00 00"


def test_distance_holds_while_the_car_creeps():
    system = instrument(PlantState())
    for k in range(1, 2001):
        system.observe(PlantState(vx_mps=20.0 if k <= 1000 else 0.1))
        if k % 10 == 0:
            system.solution(k * MS_NS)
    # 1 s at 20 m/s, 4 ms of which count late, and less one cycle: 19.8 to 20.2 m; then 0.1 m in 1 s, which the first does not count
    signals = system.message("Distance", 2000 * MS_NS)
    assert signals["DistanceWithHold"] == pytest.approx(20.0, abs=0.2001)
    assert signals["Distance"] - signals["DistanceWithHold"] == pytest.approx(0.1, abs=0.002)


def test_distance_does_not_count_a_stall_in_which_the_car_stood_still():
    moving = PlantState(vx_mps=20.0)
    system = instrument(moving)
    for k in range(1, 101):
        system.observe(moving)
        if k % 10 == 0:
            system.solution(k * MS_NS)
    system.observe(moving)
    last = system.solution(10_000 * MS_NS)
    assert (last.distance_m, last.held_distance_m) == pytest.approx((2.02, 2.02), abs=1e-6)


def test_date_and_milliseconds_at_the_turn_of_a_year():
    # One hour before midnight and 23.45 s; 2032 is a leap year.
    system = instrument(PlantState(), start_time=datetime(2032, 12, 31, 23, 0, 0))
    now_ns = 3_623_454 * MS_NS  # valid 4 ms earlier: 00:00:23.450
    assert payload(system, "DateTime", now_ns) == "21 14 01 01 2D 17 00 00"  # 2033-01-01, 45 hundredths, 23 s
    # 19354 days and 23450 ms = 1672185623450 ms = 389 * 2^32 + 0x5607B39A
    assert payload(system, "MilliTime", now_ns) == "9A B3 07 56 85 01 EE 00"


def test_every_message_of_the_instrument_has_a_golden_frame():
    shown = {message for _, message, _ in GOLDEN}
    elsewhere = {"NcomStatus03", "NcomStatus04", "NcomStatus05", "NcomStatus78", "AngAccelVehicle", "AngAccelLevel"}
    elsewhere |= {"IsoVsAngularAcceleration", "IsoIsAngularAcceleration"}
    assert shown | elsewhere == set(ins.MESSAGES)
    assert set(ins.MESSAGES) == {name for name, spec in CATALOGUE.by_name.items() if spec.sender == "INS"}


def test_signals_are_those_of_the_dbc():
    system = instrument(STATES["left"], P)
    for name in ins.MESSAGES:
        signals = system.message(name, 10 * MS_NS)
        assert signals.keys() <= set(CATALOGUE.signals(name))
        assert name == "NcomStatus78" or signals.keys() == set(CATALOGUE.signals(name)), name
