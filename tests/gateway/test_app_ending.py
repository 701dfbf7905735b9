"""How the gateway ends: the car first."""

import pytest

from gateway.ending import DISARM_NS, STANDSTILL_NS, Ending
from gateway.messages import Mode, Operation

MS = 1_000_000
WITHIN_NS = 45_000 * MS


def ticks_until_over(ending, mode, speed_mps=0.0, is_valid=True, from_ns=0):
    """Milliseconds until it is over, when mode and speed stay as they are."""
    for k in range(WITHIN_NS // (10 * MS) + 2):
        if ending.is_over(from_ns + k * 10 * MS, mode, speed_mps, is_valid):
            return k * 10
    return None


@pytest.mark.parametrize("mode", [Mode.SILENT, Mode.FAULT])
def test_where_nothing_is_sent_it_is_over_at_once(mode):
    ending = Ending(0, WITHIN_NS)
    assert ending.request(mode) is None
    assert ticks_until_over(ending, mode) == 0


def test_a_car_that_drives_is_stopped_first():
    ending = Ending(0, WITHIN_NS)
    assert ending.request(Mode.ENGAGED) is Operation.STOP
    assert not ending.is_over(10 * MS, Mode.ENGAGED, 20.0, True)
    assert ending.request(Mode.COMFORT_STOP) is None
    assert not ending.is_over(20 * MS, Mode.COMFORT_STOP, 0.2, True)
    assert ticks_until_over(ending, Mode.COMFORT_STOP, 0.05, from_ns=30 * MS) == STANDSTILL_NS // MS


@pytest.mark.parametrize("mode", [Mode.COMFORT_STOP, Mode.SAFE_STOP])
def test_a_nod_is_no_standstill(mode):
    ending = Ending(0, WITHIN_NS)
    assert not ending.is_over(0, mode, 0.0, True)
    assert not ending.is_over(900 * MS, mode, 0.0, True)
    assert not ending.is_over(910 * MS, mode, -0.3, True)
    assert not ending.is_over(920 * MS, mode, 0.0, True)
    assert not ending.is_over(1_900 * MS, mode, 0.0, True)
    assert ending.is_over(1_920 * MS, mode, 0.0, True)


def test_a_speed_that_is_not_known_is_no_standstill_and_the_time_is_bounded():
    assert ticks_until_over(Ending(0, WITHIN_NS), Mode.SAFE_STOP, 0.0, is_valid=False) == WITHIN_NS // MS


def test_robots_that_are_armed_are_disarmed_first():
    ending = Ending(0, WITHIN_NS)
    assert ending.request(Mode.READY) is Operation.DISENGAGE
    assert not ending.is_over(10 * MS, Mode.READY, 0.0, True)
    assert ticks_until_over(ending, Mode.STANDBY, from_ns=20 * MS) == DISARM_NS // MS


def test_robots_that_have_just_been_disarmed_may_not_have_heard_it():
    assert ticks_until_over(Ending(0, WITHIN_NS), Mode.STANDBY, from_ns=10 * MS) == DISARM_NS // MS


def test_a_driver_who_takes_over_ends_it_soon():
    ending = Ending(0, WITHIN_NS)
    assert not ending.is_over(0, Mode.COMFORT_STOP, 15.0, True)
    assert ticks_until_over(ending, Mode.STANDBY, 15.0, from_ns=10 * MS) == DISARM_NS // MS
