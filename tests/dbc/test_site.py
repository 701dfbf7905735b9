"""Another robot DBC in place of ours: gateway, stub car and emulated car do on it what they do on ours.

Everything is compared in SI units or in those of our DBC. What may differ is the resolution.
"""

import math
import random
import tomllib
from itertools import pairwise
from typing import NamedTuple

import cantools
import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, DecodeError, EncodeError, load
from dbc.e2e import E2EReceiver, E2EStatus
from dbc.frame import CanFrame
from dbc.vehicle import load_vehicle
from gateway.causes import Cause
from gateway.core import TICK_NS
from gateway.limits import PROVING_GROUND
from gateway.messages import Mode, Operation
from tests.support import drive
from tests.support.site import SITE_DBC, SITE_MAPPING, load_site
from vehicle_emulator.emulator import STEP_NS, Emulator, EmulatorSetup, StartPose

OURS, SITE = load(), load_site()
ROBOT_MESSAGES = [spec.name for spec in OURS.by_name.values() if spec.network == "robots"]
OUR_LAYOUTS = {message.name: message for message in cantools.database.load_file(str(ROBOTS_DBC)).messages}
SITE_LAYOUTS = {message.name: message for message in cantools.database.load_file(str(SITE_DBC)).messages}
MAPPING = tomllib.loads(SITE_MAPPING.read_text())["messages"]
NUMBERS = [(name, signal.name) for name in ROBOT_MESSAGES for signal in OUR_LAYOUTS[name].signals if not signal.choices]
BRAKE_ENCODER_STEP_NORM = 0.0032
"""What a step of the emulated brake robot's encoder, 0.1 % of the pedal, is as a drive demand."""
# The steps of the coarser of the two DBCs.
STEERING_STEP_RAD, STEERING_RATE_STEP_RADPS, PEDAL_STEP_NORM, WHEEL_STEP_RADPS = 0.0009, 0.0176, 0.0001, 0.0105


def steps(name, signal):
    """Smallest difference of two values of a signal at home and at the site, in our unit, read from the files alone."""
    at_site = MAPPING[name]["signals"][signal]
    at_site = {"name": at_site} if isinstance(at_site, str) else at_site
    theirs = SITE_LAYOUTS[MAPPING[name]["name"]].get_signal_by_name(at_site["name"])
    ours = OUR_LAYOUTS[name].get_signal_by_name(signal)
    return abs(ours.scale), abs(theirs.scale * at_site.get("factor", 1.0))


def sent(catalogue, name, values):
    return CanFrame(catalogue.by_name[name].arbitration_id, catalogue.encode(name, values), 0)


def read(catalogue, frame):
    return catalogue.decode(catalogue.by_id[frame.arbitration_id], frame)


def test_the_site_has_nothing_of_ours_but_the_meaning():
    ids = {spec.name: spec.arbitration_id for spec in SITE.by_name.values() if spec.network == "robots"}
    assert set(ids) == set(ROBOT_MESSAGES), "tests/support/site_robots.dbc and site_mapping.toml follow dbc/robots.dbc"
    assert not set(ids) & set(SITE_LAYOUTS)
    assert not set(ids.values()) & set(OURS.by_id)
    is_motorola = [signal.byte_order == "big_endian" for message in SITE_LAYOUTS.values() for signal in message.signals]
    assert 0.8 < sum(is_motorola) / len(is_motorola) < 1.0
    assert set(SITE.sha256) == {"site_robots.dbc", "gnss_imu.dbc", "site_mapping.toml"}


@pytest.mark.parametrize("name", ROBOT_MESSAGES)
def test_every_message_means_the_same(name):
    """Signals, words of the tables, times and nodes are ours; identifiers and data ids are not."""
    ours, site = OURS.by_name[name], SITE.by_name[name]
    for fact in ("sender", "cycle_time_ns", "timeout_ns", "network", "length_bytes"):
        assert getattr(site, fact) == getattr(ours, fact)
    assert (site.e2e_data_id is None) == (ours.e2e_data_id is None)
    assert ours.e2e_data_id is None or site.e2e_data_id != ours.e2e_data_id
    assert set(SITE.signals(name)) == set(OURS.signals(name))
    for signal in OURS.signals(name):
        found, expected = SITE.enumeration(name, signal), OURS.enumeration(name, signal)
        assert set(found) == set(expected), f"{name}.{signal}: tests/support/site_robots.dbc follows dbc/robots.dbc"


@pytest.mark.req("G3")
@pytest.mark.parametrize(("name", "signal"), NUMBERS)
def test_every_signal_carries_the_same_values(name, signal):
    """Over the range that both can hold, and to within half a step of its own; beyond it, none of both is sent."""
    (low_ours, high_ours), (low_site, high_site) = OURS.bounds(name, signal), SITE.bounds(name, signal)
    low, high = max(low_ours, low_site), min(high_ours, high_site)
    rng = random.Random(signal)
    for value in [low, high, *(rng.uniform(low, high) for _ in range(30))]:
        for catalogue, step in zip((OURS, SITE), steps(name, signal), strict=True):
            assert read(catalogue, sent(catalogue, name, {signal: value}))[signal] == pytest.approx(value, abs=0.5001 * step + 1e-9)
    step = steps(name, signal)[1]
    for beyond in (high_site + step, low_site - step, math.nan, math.inf):
        with pytest.raises(EncodeError, match=rf"^{name}\.{signal} = "):
            SITE.encode(name, {signal: beyond})


def test_what_goes_over_the_wire_is_in_the_words_of_the_site():
    frame = sent(SITE, "SR_Command", {"AngleCommand": 90.0, "Mode": SITE.enumeration("SR_Command", "Mode")["AnglePosition"], "Enable": 1})
    told = SITE_LAYOUTS["STEER_DEMAND"].decode(frame.data)
    assert told["ANGLE_COMMAND"] == pytest.approx(-math.pi / 2, abs=0.0004)  # to the right, in rad
    assert (str(told["MODE"]), told["ENABLE"]) == ("ANGLE_POSITION", 1)
    frame = sent(SITE, "RC_SafetyStatus", {"DeadManPressed": 1, "SrReady": 0, "ControllerTemperature": 26.85})
    told = SITE_LAYOUTS["SUP_STATE"].decode(frame.data)
    assert (told["DeadManReleased"], told["STR_NotReady"], told["CONTROLLER_TEMPERATURE"]) == (0, 1, 300)
    # What nobody gives is what it is at home: nobody presses, nothing is ready, though these bits are then set.
    told = SITE_LAYOUTS["SUP_STATE"].decode(SITE.encode("RC_SafetyStatus", {}))
    assert (told["DeadManReleased"], told["BRK_NotReady"]) == (1, 1)
    # By hand: 100 % of the pedal is 1 = 50000 * 0.00002 = 0xC350, high byte first.
    assert SITE.encode("BR_Command", {"PositionCommand": 100.0})[2:4].hex() == "c350"


def test_a_value_that_the_site_does_not_allow_is_named_by_our_name():
    frame = sent(SITE, "AR_Status", {})
    with pytest.raises(DecodeError, match=r"^AR_Status\.PositionActual = 13\d\.\d* outside \[-?[0-9.e-]+, 100\."):
        read(SITE, frame._replace(data=frame.data[:2] + b"\xff\xff" + frame.data[4:]))


class EmulatedCar:
    """The emulated car in place of the stub: ten of its steps are one cycle of the gateway."""

    def __init__(self, catalogue, start_ns):
        setup = EmulatorSetup(load_vehicle(), StartPose(speed_mps=20.0), plant="bicycle")
        self._emulator, self._heard = Emulator(setup, catalogue, start_ns), []

    def hear(self, frames):
        self._heard = frames

    def speak(self, now_ns):
        frames = []
        for step in range(10):
            frames += self._emulator.step(now_ns + (step - 9) * STEP_NS, self._heard)
            self._heard = []
        return frames


class Cycle(NamedTuple):
    """One cycle of the gateway: position, heading, speed, yaw rate; demands, and what the robots are measured to do; all SI."""

    mode: Mode
    is_valid: bool
    state: tuple[float, ...]
    demands: tuple[float, ...]
    frames: int


def gateway_drive(monkeypatch, catalogue, is_emulated=False):
    """A gateway that is armed, engaged, steered and driven; then the operator stops it. What it saw and commanded in every cycle."""
    monkeypatch.setattr(drive, "load", lambda: catalogue)
    found = drive.GatewayDrive()
    found.car.is_following = True
    if is_emulated:
        found.car = EmulatedCar(catalogue, found.now_ns)
    trace = []

    def tick(count):
        for _ in range(count):
            found.tick()
            demand, state = found.core.actuation.demand, found.output.state
            numbers = (state.x_m, state.y_m, state.yaw_rad, state.vx_mps, state.yaw_rate_radps)
            demands = (demand.steering_wheel_rad, demand.accelerator_norm, demand.brake_norm, state.steer_rad, state.drive_norm)
            trace.append(Cycle(found.core.mode, state.is_valid, numbers, demands, len(found.output.frames)))

    tick(230)
    found.ask(Operation.ARM)
    tick(30)
    found.ask(Operation.ENGAGE)
    tick(1)
    for cycle in range(120):
        found.steer_rad, found.drive_norm = 0.01 * math.sin(0.05 * cycle), 0.1 * math.cos(0.03 * cycle)
        tick(1)
    found.ask(Operation.STOP)
    tick(100)
    return found, trace


@pytest.mark.req("G3")
@pytest.mark.parametrize("is_emulated", [False, True], ids=["stub", "emulated"])
def test_the_closed_loop_drives_the_same_car(monkeypatch, is_emulated):
    (at_home, ours), (away, site) = (gateway_drive(monkeypatch, catalogue, is_emulated) for catalogue in (OURS, SITE))
    told_ours, told_site = ([(one.t_ns, one.after, one.reason) for one in found.transitions] for found in (at_home, away))
    assert told_ours == told_site
    assert [mode for _, mode, _ in told_site] == [Mode.READY, Mode.ENGAGED, Mode.COMFORT_STOP]
    assert away.core.supervisor.rejected == at_home.core.supervisor.rejected
    for here, there in zip(ours, site, strict=True):
        assert (here.mode, here.is_valid, here.frames) == (there.mode, there.is_valid, there.frames)
        # Positions run apart as the rounded demands add up; 0.02 m after 4 s at 20 m/s.
        assert there.state == pytest.approx(here.state, abs=0.02)
        assert there.demands[:4] == pytest.approx(here.demands[:4], abs=3 * STEERING_STEP_RAD)
        assert there.demands[4] == pytest.approx(here.demands[4], abs=BRAKE_ENCODER_STEP_NORM)
    assert max(abs(cycle.demands[0]) for cycle in site) > 0.1
    assert max(cycle.demands[2] for cycle in site) > 0.02
"""There is something to compare: steering-wheel angle and brake."""


def with_steering_step(tmp_path, step_deg):
    line, site = '16|16@1- (0.05,0) [-1080|1080] "deg" SR', tmp_path / "coarse.dbc"
    text = ROBOTS_DBC.read_text()
    assert line in text
    site.write_text(text.replace(line, line.replace("0.05", str(step_deg))))
    return load([site, GNSS_IMU_DBC])


@pytest.mark.req("G1")
@pytest.mark.parametrize("speed_mps", [10.0, 30.0])
def test_rates_hold_on_the_steps_of_the_site(tmp_path, monkeypatch, speed_mps):
    """Demands that were rounded to our steps would break them by up to half a step of the site."""
    catalogue = with_steering_step(tmp_path, 0.45)
    monkeypatch.setattr(drive, "load", lambda: catalogue)
    found = drive.GatewayDrive()
    found.car.is_following, found.car.vx_mps = True, speed_mps
    found.engage()
    vehicle, angles_rad = load_vehicle(), [0.0]
    for tick in range(200):
        found.steer_rad = math.copysign(0.2, 100 - tick)
        frames = {frame.arbitration_id: frame for frame in found.tick().output.frames}
        spec = catalogue.by_name["SR_Command"]
        angles_rad.append(math.radians(catalogue.decode(spec, frames[spec.arbitration_id])["AngleCommand"]))
    assert found.core.mode is Mode.ENGAGED
    wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
    lateral_mps2 = [found.car.vx_mps**2 * math.tan(angle_rad / vehicle.steering.ratio) / wheelbase_m for angle_rad in angles_rad]
    shares = [
        max(abs(after - before) for before, after in pairwise(values)) / (TICK_NS * 1e-9) / limit
        for values, limit in (
            (angles_rad, PROVING_GROUND.steering_wheel_rate_radps),
            (lateral_mps2, PROVING_GROUND.lateral_jerk_mps3),
        )
    ]
    assert 0.9 < max(shares) <= 1.0 + 1e-9  # the one that limits is used, none is broken


def test_what_the_robots_say_is_seen_to_within_the_resolution(monkeypatch):
    measured = []
    for catalogue in (OURS, SITE):
        monkeypatch.setattr(drive, "load", lambda found=catalogue: found)
        found = drive.GatewayDrive()
        found.car.steering_wheel_deg, found.car.steering_wheel_rate_dps = -123.456, 77.7
        found.car.accelerator_percent, found.car.brake_percent, found.car.emergency_stop = 12.3456, 45.678, 1
        found.tick(5)
        measured.append(found.core.measurement)
    ours, site = measured
    for fact, step in {
        "steering_wheel_rad": STEERING_STEP_RAD,
        "steering_wheel_rate_radps": STEERING_RATE_STEP_RADPS,
        "accelerator_norm": PEDAL_STEP_NORM,
        "brake_norm": PEDAL_STEP_NORM,
    }.items():
        assert getattr(site, fact) == pytest.approx(getattr(ours, fact), abs=step)
        assert getattr(site, fact) != 0.0
    assert site.steering_wheel_rad == pytest.approx(math.radians(-123.456), abs=0.5 * STEERING_STEP_RAD)
    assert site.wheel_speed_radps == pytest.approx(ours.wheel_speed_radps, abs=WHEEL_STEP_RADPS)
    flags = [fact for fact in type(site).__slots__ if isinstance(getattr(ours, fact), bool | int | str)]
    assert "is_emergency_stopped" in flags
    assert {fact: getattr(site, fact) for fact in flags} == {fact: getattr(ours, fact) for fact in flags}


@pytest.mark.req("F7")
def test_protection_works_on_the_layout_of_the_site(monkeypatch):
    monkeypatch.setattr(drive, "load", load_site)
    found = drive.GatewayDrive().engage()
    for frame in found.output.frames:
        spec = SITE.by_id[frame.arbitration_id]
        if spec.e2e_data_id is not None:
            damaged = frame.data[:3] + bytes([frame.data[3] ^ 4]) + frame.data[4:]
            assert E2EReceiver(spec.e2e_data_id).check(frame.data) is E2EStatus.INITIAL
            assert E2EReceiver(spec.e2e_data_id).check(damaged) is E2EStatus.WRONG_CRC
    found.car.corrupt.add("SR_Status")
    found.tick(10)
    assert found.core.mode is Mode.SAFE_STOP
    assert found.transitions[-1].finding.cause is Cause.MESSAGE_INVALID
