"""The process: it answers a gateway's states over real sockets, and ends when told to."""

import threading
import time
from types import SimpleNamespace

import pytest

from controller.app import ControlCycle, ControllerOptions, run
from controller.objects import report_of
from controller.parameters import ParameterStore
from controller.planning.options import PlannerOptions
from controller.planning.reference import ReferencePathError
from controller.problem import OcpOptions
from dbc.vehicle import FOCUS
from gateway.channel import Channel, control_path
from gateway.messages import CommandStatus, ControlCommand, Mode, VehicleState
from gateway.telemetry import CommandSample, ObjectsSample, ParametersSample, Publisher, Source, Subscriber, WorldObject, decode
from tests.support.processes import free_base_port, wait_until


@pytest.fixture
def options(tmp_path, wavy_path, library):
    wavy_path.to_csv(tmp_path / "path.csv")
    return ControllerOptions(tmp_path / "path.csv", FOCUS, control_path(tmp_path), "casadi-c", free_base_port())


def gateway_end(options):
    control = options.control
    return Channel(control.gateway_socket, control.controller_socket, control.key())


def state_at(path, seq):
    return VehicleState(
        1, seq, time.monotonic_ns(), Mode.READY, True, float(path.x_m[5]), float(path.y_m[5]), float(path.yaw_rad[5]),
        60 / 3.6, 0.0, 0.0, 0.0, 0.0, 0.1,
    )  # fmt: skip


def test_states_are_answered_until_told_to_stop(options, wavy_path):
    stop = threading.Event()
    thread = threading.Thread(target=run, args=(options, stop), daemon=True)
    commands: list[ControlCommand] = []
    with gateway_end(options) as gateway:
        thread.start()
        deadline_s = time.monotonic() + 60.0
        while len(commands) < 5 and time.monotonic() < deadline_s:
            gateway.send(state_at(wavy_path, len(commands) + 1))
            time.sleep(0.01)
            if (command := gateway.newest(ControlCommand)) is not None:
                commands.append(command)
        stop.set()
        thread.join(timeout=10.0)
    assert not thread.is_alive()
    assert len(commands) == 5
    assert CommandStatus.OK in {command.status for command in commands}
    assert len({command.boot_id for command in commands}) == 1
    assert [command.seq for command in commands] == sorted({command.seq for command in commands})
    assert all(command.solve_time_ns > 0 for command in commands if command.status is CommandStatus.OK)


def test_a_missing_path_is_the_users_mistake(options, tmp_path):
    (tmp_path / "path.csv").unlink()
    with pytest.raises(ReferencePathError, match=r"path\.csv"):
        run(options, threading.Event())


def van(x_m, y_m):
    return WorldObject(name="van", x_m=x_m, y_m=y_m, yaw_rad=0.0, length_m=4.5, width_m=1.8)


def test_objects_reach_the_planner_and_vanish_with_whoever_told_of_them(options, wavy_path):
    stop, commands = threading.Event(), []
    thread = threading.Thread(target=run, args=(options, stop), daemon=True)
    with (
        gateway_end(options) as gateway,
        Subscriber(lambda topic, payload: commands.append(decode(topic, payload)), ["command"], options.telemetry_base_port),
    ):
        thread.start()

        def considers(count, publisher=None):
            def look():
                gateway.send(state_at(wavy_path, 1))
                if publisher is not None:
                    publisher.post(ObjectsSample(t_ns=time.monotonic_ns(), seq=0, objects=[van(40.0, 30.0)]))
                return commands and commands[-1].objects == count

            return look

        wait_until(considers(0), 60, "the first command")
        with Publisher(Source.WORLD, options.telemetry_base_port) as world:
            wait_until(considers(1, world), 10, "an object")
        wait_until(considers(0), 10, "its end")
        stop.set()
        thread.join(timeout=10.0)
    assert {command.status for command in commands} == {"OK"}


class Recorder:
    """Stands for the controller, the channel and telemetry of a cycle, and keeps what they are told, in order."""

    def __init__(self, state=None):
        self.told = []
        self._state = state

    def newest(self, _):
        return self._state

    def tune(self, ocp, planner):
        self.told.append(("tune", ocp, planner))

    def step(self, state, now_ns, objects):
        self.told.append(("step", now_ns, [thing.name for thing in objects]))
        command = SimpleNamespace(
            t_ns=now_ns, seq=1, state_seq=state.seq, status=CommandStatus.OK, steer_rad=0.0, drive_norm=0.0, solve_time_ns=0
        )
        return SimpleNamespace(command=command, solution=None, disturbance_mps2=0.0)

    def send(self, command):
        self.told.append(("send", command.t_ns))

    def post(self, sample):
        self.told.append(sample)


def cycle_of(recorder, store, report=None):
    inbox = SimpleNamespace(report=report, rejected=3)
    return ControlCycle(recorder, "riccati", recorder, recorder, store=store, inbox=inbox)


def test_parameters_change_at_the_edge_before_the_step_and_once(wavy_path):
    store = ParameterStore(OcpOptions(), PlannerOptions())
    recorder = Recorder(state_at(wavy_path, 1))
    cycle = cycle_of(recorder, store)
    store.propose({"ocp.input_weights.delta": 2.0}, "ann", 5)
    store.propose({"planner.safe_time_s": 1.8}, "bob", 6)
    cycle.step(1000)
    cycle.step(2000)
    tuned, first, second, step, send, command, *after = recorder.told
    assert tuned == ("tune", OcpOptions(input_weights=(2.0, 0.1)), PlannerOptions(safe_time_s=1.8))
    assert [(type(one), one.version, one.t_ns, one.who) for one in (first, second)] == [
        (ParametersSample, 1, 1000, "ann"), (ParametersSample, 2, 1000, "bob"),
    ]  # fmt: skip
    assert (step, send) == (("step", 1000, []), ("send", 1000))
    assert isinstance(command, CommandSample)
    assert (command.parameters_version, command.objects_rejected) == (2, 3)
    assert [one if isinstance(one, tuple) else type(one) for one in after] == [("step", 2000, []), ("send", 2000), CommandSample]


def test_without_a_state_there_is_no_command_but_parameters_come_in_force():
    store = ParameterStore(OcpOptions(), PlannerOptions())
    recorder = Recorder()
    store.propose({"planner.safe_time_s": 1.8}, "ann", 5)
    cycle_of(recorder, store).step(1000)
    assert [one[0] if isinstance(one, tuple) else type(one) for one in recorder.told] == ["tune", ParametersSample]
    assert store.in_force == 1


def test_the_planner_gets_objects_where_they_are_now(wavy_path):
    recorder = Recorder(state_at(wavy_path, 1))
    report = report_of(ObjectsSample(t_ns=1000, seq=0, objects=[van(30.0, 0.0)]))
    cycle = cycle_of(recorder, ParameterStore(OcpOptions(), PlannerOptions()), report)
    cycle.step(2000)
    cycle.step(10**9)  # too old by now
    assert [one[2] for one in recorder.told if isinstance(one, tuple) and one[0] == "step"] == [["van"], []]
