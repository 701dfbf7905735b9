"""The codec: what each signal becomes in SI units, what each demand becomes on the bus, and the DBC it is given."""

import math
from dataclasses import asdict, fields, replace

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load
from dbc.e2e import E2EReceiver
from gateway.causes import Cause, Finding
from gateway.codec import NEEDED_MESSAGES, Codec, Cycle, Measurement, Monitors, RobotLimits
from gateway.limits import Demand, Resolution
from gateway.messages import Mode

LIMITS = RobotLimits(steering_wheel_rate_radps=10.0, max_speed_mps=36.0, pedal_rate_mps=0.5049)
CATALOGUE = load()
CYCLE = Cycle(command_age_ms=40.0, measurement_id=11, watchdog_question=0x12, is_navigation_valid=True)
DEMAND = Demand(steering_wheel_rad=0.5, accelerator_norm=0.25, brake_norm=0.75)
DRIVING = (Mode.ENGAGED, Mode.COMFORT_STOP, Mode.SAFE_STOP)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (" SG_ AngleCommand ", " SG_ WheelAngle ", "no signal AngleCommand"),
        (" SG_ PositionActual ", " SG_ Position ", "'PositionActual'"),
        ("BO_ 304 BR_Command", "BO_ 304 Brake_Command", "no message BR_Command, which the gateway needs"),
        ('3 "Engage"', '3 "Go"', "'Engage'"),
        ('2 "AnglePosition"', '2 "Angle"', "'AnglePosition'"),
        ('5 "EStop"', '5 "Halt"', "'EStop'"),
        (' 3 "D"', ' 3 "Drive"', "'D'"),
        ('6 "Silent"', '6 "Mute"', "'Silent'"),
        ('30 "FramesLost"', '30 "Lossy"', "'FramesLost'"),
        (" SG_ RxErrorCount ", " SG_ RxErrors ", "no signal RxErrorCount"),
        (" SG_ Limit : ", " SG_ Bound : ", "Limit"),
        (" SG_ WatchdogQuestion : ", " SG_ Question : ", "'WatchdogQuestion'"),
    ],
)
def test_a_dbc_that_lacks_something_is_refused_at_start(tmp_path, old, new, named):
    site = tmp_path / "site.dbc"
    text = ROBOTS_DBC.read_text()
    assert old in text
    site.write_text(text.replace(old, new))
    with pytest.raises(CatalogueError) as caught:
        Codec(load([site, GNSS_IMU_DBC]), LIMITS)
    said = str(caught.value)
    assert said.startswith("site.dbc, gnss_imu.dbc: ")
    assert named in said
    assert "\n" not in said


def test_a_refused_dbc_is_told_in_one_line(tmp_path):
    site = tmp_path / "site.dbc"
    site.write_text(ROBOTS_DBC.read_text().replace('3 "Engage"', '3 "Go"'))
    with pytest.raises(CatalogueError, match=r"^site\.dbc, gnss_imu\.dbc: not what the gateway needs: 'Engage'$"):
        Codec(load([site, GNSS_IMU_DBC]), LIMITS)


def test_a_dbc_whose_demands_do_not_reach_neutral_is_refused(tmp_path):
    site = tmp_path / "site.dbc"
    site.write_text(ROBOTS_DBC.read_text().replace("(0.05,0) [-1080|1080] \"deg\" SR,RC", "(0.05,0) [1|1080] \"deg\" SR,RC"))
    with pytest.raises(CatalogueError, match="AngleCommand"):
        Codec(load([site, GNSS_IMU_DBC]), LIMITS)


@pytest.mark.parametrize("codes", ["Mode : 0|4@1+ (1,0) [0|5]", "Mode : 0|4@1+ (1,0) [1|15]"])
def test_a_dbc_whose_status_has_no_room_for_a_mode_is_refused(tmp_path, codes):
    site = tmp_path / "site.dbc"
    text = ROBOTS_DBC.read_text()
    assert "Mode : 0|4@1+ (1,0) [0|15]" in text
    site.write_text(text.replace("Mode : 0|4@1+ (1,0) [0|15]", codes))
    with pytest.raises(CatalogueError, match=r"GW_Status\.Mode"):
        Codec(load([site, GNSS_IMU_DBC]), LIMITS)


def test_a_demand_beyond_the_range_of_a_site_becomes_the_nearest_in_it(tmp_path):
    site = tmp_path / "site.dbc"
    site.write_text(ROBOTS_DBC.read_text().replace("(0.05,0) [-1080|1080] \"deg\" SR,RC", "(0.05,0) [-90|90] \"deg\" SR,RC"))
    catalogue = load([site, GNSS_IMU_DBC])
    narrow = Codec(catalogue, LIMITS)
    for wheel_rad, wheel_deg in ((math.pi, 90.0), (-math.pi, -90.0), (math.pi / 4.0, 45.0)):
        _, steering, *_ = narrow.encode(0, Mode.ENGAGED, replace(DEMAND, steering_wheel_rad=wheel_rad), CYCLE)
        assert catalogue.decode(catalogue.by_name["SR_Command"], steering)["AngleCommand"] == pytest.approx(wheel_deg)


STEPS = {
    "steering_wheel_rad": ('AngleCommand : 16|16@1- (0.05,0) [-1080|1080] "deg" SR', "(0.05,0)", "SR_Command.AngleCommand"),
    "accelerator_norm": ('PositionCommand : 16|16@1+ (0.01,0) [0|100] "%" AR', "(0.01,0)", "AR_Command.PositionCommand"),
    "brake_norm": ('PositionCommand : 16|16@1+ (0.01,0) [0|100] "%" BR', "(0.01,0)", "BR_Command.PositionCommand"),
}


def dbc_with_step(tmp_path, demand, step, offset=0):
    line, ours, _ = STEPS[demand]
    text, site = ROBOTS_DBC.read_text(), tmp_path / "site.dbc"
    assert line in text
    site.write_text(text.replace(line, line.replace(ours, f"({step},{offset})")))
    return [site, GNSS_IMU_DBC]


def test_demands_have_the_steps_of_the_dbc(tmp_path, monkeypatch):
    assert Codec(CATALOGUE, LIMITS).resolution == Resolution(math.radians(0.05), 1e-4, 1e-4)
    for demand, step, offset, expected in (
        ("steering_wheel_rad", 0.5, 0, math.radians(0.5)),
        ("steering_wheel_rad", -0.2, 0, math.radians(0.2)),
        ("steering_wheel_rad", 0.1, -1080, math.radians(0.1)),
        ("accelerator_norm", 0.5, -1, 0.005),
        ("brake_norm", 0.2, 0, 0.002),
    ):
        found = Codec(load(dbc_with_step(tmp_path, demand, step, offset)), LIMITS).resolution
        assert asdict(found) == pytest.approx(asdict(replace(Resolution(), **{demand: expected})))
    catalogue = load()
    monkeypatch.setattr(catalogue, "resolution", lambda name, signal: (0.0, 0.3))  # all in floating point
    assert Codec(catalogue, LIMITS).resolution == Resolution()
    monkeypatch.setattr(catalogue, "resolution", lambda name, signal: (0.0, 0.3) if name == "SR_Command" else (0.5, 0.0))
    assert Codec(catalogue, LIMITS).resolution == Resolution(accelerator_norm=0.005, brake_norm=0.005)


@pytest.mark.parametrize("demand", STEPS)
@pytest.mark.parametrize(("step", "offset"), [(0.07, -0.1), (0.5, -0.25), (0.5, 0.001), (0.5, -1e-06)])
def test_a_dbc_on_whose_steps_no_demand_is_neutral_is_refused(tmp_path, demand, step, offset):
    files, signal = dbc_with_step(tmp_path, demand, step, offset), STEPS[demand][2]
    with pytest.raises(CatalogueError, match=rf"^site\.dbc, gnss_imu\.dbc: .* {signal}: steps of {step} from {offset} do not meet 0$"):
        Codec(load(files), LIMITS)


def test_steps_that_are_too_coarse_are_refused_all_at_once():
    codec().check_resolution(Resolution(math.radians(0.05), 1e-4, 1e-4), "nobody allows")
    codec().check_resolution(Resolution(1.0, 1.0, 1.0), "nobody allows")
    with pytest.raises(CatalogueError) as caught:
        codec().check_resolution(Resolution(math.radians(0.04), 1e-4, 5e-5), "limits nominal allow")
    assert str(caught.value) == (
        "robots.dbc, gnss_imu.dbc: SR_Command.AngleCommand: steps of 0.05, limits nominal allow up to 0.04; "
        "BR_Command.PositionCommand: steps of 0.01, limits nominal allow up to 0.005"
    )


def codec():
    return Codec(CATALOGUE, LIMITS)


def values(name, **given):
    """Values of all signals of a message: 0 but for those given."""
    assert given.keys() <= set(CATALOGUE.signals(name))
    return {name: dict.fromkeys(CATALOGUE.signals(name), 0.0) | given}


def measured(*messages):
    """Every field of the measurement that these messages change."""
    measurement = Measurement()
    codec().update(measurement, {name: signals for message in messages for name, signals in message.items()})
    fresh = Measurement()
    names = [field.name for field in fields(fresh)]
    return {name: getattr(measurement, name) for name in names if getattr(measurement, name) != getattr(fresh, name)}


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (values("PosLocal", PosLocalX=1.5, PosLocalY=-2.5), {"x_m": 1.5, "y_m": -2.5}),
        (values("VelocityLevel", VelForward=20.0, VelLateral=0.5), {"vx_mps": 20.0, "vy_mps": -0.5}),
        (values("VelYawLocal", AngleLocalYaw=180.0), {"yaw_rad": math.pi}),
        (values("RateVehicle", AngRateZ=90.0), {"yaw_rate_radps": -math.pi / 2}),
        (values("AccelLevel", AccelForward=-1.25), {"ax_mps2": -1.25}),
        (values("MilliTime", MilliTime=123456.0), {"navigation_time_ms": 123456}),
        (values("NcomStatus00", PosMode=6.0), {"is_navigation_precise": True}),
        (
            values("SR_Status", AngleActual=90.0, RateActual=-180.0, TorqueActual=7.5),
            {"steering_wheel_rad": math.pi / 2, "steering_wheel_rate_radps": -math.pi, "steering_torque_nm": 7.5},
        ),
        (values("AR_Status", PositionActual=25.0), {"accelerator_norm": 0.25}),
        (values("BR_Status", PositionActual=50.0), {"brake_norm": 0.5}),
        (
            values("CAR_WheelSpeeds", FrontLeft=1.0, FrontRight=2.0, RearLeft=3.0, RearRight=4.0),
            {"wheel_speed_radps": (1.0, 2.0, 3.0, 4.0)},
        ),
        (
            values("CAR_Powertrain", AcceleratorPedal=75.0, BrakePedal=25.0, Selector=3.0),
            {"accelerator_pedal_norm": 0.75, "brake_pedal_norm": 0.25, "is_in_drive": True},
        ),
        (values("RC_SafetyStatus", SystemState=2.0), {"is_armed": True}),
        (values("RC_SafetyStatus", SystemState=3.0), {"is_engaged": True}),
        (values("RC_SafetyStatus", SystemState=5.0), {"is_emergency_stopped": True}),
        (values("RC_SafetyStatus", EmergencyStopActive=1.0), {"is_emergency_stopped": True}),
        (values("RC_SafetyStatus", SystemState=4.0), {"is_stopped_by_robots": True}),
        (values("RC_SafetyStatus", SystemState=6.0), {"is_stopped_by_robots": True}),
        (values("RC_SafetyStatus", SystemState=1.0), {}),
        (values("RC_SafetyStatus", DeadManPressed=1.0), {"is_dead_man_pressed": True}),
        (values("RC_SafetyStatus", DriverOverride=1.0), {"is_driver_override": True}),
        (values("RC_SafetyStatus", SrReady=1.0, ArReady=1.0, BrReady=1.0), {"are_robots_ready": True}),
        (values("RC_SafetyStatus", SrReady=1.0, ArReady=1.0), {}),
        (values("RC_SafetyStatus", SrReady=1.0, BrReady=1.0), {}),
        (values("RC_SafetyStatus", ArReady=1.0, BrReady=1.0), {}),
        (values("RC_SafetyStatus", StopSource=1.0), {"stop_source": "CabinButton"}),
        (values("RC_SafetyStatus", StopSource=6.0), {"stop_source": "E2EFailure"}),
        (values("RC_SafetyStatus", WatchdogQuestion=200.0), {"watchdog_question": 200}),
        (values("RC_SafetyStatus", MeasurementId=15.0), {"measurement_id": 15}),
    ],
)
def test_what_each_message_says(message, expected):
    found = measured(message)
    assert found.keys() == expected.keys()
    assert all(found[name] == (pytest.approx(value) if isinstance(value, float) else value) for name, value in expected.items())


def test_a_stop_source_that_the_dbc_does_not_name():
    measurement = Measurement()
    site = codec()
    site._stop_sources.pop(9)
    site.update(measurement, values("RC_SafetyStatus", StopSource=9.0))
    assert measurement.stop_source == "unknown"


@pytest.mark.parametrize("mode", range(256))
def test_the_position_modes_that_are_precise_enough(mode):
    is_precise = mode in {5, 6, 23, 24, 28, 29}
    assert measured(values("NcomStatus00", PosMode=float(mode))) == ({"is_navigation_precise": True} if is_precise else {})


def test_what_was_true_is_taken_back():
    site, measurement = codec(), Measurement()
    site.update(measurement, values("NcomStatus00", PosMode=6.0) | values("CAR_Powertrain", Selector=3.0))
    site.update(measurement, {})
    assert measurement.is_navigation_precise
    assert measurement.is_in_drive
    site.update(measurement, values("NcomStatus00", PosMode=3.0) | values("CAR_Powertrain", Selector=1.0))
    assert not measurement.is_navigation_precise
    assert not measurement.is_in_drive


@pytest.mark.parametrize(
    ("flag", "field"), [("Fault", "faulty_robots"), ("CommandTimeout", "deaf_robots"), ("DriverOverride", "overridden_robots")]
)
def test_the_robots_that_say_something_are_named_until_they_take_it_back(flag, field):
    site, measurement = codec(), Measurement()
    for node in ("BR", "SR"):
        site.update(measurement, values(f"{node}_Status", **{flag: 1.0}))
    assert set(getattr(measurement, field)) == {"SR", "BR"}
    site.update(measurement, values("PosLocal"))
    assert set(getattr(measurement, field)) == {"SR", "BR"}
    site.update(measurement, values("BR_Status") | values("AR_Status", **{flag: 1.0}))
    assert set(getattr(measurement, field)) == {"SR", "AR"}
    others = {"faulty_robots", "deaf_robots", "overridden_robots"} - {field}
    assert [getattr(measurement, name) for name in others] == [(), ()]


def test_building_a_codec_leaves_no_trace():
    assert measured(values("PosLocal")) == {}
    for frame in codec().encode(0, Mode.STANDBY, DEMAND, CYCLE):
        spec = CATALOGUE.by_id[frame.arbitration_id]
        assert CATALOGUE.decode(spec, frame)["AliveCounter"] == 0


def told(mode, demand=DEMAND, cycle=CYCLE):
    """What the cyclic frames of a tick say, by message, without their protection."""
    spoken = {}
    for frame in codec().encode(77, mode, demand, cycle):
        spec = CATALOGUE.by_id[frame.arbitration_id]
        assert frame.t_ns == 77
        assert E2EReceiver(spec.e2e_data_id).check(frame.data).is_usable
        spoken[spec.name] = {k: v for k, v in CATALOGUE.decode(spec, frame).items() if k not in ("Crc", "AliveCounter")}
    return spoken


SAFETY = {
    "EmergencyStopRequest": 0, "WatchdogAnswer": 0x37, "SessionId": 0, "MaxSpeed": 130, "NavigationValid": 1, "SimulationMode": 0,
    "MeasurementId": 11, "CommandAge": 40,
}  # fmt: skip


@pytest.mark.req("E1")
@pytest.mark.parametrize(
    ("mode", "request_raw"),
    [
        *((Mode.SILENT, 0), (Mode.STANDBY, 1), (Mode.READY, 2), (Mode.ENGAGED, 3), (Mode.COMFORT_STOP, 3), (Mode.SAFE_STOP, 3)),
        (Mode.FAULT, 0),
    ],
)
def test_what_the_robots_are_told(mode, request_raw):
    is_active = mode in DRIVING
    assert told(mode) == {
        "GW_SafetyCommand": SAFETY | {"SystemRequest": request_raw, "TrajectoryValid": mode is Mode.ENGAGED},
        "SR_Command": {
            "Mode": 2 if is_active else 1, "Enable": is_active, "AngleCommand": pytest.approx(28.65), "RateLimit": 570, "TorqueLimit": 40,
            "TorqueFeedForward": 0, "ClearFault": 0,
        },
        "AR_Command": {
            "Mode": 2 if is_active else 1, "Enable": is_active, "PositionCommand": 25, "RateLimit": 500, "ForceLimit": 200,
            "ForceCommand": 0, "ClearFault": 0,
        },
        "BR_Command": {
            "Mode": 2 if is_active else 1, "Enable": is_active, "PositionCommand": 75, "RateLimit": 500, "ForceLimit": 1000,
            "ForceCommand": 0, "ClearFault": 0,
        },
    }  # fmt: skip


def test_the_order_on_the_bus_is_that_of_the_identifiers():
    names = [CATALOGUE.by_id[frame.arbitration_id].name for frame in codec().encode(0, Mode.READY, DEMAND, CYCLE)]
    assert names == ["GW_SafetyCommand", "SR_Command", "AR_Command", "BR_Command"]


@pytest.mark.parametrize(("age_ms", "raw"), [(-5.0, 0), (0.0, 0), (254.0, 254), (255.0, 255), (1e12, 255)])
def test_the_age_of_a_command_stays_within_its_signal(age_ms, raw):
    assert told(Mode.ENGAGED, cycle=replace(CYCLE, command_age_ms=age_ms))["GW_SafetyCommand"]["CommandAge"] == raw


def test_navigation_that_is_not_valid_is_told():
    assert told(Mode.ENGAGED, cycle=replace(CYCLE, is_navigation_valid=False))["GW_SafetyCommand"]["NavigationValid"] == 0


def test_the_alive_counter_counts():
    site = codec()
    frames = [site.encode(0, Mode.READY, DEMAND, CYCLE)[1] for _ in range(17)]
    assert [CATALOGUE.decode(CATALOGUE.by_name["SR_Command"], frame)["AliveCounter"] for frame in frames] == [*range(16), 0]


def monitors(**changes):
    """What heartbeat and status say."""
    finding = Finding(Cause.COMMAND_LOST, 101.5, 100.0, "controller")
    told_ = Monitors(12.5, bus_load_norm=0.42, cpu_load_norm=0.185, rejected=7, tx_error_count=96, mode=Mode.SAFE_STOP, finding=finding)
    frames = codec().encode_monitors(99, replace(told_, **changes))
    assert [frame.t_ns for frame in frames] == [99, 99]
    specs = [CATALOGUE.by_id[frame.arbitration_id] for frame in frames]
    assert [spec.name for spec in specs] == ["GW_Heartbeat", "GW_Status"]
    return [CATALOGUE.decode(spec, frame) for spec, frame in zip(specs, frames, strict=True)]


def test_what_bus_monitors_are_told():
    heartbeat, status = monitors()
    assert heartbeat == {"UpTime": 12.5, "BusLoad": 42, "CpuLoad": 18.5, "RxErrorCount": 7, "TxErrorCount": 96}
    assert status == {"Mode": 3, "Cause": 41, "Value": 101.5, "Limit": 100}
    beyond, _ = monitors(bus_load_norm=1.01, cpu_load_norm=1.01, rejected=256, tx_error_count=256)
    assert beyond == {"UpTime": 12.5, "BusLoad": 100, "CpuLoad": 100, "RxErrorCount": 255, "TxErrorCount": 255}
    assert monitors(tx_error_count=-1)[0]["TxErrorCount"] == 0
    _, none = monitors(finding=None, mode=Mode.READY)
    assert none == {"Mode": 1, "Cause": 0, "Value": 0, "Limit": 0}


@pytest.mark.parametrize(("rejected", "raw"), [(254, 254), (255, 255), (256, 255), (10**9, 255)])
def test_the_count_of_rejected_frames_stays_at_its_end(rejected, raw):
    assert monitors(rejected=rejected)[0]["RxErrorCount"] == raw


def test_a_finding_beyond_its_signal_is_told_as_its_end():
    status = monitors(finding=Finding(Cause.COMMAND_LOST, 1e6, -1e6, "controller"))[1]
    assert status == {"Mode": 3, "Cause": 41, "Value": pytest.approx(8388.607), "Limit": pytest.approx(-8388.608)}


@pytest.mark.parametrize("cause", Cause)
def test_every_cause_has_the_same_number_in_the_dbc_as_in_the_code(cause):
    assert monitors(finding=Finding(cause, 0.0, 0.0, ""))[1]["Cause"] == cause.code


@pytest.mark.parametrize("mode", Mode)
def test_every_mode_has_the_same_number_in_the_dbc_as_in_the_code(mode):
    assert monitors(mode=mode)[1]["Mode"] == mode.value


def test_every_needed_message_is_in_the_shipped_dbc():
    assert codec() is not None
    assert {CATALOGUE.by_name[name].sender for name in NEEDED_MESSAGES} == {"INS", "RC", "SR", "AR", "BR", "CAR"}
