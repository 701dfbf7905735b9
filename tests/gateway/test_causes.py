"""Causes and findings in words; the words are read in logs, telemetry and refusals."""

import pytest

from gateway.causes import Cause, Finding


@pytest.mark.parametrize(
    ("finding", "text"),
    [
        (Finding(Cause.BUS_DOWN, 1, 0, "robots"), "bus is gone: robots"),
        (Finding(Cause.ROBOTS_NOT_ENGAGED, 0, 1, "RC"), "robot controller is not engaged: RC"),
        (Finding(Cause.ROBOT_FAULT, 2, 0, "SR, BR"), "robot fault: SR, BR, 2, limit 0"),
        (Finding(Cause.ROBOT_FAULT, 1, 1, "SR"), "robot fault: SR, 1, limit 1"),
        (Finding(Cause.COMMAND_LOST, 1, 0, "controller"), "controller silent: controller, 1 ms, limit 0 ms"),
        (Finding(Cause.OVERSPEED, 36.1234567, 36.0, "navigation"), "too fast for the limit profile: navigation, 36.1235 m/s, limit 36 m/s"),
        (Finding(Cause.COMMAND_LOST, 1e6, 100.0, "controller"), "controller silent: controller, 1e+06 ms, limit 100 ms"),
    ],
)
def test_a_finding_in_words(finding, text):
    assert str(finding) == text


def test_the_numbers_on_the_bus_are_those_that_records_have():
    assert {cause.name: cause.code for cause in Cause} == {
        "ROBOTS_EMERGENCY_STOP": 1, "ROBOTS_STOPPED": 2, "BUS_DOWN": 3, "BUS_OFF": 4, "BUS_BLOCKED": 5, "SECOND_SENDER": 6,
        "WATCHDOG_SILENT": 7, "ROBOT_FAULT": 10, "ROBOT_MISSES_COMMANDS": 11, "ROBOTS_NOT_ENGAGED": 12, "TICK_GAP": 20,
        "MESSAGE_MISSING": 21, "MESSAGE_INVALID": 22, "NAVIGATION_FROZEN": 23, "NAVIGATION_COARSE": 24, "SPEED_IMPLAUSIBLE": 25,
        "POSITION_IMPLAUSIBLE": 26, "YAW_RATE_IMPLAUSIBLE": 27, "STEERING_IMPLAUSIBLE": 28, "STEERING_NOT_FOLLOWING": 29, "FRAMES_LOST": 30,
        "CAR_NOT_SLOWING": 31,
        "COMMAND_FAILED": 40, "COMMAND_LOST": 41, "COMMAND_INVALID": 42, "SECOND_CONTROLLER": 43, "LATENCY": 50, "OVERSPEED": 51,
        "SELECTOR_NOT_IN_DRIVE": 52, "OPERATOR_STOP": 53, "DRIVER_STEERS": 60, "DRIVER_BRAKES": 61, "DRIVER_ACCELERATES": 62,
        "DRIVER_OVERRIDE": 63, "OPERATOR_DISENGAGE": 64,
    }  # fmt: skip
