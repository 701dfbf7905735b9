"""State machines of one robot and of the robot controller: every row of their tables, and nothing beside them."""

import pytest

from dbc.catalogue import load
from vehicle_emulator.robots import states, supervisor
from vehicle_emulator.robots.states import TRANSITIONS, Dtc, Event, Persistence, RobotState, RobotStateMachine
from vehicle_emulator.robots.supervisor import SafetyInputs, Supervisor, SystemState

CATALOGUE = load()
GOOD = SafetyInputs(
    request="None",
    is_stop_button_pressed=False,
    is_stop_requested=False,
    are_commands_fresh=True,
    are_frames_bad=False,
    is_watchdog_answered=True,
    is_dead_man_pressed=True,
    have_robots_started=True,
    has_robot_fault=False,
    is_overridden=False,
    is_too_fast=False,
    is_standing=False,
)


def machine_in(state: RobotState) -> RobotStateMachine:
    machine = RobotStateMachine(1e-3)
    machine.state = state
    return machine


@pytest.mark.parametrize(("state", "event"), sorted((key for key in TRANSITIONS if key[1] is not Event.NEXT), key=str), ids=str)
def test_every_row_acts(state: RobotState, event: Event):
    assert machine_in(state).update({event}) is TRANSITIONS[state, event]


@pytest.mark.parametrize("state", [state for state in RobotState if state not in states.STARTING])
def test_without_an_event_nothing_changes(state: RobotState):
    assert machine_in(state).update(set()) is state


def test_the_table_is_what_the_module_says():
    def leads(*before: RobotState, event: Event, after: RobotState) -> None:
        assert {state for state in RobotState if TRANSITIONS.get((state, event)) is after} == set(before)

    powered = (RobotState.STANDBY, RobotState.ARMED, RobotState.ENGAGED)
    stopping = (RobotState.SAFE_STOP, RobotState.EMERGENCY_STOP)
    leads(RobotState.ARMED, RobotState.ENGAGED, event=Event.FOLLOW, after=RobotState.ENGAGED)
    leads(RobotState.ARMED, RobotState.ENGAGED, *stopping, event=Event.OVERRIDE, after=RobotState.OVERRIDE)
    leads(RobotState.STANDBY, RobotState.ENGAGED, event=Event.ARMED, after=RobotState.ARMED)
    leads(*powered, event=Event.CONTROLLED_STOP, after=RobotState.SAFE_STOP)
    leads(*powered, RobotState.SAFE_STOP, event=Event.EMERGENCY_STOP, after=RobotState.EMERGENCY_STOP)
    leads(*powered[1:], RobotState.OVERRIDE, *stopping, event=Event.DISARMED, after=RobotState.STANDBY)
    leads(RobotState.FAULT_SOFT, RobotState.FAULT_HARD, event=Event.CLEARED, after=RobotState.STANDBY)
    assert {state for state, _ in TRANSITIONS} == set(RobotState)


@pytest.mark.parametrize("state", list(RobotState))
def test_the_gravest_event_acts(state: RobotState):
    assert machine_in(state).update(set(Event)) is (RobotState.FAULT_HARD if state is not RobotState.FAULT_HARD else RobotState.STANDBY)


def test_start_up_takes_its_time():
    machine = RobotStateMachine(1e-3)
    track = [machine.update(set()) for _ in range(60)]
    assert list(dict.fromkeys(track)) == [RobotState.INIT, RobotState.NOT_LEARNED, RobotState.LEARNING, RobotState.STANDBY]
    assert track.count(RobotState.INIT) == round(1e3 * states.SELF_TEST_S)
    assert track.count(RobotState.LEARNING) == round(1e3 * states.LEARNING_S)


def test_all_names_stand_in_the_dbc():
    for node in ("SR", "AR", "BR"):
        assert set(RobotState) <= set(CATALOGUE.enumeration(f"{node}_Status", "State"))
        assert set(Dtc) <= set(CATALOGUE.enumeration(f"{node}_Diag", "Dtc"))
        assert all(CATALOGUE.enumeration(f"{node}_Diag", "Dtc")[name] in states.SOFT_CODES for name in Dtc)
    assert set(SystemState) <= set(CATALOGUE.enumeration("RC_SafetyStatus", "SystemState"))


def test_persistence_needs_its_time_without_a_break():
    held = Persistence(1e-3, 0.005)
    assert [held.step(x) for x in (1, 1, 1, 1, 0, 1, 1, 1, 1, 1, 1, 0)] == [False] * 9 + [True, True, False]


def supervisor_in(state: SystemState) -> Supervisor:
    rc = Supervisor()
    rc.state = state
    return rc


REQUESTS = tuple(CATALOGUE.enumeration("GW_SafetyCommand", "SystemRequest"))
LEADS_TO = {
    ("Disarmed", "Arm"): "Armed",
    ("Armed", "Engage"): "Engaged",
    ("Armed", "Disarm"): "Disarmed",
    ("Armed", "None"): "Disarmed",
    ("Engaged", "Arm"): "Armed",
    ("Engaged", "Disarm"): "Disarmed",
    ("Engaged", "None"): "Disarmed",
    ("Engaged", "ControlledStop"): "ControlledStop",
    ("ControlledStop", "Disarm"): "Disarmed",
    ("EStop", "Disarm"): "Disarmed",
    **{("Init", request): "Disarmed" for request in REQUESTS},
    **{("Fault", request): "Disarmed" for request in REQUESTS},
}


@pytest.mark.parametrize("state", list(SystemState))
@pytest.mark.parametrize("request_", REQUESTS)
def test_every_request_in_every_state(state: SystemState, request_: str):
    rc = supervisor_in(state)
    rc.update(GOOD._replace(request=request_, is_standing=True))
    assert rc.state == LEADS_TO.get((state, request_), state)


@pytest.mark.parametrize("state", supervisor.STOPS)
def test_a_stop_is_not_left_before_standstill(state: SystemState):
    rc = supervisor_in(state)
    rc.update(GOOD._replace(request="Disarm"))
    assert rc.state is state


STOP_CAUSES = [
    ({"is_stop_button_pressed": True}, "EStop", "CabinButton"),
    ({"is_stop_requested": True}, "EStop", "GatewayRequest"),
    ({"are_commands_fresh": False, "are_frames_bad": True}, "ControlledStop", "E2EFailure"),
    ({"are_commands_fresh": False}, "ControlledStop", "CommandTimeout"),
    ({"is_watchdog_answered": False}, "ControlledStop", "WatchdogAnswer"),
    ({"is_dead_man_pressed": False}, "ControlledStop", "DeadmanReleased"),
    ({"has_robot_fault": True}, "ControlledStop", "RobotFault"),
    ({"is_too_fast": True}, "ControlledStop", "SpeedLimit"),
    ({"request": "ControlledStop"}, "ControlledStop", "GatewayRequest"),
]


@pytest.mark.parametrize(("change", "state", "source"), STOP_CAUSES)
def test_every_cause_of_a_stop(change: dict, state: str, source: str):
    rc = supervisor_in(SystemState.ENGAGED)
    rc.update(GOOD._replace(request="Engage")._replace(**change))
    assert (rc.state, rc.stop_source) == (state, source)
    assert source in CATALOGUE.enumeration("RC_SafetyStatus", "StopSource")


def test_the_gravest_cause_is_named():
    everything = {key: value for change, _, _ in reversed(STOP_CAUSES) for key, value in change.items()}
    rc = supervisor_in(SystemState.ENGAGED)
    rc.update(GOOD._replace(**everything))
    assert (rc.state, rc.stop_source) == ("EStop", "CabinButton")


@pytest.mark.parametrize(
    "missing",
    [
        {"are_commands_fresh": False},
        {"is_watchdog_answered": False},
        {"is_dead_man_pressed": False},
        {"is_overridden": True},
        {"is_too_fast": True},
    ],
)
def test_engagement_needs_every_condition(missing: dict):
    rc = supervisor_in(SystemState.ARMED)
    rc.update(GOOD._replace(request="Engage")._replace(**missing))
    assert rc.state is SystemState.ARMED
    rc.update(GOOD._replace(request="Engage"))
    assert rc.state is SystemState.ENGAGED


@pytest.mark.parametrize("cause", ["is_stop_requested", "is_stop_button_pressed", "has_robot_fault"])
def test_an_armed_system_disarms_for_what_stops_an_engaged_one(cause: str):
    rc = supervisor_in(SystemState.ARMED)
    rc.update(GOOD._replace(request="Engage", **{cause: True}))
    assert rc.state is SystemState.DISARMED
    rc.update(GOOD._replace(request="Arm", **{cause: True}))
    assert rc.state is (SystemState.FAULT if cause == "has_robot_fault" else SystemState.DISARMED)


def test_a_stop_with_a_faulty_robot_is_not_left_by_itself():
    rc = supervisor_in(SystemState.CONTROLLED_STOP)
    rc.update(GOOD._replace(request="Engage", has_robot_fault=True, is_standing=True))
    assert rc.state is SystemState.CONTROLLED_STOP


@pytest.mark.parametrize(("cause", "source"), [("is_stop_button_pressed", "CabinButton"), ("is_stop_requested", "GatewayRequest")])
def test_an_emergency_stop_replaces_a_controlled_one_and_lasts_while_it_is_asked_for(cause: str, source: str):
    rc = supervisor_in(SystemState.ENGAGED)
    rc.update(GOOD._replace(request="Engage", is_dead_man_pressed=False))
    assert (rc.state, rc.stop_source) == ("ControlledStop", "DeadmanReleased")
    rc.update(GOOD._replace(request="Disarm", is_standing=True, **{cause: True}))
    assert (rc.state, rc.stop_source) == ("EStop", source)
    rc.update(GOOD._replace(request="Disarm", is_standing=True, has_robot_fault=True, **{cause: True}))
    assert (rc.state, rc.stop_source) == ("EStop", source)
    rc.update(GOOD._replace(request="Disarm", is_standing=True))
    assert (rc.state, rc.stop_source) == ("Disarmed", "None")


def test_nothing_is_armed_while_the_driver_still_pulls():
    rc = supervisor_in(SystemState.DISARMED)
    rc.update(GOOD._replace(request="Arm", is_overridden=True))
    assert rc.state is SystemState.DISARMED
    rc.update(GOOD._replace(request="Arm"))
    assert rc.state is SystemState.ARMED


def test_faults_show_while_nothing_is_engaged_and_go_with_their_cause():
    rc = supervisor_in(SystemState.DISARMED)
    rc.update(GOOD._replace(has_robot_fault=True))
    assert (rc.state, rc.stop_source) == ("Fault", "RobotFault")
    rc.update(GOOD._replace(request="Arm"))
    assert (rc.state, rc.stop_source) == ("Disarmed", "None")


def test_init_lasts_until_the_robots_have_started():
    rc = Supervisor()
    rc.update(GOOD._replace(have_robots_started=False, request="Arm"))
    assert rc.state is SystemState.INIT
    rc.update(GOOD._replace(request="Arm"))
    assert rc.state is SystemState.DISARMED
