"""The table of parameters and the store: whole requests or nothing, one set per cycle edge, an audit trail that can be walked back."""

import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.nmpc import Nmpc
from controller.parameters import HISTORY_LENGTH, Accepted, ParameterStore, Refused, table
from controller.planning.options import PlannerOptions
from controller.problem import SINGLE_TRACK_LAG, OcpOptions
from controller.solvers import make_solver
from gateway.messages import PLAN_PERIOD_NS, CommandStatus, Mode, VehicleState

SAFE_TIME, RANGE = "planner.safe_time_s", "planner.detection_range_m"


@pytest.fixture
def store():
    return ParameterStore(OcpOptions(), PlannerOptions())


def value(store, name):
    return store.newest.value(store.table[name])


def refused(answer, *words):
    assert isinstance(answer, Refused), answer
    (reason,) = answer.reasons
    assert "\n" not in reason
    for word in words:
        assert word in reason
    return reason


def test_no_number_that_a_solver_is_given_is_forgotten():
    generated = OcpOptions().generated().keys()
    named = {parameter.path[0] for parameter in table(OcpOptions()) if parameter.group == "ocp"}
    assert named == {field.name for field in fields(OcpOptions)} - generated


def test_no_number_of_the_planner_is_forgotten():
    named = {parameter.path[0] for parameter in table(OcpOptions()) if parameter.group == "planner"}
    assert named == {field.name for field in fields(PlannerOptions)}


LAG = OcpOptions(model=SINGLE_TRACK_LAG)


@pytest.mark.parametrize("ocp", [OcpOptions(), LAG, replace(LAG, state_weights=(1.0,) * 8)])
def test_names_are_the_models_and_what_runs_is_in_range(ocp):
    store = ParameterStore(ocp, PlannerOptions())
    weights = [f"ocp.state_weights.{name}" for name in ocp.model.states[: len(ocp.state_weights)]]
    assert [name for name in store.table if name.startswith("ocp.state_weights.")] == weights
    assert {"ocp.input_bounds.delta.min", "ocp.input_bounds.t_r.max", "ocp.state_bounds.v_x.max"} <= store.table.keys()
    for name, about in store.table.items():
        assert about.smallest <= value(store, name) <= about.largest, name
        assert about.description
        assert "\n" not in about.description


def test_every_parameter_reaches_its_own_place_and_no_other(store):
    """Each is changed alone; whatever the options then differ in must be that one number."""
    for name, about in store.table.items():
        fresh = ParameterStore(OcpOptions(), PlannerOptions(hardest_deceleration_mps2=10.0, hardest_lateral_acceleration_mps2=10.0))
        old = value(fresh, name)
        twin = name.replace(".X", ".Y") if name.endswith(".X") else name.replace(".Y", ".X")
        new = about.smallest + 0.75 * (min(about.largest, 100.0) - about.smallest)
        new = new if new != old else 0.5 * (new + about.smallest)
        if name in ("planner.hardest_deceleration_mps2", "planner.hardest_lateral_acceleration_mps2"):
            new = 9.0
        changes = {name: new} | ({twin: new} if twin != name else {})
        assert fresh.propose(changes, "test", 0).version == 1, name
        before, after = fresh.starting, fresh.newest
        assert {n for n in fresh.table if after.value(fresh.table[n]) != before.value(fresh.table[n])} == changes.keys()
        assert after.value(about) == new
        assert before.value(about) == old


def test_one_bad_number_refuses_all(store):
    answer = store.propose({SAFE_TIME: 1.8, "ocp.state_weights.v_x": -1.0, "planner.safe_tme_s": 1.0}, "test", 0)
    assert isinstance(answer, Refused)
    assert len(answer.reasons) == 2
    assert "planner.safe_tme_s" in answer.reasons[0]
    assert SAFE_TIME in answer.reasons[0]
    assert answer.reasons[1] == "ocp.state_weights.v_x = -1: from 0 to 100000 1/(m/s)²"
    assert store.take() is None
    assert value(store, SAFE_TIME) == 1.2


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -0.001, 5.001, 1e300])
def test_what_is_out_of_range_is_named_with_its_range(store, bad):
    refused(store.propose({SAFE_TIME: bad}, "test", 0), SAFE_TIME, "from 0 to 5 s")
    assert store.newest is store.starting


def test_the_ends_of_a_range_are_in_it(store):
    assert isinstance(store.propose({SAFE_TIME: 5.0}, "test", 0), Accepted)
    assert isinstance(store.propose({SAFE_TIME: 0.0}, "test", 0), Accepted)


def test_numbers_that_do_not_go_together_are_refused(store):
    refused(store.propose({"planner.acceleration_mps2": 5.0}, "test", 0), "acceleration_mps2", "hardest_deceleration_mps2")
    assert isinstance(store.propose({"planner.acceleration_mps2": 5.0, "planner.hardest_deceleration_mps2": 6.0}, "test", 0), Accepted)
    refused(store.propose({"planner.hardest_deceleration_mps2": 3.0}, "test", 0), "hardest_deceleration_mps2")


@pytest.mark.parametrize("kind", ["state_weights", "terminal_weights"])
def test_the_cost_does_not_know_north(store, kind):
    refused(store.propose({f"ocp.{kind}.X": 7.0}, "test", 0), f"ocp.{kind}.Y")
    assert isinstance(store.propose({f"ocp.{kind}.X": 7.0, f"ocp.{kind}.Y": 7.0}, "test", 0), Accepted)


@pytest.mark.parametrize("who", ["", "  ", "a\nb", "x" * 81, "\x1b[31m"])
def test_who_asks_is_a_name_that_a_log_can_hold(store, who):
    refused(store.propose({SAFE_TIME: 1.8}, who, 0), "who")
    assert store.newest is store.starting


def test_a_flood_of_unknown_names_gets_few_reasons(store):
    answer = store.propose({f"nothing.{k}" * 100: 1.0 for k in range(2000)}, "test", 0)
    assert isinstance(answer, Refused)
    assert 0 < len(answer.reasons) < 10
    assert max(map(len, answer.reasons)) < 400


def test_nothing_named_and_nothing_new(store):
    refused(store.propose({}, "test", 0), "no parameter")
    assert store.propose({SAFE_TIME: 1.2}, "test", 0) == Accepted(version=0, changes=[])
    assert store.take() is None


def test_changes_wait_for_the_cycle_edge_and_come_as_one_set(store):
    assert store.take() is None
    store.propose({SAFE_TIME: 1.8, "ocp.input_bounds.t_r.min": -0.5}, "ann", 10)
    store.propose({RANGE: 80.0}, "bob", 20)
    assert store.in_force == 0
    parameters, entries = store.take()
    assert store.in_force == parameters.version == 2
    assert parameters.ocp == replace(OcpOptions(), input_bounds=((-0.55, 0.55), (-0.5, 1.0)))
    assert parameters.planner == PlannerOptions(safe_time_s=1.8, detection_range_m=80.0)
    assert [(entry.version, entry.accepted_ns, entry.who) for entry in entries] == [(1, 10, "ann"), (2, 20, "bob")]
    assert [(change.name, change.old, change.new) for change in entries[0].changes] == [
        (SAFE_TIME, 1.2, 1.8), ("ocp.input_bounds.t_r.min", -1.0, -0.5),
    ]  # fmt: skip
    assert store.take() is None
    store.propose({RANGE: 90.0}, "bob", 30)
    assert [entry.version for entry in store.take()[1]] == [3]


def test_a_set_that_was_taken_never_changes(store):
    store.propose({SAFE_TIME: 1.8}, "test", 0)
    parameters, _ = store.take()
    store.propose({SAFE_TIME: 2.0}, "test", 0)
    assert (parameters.version, parameters.planner.safe_time_s, len(parameters.history)) == (1, 1.8, 1)


def test_last_walks_back_change_by_change(store):
    for seconds in (1.5, 1.8, 2.1):
        store.propose({SAFE_TIME: seconds}, "test", 0)
    seen = []
    for _ in range(3):
        assert isinstance(store.revert("last", "test", 0), Accepted)
        seen.append((value(store, SAFE_TIME), store.newest.history[-1].reverts))
    assert seen == [(1.8, [3]), (1.5, [2]), (1.2, [1])]
    assert store.newest.version == 6
    refused(store.revert("last", "test", 0), "no change")


def test_a_change_is_taken_back_by_its_number_unless_another_lies_on_it(store):
    store.propose({SAFE_TIME: 1.8, RANGE: 80.0}, "test", 0)
    store.propose({RANGE: 90.0}, "test", 0)
    store.propose({"planner.safe_lateral_m": 1.0}, "test", 0)
    refused(store.revert(1, "test", 0), "change 2", "first")
    assert store.revert(2, "test", 0).version == 4
    assert store.revert(1, "ann", 5).version == 5
    assert (value(store, SAFE_TIME), value(store, RANGE), value(store, "planner.safe_lateral_m")) == (1.2, 60.0, 1.0)
    assert (store.newest.history[-1].who, store.newest.history[-1].reverts) == ("ann", [1])
    refused(store.revert(1, "test", 0), "1", "do, newest last: 3;")
    refused(store.revert(4, "test", 0), "4")
    refused(store.revert(99, "test", 0), "99")


def test_all_leads_back_to_the_start(store):
    store.propose({"ocp.state_weights.v_x": 3.0}, "test", 0)
    store.propose({SAFE_TIME: 1.8}, "test", 0)
    assert store.revert("all", "test", 0).version == 3
    assert (store.newest.ocp, store.newest.planner) == (store.starting.ocp, store.starting.planner)
    assert store.newest.history[-1].reverts == [1, 2]
    refused(store.revert("last", "test", 0), "no change")
    assert store.revert("all", "test", 0) == Accepted(version=3, changes=[])


def test_memory_is_bounded(store):
    for k in range(HISTORY_LENGTH + 50):
        store.propose({SAFE_TIME: 1.0 + 0.001 * (k % 7)}, "test", k)
    assert len(store.newest.history) == HISTORY_LENGTH
    assert store.newest.version == HISTORY_LENGTH + 50
    refused(store.revert(1, "test", 0), "1")


@pytest.mark.parametrize("name", ["casadi-c", "qrqp", "riccati"])
def test_the_compiled_solver_drives_with_them_from_the_next_step_on(name, vehicle, wavy_path, store):
    solver = make_solver(name, vehicle.model, OcpOptions(), print)
    nmpc = Nmpc(solver, wavy_path, vehicle, boot_id=1)
    x_m, y_m, yaw_rad = (float(column[5]) for column in (wavy_path.x_m, wavy_path.y_m, wavy_path.yaw_rad))

    def hardest_drive(t_ns):
        state = VehicleState(1, 1, t_ns, Mode.READY, True, x_m, y_m, yaw_rad, 13.0, 0.0, 0.0, 0.0, 0.0, 0.1)  # slower than the path asks
        output = nmpc.step(state, t_ns)
        assert output.command.status is CommandStatus.OK
        return output.plan.inputs[:, 1].max()

    assert hardest_drive(0) > 0.5
    store.propose({"ocp.input_bounds.t_r.max": 0.3}, "test", 0)
    parameters, _ = store.take()
    nmpc.tune(parameters.ocp, parameters.planner)
    assert hardest_drive(PLAN_PERIOD_NS) == pytest.approx(0.3, abs=1e-6)


names = st.sampled_from(sorted(ParameterStore(OcpOptions(), PlannerOptions()).table))
requests = st.dictionaries(names, st.floats(), max_size=4)


@given(st.lists(st.one_of(requests, st.sampled_from(["last", "all"]), st.integers(-1, 9)), max_size=12))
def test_whatever_is_asked_for_the_trail_explains_the_values(asked):
    store = ParameterStore(OcpOptions(), PlannerOptions())
    for k, one in enumerate(asked):
        answer = store.propose(one, "test", k) if isinstance(one, dict) else store.revert(one, "test", k)
        assert isinstance(answer, Accepted | Refused)
    explained = {name: store.starting.value(about) for name, about in store.table.items()}
    for entry in store.newest.history:
        for change in entry.changes:
            assert explained[change.name] == change.old != change.new
            explained[change.name] = change.new
    assert explained == {name: value(store, name) for name in store.table}
    assert all(about.smallest <= explained[name] <= about.largest for name, about in store.table.items())
    assert store.newest.version == len(store.newest.history)
