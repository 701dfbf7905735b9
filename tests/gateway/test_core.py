"""The gateway in closed loop with a stub car, in virtual time: engagement, hand-over, stops, limits."""

import math
from dataclasses import replace

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dbc.frame import CanFrame
from gateway.causes import Cause
from gateway.core import TICK_NS
from gateway.messages import CommandStatus, Mode, Operation
from tests.support.drive import GatewayDrive


def test_state_is_si_and_iso_8855():
    drive = GatewayDrive().tick(5)
    state = drive.output.state
    assert state.is_valid
    assert (state.x_m, state.y_m) == (pytest.approx(drive.car.x_m, abs=1e-4), pytest.approx(drive.car.y_m, abs=1e-4))
    assert state.vx_mps == 20.0
    assert state.vy_mps == -0.5  # the instrument counts to the right
    assert state.yaw_rad == pytest.approx(math.radians(10.25), abs=1e-4)
    assert state.yaw_rate_radps == pytest.approx(math.radians(5.0))
    assert state.t_ns == drive.now_ns


def test_the_state_is_as_old_as_the_time_of_its_navigation_data():
    drive = GatewayDrive().tick(5)
    arrived_ns = drive.now_ns + 3_000_000
    sr_status = drive.catalogue.by_name["SR_Status"].arbitration_id
    *others, robot = sorted(drive.car.speak(drive.now_ns), key=lambda frame: frame.arbitration_id == sr_status)
    # On a bus of its own a robot's frame comes when it comes, which says nothing about the navigation data.
    frames = [frame._replace(t_ns=arrived_ns) for frame in others] + [robot._replace(t_ns=arrived_ns + 4_000_000)]
    output = drive.core.step(drive.now_ns + TICK_NS, frames)
    assert output.state.t_ns == arrived_ns


def test_nothing_is_sent_until_the_operator_arms():
    drive = GatewayDrive()
    for _ in range(300):
        assert drive.tick().output.frames == []
    assert (drive.core.mode, drive.core.blockers) == (Mode.SILENT, [])


def test_neutral_until_engaged():
    drive = GatewayDrive()
    drive.steer_rad, drive.drive_norm = 0.1, 0.5
    drive.arm()
    for _ in range(100):
        drive.tick()
        for robot in ("SR", "AR", "BR"):
            told = drive.car.told[f"{robot}_Command"]
            assert told["Enable"] == 0
            assert told.get("AngleCommand", 0) == 0
            assert told.get("PositionCommand", 0) == 0
    assert drive.core.mode is Mode.READY


def test_engagement_needs_the_operator_and_acts_once_per_request():
    drive = GatewayDrive().engage()
    drive.ask(Operation.DISENGAGE)
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    drive.arm()
    drive.tick(200)
    assert drive.core.mode is Mode.READY  # and not ENGAGED: nothing re-engages by itself


@pytest.mark.parametrize(
    ("break_it", "named"),
    [
        (lambda d: d.car.silent.add("PosLocal"), "PosLocal"),
        (lambda d: d.car.corrupt.add("SR_Status"), "SR_Status"),
        (lambda d: setattr(d.car, "position_mode", "SPS"), "position mode"),
        (lambda d: setattr(d.car, "dead_man", 0), "dead-man"),
        (lambda d: setattr(d.car, "override", 1), "driver override"),
        (lambda d: setattr(d.car, "fault", 1), "fault"),
        (lambda d: setattr(d.car, "is_time_frozen", True), "frozen"),
        (lambda d: setattr(d, "is_controller_alive", False), "controller silent"),
        (lambda d: setattr(d, "status", CommandStatus.DEGRADED), "good commands"),
    ],
)
def test_not_ready_names_every_reason(break_it, named):
    drive = GatewayDrive()
    break_it(drive)
    drive.tick(250)
    assert any(named in blocker for blocker in drive.core.blockers), drive.core.blockers
    drive.ask(Operation.ARM)
    drive.tick()
    assert any(named in refusal for refusal in drive.output.reply.refusals)
    drive.ask(Operation.ENGAGE)
    drive.tick(5)
    assert drive.core.mode is Mode.SILENT


def test_hand_over_has_no_bump():
    drive = GatewayDrive()
    drive.car.steering_wheel_deg = 25.0
    drive.car.accelerator_percent = 25.0
    drive.drive_norm = 0.25
    drive.engage()
    told = drive.car.told
    assert told["SR_Command"]["AngleCommand"] == pytest.approx(25.0, abs=8.1)  # one tick at 800 deg/s
    assert told["AR_Command"]["PositionCommand"] == pytest.approx(25.0, abs=0.1)


def test_command_reaches_the_robots_in_their_units():
    drive = GatewayDrive()
    drive.car.is_following = True
    drive.engage()
    drive.steer_rad, drive.drive_norm = 0.05, 0.4
    drive.tick(50)
    assert drive.car.told["SR_Command"]["AngleCommand"] == pytest.approx(math.degrees(0.05 * 14.7), abs=0.03)
    assert drive.car.told["AR_Command"]["PositionCommand"] == pytest.approx(40.0, abs=0.01)
    assert drive.car.told["BR_Command"]["PositionCommand"] == 0.0
    drive.drive_norm = -0.5
    drive.tick(50)
    assert drive.car.told["AR_Command"]["PositionCommand"] == 0.0
    assert drive.car.told["BR_Command"]["PositionCommand"] == pytest.approx(100 * 0.5 * 4838.7 / 15000.0, abs=0.01)


def test_accelerator_waits_for_the_brake_pedal():
    drive = GatewayDrive()
    drive.drive_norm = 0.5
    drive.engage()
    drive.car.brake_percent = 10.0
    drive.tick(50)
    assert drive.car.told["AR_Command"]["PositionCommand"] == 0.0
    drive.car.brake_percent = 0.0
    drive.tick(2)
    assert drive.car.told["AR_Command"]["PositionCommand"] > 0.0


def test_one_missed_command_is_tolerated_two_are_not():
    drive = GatewayDrive().engage()
    while drive._ticks % 4 != 1:
        drive.tick()  # the controller has just answered
    drive.is_controller_alive = False
    drive.tick(7)  # one command missed, then it comes back
    drive.is_controller_alive = True
    drive.tick(10)
    assert drive.core.mode is Mode.ENGAGED
    drive.is_controller_alive = False
    drive.tick(20)
    assert drive.core.mode is Mode.SAFE_STOP
    assert drive.transitions[-1].finding.cause is Cause.COMMAND_LOST


def test_silent_controller_stops_the_car_within_120_ms():
    drive = GatewayDrive().engage()
    while drive._ticks % 4 != 1:
        drive.tick()
    last_command_ns = drive.now_ns
    drive.is_controller_alive = False
    drive.tick(30)
    assert drive.transitions[-1].t_ns - last_command_ns <= 120_000_000
    assert drive.transitions[-1].t_ns - last_command_ns > 100_000_000
    drive.tick(250)
    assert drive.car.told["BR_Command"]["PositionCommand"] == pytest.approx(100 * 1500 * 2.5 / 15000, abs=0.1)
    drive.car.vx_mps = 0.0
    drive.tick(2)
    assert drive.car.told["BR_Command"]["PositionCommand"] == pytest.approx(30.0)  # held
    drive.car.vx_mps = 1.0
    drive.tick(2)
    assert drive.car.told["BR_Command"]["PositionCommand"] == pytest.approx(30.0)  # and stays held


def test_safe_stop_follows_the_tail_of_the_plan():
    drive = GatewayDrive()
    drive.engage().tick(20)
    drive.plan_steer_rad = tuple(0.001 * k for k in range(30))
    drive.tick(8)
    drive.is_controller_alive = False
    start = drive.core.commands.newest
    drive.tick(60)
    k = (drive.now_ns - start.t_ns) // 40_000_000
    assert k > 5
    assert drive.car.told["SR_Command"]["AngleCommand"] == pytest.approx(math.degrees(0.001 * k * 14.7), abs=0.05)
    drive.tick(200)
    assert drive.car.told["SR_Command"]["AngleCommand"] == pytest.approx(math.degrees(0.029 * 14.7), abs=0.05)


@pytest.mark.parametrize(
    ("break_it", "cause", "mode"),
    [
        (lambda d: d.car.silent.add("VelocityLevel"), Cause.MESSAGE_MISSING, Mode.SAFE_STOP),
        (lambda d: d.car.corrupt.add("BR_Status"), Cause.MESSAGE_INVALID, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "is_time_frozen", True), Cause.NAVIGATION_FROZEN, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "position_mode", "Blanked"), Cause.NAVIGATION_COARSE, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "fault", 1), Cause.ROBOT_FAULT, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "command_timeout", 1), Cause.ROBOT_MISSES_COMMANDS, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "system_state", "Armed"), Cause.ROBOTS_NOT_ENGAGED, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "system_state", "EStop"), Cause.ROBOTS_EMERGENCY_STOP, Mode.FAULT),
        (lambda d: setattr(d, "status", CommandStatus.FAILED), Cause.COMMAND_FAILED, Mode.SAFE_STOP),
        (lambda d: setattr(d, "command_boot_id", 8), Cause.COMMAND_LOST, Mode.SAFE_STOP),
        (lambda d: setattr(d, "steer_rad", 3.0), Cause.COMMAND_LOST, Mode.SAFE_STOP),
        (lambda d: setattr(d, "now_ns", d.now_ns + 60_000_000), Cause.TICK_GAP, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "override", 1), Cause.DRIVER_OVERRIDE, Mode.STANDBY),
    ],
)
def test_every_fault_ends_the_engagement_with_its_name(break_it, cause, mode):
    drive = GatewayDrive().engage().tick(50)
    assert drive.core.mode is Mode.ENGAGED
    break_it(drive)
    drive.tick(20)
    assert drive.core.mode is mode
    assert [t.finding.cause for t in drive.transitions if t.before is Mode.ENGAGED] == [cause]
    drive.tick(200)
    assert drive.core.mode is not Mode.ENGAGED


def test_reset_leaves_a_safe_stop_and_allows_a_new_engagement():
    drive = GatewayDrive().engage().tick(50)
    drive.status = CommandStatus.FAILED
    drive.tick(10)
    assert drive.core.mode is Mode.SAFE_STOP
    drive.status = CommandStatus.OK
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.output.reply.refusals == ("the car moves: 20.0 m/s",)
    drive.car.vx_mps = 0.0
    drive.tick(20)
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    drive.engage()


def test_a_stop_is_not_reset_because_of_a_speed_that_the_wheels_contradict():
    drive = GatewayDrive().engage().tick(50)
    drive.car.vx_mps, drive.car.wheel_speed_offset_mps = 0.0, 20.0
    drive.tick(20)
    assert drive.transitions[-1].finding.cause is Cause.SPEED_IMPLAUSIBLE
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.output.reply.refusals == ("the car moves: 20.0 m/s",)
    drive.tick(200)
    assert drive.core.mode is Mode.SAFE_STOP
    assert drive.car.told["BR_Command"]["PositionCommand"] == pytest.approx(25.0, abs=0.1)  # it brakes on, and is not held as if it stood
    drive.car.wheel_speed_offset_mps = 0.0
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.core.mode is Mode.STANDBY


@pytest.mark.req("E3", "F6")
@pytest.mark.parametrize("drive_norm", [0.3, -1.0])
def test_pedals_that_are_not_told_any_more_are_no_foot(drive_norm):
    drive = GatewayDrive()
    drive.car.is_following, drive.car.vx_mps = True, 25.0
    drive.engage().tick(40)
    drive.drive_norm = drive_norm
    drive.tick(40)
    drive.drive_norm = 0.0  # the robot lets the pedal go, and nobody sees it
    drive.car.silent = {"CAR_Powertrain"}
    drive.tick(100)
    assert [t.finding.cause for t in drive.transitions[2:]] == [Cause.MESSAGE_MISSING]
    assert drive.core.mode is Mode.SAFE_STOP


@pytest.mark.req("E3", "F7")
@pytest.mark.parametrize(("lie", "message"), [({"override_of": {"BR"}}, "BR_Status"), ({"override": 1}, "RC_SafetyStatus")])
def test_a_message_that_is_invalid_does_not_hand_the_car_over(lie, message):
    drive = GatewayDrive().engage().tick(50)
    drive.car.corrupt = {message}
    drive.tick(4)
    assert drive.transitions[-1].finding.cause is Cause.MESSAGE_INVALID
    drive.car.corrupt = set()
    for name, value in lie.items():
        setattr(drive.car, name, value)
    drive.tick(90)
    assert drive.core.mode is Mode.SAFE_STOP
    drive.tick(30)  # clean for a second: now it is believed
    assert drive.core.mode is Mode.STANDBY


def test_a_stop_begins_with_what_is_asked_for_not_with_a_sample_of_the_accelerometer():
    drive = GatewayDrive().engage().tick(50)
    drive.car.acceleration_mps2 = -9.0
    drive.ask(Operation.STOP)
    drive.tick()
    drive.car.acceleration_mps2 = 0.0
    drive.tick(50)
    assert drive.core.mode is Mode.COMFORT_STOP
    assert drive.core.actuation.acceleration_mps2 == pytest.approx(-0.15, abs=0.005)  # 0.3 m/s3 for half a second


def test_a_stop_soon_after_the_engagement_stays_gentle():
    drive = GatewayDrive()
    drive.car.system_state = "Armed"  # it takes the robots some time to follow
    drive.engage()
    drive.ask(Operation.STOP)
    drive.tick(5)
    drive.car.system_state = None
    drive.tick(50)
    assert drive.core.mode is Mode.COMFORT_STOP


@pytest.mark.req("S2")
@pytest.mark.parametrize("arms", [False, True])
def test_a_controller_may_come_back_as_another_process_while_nothing_is_armed(arms):
    drive = GatewayDrive()
    drive = drive.arm() if arms else drive.tick(50)
    drive.is_controller_alive = False
    drive.tick(30)
    assert drive.core.mode is (Mode.STANDBY if arms else Mode.SILENT)
    drive.is_controller_alive, drive.command_boot_id = True, 8
    drive.engage()


@pytest.mark.req("S2")
def test_a_second_controller_does_not_take_the_place_of_one_that_lives():
    drive = GatewayDrive().tick(50)
    for _ in range(50):
        drive.tick(4)
        drive.core.commands.offer(drive.now_ns, replace(drive.command(), boot_id=8, seq=10**6), drive.core._state_seq)
    assert drive.core.commands.newest.boot_id == 7
    assert any("second controller" in name for name in drive.core.blockers)


@pytest.mark.req("E2")
def test_a_request_that_is_made_while_a_step_is_under_way_is_heard():
    drive = GatewayDrive().engage()
    drive.ask(Operation.DISENGAGE)
    drive._to_send = replace(drive._to_send, t_ns=drive.now_ns + TICK_NS + 300_000)  # after the time that the step goes by
    drive.tick()
    assert drive.output.reply.refusals == ()
    assert drive.core.mode is Mode.STANDBY


def test_between_two_steps_there_is_one_state_however_fast_the_navigation_system():
    drive = GatewayDrive().tick(3)
    seq, states = drive.output.state.seq, []
    for k in range(1, 4):
        frames = drive.car.speak(drive.now_ns)
        states.append(drive.core.sense(drive.now_ns + k * 2_000_000, frames))
    assert [state and state.seq for state in states] == [seq + 1, None, None]
    assert drive.tick().output.state is states[0]
    assert drive.tick().output.state.seq == seq + 2


def test_heartbeat_every_100_ms():
    drive = GatewayDrive().arm()
    heartbeat_id = drive.catalogue.by_name["GW_Heartbeat"].arbitration_id
    beats = [any(f.arbitration_id == heartbeat_id for f in drive.tick().output.frames) for _ in range(100)]
    assert sum(beats) == 10


@given(
    steers=st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=30),
    drives=st.lists(st.floats(-4.0, 4.0), min_size=5, max_size=30),
    vx_mps=st.floats(0.0, 36.0),
)
@settings(max_examples=30, deadline=None, phases=(Phase.generate,))  # to shrink takes minutes
def test_no_demand_ever_breaks_a_limit(steers, drives, vx_mps):
    drive = GatewayDrive()
    drive.car.vx_mps = round(vx_mps, 2)
    drive.car.is_following = True
    drive.engage().tick(60)
    previous_deg = drive.car.told["SR_Command"]["AngleCommand"]
    for steer, drive_norm in zip(steers, drives, strict=False):
        drive.steer_rad, drive.drive_norm = steer, drive_norm
        for _ in range(4):
            drive.tick()
            told = drive.car.told
            angle_deg = told["SR_Command"]["AngleCommand"]
            assert abs(angle_deg - previous_deg) <= 800.0 * TICK_NS * 1e-9 + 0.05
            if drive.car.vx_mps > 1.0:
                road_wheel = math.radians(angle_deg) / 14.7
                assert drive.car.vx_mps**2 * math.tan(abs(road_wheel)) / 2.648 <= 15.0 * 1.01 + 0.05
            assert not (told["AR_Command"]["PositionCommand"] > 0 and told["BR_Command"]["PositionCommand"] > 0)
            previous_deg = angle_deg
    assert drive.core.mode is Mode.ENGAGED


@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_no_frame_makes_the_core_raise(data):
    drive = GatewayDrive().tick(3)
    now_ns = drive.now_ns + TICK_NS
    ids = st.one_of(st.sampled_from(sorted(drive.catalogue.by_id)), st.integers(0, 2047))
    frames = data.draw(st.lists(st.builds(CanFrame, ids, st.binary(max_size=8), st.just(now_ns)), max_size=40))
    output = drive.core.step(now_ns, frames)
    assert output.state.mode is Mode.SILENT
    assert drive.core.supervisor.received >= len(frames)
