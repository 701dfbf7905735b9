"""The gateway in closed loop with a stub car, in virtual time: engagement, hand-over, stops, limits."""

import copy
import math
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load
from dbc.frame import CanFrame
from dbc.health import LinkHealth
from dbc.vehicle import load_vehicle
from dbc.watchdog import answer
from gateway.causes import Cause, Finding
from gateway.conditions import Surroundings
from gateway.core import ENGAGE_GRACE_NS, TICK_NS, GatewayCore
from gateway.limits import BENCH, LIFTED, NOMINAL, PROVING_GROUND
from gateway.messages import CommandStatus, Mode, Operation, OperatorRequest
from tests.support.drive import GatewayDrive


@cache
def _prepared(mode):
    return {Mode.SILENT: GatewayDrive.tick, Mode.READY: GatewayDrive.arm, Mode.ENGAGED: GatewayDrive.engage}[mode](GatewayDrive())


def _twin(drive):
    """A copy that goes on alone: to drive to where a test begins takes longer than the test."""
    catalogue = drive.catalogue
    shared = (catalogue, *catalogue.by_name.values(), drive.core.profile, drive.core.actuation._vehicle)
    return copy.deepcopy(drive, {id(thing): thing for thing in shared})


def armed():
    return _twin(_prepared(Mode.READY))


def engaged():
    return _twin(_prepared(Mode.ENGAGED))


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
    drive = engaged()
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
        (lambda d: setattr(d, "status", CommandStatus.DEGRADED), "degraded"),
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
    drive = engaged()
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
    drive = engaged()
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
        (lambda d: setattr(d.car, "system_state", "Armed"), Cause.ROBOTS_NOT_ENGAGED, Mode.STANDBY),
        (lambda d: setattr(d.car, "system_state", "EStop"), Cause.ROBOTS_EMERGENCY_STOP, Mode.FAULT),
        (lambda d: setattr(d, "status", CommandStatus.FAILED), Cause.COMMAND_FAILED, Mode.SAFE_STOP),
        (lambda d: setattr(d, "command_boot_id", 8), Cause.COMMAND_LOST, Mode.SAFE_STOP),
        (lambda d: setattr(d, "steer_rad", 3.0), Cause.COMMAND_LOST, Mode.SAFE_STOP),
        (lambda d: setattr(d, "now_ns", d.now_ns + 60_000_000), Cause.TICK_GAP, Mode.SAFE_STOP),
        (lambda d: setattr(d.car, "override", 1), Cause.DRIVER_OVERRIDE, Mode.STANDBY),
    ],
)
def test_every_fault_ends_the_engagement_with_its_name(break_it, cause, mode):
    drive = engaged().tick(50)
    assert drive.core.mode is Mode.ENGAGED
    break_it(drive)
    drive.tick(20)
    assert drive.core.mode is mode
    assert [t.finding.cause for t in drive.transitions if t.before is Mode.ENGAGED] == [cause]
    drive.tick(200)
    assert drive.core.mode is not Mode.ENGAGED


def test_reset_leaves_a_safe_stop_and_allows_a_new_engagement():
    drive = engaged().tick(50)
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
    drive = engaged().tick(50)
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
    drive = engaged().tick(50)
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
    drive = engaged().tick(50)
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
    drive.tick(4)
    assert drive.core.commands.good_in_a_row == 1
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
    drive = engaged()
    drive.ask(Operation.DISENGAGE)
    drive._to_send = replace(drive._to_send, t_ns=drive.now_ns + TICK_NS + 300_000)  # after the time that the step goes by
    drive.tick()
    assert drive.output.reply.refusals == ()
    assert drive.core.mode is Mode.STANDBY


def test_between_two_steps_there_is_one_state_however_fast_the_navigation_system():
    drive = GatewayDrive().tick(3)
    seq, states = drive.output.state.seq, []
    for k in range(1, 4):
        frames = drive.car.speak(drive.now_ns + k * 2_000_000)
        states.append(drive.core.sense(drive.now_ns + k * 2_000_000, frames))
    assert [state and state.seq for state in states] == [seq + 1, None, None]
    assert drive.tick().output.state is states[0]
    assert drive.tick().output.state.seq == seq + 2


def test_every_field_of_a_state():
    drive = GatewayDrive()
    drive.car.accelerator_percent, drive.car.brake_percent, drive.car.acceleration_mps2 = 25.0, 10.0, -1.25
    drive.car.steering_wheel_deg = 147.0
    state = drive.tick(3).output.state
    assert (state.boot_id, state.seq, state.mode) == (1, 3, Mode.SILENT)
    assert state.ax_mps2 == -1.25
    assert state.steer_rad == pytest.approx(math.radians(10.0))
    assert state.drive_norm == pytest.approx(0.25 - 0.10 * 15000.0 / 4838.7)


def test_a_gateway_that_has_heard_nothing():
    core = GatewayDrive().core
    output = core.step(1_000_000_007, [])
    assert (output.state.t_ns, output.state.is_valid, output.state.seq) == (0, False, 1)
    assert (output.frames, output.transition, output.reply, core.ticks) == ([], None, None, 1)
    found = {finding.cause: finding.value for finding in core.findings}
    assert found[Cause.NAVIGATION_FROZEN] == found[Cause.WATCHDOG_SILENT] == 1_000_000_007 * 1e-6


def test_a_state_between_two_steps_is_that_of_the_next_step():
    drive = GatewayDrive()
    assert drive.core.sense(drive.now_ns, []) is None
    sensed = drive.core.sense(drive.now_ns + 3, drive.car.speak(drive.now_ns + 2))
    assert (sensed.t_ns, sensed.seq, sensed.is_valid) == (drive.now_ns + 2, 1, False)  # valid once a step has judged it
    drive.car.is_time_frozen = True
    assert drive.core.sense(drive.now_ns + 4, drive.car.speak(drive.now_ns + 4)) is None
    assert drive.tick().output.state is sensed
    assert drive.tick().output.state.seq == 2


@pytest.mark.req("E2", "S2")
@pytest.mark.parametrize(
    ("younger_ns", "refusal"), [(0, "the request is repeated, or made before another one"), (1, "not possible in SILENT")]
)
def test_what_was_asked_before_the_gateway_lived_does_not_act(younger_ns, refusal):
    drive = GatewayDrive()
    drive.ask(Operation.ENGAGE)
    drive._to_send = replace(drive._to_send, t_ns=drive.now_ns + younger_ns)  # the first step is one period later
    drive.tick()
    reply = drive.output.reply
    assert (reply.boot_id, reply.seq, reply.operation, reply.mode, reply.refusals) == (9, 1, Operation.ENGAGE, Mode.SILENT, (refusal,))


@pytest.mark.req("S2")
def test_a_request_acts_once():
    drive = armed()
    drive.ask(Operation.DISENGAGE)
    asked = drive._to_send
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    drive.arm()
    drive._to_send = asked
    drive.tick()
    assert drive.output.reply.refusals == ("the request is repeated, or made before another one",)
    assert drive.core.mode is Mode.READY


@pytest.mark.req("S2")
def test_a_request_that_was_made_while_a_step_was_under_way_acts_once():
    drive = engaged()
    drive.ask(Operation.STOP)
    asked = drive._to_send = replace(drive._to_send, operation=Operation.DISENGAGE, t_ns=drive.now_ns + TICK_NS + 300_000)
    drive.tick()
    assert drive.output.reply.refusals == ()
    drive._to_send = asked
    drive.tick()
    assert drive.output.reply.refusals == ("the request is repeated, or made before another one",)


def test_a_stop_from_the_future_does_not_hold_up_what_is_asked_now():
    drive = armed()
    drive.ask(Operation.STOP)
    drive._to_send = replace(drive._to_send, t_ns=drive.now_ns + 10**12)
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    drive.ask(Operation.RESET)
    drive._to_send = replace(drive._to_send, t_ns=drive.now_ns)
    drive.tick()
    assert drive.output.reply.refusals == ("not possible in STANDBY",)  # looked at: the date of a stop says nothing about others
    drive.arm()


@pytest.mark.parametrize(
    ("prepare", "possible"),
    [
        (lambda: GatewayDrive().tick(), {Operation.ARM, Operation.RESET}),
        (armed, {Operation.ENGAGE, Operation.DISENGAGE, Operation.STOP}),
        (engaged, {Operation.DISENGAGE, Operation.STOP}),
    ],
)
def test_what_may_be_asked_for_in_a_mode(prepare, possible):
    for operation in Operation:
        drive = prepare()
        mode = drive.core.mode
        drive.ask(operation)
        drive.tick()
        assert ((f"not possible in {mode.name}",) != drive.output.reply.refusals) == (operation in possible)


def test_what_the_operator_ends_is_told_as_his_doing():
    for operation, cause in ((Operation.DISENGAGE, Cause.OPERATOR_DISENGAGE), (Operation.STOP, Cause.OPERATOR_STOP)):
        drive = engaged()
        assert drive.core.disengagement is None
        drive.ask(operation)
        drive.tick()
        assert drive.core.disengagement.finding == Finding(cause, 1, 0, "operator") == drive.output.transition.finding
        assert drive.core.disengagement.t_ns == drive.now_ns


def test_a_stop_that_its_own_process_asks_for_is_told_as_that():
    drive = engaged()
    drive._to_send = OperatorRequest(drive.output.state.boot_id, 1, Operation.STOP, drive.now_ns)
    drive.tick()
    assert drive.core.disengagement.finding == Finding(Cause.OPERATOR_STOP, 1, 0, "the gateway is to end")


def test_only_the_end_of_an_engagement_is_a_disengagement():
    drive = armed()
    drive.car.dead_man = 0
    drive.tick()
    assert (drive.core.mode, drive.core.disengagement) == (Mode.STANDBY, None)
    drive.car.dead_man = 1
    drive.arm()
    drive.car.fault = 1
    drive.tick(2)
    assert (drive.core.mode, drive.core.disengagement) == (Mode.STANDBY, None)
    assert drive.transitions[-1].finding is not None


def test_a_reset_is_no_second_disengagement():
    drive = GatewayDrive()
    drive.car.vx_mps = 0.0
    drive.engage()
    drive.ask(Operation.STOP)
    drive.tick()
    ended = drive.core.disengagement
    drive.tick(5)
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    assert drive.core.disengagement is ended
    assert drive.core.reason == "operator reset"


def heard(drive, name, ticks):
    """Values of a message, by the tick of the core in which it was sent."""
    spec, found = drive.catalogue.by_name[name], {}
    for _ in range(ticks):
        for frame in drive.tick().output.frames:
            if frame.arbitration_id == spec.arbitration_id:
                assert frame.t_ns == drive.now_ns
                found[drive.core.ticks] = drive.catalogue.decode(spec, frame)
    return found


def test_bus_monitors_are_told_of_time_that_has_passed_and_of_what_is_around():
    drive = GatewayDrive()
    drive.arm()
    links = {"robots": LinkHealth(tx_error_count=8), "navigation": LinkHealth(tx_error_count=97)}
    drive.now_ns += 60_000_000_000  # however many steps there were in it
    for _ in range(10):
        drive.now_ns += 10_000_000
        output = drive.core.step(drive.now_ns, [], surroundings=Surroundings(links, bus_load_norm=0.25, cpu_load_norm=0.5))
        beats = [frame for frame in output.frames if frame.arbitration_id == drive.catalogue.by_name["GW_Heartbeat"].arbitration_id]
        if beats:
            beat = drive.catalogue.decode(drive.catalogue.by_name["GW_Heartbeat"], beats[0])
    assert beat["UpTime"] == pytest.approx((drive.now_ns - 1_010_000_000) * 1e-9, abs=0.2)
    assert (beat["BusLoad"], beat["CpuLoad"], beat["TxErrorCount"]) == (25, 50, 97)


def test_what_bus_monitors_are_told_every_100_ms():
    drive = GatewayDrive()
    drive.core.step(drive.now_ns, [CanFrame(0x7FF, b"", drive.now_ns)] * 5)
    drive.arm()
    beats = heard(drive, "GW_Heartbeat", 25)
    assert len(beats) in (2, 3)
    for tick, beat in beats.items():
        assert tick % 10 == 0
        assert beat["UpTime"] == pytest.approx((tick - 1) * 0.01, abs=0.051)
        assert beat["RxErrorCount"] == 5
        assert beat["TxErrorCount"] == 0  # nobody tells one
    assert all(status == {"Mode": 1, "Cause": 0, "Value": 0, "Limit": 0} for status in heard(drive, "GW_Status", 20).values())


@pytest.mark.req("F10")
def test_in_a_fault_only_bus_monitors_hear_something():
    drive = engaged()
    drive.car.emergency_stop = 1
    drive.tick(2)
    assert drive.core.mode is Mode.FAULT
    heard_ids = {frame.arbitration_id for _ in range(20) for frame in drive.tick().output.frames}
    assert {drive.catalogue.by_id[identifier].name for identifier in heard_ids} == {"GW_Heartbeat", "GW_Status"}
    (status, *_) = heard(drive, "GW_Status", 20).values()
    assert (status["Mode"], status["Cause"], status["Value"]) == (4, Cause.ROBOTS_EMERGENCY_STOP.code, 1)


def test_the_safety_command_tells_age_measurement_and_limits():
    drive = armed()
    ids = []
    for _ in range(8):
        told = drive.tick().car.told["GW_SafetyCommand"]
        assert told["CommandAge"] == 10 * ((drive._ticks - 1) % 4)
        assert told["MaxSpeed"] == round(1.1 * drive.core.profile.max_speed_mps * 3.6)
        assert told["NavigationValid"] == 1
        assert told["WatchdogAnswer"] == answer(drive.car._question)
        ids.append(int(told["MeasurementId"]))
    assert sorted((after - before) % 16 for before, after in pairwise(ids)) in ([0] * 6 + [1], [0] * 5 + [1] * 2)
    drive.car.position_mode = "SPS"
    assert drive.tick().car.told["GW_SafetyCommand"]["NavigationValid"] == 0


def test_before_any_command_there_is_no_measurement():
    drive = GatewayDrive()
    drive.is_controller_alive = False
    drive.tick(5)
    drive.ask(Operation.RESET)
    told = drive.tick().car.told["GW_SafetyCommand"]
    assert (drive.core.mode, told["MeasurementId"], told["CommandAge"]) == (Mode.STANDBY, 0, 255)
    assert told["MaxSpeed"] == round(1.1 * drive.core.profile.max_speed_mps * 3.6)


@pytest.mark.parametrize("lag", range(11))
def test_the_age_at_actuation_is_that_of_the_state_that_was_answered(lag):
    drive = armed()
    drive.command = lambda: replace(GatewayDrive.command(drive), state_seq=drive.core.ticks - lag)
    drive.tick(8)
    # One period from the state to the command, one from the robots' acting on it to their status.
    assert drive.core.latency.newest_ns == (lag + 2) * TICK_NS


def test_a_command_that_answers_no_state_is_as_old_as_the_clock():
    drive = GatewayDrive().tick()
    drive.is_controller_alive = False
    drive.ask(Operation.RESET)
    drive.tick(2)
    assert drive.core.latency.newest_ns == drive.now_ns


def test_latency_only_matters_while_the_car_is_driven():
    drive = GatewayDrive()
    drive.car.is_echoing = False
    drive.arm().tick(100)
    assert (drive.core.mode, drive.core.findings) == (Mode.READY, [])
    drive.ask(Operation.ENGAGE)
    drive.tick(60)
    assert (drive.core.mode, drive.transitions[-1].finding.cause) == (Mode.COMFORT_STOP, Cause.LATENCY)


def test_what_was_late_before_an_engagement_does_not_count():
    drive = GatewayDrive()
    drive.car.is_echoing = False
    drive.arm().tick(30)
    drive.car.is_echoing = True
    drive.ask(Operation.ENGAGE)
    drive.tick(60)
    assert drive.core.mode is Mode.ENGAGED


def test_the_robots_have_200_ms_to_follow():
    drive = GatewayDrive()
    drive.car.system_state = "Armed"
    drive.engage()
    engaged_ns = drive.now_ns
    drive.tick(30)
    assert drive.transitions[-1].t_ns == engaged_ns + ENGAGE_GRACE_NS + TICK_NS
    assert drive.transitions[-1].finding.cause is Cause.ROBOTS_NOT_ENGAGED


@pytest.mark.req("E4")
def test_robots_that_have_not_followed_are_not_asked_any_more():
    """Or they would take a wheel that somebody else has, whenever it pleases them."""
    drive = GatewayDrive()
    drive.car.system_state = "Armed"
    drive.engage().tick(25)
    assert drive.core.mode is Mode.STANDBY
    requests = drive.catalogue.enumeration("GW_SafetyCommand", "SystemRequest")
    for _ in range(100):
        drive.tick()
        assert drive.car.told["GW_SafetyCommand"]["SystemRequest"] == requests["Disarm"]
        assert drive.car.told["SR_Command"]["Enable"] == 0


@pytest.mark.req("S2")
def test_a_second_controller_that_has_gone_does_not_keep_from_arming():
    drive = GatewayDrive().tick(250)
    for _ in range(3):
        drive.now_ns += TICK_NS
        drive.core.step(drive.now_ns, drive.car.speak(drive.now_ns), replace(drive.command(), boot_id=8))
    assert any("second controller" in blocker for blocker in drive.core.blockers)
    drive.tick(250)
    assert drive.core.blockers == []


@pytest.mark.req("S2")
def test_while_a_car_may_be_driven_a_second_controller_is_remembered():
    drive = engaged()
    for _ in range(2):
        drive.now_ns += TICK_NS
        drive.core.step(drive.now_ns, drive.car.speak(drive.now_ns), replace(drive.command(), boot_id=8))
    drive.tick(250)
    assert (drive.core.mode, drive.core.commands.strangers) == (Mode.ENGAGED, 2)


@pytest.mark.req("E3")
def test_robots_that_have_let_go_for_a_driver_are_no_fault():
    drive = engaged().tick(50)
    drive.car.system_state, drive.car.override = "Disarmed", 1
    drive.tick(2)
    assert (drive.core.mode, drive.transitions[-1].finding.cause) == (Mode.STANDBY, Cause.DRIVER_OVERRIDE)


@pytest.mark.req("F1")
def test_a_car_that_a_gentle_stop_does_not_slow_is_stopped_firmly():
    drive = GatewayDrive()
    drive.car.vx_mps = 10.0  # and stays: it rolls down a hill
    drive.engage().tick(50)
    drive.ask(Operation.STOP)
    drive.tick(560)
    assert drive.core.mode is Mode.COMFORT_STOP
    drive.tick(20)
    assert drive.core.mode is Mode.SAFE_STOP
    assert drive.core.disengagement.finding.cause is Cause.CAR_NOT_SLOWING
    drive.tick(300)
    assert drive.car.told["BR_Command"]["PositionCommand"] == pytest.approx(25.0, abs=0.01)
    assert drive.core.findings == []  # a firm stop has nothing above it


@pytest.mark.req("F1")
def test_a_car_that_follows_a_gentle_stop_stays_in_it():
    drive = GatewayDrive()
    drive.car.is_following, drive.car.vx_mps = True, 20.0
    drive.drive_norm = 1.0  # the engine pulls until the stop begins
    drive.engage().tick(200)
    drive.ask(Operation.STOP)
    drive.tick(3_000)
    assert (drive.core.mode, drive.core.disengagement.finding.cause) == (Mode.COMFORT_STOP, Cause.OPERATOR_STOP)
    assert drive.car.vx_mps == 0.0


@pytest.mark.req("F13")
def test_a_gateway_that_slept_before_an_engagement_looks_again_first():
    drive = armed()
    drive.now_ns += 50_000_000
    drive.ask(Operation.ENGAGE)
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    assert drive.output.reply.refusals[0].startswith("gateway was stopped: gateway, 60 ms")


@pytest.mark.req("F9")
@pytest.mark.parametrize(("step_ms", "is_found"), [(0, False), (45, False), (60, True)])
def test_navigation_data_that_come_later_than_they_did_are_older(step_ms, is_found):
    drive = engaged().tick(50)
    age_ns = drive.now_ns - drive.output.state.t_ns
    drive.car._time_ms -= step_ms
    drive.tick()  # repeats what was valid already, or goes back
    drive.tick(6)
    assert drive.now_ns - drive.output.state.t_ns - age_ns == pytest.approx(1_000_000 * step_ms, abs=40_000)
    assert (drive.core.mode is not Mode.ENGAGED) is is_found
    if is_found:
        assert drive.transitions[-1].finding.cause is Cause.NAVIGATION_FROZEN


@pytest.mark.req("F8")
def test_a_time_of_validity_that_goes_to_and_fro_is_not_new():
    drive = engaged().tick(50)
    for k in range(12):
        drive.car._time_ms -= 10 + (5 if k % 2 else -5)
        drive.tick()
    assert drive.transitions[-1].finding.cause is Cause.NAVIGATION_FROZEN


@pytest.mark.req("F8")
def test_before_an_operator_arms_a_navigation_system_may_begin_anew():
    drive = GatewayDrive().tick(300)
    drive.car._time_ms = 5
    drive.tick(250)
    assert drive.core.blockers == []
    assert drive.output.state.t_ns == drive.now_ns


@pytest.mark.req("G1")
@pytest.mark.parametrize(("profile", "limit_mps2"), [(PROVING_GROUND, 15.0), (LIFTED, math.inf)])
def test_the_faster_of_two_speeds_limits_the_steering(profile, limit_mps2):
    drive = GatewayDrive()
    drive.core = GatewayCore(drive.catalogue, load_vehicle(), boot_id=1, profile=profile)
    drive.engage().tick(50)
    drive.car.vx_mps, drive.car.wheel_speed_offset_mps = 0.0, 20.0
    drive.plan_steer_rad = (0.4,) * 30
    largest_mps2 = 0.0
    for _ in range(100):
        drive.tick()
        road_wheel_rad = math.radians(drive.car.told["SR_Command"]["AngleCommand"]) / 14.7
        largest_mps2 = max(largest_mps2, 20.0**2 * math.tan(road_wheel_rad) / 2.648)
    assert largest_mps2 == pytest.approx(min(limit_mps2, 63.9), abs=0.2)


def test_a_reset_that_something_graver_prevents_says_so():
    drive = engaged().tick(50)
    drive.car.vx_mps = 0.0
    drive.tick(20)
    drive.ask(Operation.STOP)
    drive.tick(10)
    drive.car.emergency_stop = 1
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.core.mode is Mode.FAULT
    assert drive.output.reply.refusals == ("emergency stop of the robots: None",)


def test_a_driver_who_takes_over_in_a_stop_does_not_become_its_cause():
    drive = engaged().tick(50)
    drive.status = CommandStatus.FAILED
    drive.tick(10)
    drive.car.override = 1
    drive.tick(5)
    assert (drive.core.mode, drive.core.disengagement.finding.cause) == (Mode.STANDBY, Cause.COMMAND_FAILED)


def test_a_wheel_that_nobody_steers_follows_nothing():
    drive = GatewayDrive()
    drive.car.steering_wheel_deg = 80.0
    drive.steer_rad = math.radians(80.0) / 14.7
    drive.arm().tick(100)
    assert (drive.core.mode, drive.core.findings) == (Mode.READY, [])
    drive.engage().tick(5)
    drive.steer_rad = 0.0
    drive.tick(40)
    assert drive.transitions[-1].finding.cause is Cause.STEERING_NOT_FOLLOWING


@pytest.mark.req("E2")
def test_an_engagement_needs_the_steering_wheel_where_the_demand_is():
    drive = GatewayDrive()
    drive.car.steering_wheel_deg = 14.7 * 5.0
    drive.steer_rad = math.radians(5.0 - 2.1)
    drive.arm()
    drive.ask(Operation.ENGAGE)
    drive.tick()
    assert drive.output.reply.refusals == ("steering 0.037 rad from the demand, limit 0.0349 rad",)


@pytest.mark.req("E2")
def test_everything_has_to_be_good_for_a_second_without_a_break():
    drive = GatewayDrive().tick(210)
    assert drive.core.blockers == []
    drive.car.dead_man = 0
    drive.tick()
    drive.car.dead_man = 1
    for good_ms in range(0, 1000, 10):
        (blocker,) = drive.tick().core.blockers
        assert blocker == f"everything good for {10_000_000 * (good_ms // 10) * 1e-9:.1f} s, 1.0 s needed"
    assert drive.tick().core.blockers == []


@pytest.mark.req("F8")
def test_a_robot_controller_that_asks_no_new_question_is_found_after_100_ms():
    drive = engaged().tick(10)
    drive.car.is_asking = False
    asked_ns = drive.now_ns
    drive.tick(20)
    assert drive.transitions[-1].finding == Finding(Cause.WATCHDOG_SILENT, pytest.approx(110.0), 100.0, "RC")
    assert drive.transitions[-1].t_ns == asked_ns + 110_000_000


@pytest.mark.req("F8")
@pytest.mark.parametrize(("profile", "contradicts"), [(PROVING_GROUND, True), (LIFTED, False)])
def test_only_on_the_road_have_wheels_and_navigation_to_agree(profile, contradicts):
    drive = GatewayDrive()
    drive.core = GatewayCore(drive.catalogue, load_vehicle(), boot_id=1, profile=profile)
    drive.car.wheel_speed_offset_mps = 20.0
    drive.tick(100)
    assert (Cause.SPEED_IMPLAUSIBLE in {finding.cause for finding in drive.core.findings}) is contradicts


@pytest.mark.req("G1")
@pytest.mark.parametrize("elapsed_ms", [10, 6])
def test_a_step_that_follows_early_changes_the_demand_by_less(elapsed_ms):
    drive = GatewayDrive()
    drive.car.is_following, drive.car.vx_mps = True, 0.0
    drive.steer_rad = 0.0
    drive.engage()
    drive.steer_rad = 0.3
    drive.tick(5)
    before_deg = drive.car.told["SR_Command"]["AngleCommand"]
    drive.now_ns += elapsed_ms * 1_000_000 - TICK_NS
    drive.tick()
    limit_deg = math.degrees(drive.core.profile.steering_wheel_rate_radps) * elapsed_ms * 1e-3
    assert drive.car.told["SR_Command"]["AngleCommand"] - before_deg == pytest.approx(limit_deg, abs=0.05)


def test_a_clock_that_has_run_for_long_shortens_no_stop():
    drive = GatewayDrive()
    drive.now_ns = 10**15
    drive.engage()
    drive.ask(Operation.STOP)
    drive.tick(2)
    drive.ask(Operation.RESET)
    drive.tick()
    assert drive.output.reply.refusals == ("the car moves: 20.0 m/s",)


@pytest.mark.req("S2")
@pytest.mark.parametrize(("ticks", "is_gone"), [(9, False), (10, True)])
def test_a_controller_has_gone_when_its_last_command_is_older_than_100_ms(ticks, is_gone):
    drive = GatewayDrive()
    drive.tick()  # with a command
    drive.is_controller_alive = False
    drive.tick(ticks)
    other = replace(drive.command(), boot_id=8)
    drive.core.step(drive.now_ns + TICK_NS, [], replace(other, t_ns=drive.now_ns + TICK_NS))
    assert drive.core.commands.rejected == ({} if is_gone else {"second sender": 1})


@pytest.mark.req("F5")
def test_commands_that_were_never_good_are_told_as_invalid():
    drive = GatewayDrive()
    drive.steer_rad = 3.0
    drive.tick(13)
    assert Cause.COMMAND_INVALID in {finding.cause for finding in drive.core.findings}


def test_after_an_engagement_the_wheel_follows_nothing_any_more():
    drive = engaged().tick(50)
    drive.ask(Operation.DISENGAGE)
    drive.tick()
    drive.car.steering_wheel_deg = 90.0
    drive.tick(2)
    drive.tick(200)
    assert Cause.STEERING_NOT_FOLLOWING not in {finding.cause for finding in drive.core.findings}
    assert drive.core.mode is Mode.STANDBY


@pytest.mark.req("F13")
def test_a_gap_between_two_steps_is_told_from_the_step_before():
    drive = engaged().tick(10)
    drive.now_ns += 50 * 1_000_000
    drive.tick()
    assert drive.transitions[-1].finding == Finding(Cause.TICK_GAP, 60.0, 50.0, "gateway")


@pytest.mark.parametrize(("mode", "acceleration_mps2", "jerk_mps3"), [(Mode.COMFORT_STOP, -1.0, 0.3), (Mode.SAFE_STOP, -2.5, 1.5)])
def test_how_firmly_each_stop_brakes(mode, acceleration_mps2, jerk_mps3):
    drive = engaged().tick(50)
    if mode is Mode.COMFORT_STOP:
        drive.ask(Operation.STOP)
    else:
        drive.status = CommandStatus.FAILED
    while drive.core.mode is Mode.ENGAGED:
        drive.tick()
    drive.tick(50)
    assert drive.core.actuation.acceleration_mps2 == pytest.approx(-jerk_mps3 * 0.5, abs=0.02)
    drive.tick(400)
    assert drive.core.actuation.acceleration_mps2 == pytest.approx(acceleration_mps2, abs=0.005)


def test_a_stop_that_becomes_firmer_goes_on_from_where_it_is():
    drive = GatewayDrive()
    drive.car.is_following, drive.car.vx_mps = True, 30.0
    drive.engage().tick(50)
    drive.ask(Operation.STOP)
    drive.tick(401)
    assert drive.core.actuation.acceleration_mps2 == pytest.approx(-1.0, abs=0.005)
    drive.is_controller_alive = False
    while drive.core.mode is Mode.COMFORT_STOP:
        drive.tick()
    drive.tick(20)
    assert drive.core.mode is Mode.SAFE_STOP
    assert drive.core.actuation.acceleration_mps2 == pytest.approx(-1.3, abs=0.02)


def test_a_stop_without_a_plan_holds_the_wheel():
    drive = GatewayDrive()
    drive.car.is_following = True
    drive.engage().tick(20)
    drive.steer_rad = 0.02
    drive.tick(20)
    drive.core.commands.newest = None
    drive.is_controller_alive = False
    drive.ask(Operation.STOP)
    drive.tick(5)
    assert drive.core.mode is Mode.COMFORT_STOP
    assert drive.car.told["SR_Command"]["AngleCommand"] == pytest.approx(math.degrees(0.02 * 14.7), abs=0.05)


def test_an_old_stop_has_no_say_in_what_comes_after_it():
    drive = engaged()
    drive.ask(Operation.STOP)
    drive.tick(100)
    drive.car.override = 1
    drive.tick()
    assert drive.core.mode is Mode.STANDBY
    assert drive.car.told["BR_Command"]["PositionCommand"] == 0
    drive.car.override = 0
    drive.engage().tick(5)
    assert drive.car.told["BR_Command"]["PositionCommand"] == 0
    drive.ask(Operation.DISENGAGE)
    drive.tick()
    assert drive.output.reply.refusals == ()  # no stop is under way any more


@pytest.mark.req("S2")
def test_the_controller_may_be_another_one_after_an_engagement_and_not_after_a_mere_disarming():
    for prepare, is_new in ((engaged, True), (armed, False)):
        drive = prepare()
        drive.ask(Operation.DISENGAGE)
        drive.tick()
        assert drive.core.mode is Mode.STANDBY
        assert (drive.core.commands.newest is None) is is_new


def test_speed_is_that_of_the_wheels_or_of_navigation_whoever_says_more():
    for vx_mps, wheels_mps in ((0.0, -3.0), (-3.0, 0.0)):
        drive = engaged()
        drive.ask(Operation.STOP)
        drive.tick()
        drive.car.vx_mps, drive.car.wheel_speed_offset_mps = vx_mps, wheels_mps - vx_mps
        drive.tick(2)
        drive.ask(Operation.RESET)
        drive.tick()
        assert drive.output.reply.refusals == ("the car moves: 3.0 m/s",)


def test_heartbeat_every_100_ms():
    drive = armed()
    heartbeat_id = drive.catalogue.by_name["GW_Heartbeat"].arbitration_id
    beats = [any(f.arbitration_id == heartbeat_id for f in drive.tick().output.frames) for _ in range(100)]
    assert sum(beats) == 10


@given(
    steers=st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=30),
    drives=st.lists(st.floats(-4.0, 4.0), min_size=5, max_size=30),
    vx_mps=st.floats(0.0, 35.9),
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
    drive = _twin(_prepared(Mode.SILENT))
    now_ns = drive.now_ns + TICK_NS
    ids = st.one_of(st.sampled_from(sorted(drive.catalogue.by_id)), st.integers(0, 2047))
    frames = data.draw(st.lists(st.builds(CanFrame, ids, st.binary(max_size=8), st.just(now_ns)), max_size=40))
    output = drive.core.step(now_ns, frames)
    assert output.state.mode is Mode.SILENT
    assert drive.core.supervisor.received >= len(frames)


def test_in_a_gentle_stop_the_controller_goes_on_steering():
    drive = GatewayDrive()
    drive.car.is_following = True
    drive.engage().tick(20)
    drive.ask(Operation.STOP)
    drive.tick()
    assert drive.core.mode is Mode.COMFORT_STOP
    drive.steer_rad = 0.01
    drive.tick(30)
    assert drive.car.told["SR_Command"]["AngleCommand"] == pytest.approx(math.degrees(0.01 * 14.7), abs=0.06)
    assert drive.car.told["BR_Command"]["PositionCommand"] > 0.0
    drive.is_controller_alive = False
    drive.tick(20)
    assert drive.core.mode is Mode.SAFE_STOP


# ---- a site's DBC


def site_with(tmp_path, pattern, replacement):
    site = tmp_path / "site.dbc"
    text, found = re.subn(pattern, replacement, ROBOTS_DBC.read_text())
    assert found == 1
    site.write_text(text)
    return load([site, GNSS_IMU_DBC])


@pytest.mark.req("G1")
def test_steps_with_which_a_profile_cannot_be_kept_are_refused(tmp_path):
    for profile, step_deg, is_allowed in ((NOMINAL, 0.05, True), (NOMINAL, 0.1, False), (BENCH, 0.3, True), (BENCH, 0.5, False)):
        catalogue = site_with(tmp_path, r'(AngleCommand : 16\|16@1- \()0\.05,0\) \[-1080', rf"\g<1>{step_deg},0) [-1080")
        if is_allowed:
            GatewayCore(catalogue, load_vehicle(), 1, profile)
            continue
        said = rf"^site\.dbc, gnss_imu\.dbc: SR_Command\.AngleCommand: steps of {step_deg}, limits {profile.name} allow up to 0\.\d+$"
        with pytest.raises(CatalogueError, match=said):
            GatewayCore(catalogue, load_vehicle(), 1, profile)


@pytest.mark.req("G4")
@pytest.mark.parametrize(
    ("identifier", "cycle_ms", "said"),
    [
        (272, 20, r"SR_Command: cycle time 20 ms, allowed: 10 ms$"),
        (160, 0, r"GW_SafetyCommand: cycle time 0 ms, allowed: 10 ms$"),
        (1792, 50, r"GW_Heartbeat: cycle time 50 ms, allowed: 100 ms$"),
        (1793, 0, r"GW_Heartbeat: cycle time 100 ms, allowed: 10 ms; GW_Status: cycle time 0 ms, allowed: 10 ms$"),
        (1793, 55, r"GW_Heartbeat: cycle time 100 ms, allowed: 50 ms; GW_Status: cycle time 55 ms, allowed: 50 ms$"),
    ],
)
def test_cycles_at_which_the_gateway_does_not_send_are_refused(tmp_path, identifier, cycle_ms, said):
    catalogue = site_with(tmp_path, rf'(BA_ "GenMsgCycleTime" BO_ {identifier}) \d+', rf"\g<1> {cycle_ms}")
    with pytest.raises(CatalogueError, match=r"^site\.dbc, gnss_imu\.dbc: " + said):
        GatewayCore(catalogue, load_vehicle(), 1)
