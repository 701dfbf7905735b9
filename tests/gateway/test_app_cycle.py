"""The control cycle with a stub car: what it tells, how it ends, when it takes another configuration, and what it never does."""

import contextlib
import logging
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from dbc.catalogue import NAVIGATION
from dbc.health import BusState, LinkHealth
from dbc.realtime import Grant
from dbc.traffic import Traffic
from gateway import app
from gateway.causes import Cause
from gateway.core import TICK_NS
from gateway.cycle import Links
from gateway.housekeeping import Notice, Orders
from gateway.journal import pack_value
from gateway.messages import Mode, Operation
from gateway.modes import Transition
from gateway.preparation import prepare
from gateway.recorder import RecorderStatus
from gateway.rig import make_rig
from gateway.systemd import Notifier
from gateway.telemetry import Source, StatusSample
from gateway.warm_up import warm_up
from tests.support.cycle import TREE, CycleBench


@pytest.fixture
def bench():
    return CycleBench()


def transitions(bench):
    return [(event.before, event.after) for event in bench.events() if isinstance(event, Transition)]


def statuses(bench):
    return [sample for sample in bench.samples if isinstance(sample, StatusSample)]


def test_engagement_is_told_and_answered(bench):
    bench.engage()
    assert transitions(bench) == [(Mode.SILENT, Mode.READY), (Mode.READY, Mode.ENGAGED)]
    assert [reply.refusals for reply in bench.replies] == [(), ()]
    assert statuses(bench)[-1] is bench.pulse.status
    assert bench.pulse.status.hashes == dict(bench.preparation.hashes)
    assert bench.pulse.status.buses == {"robots": "error-active", "navigation": "error-active"}
    assert bench.pulse.ticks == len(bench.states) == sum(bench.pulse.step_cpu.counts)


@pytest.mark.parametrize("is_step", [True, False])
def test_navigation_data_are_due_a_cycle_after_those_before(bench, monkeypatch, is_step):
    assert bench.cycle.due_ns == 0
    bench.tick()
    monkeypatch.setattr(bench.pacer, "is_due", lambda _: is_step)
    bench.tick()
    assert bench.cycle.due_ns == bench.now_ns + TICK_NS
    bench.car.is_time_frozen = True
    bench.tick(3)
    assert bench.cycle.due_ns == bench.now_ns - 2 * TICK_NS


@pytest.mark.req("E1")
def test_end_in_silence_is_at_once_and_still_silent(bench):
    bench.tick(50)
    bench.orders.ends = 1
    assert bench.tick(10) == 1
    assert bench.frames == []


def test_end_while_engaged_stops_the_car_first(bench):
    bench.engage().orders.ends = 1
    bench.tick(3_000)
    assert bench.cycle.is_over
    assert bench.mode is Mode.COMFORT_STOP
    assert abs(bench.car.vx_mps) < 0.1
    assert transitions(bench)[-1] == (Mode.ENGAGED, Mode.COMFORT_STOP)
    report = bench.pulse.status.disengagement
    assert (report.cause, report.source) == ("OPERATOR_STOP", "the gateway is to end")
    assert len(bench.replies) == 2  # an operator is not told what he did not ask


def test_a_standstill_that_is_not_known_ends_nothing_before_its_time():
    bench = CycleBench(stop_within_s=20.0).engage()
    bench.orders.ends = 1
    bench.tick(100)
    while bench.car.vx_mps > 0.05:
        bench.tick()
    bench.car.silent |= {"VelocityLevel"}
    bench.tick(300)
    assert not bench.states[-1].is_valid
    assert abs(bench.states[-1].vx_mps) < 0.1
    assert not bench.cycle.is_over
    bench.tick(2_000)
    assert bench.cycle.is_over


def test_end_at_speed_is_over_when_its_time_is():
    bench = CycleBench(stop_within_s=2.0).engage()
    bench.car.is_following = False
    bench.orders.ends = 1
    assert bench.tick(1_000) == 201
    assert bench.cycle.is_over


def test_second_request_to_end_is_obeyed_after_the_tick(bench):
    bench.engage().orders.ends = 1
    bench.tick(20)
    assert not bench.cycle.is_over
    sent = len(bench.frames)
    bench.orders.ends = 2
    assert bench.tick(10) == 1
    assert len(bench.frames) > sent  # the tick was a whole one
    told = [event for event in bench.events() if isinstance(event, Notice)]
    assert [event.level for event in told] == [logging.INFO, logging.WARNING]
    assert re.fullmatch(r"asked again: ends at once, in mode COMFORT_STOP at \d+\.\d m/s", told[-1].text)
    assert told[-1].fields["value"] > 1.0


def test_end_when_ready_disarms_the_robots_first(bench):
    bench.tick(210)
    bench.ask(Operation.ARM)
    bench.tick(2)
    assert bench.mode is Mode.READY
    bench.orders.ends = 1
    assert 10 < bench.tick(100) < 15  # 100 ms in which they are told, as docs/target.md says
    assert bench.mode is Mode.STANDBY
    requests = bench.preparation.catalogue.enumeration("GW_SafetyCommand", "SystemRequest")
    assert bench.car.told["GW_SafetyCommand"]["SystemRequest"] == requests["Disarm"]


def test_an_operator_is_heard_while_the_process_ends(bench):
    bench.engage().orders.ends = 1
    bench.tick(1)
    bench.ask(Operation.DISENGAGE)
    bench.tick(1)
    assert bench.mode is Mode.STANDBY


def test_another_configuration_comes_in_force_where_nobody_drives(bench):
    bench.tick(10)
    bench.pulse.successor = successor = bench.preparation
    assert bench.tick(5) == 1
    assert bench.cycle.successor is successor


@pytest.mark.req("S5")
@pytest.mark.parametrize("is_engaged", [False, True])
def test_another_configuration_is_refused_where_somebody_may_be_driven(bench, is_engaged):
    if is_engaged:
        bench.engage()
    else:
        bench.tick(210)
        bench.ask(Operation.ARM)
        bench.tick(2)
    bench.events()
    bench.pulse.successor = bench.preparation
    assert bench.tick(5) == 5
    assert bench.cycle.successor is bench.pulse.successor is None
    (notice,) = bench.events()
    assert isinstance(notice, Notice)
    assert notice.text == f"reload refused: mode {bench.mode.name}"
    assert notice.level == logging.WARNING


def test_a_configuration_that_comes_while_the_process_ends_is_not_taken(bench):
    bench.engage().orders.ends = 1
    bench.pulse.successor = bench.preparation
    bench.tick(3_000)
    assert bench.cycle.is_over
    assert bench.cycle.successor is None


def test_a_reset_allows_the_buses_to_be_entered_again(bench):
    bench.tick(10)
    assert bench.buses.recoveries == 0
    bench.ask(Operation.RESET)
    bench.tick(2)
    assert bench.buses.recoveries == 1


def test_what_was_heard_and_answered_is_recorded_and_its_state_surrounds_the_core():
    records = []
    status = RecorderStatus(is_recording=False, disk_free_share=0.5, recorded=3, lost=2, problem="disk full")
    bench = CycleBench(SimpleNamespace(poll=lambda _: status, record=lambda *record: records.append(record)))
    bench.tick(210)
    arguments, output = records[-1]
    assert arguments.now_ns == bench.now_ns
    assert output.state is bench.states[-1]
    assert (arguments.surroundings.is_recording, arguments.surroundings.disk_free_share) == (False, 0.5)
    assert (bench.pulse.status.ticks_unrecorded, bench.pulse.status.record_problem) == (2, "disk full")
    assert any("record" in blocker for blocker in bench.pulse.status.blockers), bench.pulse.status.blockers


@pytest.mark.req("G5")
def test_the_record_has_every_look_between_two_steps_once_and_runs_again():
    records = []
    status = RecorderStatus(is_recording=True, disk_free_share=0.5, recorded=3, lost=0, problem="")
    keep = SimpleNamespace(poll=lambda _: status, record=lambda arguments, output: records.append((arguments, pack_value(output))))
    bench = CycleBench(keep).engage()
    bench.pacer.is_due = lambda now_ns: False
    bench.tick(2)
    del bench.pacer.is_due
    bench.tick(50)
    looks = {glance.now_ns for arguments, _ in records for glance in arguments.glances}
    assert [len(arguments.glances) for arguments, _ in records[-51:]] == [0, 2, *[0] * 49]
    assert looks == {bench.now_ns - 51 * TICK_NS, bench.now_ns - 50 * TICK_NS}
    core = bench.preparation.new_core(1)
    assert [pack_value(arguments.step(core)) for arguments, _ in records] == [output for _, output in records]


def test_rejected_datagrams_are_told(bench):
    bench.cycle._links.channel.rejected, bench.cycle._links.operators.rejected = 3, 4
    bench.tick(10)
    assert bench.pulse.status.commands_rejected == {"no datagram of the controller's": 3, "no datagram of the operator's": 4}


def test_what_the_buses_say_is_told(bench):
    bench.buses.dead, bench.buses.bus_errors = ["navigation"], {"robots": 5}
    bench.buses.dropped, bench.buses.unsent = {"not read in time": 6}, {"older than a cycle": 7}
    bench.buses.links, bench.buses.refusals = {"robots": LinkHealth(BusState.ERROR_PASSIVE)}, {"robots": "Operation not permitted"}
    bench.tick(10)
    status = bench.pulse.status
    assert (status.dead_buses, status.bus_errors, status.buses) == (["navigation"], {"robots": 5}, {"robots": "error-passive"})
    assert (status.frames_rejected["not read in time"], status.frames_unsent) == (6, {"older than a cycle": 7})
    assert status.bus_refusals == {"robots": "Operation not permitted"}


def test_a_frame_that_no_dbc_knows_is_no_message_with_a_rate(bench):
    """A link hears such frames where there are more messages than the kernel takes filters."""
    known = bench.preparation.catalogue.by_name["SR_Status"].arbitration_id
    unknown = next(number for number in range(0x800) if number not in bench.preparation.catalogue.by_id)
    bench.buses.loads = {"robots": Traffic(0.5, {unknown: 50.0, known: 100.0})}
    bench.tick(10)
    assert bench.pulse.status.message_rates_hz == {"SR_Status": 100.0}


@pytest.mark.req("F10")
def test_a_bus_that_fails_ends_the_drive(bench):
    bench.engage()
    bench.buses.links["navigation"] = LinkHealth(BusState.DOWN)
    bench.tick(1)
    assert bench.mode is Mode.FAULT
    report = bench.cycle._core.disengagement.finding
    assert (report.cause, report.source) == (Cause.BUS_DOWN, "navigation")


def test_the_robots_are_told_how_busy_the_busiest_bus_and_the_control_thread_are(bench, monkeypatch):
    monkeypatch.setattr("gateway.cycle.time", SimpleNamespace(thread_time_ns=lambda: bench.now_ns // 5))
    bench.buses.loads["navigation"] = Traffic(0.5)
    bench.engage().tick(100)
    told = bench.car.told["GW_Heartbeat"]
    assert (told["BusLoad"], told["CpuLoad"]) == (50.0, 20.0)


def test_the_pacer_hears_of_commands_and_what_was_late_is_told(bench):
    heard_ns = []
    bench.pacer.command_arrived = heard_ns.append
    start_ns = bench.now_ns
    bench.tick(9)
    assert heard_ns == [start_ns + k * TICK_NS for k in range(1, 10) if k % 4 == 1 and k > 1]
    assert bench.pulse.lateness.max_ns == 0
    bench.now_ns += 37_000_000
    bench.tick()
    assert (bench.pulse.lateness.max_ns, bench.pulse.status.ticks_late) == (37_000_000, 3)


def test_the_control_thread_wakes_up_for_navigation_data_and_for_commands():
    buses = SimpleNamespace(filenos=lambda network: {NAVIGATION: [5]}.get(network, [6]))
    arrivals = Links(buses, SimpleNamespace(fileno=lambda: 7), SimpleNamespace(fileno=lambda: 8), None, None).wait()
    assert (arrivals._frames(), arrivals._command) == ([5], 7)


def test_the_control_thread_never_logs(bench, caplog):
    with caplog.at_level(logging.DEBUG):
        logging.getLogger("anybody").debug("the trap works")
        bench.engage()
        bench.car.fault = 1
        bench.tick(100)
        bench.orders.ends = 1
        bench.tick(100)
    assert Mode.SAFE_STOP in {after for _, after in transitions(bench)}
    assert [record.msg for record in caplog.records] == ["the trap works"]


def test_what_the_machine_refused_is_in_the_status():
    bench = CycleBench(realtime={"priority": Grant("SCHED_FIFO 60", "no"), "memory": Grant("memory locked")})
    bench.tick(10)
    assert bench.pulse.status.realtime == {"priority": "SCHED_FIFO 60: refused, no", "memory": "memory locked"}


@pytest.mark.req("E1")
def test_warm_up_hears_everything_and_leaves_the_gateway_as_new(bench):
    assert warm_up(bench.preparation) > 0
    bench.tick(10)
    assert (bench.mode, bench.pulse.ticks, bench.frames) == (Mode.SILENT, 10, [])


def test_a_state_is_sent_as_soon_as_the_navigation_data_are_new_and_not_again(bench):
    bench.tick(5)
    sent = len(bench.states)
    bench.pacer.is_due = lambda now_ns: False
    bench.tick()
    assert len(bench.states) == sent + 1
    assert bench.states[-1].t_ns == bench.now_ns
    del bench.pacer.is_due
    bench.cycle._links.buses.receive = list
    bench.tick()
    assert len(bench.states) == sent + 1  # the step has nothing newer to tell
    bench.tick()
    assert len(bench.states) == sent + 2  # but is not silent when nothing comes


def test_a_command_that_came_between_two_steps_is_kept_for_the_next(bench):
    bench.engage()
    while len(bench.states) % 4 != 3:  # the next state, which comes between two steps, is answered with a command
        bench.tick()
    admitted = bench.cycle._core.commands.newest
    bench.pacer.is_due = lambda now_ns: False
    bench.tick(2)
    assert bench.cycle._command is not None
    assert bench.cycle._core.commands.newest is admitted
    del bench.pacer.is_due
    bench.tick()
    assert bench.cycle._core.commands.newest is not admitted


@pytest.mark.req("G4")
def test_status_tells_of_limits_latency_traffic_and_how_an_engagement_ended(bench):
    bench.engage().tick(30)
    status = statuses(bench)[-1]
    assert (status.profile, status.bus_load, status.message_rates_hz) == ("proving_ground", {"robots": 0.25}, {"SR_Status": 100.0})
    assert (status.disengagement, status.limits, status.limited_share) == (None, {}, 0.0)
    assert 0.0 < status.actuation_age_ms <= status.actuation_age_max_ms < 50.0
    bench.plan_steer_rad = 0.9
    bench.tick(12)
    bench.car.override = 1
    bench.tick(2)
    status = statuses(bench)[-1]
    limit = status.limits["steering angle"]
    assert limit.ticks > 0
    assert limit.unit == "rad"
    assert limit.asked > limit.limit >= limit.given > 0.0
    assert status.limited_share > 0.0
    ended = status.disengagement
    assert (ended.cause, ended.code, ended.source, ended.unit) == ("DRIVER_OVERRIDE", 63, "RC", "")


@pytest.mark.req("F10")
def test_a_reset_lets_the_buses_recover_but_not_while_the_car_is_driven(bench):
    bench.engage()
    bench.ask(Operation.RESET)
    bench.tick()
    assert bench.replies[-1].refusals == ("not possible in ENGAGED",)
    assert bench.buses.recoveries == 0  # it would forget which frames have not got through
    bench.car.emergency_stop = 1
    bench.tick(2)
    assert bench.mode is Mode.FAULT
    bench.ask(Operation.RESET)
    bench.tick()
    assert bench.buses.recoveries == 1


def test_the_process_is_made_of_what_the_rig_file_says(tmp_path, monkeypatch):
    given = {}

    def noting(name, make):
        def noted(*arguments):
            given[name] = arguments
            return make(*arguments)

        monkeypatch.setattr(app, name, noted)

    noting("BusSet", app.BusSet)
    noting("warm_up", app.warm_up)
    noting("Publisher", lambda *_: contextlib.nullcontext(SimpleNamespace(post=lambda _: None, dropped=0)))
    noting("realtime_practice", lambda *_: contextlib.nullcontext({}))
    tls = {"address": "192.0.2.1:7547", "certificate": "a", "private_key": "b", "authority": "c"}
    more = {"control": {"directory": str(tmp_path)}, "telemetry": {"base_port": 7000, "tls": tls}, "realtime": {"cpus": [1]}}
    preparation = prepare(make_rig(Path("test"), TREE | more, Path("/")))
    assert app.run(preparation, Orders(ends=1), Notifier({}), None) is None
    assert given["BusSet"] == (preparation.rig.buses.by_network, preparation.catalogue, "GW")  # answerable for what it sends
    assert given["Publisher"] == (Source.GATEWAY, 7000, preparation.rig.telemetry.tls)
    assert given["warm_up"] == (preparation,)
    assert given["realtime_practice"] == (preparation.rig.realtime,)


def test_the_loop_sleeps_until_navigation_data_are_due(tmp_path, monkeypatch):
    asked_ns = []
    cycle = SimpleNamespace(is_over=False, successor=None, due_ns=17)
    cycle.look = lambda *_: setattr(cycle, "is_over", True)
    monkeypatch.setattr(app, "ControlCycle", lambda *_: cycle)
    monkeypatch.setattr(app, "warm_up", lambda _: None)
    monkeypatch.setattr(app, "Publisher", lambda *_: contextlib.nullcontext(SimpleNamespace(post=lambda _: None, dropped=0)))
    monkeypatch.setattr(app, "realtime_practice", lambda *_: contextlib.nullcontext({}))
    monkeypatch.setattr(Links, "wait", lambda _: SimpleNamespace(wait=lambda _, due_ns: asked_ns.append(due_ns)))
    preparation = prepare(make_rig(Path("test"), TREE | {"control": {"directory": str(tmp_path)}}, Path("/")))
    assert app.run(preparation, Orders(), Notifier({}), None) is None
    assert asked_ns == [17]
