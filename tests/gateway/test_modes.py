"""The mode tables."""

from pathlib import Path

import pytest

from gateway.causes import Cause, Finding
from gateway.messages import Mode
from gateway.mode_diagram import page
from gateway.modes import DRIVING, REACTIONS, TRANSITIONS, ModeMachine, Trigger


def machine_in(mode):
    machine = ModeMachine()
    machine.mode = mode
    return machine


def found(cause):
    return Finding(cause, 2.0, 1.0, "somewhere")


@pytest.mark.req("E1")
def test_only_the_operator_engages_and_only_from_ready():
    assert [key for key, after in TRANSITIONS.items() if after is Mode.ENGAGED] == [(Mode.READY, Trigger.ENGAGE)]
    assert {trigger for (_, trigger), after in TRANSITIONS.items() if after is Mode.READY} == {Trigger.ARM}


@pytest.mark.req("E4")
@pytest.mark.parametrize("mode", [Mode.COMFORT_STOP, Mode.SAFE_STOP, Mode.FAULT])
def test_latched_modes_are_left_by_people_only(mode):
    leaving = {trigger for (before, trigger), after in TRANSITIONS.items() if before is mode and after in (Mode.STANDBY, Mode.READY)}
    assert leaving <= {Trigger.RESET, Trigger.HAND_OVER}


def test_every_cause_has_a_number_of_its_own_and_a_reaction():
    assert set(REACTIONS) == set(Cause)
    assert len({cause.code for cause in Cause}) == len(Cause) > 20
    assert all(1 <= cause.code <= 255 for cause in Cause)


@pytest.mark.parametrize("cause", Cause)
def test_every_cause_ends_an_engagement_and_says_what_was_found(cause):
    machine = machine_in(Mode.ENGAGED)
    transition = machine.update(5, [found(cause)])
    assert transition.before is Mode.ENGAGED
    assert transition.after is TRANSITIONS[Mode.ENGAGED, REACTIONS[cause]] is machine.mode
    assert (transition.t_ns, transition.finding) == (5, found(cause))
    unit = f" {cause.value.unit}" if cause.value.unit else ""
    assert machine.reason == transition.reason == f"{cause.value.text}: somewhere, 2{unit}, limit 1{unit}"


@pytest.mark.parametrize("cause", Cause)
def test_no_cause_starts_anything(cause):
    for mode in Mode:
        machine = machine_in(mode)
        machine.update(0, [found(cause)])
        assert machine.mode not in DRIVING or mode in DRIVING
        assert machine.mode is not Mode.READY or mode is Mode.READY


def test_the_gravest_cause_wins_whatever_the_order():
    causes = [found(Cause.OVERSPEED), found(Cause.BUS_OFF), found(Cause.COMMAND_LOST), found(Cause.BUS_BLOCKED)]
    for order in (causes, causes[::-1]):
        machine = machine_in(Mode.ENGAGED)
        assert machine.update(0, order).finding.cause is Cause.BUS_OFF
        assert machine.mode is Mode.FAULT


def test_a_gentle_stop_becomes_a_firm_one_and_never_the_reverse():
    machine = machine_in(Mode.ENGAGED)
    machine.update(0, [found(Cause.LATENCY)])
    assert machine.mode is Mode.COMFORT_STOP
    assert machine.update(1, [found(Cause.OVERSPEED)]) is None
    machine.update(2, [found(Cause.COMMAND_LOST)])
    assert machine.mode is Mode.SAFE_STOP
    assert machine.update(3, [found(Cause.LATENCY)]) is None
    machine.update(4, [found(Cause.BUS_DOWN)])
    assert machine.mode is Mode.FAULT


def test_readiness_lost_beats_an_engagement_in_the_same_tick():
    machine = machine_in(Mode.READY)
    machine.update(0, [], frozenset({Trigger.ENGAGE, Trigger.BLOCKED}))
    assert machine.mode is Mode.STANDBY


def test_a_request_without_a_finding_is_told_as_such():
    machine = machine_in(Mode.SAFE_STOP)
    transition = machine.update(0, [], frozenset({Trigger.RESET}))
    assert (transition.finding, transition.reason) == (None, "operator reset")


def test_nothing_no_change():
    machine = ModeMachine()
    assert machine.update(0, []) is None
    assert (machine.mode, machine.reason) == (Mode.SILENT, "started")


def test_the_page_of_the_documentation_is_that_of_the_tables():
    assert (Path(__file__).parents[2] / "docs" / "modes.md").read_text(encoding="utf-8") == page()
