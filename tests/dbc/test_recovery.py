"""Three attempts to leave bus-off, each after a longer wait, and no more before the operator says so; a lost bus is looked for always."""

import pytest

from dbc.health import BusState
from dbc.recovery import BUS_OFF_DELAYS_NS, REOPENING_DELAYS_NS, Recovery, Reopening

MS = 1_000_000
ACTIVE, OFF, DOWN = BusState.ERROR_ACTIVE, BusState.BUS_OFF, BusState.DOWN


def attempts_ms(recovery: Recovery, bus_offs: int, start_ms: int = 0, duration_ms: int = 20_000, state: BusState = OFF) -> list[int]:
    """When it tries, looked at every 10 ms in one lasting state."""
    return [t for t in range(start_ms, start_ms + duration_ms, 10) if recovery.is_due(state, bus_offs, t * MS)]


@pytest.mark.req("F10")
def test_three_attempts_each_later_than_the_one_before():
    assert attempts_ms(Recovery(), 1) == [100, 610, 3120]  # each wait begins with the first look after the attempt before it
    assert list(BUS_OFF_DELAYS_NS) == sorted(BUS_OFF_DELAYS_NS)


@pytest.mark.req("F10")
def test_every_bus_off_has_its_share_of_the_three_attempts_and_the_fourth_has_none():
    recovery = Recovery()
    waits_ms = []
    for bus_offs in (1, 2, 3):
        start_ms = bus_offs * 10_000
        assert not recovery.has_given_up(bus_offs)
        waits_ms.append(next(t for t in range(start_ms, start_ms + 10_000, 10) if recovery.is_due(OFF, bus_offs, t * MS)) - start_ms)
        assert attempts_ms(recovery, bus_offs, start_ms + waits_ms[-1] + 10, 2000, ACTIVE) == []
    assert waits_ms == [100, 500, 2500]
    assert recovery.has_given_up(4)
    assert attempts_ms(recovery, 4, 50_000) == []


def test_a_driver_that_restarts_by_itself_uses_the_attempts_up():
    recovery = Recovery()
    assert attempts_ms(recovery, 3, 0, 2_400) == []  # two of them passed unnoticed: only the last wait is left
    assert attempts_ms(recovery, 3, 2_400) == [2_500]
    assert recovery.has_given_up(4)
    assert not recovery.has_given_up(3)


@pytest.mark.req("F10")
def test_the_operator_allows_all_attempts_again():
    recovery = Recovery()
    attempts_ms(recovery, 1)
    recovery.rearm(OFF, 1)  # it is bus-off still
    assert attempts_ms(recovery, 1, 60_000) == [60_100, 60_610, 63_120]
    recovery.rearm(ACTIVE, 4)
    assert not recovery.has_given_up(7)
    assert recovery.has_given_up(8)
    recovery.rearm(OFF, 8)
    assert not recovery.has_given_up(10)
    assert recovery.has_given_up(11)


def test_a_bus_that_is_down_is_looked_for_without_end_and_ever_more_rarely():
    reopening = Reopening()
    tries_ms = [t for t in range(0, 60_000, 10) if reopening.is_due(DOWN, t * MS)]
    waits_ms = [after - before for before, after in zip([0, *tries_ms], tries_ms, strict=False)]
    assert waits_ms[:5] == [100, 210, 510, 1010, 2010]
    assert set(waits_ms[5:]) == {2010}
    assert list(REOPENING_DELAYS_NS) == sorted(REOPENING_DELAYS_NS)


@pytest.mark.parametrize("again", [lambda reopening: reopening.is_due(ACTIVE, 0), Reopening.rearm], ids=["came up", "operator"])
def test_it_begins_anew_when_the_bus_was_up_or_the_operator_says_so(again):
    reopening = Reopening()
    for t in range(0, 10_000, 10):
        reopening.is_due(DOWN, t * MS)
    again(reopening)
    assert next(t for t in range(10_000, 20_000, 10) if reopening.is_due(DOWN, t * MS)) == 10_100
