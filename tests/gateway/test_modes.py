"""The mode table."""

import pytest

from gateway.messages import Mode
from gateway.modes import TRANSITIONS, Event, ModeMachine

GRAVE = [Event.EMERGENCY_STOP, Event.ROBOT_FAULT, Event.STATE_LOST, Event.COMMAND_FAILED, Event.COMMAND_LOST, Event.TICK_GAP]


def machine_in(mode):
    machine = ModeMachine()
    machine.mode = mode
    return machine


def test_only_the_operator_engages_and_only_from_ready():
    assert [key for key, after in TRANSITIONS.items() if after is Mode.ENGAGED] == [(Mode.READY, Event.ENGAGE_REQUESTED)]


@pytest.mark.parametrize("mode", [Mode.SAFE_STOP, Mode.FAULT])
def test_latched_modes_are_left_by_people_only(mode):
    leaving = {event for (before, event), after in TRANSITIONS.items() if before is mode and after in (Mode.STANDBY, Mode.READY)}
    assert leaving <= {Event.RESET_REQUESTED, Event.DRIVER_OVERRIDE}


@pytest.mark.parametrize("event", GRAVE)
def test_every_grave_event_ends_an_engagement(event):
    machine = machine_in(Mode.ENGAGED)
    transition = machine.update(5, {event: "why"})
    assert transition is not None
    assert machine.mode in (Mode.SAFE_STOP, Mode.FAULT)
    assert "why" in machine.reason


def test_the_gravest_event_wins():
    machine = machine_in(Mode.ENGAGED)
    machine.update(0, {Event.COMMAND_LOST: "", Event.EMERGENCY_STOP: ""})
    assert machine.mode is Mode.FAULT


def test_readiness_lost_beats_an_engagement_in_the_same_tick():
    machine = machine_in(Mode.READY)
    machine.update(0, {Event.ENGAGE_REQUESTED: "", Event.NOT_READY: "x"})
    assert machine.mode is Mode.STANDBY


def test_no_event_no_change():
    machine = ModeMachine()
    assert machine.update(0, {}) is None
    assert machine.mode is Mode.STANDBY
