"""What the gateway believes of a command."""

import math
from dataclasses import replace

import pytest

from gateway.commands import DRIVE_RANGE_NORM, MAX_CLOCK_OFFSET_NS, MAX_STATE_LAG, NEVER_NS, STEER_RANGE_RAD, CommandGate
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand

NOW_NS = 5_000_000_000
LEVEL = (0.0,) * HORIZON_STEPS
COMMAND = ControlCommand(
    boot_id=7, seq=1, state_seq=50, t_ns=NOW_NS, status=CommandStatus.OK, solve_time_ns=0, lateral_error_m=0.0, heading_error_rad=0.0,
    steer_rad=0.0, drive_norm=0.0, plan_steer_rad=LEVEL, plan_drive_norm=LEVEL,
)  # fmt: skip
STATE_SEQ = 55


def with_last(plan, value):
    return (*plan[:-1], value)


def gate_with_one():
    gate = CommandGate()
    assert gate.offer(NOW_NS, COMMAND, STATE_SEQ)
    return gate


def test_a_gate_that_was_offered_nothing():
    gate = CommandGate()
    assert (gate.newest, gate.status, gate.good_in_a_row, gate.bad_in_a_row, gate.strangers, gate.last_cause) == (
        None, CommandStatus.OK, 0, 0, 0, "",
    )  # fmt: skip
    assert gate.age_ns(NOW_NS) == NEVER_NS
    assert gate.rejected == {}


def test_a_good_command_is_admitted():
    gate = gate_with_one()
    assert gate.newest is COMMAND
    assert (gate.good_in_a_row, gate.bad_in_a_row, gate.status) == (1, 0, CommandStatus.OK)
    assert gate.age_ns(NOW_NS + 7) == 7
    second = replace(COMMAND, seq=2)
    assert gate.offer(NOW_NS + 1, second, STATE_SEQ)
    assert (gate.newest, gate.good_in_a_row) == (second, 2)


@pytest.mark.req("F5")
@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"boot_id": 8}, "second sender"),
        ({"seq": 1}, "repeated or old sequence number"),
        ({"seq": 0}, "repeated or old sequence number"),
        ({"state_seq": STATE_SEQ + 1}, "answers an old state"),
        ({"state_seq": STATE_SEQ - MAX_STATE_LAG - 1}, "answers an old state"),
        ({"t_ns": NOW_NS + MAX_CLOCK_OFFSET_NS + 2}, "time of another clock"),
        ({"t_ns": NOW_NS - MAX_CLOCK_OFFSET_NS}, "time of another clock"),
        ({"t_ns": 0}, "time of another clock"),
        ({"plan_steer_rad": with_last(LEVEL, STEER_RANGE_RAD * 1.001)}, "steering out of range"),
        ({"plan_steer_rad": with_last(LEVEL, -STEER_RANGE_RAD * 1.001)}, "steering out of range"),
        ({"plan_steer_rad": with_last(LEVEL, math.nan)}, "steering out of range"),
        ({"steer_rad": math.nan}, "steering out of range"),
        ({"steer_rad": 1.001 * STEER_RANGE_RAD}, "steering out of range"),
        ({"plan_drive_norm": with_last(LEVEL, math.nan)}, "drive out of range"),
        ({"drive_norm": math.nan}, "drive out of range"),
        ({"drive_norm": -1.001 * DRIVE_RANGE_NORM}, "drive out of range"),
        ({"lateral_error_m": math.nan}, "path error is no number"),
        ({"heading_error_rad": math.inf}, "path error is no number"),
        ({"lateral_error_m": -math.inf}, "path error is no number"),
        ({"plan_drive_norm": with_last(LEVEL, DRIVE_RANGE_NORM * 1.001)}, "drive out of range"),
        ({"plan_drive_norm": with_last(LEVEL, -DRIVE_RANGE_NORM * 1.001)}, "drive out of range"),
    ],
)
def test_a_bad_command_is_dropped_and_counted(changes, cause):
    gate = gate_with_one()
    assert not gate.offer(NOW_NS + 1, replace(COMMAND, **{"seq": 2, "t_ns": NOW_NS + 1, **changes}), STATE_SEQ)
    assert gate.rejected == {cause: 1}
    assert (gate.newest, gate.last_cause, gate.bad_in_a_row, gate.good_in_a_row) == (COMMAND, cause, 1, 0)
    assert gate.strangers == (cause == "second sender")
    assert gate.age_ns(NOW_NS + 1) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"state_seq": STATE_SEQ},
        {"state_seq": STATE_SEQ - MAX_STATE_LAG},
        {"t_ns": NOW_NS + MAX_CLOCK_OFFSET_NS},
        {"t_ns": NOW_NS - MAX_CLOCK_OFFSET_NS},
        {"plan_steer_rad": (STEER_RANGE_RAD, *with_last(LEVEL, -STEER_RANGE_RAD)[1:])},
        {"plan_drive_norm": (DRIVE_RANGE_NORM, *with_last(LEVEL, -DRIVE_RANGE_NORM)[1:])},
    ],
)
def test_what_is_just_within_its_limit_is_admitted(changes):
    assert gate_with_one().offer(NOW_NS, replace(COMMAND, seq=2, **changes), STATE_SEQ)


def test_the_first_sender_stays_the_only_one_until_the_gate_is_reset():
    gate = gate_with_one()
    stranger = replace(COMMAND, boot_id=8, seq=1)
    for k in range(3):
        assert not gate.offer(NOW_NS, replace(stranger, seq=k), STATE_SEQ)
    assert (gate.strangers, gate.bad_in_a_row) == (3, 3)
    assert gate.offer(NOW_NS, replace(COMMAND, seq=2), STATE_SEQ)
    assert (gate.strangers, gate.bad_in_a_row) == (3, 0)
    gate.reset()
    assert (gate.strangers, gate.newest, gate.age_ns(NOW_NS)) == (0, None, NEVER_NS)
    assert gate.offer(NOW_NS, stranger, STATE_SEQ)
    assert gate.rejected == {"second sender": 3}


def test_a_sender_who_has_gone_leaves_what_he_said_and_no_readiness_for_the_next():
    gate = gate_with_one()
    gate.offer(NOW_NS, replace(COMMAND, boot_id=8), STATE_SEQ)
    gate.offer(NOW_NS, replace(COMMAND, seq=2), STATE_SEQ)
    gate.release()
    assert (gate.newest.boot_id, gate.age_ns(NOW_NS + 9), gate.status) == (7, 9, CommandStatus.OK)
    assert (gate.strangers, gate.good_in_a_row) == (0, 0)
    assert gate.offer(NOW_NS, replace(COMMAND, boot_id=8, seq=0), STATE_SEQ)
    assert gate.good_in_a_row == 1


def test_a_second_sender_is_forgotten_a_second_after_his_last_command():
    gate, second_ns = gate_with_one(), 1_000_000_000
    gate.offer(NOW_NS, replace(COMMAND, boot_id=8), STATE_SEQ)
    gate.offer(NOW_NS + second_ns, replace(COMMAND, boot_id=8), STATE_SEQ)
    gate.offer(NOW_NS + second_ns + 9, replace(COMMAND, seq=1), STATE_SEQ)  # old, but of the first
    gate.forgive(NOW_NS + 2 * second_ns)
    assert gate.strangers == 2
    gate.forgive(NOW_NS + 2 * second_ns + 1)
    assert gate.strangers == 0


def test_another_sender_may_begin_with_any_number_after_a_reset():
    gate = gate_with_one()
    gate.reset()
    assert gate.offer(NOW_NS, replace(COMMAND, boot_id=8, seq=0), STATE_SEQ)


@pytest.mark.req("F4")
def test_what_a_command_says_of_itself():
    gate = gate_with_one()
    degraded = replace(COMMAND, seq=2, status=CommandStatus.DEGRADED)
    gate.offer(NOW_NS, degraded, STATE_SEQ)
    assert (gate.status, gate.good_in_a_row, gate.newest) == (CommandStatus.DEGRADED, 0, degraded)
    assert gate.degraded_in_a_row == 1
    assert gate.offer(NOW_NS + 3, replace(COMMAND, seq=3, status=CommandStatus.FAILED), STATE_SEQ)
    assert (gate.status, gate.good_in_a_row, gate.newest) == (CommandStatus.FAILED, 0, degraded)
    assert gate.age_ns(NOW_NS + 3) == 0
    assert gate.degraded_in_a_row == 0
    for k in range(4):
        gate.offer(NOW_NS, replace(degraded, seq=4 + k), STATE_SEQ)
    assert gate.degraded_in_a_row == 4
    gate.offer(NOW_NS, replace(COMMAND, seq=9), STATE_SEQ)
    assert (gate.degraded_in_a_row, gate.good_in_a_row) == (0, 1)
    gate.offer(NOW_NS, replace(degraded, seq=10), STATE_SEQ)
    gate.reset()
    assert gate.degraded_in_a_row == 0
