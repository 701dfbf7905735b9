"""What follows from a situation: findings, blockers, refusals. Every condition just within its limit, and just beyond it."""

import math
from dataclasses import replace

import pytest

from dbc.health import BusState, LinkHealth
from gateway import conditions
from gateway.causes import Cause, Finding
from gateway.codec import Measurement
from gateway.commands import CommandGate
from gateway.conditions import Situation, Surroundings, blockers, findings, refusals, settling, state_findings, untimely
from gateway.limits import BENCH, NOMINAL, PROVING_GROUND
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Operation, OperatorRequest

MS = 1_000_000
NOW_NS = 20_000 * MS
TIMEOUT_NS = 50 * MS


def gate(**changes):
    """A gate that has admitted one command now, with attributes changed."""
    commands = CommandGate()
    level = (0.0,) * HORIZON_STEPS
    command = ControlCommand(1, 1, 1, NOW_NS, CommandStatus.OK, 0, 0.0, 0.0, 0.0, 0.0, level, level)
    assert commands.offer(NOW_NS, command, 1)
    commands.good_in_a_row = conditions.READY_COMMANDS
    for name, value in changes.items():
        setattr(commands, name, value)
    return commands


def measured(**changes):
    well = {
        "is_navigation_precise": True, "is_in_drive": True, "is_armed": True, "is_engaged": True, "is_dead_man_pressed": True,
        "are_robots_ready": True,
    }  # fmt: skip
    return Measurement(**(well | changes))


def situation(**changes):
    well = Situation(
        now_ns=NOW_NS, measurement=measured(), commands=gate(), surroundings=Surroundings({"robots": LinkHealth()}), profile=PROVING_GROUND,
        observed=[], state_age_ns=0, navigation_timeout_ns=TIMEOUT_NS, question_age_ns=0, tick_gap_ns=10 * MS, is_driving=True,
        is_settled=True, steer_rad=0.0, lateral_mps2=0.0, speed_mps=0.0, allowed_mps=math.inf, stopping_ns=0,
    )  # fmt: skip
    return replace(well, **changes)


def found(s):
    return findings(s, state_findings(s))


def test_when_all_is_well_nothing_is_found_and_nothing_blocks():
    s = situation()
    assert state_findings(s) == found(s) == blockers(s, []) == []
    for operation in Operation:
        assert refusals(operation, s, []) == []


def with_link(**changes):
    return {"surroundings": Surroundings({"robots": LinkHealth(), "navigation": LinkHealth(**changes)})}


def with_command_age(age_ns):
    return {"now_ns": NOW_NS + age_ns}


BEYOND = [
    # what is just within its limit, what is just beyond it, and the finding
    ({"state_age_ns": TIMEOUT_NS}, {"state_age_ns": TIMEOUT_NS + MS}, Finding(Cause.NAVIGATION_FROZEN, 51, 50, "navigation")),
    ({}, {"measurement": measured(is_navigation_precise=False)}, Finding(Cause.NAVIGATION_COARSE, 0, 1, "navigation")),
    (with_link(state=BusState.ERROR_PASSIVE), with_link(state=BusState.DOWN), Finding(Cause.BUS_DOWN, 1, 0, "navigation")),
    ({}, with_link(state=BusState.BUS_OFF, bus_offs=3), Finding(Cause.BUS_OFF, 3, 0, "navigation")),
    (with_link(unconfirmed_ns=50 * MS), with_link(unconfirmed_ns=51 * MS), Finding(Cause.BUS_BLOCKED, 51, 50, "navigation")),
    ({}, {"measurement": measured(is_emergency_stopped=True, stop_source="X")}, Finding(Cause.ROBOTS_EMERGENCY_STOP, 1, 0, "X")),
    ({}, {"measurement": measured(is_stopped_by_robots=True, stop_source="X")}, Finding(Cause.ROBOTS_STOPPED, 1, 0, "X")),
    ({}, {"measurement": measured(faulty_robots=("SR", "BR"))}, Finding(Cause.ROBOT_FAULT, 2, 0, "SR, BR")),
    ({"question_age_ns": 100 * MS}, {"question_age_ns": 101 * MS}, Finding(Cause.WATCHDOG_SILENT, 101, 100, "RC")),
    ({}, {"measurement": measured(overridden_robots=("SR",))}, Finding(Cause.DRIVER_STEERS, 1, 0, "SR")),
    ({}, {"measurement": measured(overridden_robots=("AR", "BR"))}, Finding(Cause.DRIVER_BRAKES, 2, 0, "AR, BR")),
    ({}, {"measurement": measured(overridden_robots=("AR",))}, Finding(Cause.DRIVER_ACCELERATES, 1, 0, "AR")),
    ({}, {"measurement": measured(is_driver_override=True)}, Finding(Cause.DRIVER_OVERRIDE, 1, 0, "RC")),
    ({}, {"measurement": measured(is_in_drive=False)}, Finding(Cause.SELECTOR_NOT_IN_DRIVE, 0, 1, "CAR_Powertrain")),
    (
        {"measurement": measured(vx_mps=PROVING_GROUND.max_speed_mps)},
        {"measurement": measured(vx_mps=PROVING_GROUND.max_speed_mps + 0.5)},
        Finding(Cause.OVERSPEED, PROVING_GROUND.max_speed_mps + 0.5, PROVING_GROUND.max_speed_mps, "navigation"),
    ),
    (
        {"measurement": measured(vx_mps=-PROVING_GROUND.max_speed_mps)},
        {"measurement": measured(vx_mps=-PROVING_GROUND.max_speed_mps - 0.5)},
        Finding(Cause.OVERSPEED, PROVING_GROUND.max_speed_mps + 0.5, PROVING_GROUND.max_speed_mps, "navigation"),
    ),
    (
        {"commands": gate(status=CommandStatus.DEGRADED)},
        {"commands": gate(status=CommandStatus.FAILED)},
        Finding(Cause.COMMAND_FAILED, 1, 0, "controller"),
    ),
    (
        {"commands": gate(degraded_in_a_row=3)},
        {"commands": gate(degraded_in_a_row=4)},
        Finding(Cause.COMMAND_FAILED, 4, 3, "controller (degraded)"),
    ),
    (with_command_age(100 * MS), with_command_age(101 * MS), Finding(Cause.COMMAND_LOST, 101, 100, "controller")),
    (
        {"commands": gate(bad_in_a_row=1, last_cause="why")},
        {"commands": gate(bad_in_a_row=1, last_cause="why"), **with_command_age(101 * MS)},
        Finding(Cause.COMMAND_LOST, 101, 100, "controller (why)"),
    ),
    (
        {"commands": gate(bad_in_a_row=2, last_cause="why")},
        {"commands": gate(bad_in_a_row=3, last_cause="why")},
        Finding(Cause.COMMAND_INVALID, 3, 2, "why"),
    ),
    ({"commands": gate(strangers=2)}, {"commands": gate(strangers=3)}, Finding(Cause.SECOND_CONTROLLER, 3, 2, "controller")),
    ({"tick_gap_ns": 50 * MS}, {"tick_gap_ns": 51 * MS}, Finding(Cause.TICK_GAP, 51, 50, "gateway")),
    (
        {"measurement": measured(deaf_robots=("AR", "BR")), "is_settled": False},
        {"measurement": measured(deaf_robots=("AR", "BR"))},
        Finding(Cause.ROBOT_MISSES_COMMANDS, 2, 0, "AR, BR"),
    ),
    (
        {"measurement": measured(is_engaged=False), "is_settled": False},
        {"measurement": measured(is_engaged=False)},
        Finding(Cause.ROBOTS_NOT_ENGAGED, 0, 1, "RC"),
    ),
    (
        {"speed_mps": 15.0, "allowed_mps": 15.0},
        {"speed_mps": 15.1, "allowed_mps": 15.0},
        Finding(Cause.CAR_NOT_SLOWING, 15.1, 15.0, "car"),
    ),
]


@pytest.mark.parametrize(("within", "beyond", "expected"), BEYOND, ids=[str(row[2].cause.name) for row in BEYOND])
def test_each_finding_begins_beyond_its_limit(within, beyond, expected):
    assert found(situation(**within)) == []
    (finding,) = found(situation(**beyond))
    assert (finding.cause, finding.source) == (expected.cause, expected.source)
    assert (finding.value, finding.limit) == pytest.approx((expected.value, expected.limit))


def test_what_only_matters_while_driving():
    trouble = {"speed_mps": 2.0, "allowed_mps": 1.0, "measurement": measured(is_engaged=False, deaf_robots=("SR",))}
    assert len(found(situation(**trouble))) == 3
    assert found(situation(**trouble, is_driving=False)) == []


def test_the_robots_own_words_are_more_precise_than_the_supervisors():
    s = situation(measurement=measured(is_driver_override=True, overridden_robots=("BR",)))
    assert [finding.cause for finding in found(s)] == [Cause.DRIVER_BRAKES]
    unknown = situation(measurement=measured(overridden_robots=("XX",)))
    assert [finding.cause for finding in found(unknown)] == [Cause.DRIVER_OVERRIDE]


def test_an_age_that_never_began_is_told_as_a_number_that_people_can_read():
    (lost,) = [finding for finding in found(situation(commands=CommandGate())) if finding.cause is Cause.COMMAND_LOST]
    assert (lost.value, lost.source) == (1e6, "controller (not heard)")


def test_what_was_observed_is_passed_on_once_what_concerns_the_state_as_such():
    missing, lags = Finding(Cause.MESSAGE_MISSING, 60, 50, "PosLocal"), Finding(Cause.LATENCY, 200, 150, "robots")
    s = situation(observed=[lags, missing])
    assert state_findings(s) == [missing]
    assert found(s) == [missing, lags]


@pytest.mark.parametrize(
    "cause",
    [
        *(Cause.MESSAGE_MISSING, Cause.MESSAGE_INVALID, Cause.FRAMES_LOST, Cause.SPEED_IMPLAUSIBLE, Cause.POSITION_IMPLAUSIBLE),
        *(Cause.YAW_RATE_IMPLAUSIBLE, Cause.STEERING_IMPLAUSIBLE),
    ],
)
def test_these_make_the_state_unusable(cause):
    finding = Finding(cause, 2, 1, "x")
    assert state_findings(situation(observed=[finding])) == [finding]


BLOCKING = [
    ({}, {"measurement": measured(are_robots_ready=False)}, "robots not ready"),
    ({}, {"measurement": measured(is_dead_man_pressed=False)}, "dead-man not pressed"),
    ({}, {"surroundings": Surroundings(is_recording=False)}, "recorder does not record"),
    (
        {"surroundings": Surroundings(disk_free_share=0.07)},
        {"surroundings": Surroundings(disk_free_share=0.069)},
        "6.9 % of the record's disk free, 7.0 % needed",
    ),
    ({}, with_link(state=BusState.ERROR_WARNING), "bus navigation is error-warning"),
    ({}, with_link(state=BusState.ERROR_PASSIVE), "bus navigation is error-passive"),
    (
        with_link(last_bus_off_ns=NOW_NS - 10_000 * MS),
        with_link(last_bus_off_ns=NOW_NS - 9_999 * MS),
        "bus navigation was bus-off 10 s ago",
    ),
]


@pytest.mark.req("E2")
@pytest.mark.parametrize(("within", "beyond", "expected"), BLOCKING, ids=[row[2] for row in BLOCKING])
def test_each_blocker_by_name(within, beyond, expected):
    assert blockers(situation(**within), []) == []
    assert blockers(situation(**beyond), []) == [expected]


def test_findings_block_as_well():
    finding = Finding(Cause.OVERSPEED, 40, 36, "navigation")
    assert blockers(situation(), [finding]) == ["too fast for the limit profile: navigation, 40 m/s, limit 36 m/s"]


@pytest.mark.req("E2")
def test_everything_has_to_be_good_for_a_second():
    assert settling(conditions.HOLD_NS, 25) == []
    assert settling(conditions.HOLD_NS - 1, 25) == ["everything good for 1.0 s, 1.0 s needed"]
    assert settling(300 * MS, 25) == ["everything good for 0.3 s, 1.0 s needed"]
    assert settling(conditions.HOLD_NS, 24) == ["24 good commands in a row, 25 needed"]
    assert len(settling(0, 0)) == 2


def demanding(**changes):
    commands = gate()
    commands.newest = replace(commands.newest, **changes)
    return {"commands": commands}


ENGAGING = [
    ({}, {"commands": gate(newest=None)}, "no command"),
    ({}, {"measurement": measured(is_armed=False)}, "robots not armed"),
    (with_command_age(60 * MS), with_command_age(61 * MS), "newest command 61 ms old, limit 60 ms"),
    ({"state_age_ns": 50 * MS}, {"state_age_ns": 51 * MS}, "state 51 ms old, limit 50 ms"),
    ({"steer_rad": 0.0349}, {"steer_rad": 0.036}, "steering 0.036 rad from the demand, limit 0.0349 rad"),
    ({"steer_rad": -0.0349}, {"steer_rad": -0.036}, "steering 0.036 rad from the demand, limit 0.0349 rad"),
    (
        {"steer_rad": 0.1, **demanding(plan_steer_rad=(0.12,) * HORIZON_STEPS)},
        {"steer_rad": 0.1, **demanding(plan_steer_rad=(0.14,) * HORIZON_STEPS)},
        "steering 0.040 rad from the demand, limit 0.0349 rad",
    ),
    (  # what is followed is the entry of the plan that holds now
        {"steer_rad": 0.1, **demanding(plan_steer_rad=(0.0, 0.1) + (0.0,) * 28), **with_command_age(40 * MS)},
        {"steer_rad": 0.05, **demanding(plan_steer_rad=(0.0, 0.1) + (0.0,) * 28), **with_command_age(40 * MS)},
        "steering 0.050 rad from the demand, limit 0.0349 rad",
    ),
    *(
        (
            {"measurement": measured(steering_wheel_rad=sign * 1.57), "profile": BENCH},
            {"measurement": measured(steering_wheel_rad=sign * 1.58), "profile": BENCH},
            "steering wheel at 1.58 rad, limit of bench 1.57 rad",
        )
        for sign in (1, -1)
    ),
    *(
        (
            {"lateral_mps2": sign * 3.0, "profile": NOMINAL},
            {"lateral_mps2": sign * 3.1, "profile": NOMINAL},
            "a bend of 3.1 m/s2, limit of nominal 3.0 m/s2",
        )
        for sign in (1, -1)
    ),
    (demanding(lateral_error_m=1.5), demanding(lateral_error_m=1.51), "1.51 m beside the path, limit 1.5 m"),
    (demanding(lateral_error_m=-1.5), demanding(lateral_error_m=-1.51), "-1.51 m beside the path, limit 1.5 m"),
    (demanding(heading_error_rad=0.26), demanding(heading_error_rad=0.27), "heading 0.27 rad from the path, limit 0.26 rad"),
    (demanding(heading_error_rad=-0.26), demanding(heading_error_rad=-0.27), "heading -0.27 rad from the path, limit 0.26 rad"),
]


@pytest.mark.req("E2")
@pytest.mark.parametrize(("within", "beyond", "expected"), ENGAGING, ids=[row[2] for row in ENGAGING])
def test_each_refusal_of_an_engagement_by_name(within, beyond, expected):
    assert refusals(Operation.ENGAGE, situation(**within), []) == []
    assert refusals(Operation.ENGAGE, situation(**beyond), []) == [expected]
    assert refusals(Operation.ARM, situation(**beyond), []) == []


def test_what_blocks_refuses_to_arm_and_to_engage_and_nothing_else():
    s = situation(measurement=measured(is_armed=False))
    assert refusals(Operation.ARM, s, ["a", "b"]) == ["a", "b"]
    assert refusals(Operation.ENGAGE, s, ["a", "b"]) == ["a", "b", "robots not armed"]
    for operation in (Operation.DISENGAGE, Operation.STOP, Operation.RESET):
        assert refusals(operation, s, ["a", "b"]) == []


def test_a_stop_is_reset_when_the_car_stands_or_after_a_long_time():
    def moving(vx_mps, stopping_ns):
        return refusals(Operation.RESET, situation(speed_mps=vx_mps, stopping_ns=stopping_ns), [])

    assert moving(0.1, 1) == []
    assert moving(0.2, 1) == ["the car moves: 0.2 m/s"]
    assert moving(0.2, conditions.RESET_PATIENCE_NS - 1) == ["the car moves: 0.2 m/s"]
    assert moving(0.2, conditions.RESET_PATIENCE_NS) == []
    assert moving(20.0, 0) == []


def test_a_stop_is_not_ended_by_a_disengagement():
    assert refusals(Operation.DISENGAGE, situation(stopping_ns=1), []) == ["a stop is ended by a reset"]


@pytest.mark.req("E2", "S2")
def test_a_request_acts_once_and_soon_or_not_at_all():
    def asked(t_ns, last_ns=0, operation=Operation.ARM):
        return untimely(OperatorRequest(1, 1, operation, t_ns), NOW_NS, last_ns)

    assert asked(NOW_NS) == asked(NOW_NS - 1_000 * MS) == asked(NOW_NS - 5, NOW_NS - 6) == ""
    assert asked(NOW_NS + conditions.MAX_REQUEST_AHEAD_NS) == ""  # made while the step was under way
    assert asked(NOW_NS + conditions.MAX_REQUEST_AHEAD_NS + 1) == "the request is from the future"
    assert asked(NOW_NS - 5, NOW_NS - 5) == asked(NOW_NS - 6, NOW_NS - 5) == "the request is repeated, or made before another one"
    for operation in (Operation.ARM, Operation.ENGAGE, Operation.DISENGAGE, Operation.RESET):
        assert asked(NOW_NS - 1_001 * MS, operation=operation) == "the request is 1.0 s old, limit 1 s"
    for t_ns in (NOW_NS - 1_001 * MS, NOW_NS + 1, NOW_NS - 5):
        assert asked(t_ns, NOW_NS - 5, operation=Operation.STOP) == ""


@pytest.mark.req("F10")
def test_a_bus_off_between_two_steps_is_not_missed():
    def causes(age_ns):
        return [finding.cause for finding in found(situation(**with_link(bus_offs=1, last_bus_off_ns=NOW_NS - age_ns)))]

    assert causes(0) == causes(50 * MS) == [Cause.BUS_OFF]
    assert causes(51 * MS) == []


@pytest.mark.req("E3", "F7")
@pytest.mark.parametrize("cause", [Cause.MESSAGE_MISSING, Cause.MESSAGE_INVALID])
def test_a_driver_who_takes_over_is_told_by_sound_messages_only(cause):
    def handed_over(source, **changes):
        s = situation(measurement=measured(**changes), observed=[Finding(cause, 1, 0, source)])
        return [finding.source for finding in found(s) if finding.cause is not cause]

    assert handed_over("PosLocal", overridden_robots=("SR", "BR")) == ["SR, BR"]
    assert handed_over("SR_Status", overridden_robots=("SR", "BR")) == ["BR"]
    assert handed_over("SR_Status", overridden_robots=("SR",)) == []
    assert handed_over("SR_Status", overridden_robots=("SR",), is_driver_override=True) == ["RC"]
    assert handed_over("RC_SafetyStatus", is_driver_override=True) == []
