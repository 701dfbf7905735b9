"""The tuning service: what clients get for what they send, over Zenoh and in a process of its own."""

import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import msgspec
import pytest

from controller.parameters import Accepted, ParameterStore, Refused
from controller.planning.options import PlannerOptions
from controller.problem import OcpOptions
from controller.tuning import (
    SERVICE,
    GetRequest,
    History,
    HistoryRequest,
    ListRequest,
    RevertRequest,
    SetRequest,
    TuningService,
    Values,
    request,
)
from gateway.channel import Channel, control_path
from gateway.messages import ControlCommand, Mode, VehicleState
from gateway.telemetry import (
    MAX_REQUEST_BYTES,
    CommandSample,
    ParametersSample,
    Publisher,
    Source,
    Subscriber,
    TelemetryError,
    ask,
    decode,
)
from tests.support.processes import end, free_base_port, start_xilgate, wait_until

SAFE_TIME = "planner.safe_time_s"


@pytest.fixture
def store():
    return ParameterStore(OcpOptions(), PlannerOptions())


@pytest.fixture
def service(store):
    return TuningService(store, clock=lambda: 77)


def answered(service, content):
    payload = content if isinstance(content, bytes) else msgspec.json.encode(content)
    return json.loads(service.answer(payload))


def test_list_and_get_tell_value_unit_range_and_default(service, store):
    service.answer(msgspec.json.encode(SetRequest(changes={SAFE_TIME: 1.8}, who="ann")))
    everything = answered(service, ListRequest())
    assert [one["name"] for one in everything["parameters"]] == list(store.table)
    assert answered(service, GetRequest(names=[SAFE_TIME, SAFE_TIME])) == {
        "answer": "values", "version": 1, "in_force": 0,
        "parameters": [
            {"name": SAFE_TIME, "value": 1.8, "unit": "s", "smallest": 0.0, "largest": 5.0, "default": 1.2,
             "description": "time gap to an object, before and behind"}
        ],
    }  # fmt: skip
    store.take()
    assert answered(service, ListRequest())["in_force"] == 1


def test_set_revert_and_history_are_told_and_logged(service, caplog):
    with caplog.at_level("INFO", "xilgate.controller"):
        assert answered(service, b'{"op": "set", "changes": {"planner.safe_time_s": 2}, "who": "ann"}') == {
            "answer": "accepted", "version": 1, "changes": [{"name": SAFE_TIME, "old": 1.2, "new": 2.0}],
        }  # fmt: skip
        assert answered(service, RevertRequest(what="last", who="bob"))["changes"] == [{"name": SAFE_TIME, "old": 2.0, "new": 1.2}]
        assert answered(service, SetRequest(changes={SAFE_TIME: 99.0}, who="eve"))["answer"] == "refused"
    entries = answered(service, HistoryRequest())["entries"]
    told = [(entry["version"], entry["who"], entry["accepted_ns"], entry["reverts"]) for entry in entries]
    assert told == [(1, "ann", 77, []), (2, "bob", 77, [1])]
    assert [record.getMessage() for record in caplog.records] == [
        "parameters version 1 by ann: planner.safe_time_s 1.2 -> 2",
        "parameters version 2 by bob, takes back [1]: planner.safe_time_s 2 -> 1.2",
        "parameters refused: planner.safe_time_s = 99: from 0 to 5 s",
    ]


@pytest.mark.parametrize(
    "junk",
    [
        b"", b"\xff\x00", b"[]", b"{}", b"[" * 60_000, b'{"op": "drop"}', b'{"op": "set"}',
        b'{"op": "set", "changes": {"planner.safe_time_s": "2"}, "who": "x"}',
        b'{"op": "set", "changes": {"planner.safe_time_s": NaN}, "who": "x"}',
        b'{"op": "set", "changes": {"planner.safe_time_s": 1e999}, "who": "x"}',
        b'{"op": "revert", "what": "first", "who": "x"}', b'{"op": "revert", "what": 1.5, "who": "x"}',
        b'{"op": "get", "names": [1]}', b'{"op": "get", "names": ["planner.safe_time"]}',
    ],
)  # fmt: skip
def test_junk_is_refused_in_words_and_changes_nothing(service, store, junk):
    answer = answered(service, junk)
    assert answer["answer"] == "refused"
    assert all(reason and len(reason) < 300 for reason in answer["reasons"])
    assert store.newest is store.starting


@pytest.fixture
def served(service):
    """The service on ports of its own, without a controller behind it."""
    base_port = free_base_port()
    with Publisher(Source.CONTROLLER, base_port) as publisher:
        publisher.serve(SERVICE, service.answer)
        yield base_port


def test_over_zenoh(served, store):
    assert request(SetRequest(changes={SAFE_TIME: 1.8}, who="ann"), served) == Accepted(version=1, changes=store.newest.history[0].changes)
    assert isinstance(request(SetRequest(changes={SAFE_TIME: 9.0}, who="ann"), served), Refused)
    assert isinstance(values := request(ListRequest(), served), Values)
    assert len(values.parameters) == len(store.table)
    assert isinstance(trail := request(HistoryRequest(), served), History)
    assert trail.entries == list(store.newest.history)


def test_a_hundred_clients_at_once_get_one_version_each(served, store):
    def one(k):
        return request(SetRequest(changes={"planner.detection_range_m": 1.0 + k}, who=f"client {k}"), served)

    with ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(one, range(100)))
    assert sorted(answer.version for answer in answers) == list(range(1, 101))
    assert [entry.version for entry in store.newest.history] == list(range(1, 101))
    assert {entry.who for entry in store.newest.history} == {f"client {k}" for k in range(100)}


def test_a_huge_request_is_refused_unread(served, store):
    with pytest.raises(TelemetryError, match=str(MAX_REQUEST_BYTES)):
        ask(Source.CONTROLLER, SERVICE, b" " * (MAX_REQUEST_BYTES + 1), served)
    with pytest.raises(TelemetryError, match="Timeout"):  # longer still: not even received
        ask(Source.CONTROLLER, SERVICE, b" " * (1 << 25), served, timeout_s=0.5)
    assert isinstance(request(ListRequest(), served), Values)


def test_without_a_controller_the_client_says_so_in_one_line():
    with pytest.raises(TelemetryError, match="no controller on port") as caught:
        ask(Source.CONTROLLER, SERVICE, b"{}", free_base_port(), timeout_s=0.3)
    assert "\n" not in str(caught.value)


def test_a_process_that_does_not_serve_is_told_from_none():
    base_port = free_base_port()
    with Publisher(Source.CONTROLLER, base_port), pytest.raises(TelemetryError, match="serves no parameters"):
        ask(Source.CONTROLLER, SERVICE, b"{}", base_port, timeout_s=0.3)


class Feed(threading.Thread):
    """Plays the gateway: sends the state of a car at one place, 100 times a second, and counts the answers."""

    def __init__(self, control, path):
        super().__init__(daemon=True)
        self._control, self._path = control, path
        self.stop = threading.Event()
        self.commands = 0

    def run(self):
        path, seq = self._path, 0
        control = self._control
        with Channel(control.gateway_socket, control.controller_socket, control.key()) as channel:
            while not self.stop.wait(0.01):
                seq += 1
                channel.send(
                    VehicleState(1, seq, time.monotonic_ns(), Mode.READY, True, float(path.x_m[5]), float(path.y_m[5]),
                                 float(path.yaw_rad[5]), 60 / 3.6, 0.0, 0.0, 0.0, 0.0, 0.1)
                )  # fmt: skip
                self.commands += channel.newest(ControlCommand) is not None


@pytest.fixture
def controller(tmp_path, wavy_path, library):
    """A controller process that drives; its telemetry port, and the samples that it publishes."""
    wavy_path.to_csv(tmp_path / "path.csv")
    base_port, control = free_base_port(), control_path(tmp_path)
    samples = {"parameters": [], "command": []}
    feed = Feed(control, wavy_path)
    feed.start()
    process = start_xilgate(
        "controller", "--reference", str(tmp_path / "path.csv"), "--control", str(tmp_path),
        "--telemetry-port", str(base_port), "--solver", "casadi-c",
    )  # fmt: skip
    with Subscriber(lambda topic, payload: samples[topic].append(decode(topic, payload)), list(samples), base_port):
        wait_until(lambda: samples["command"], 60, "the first command")
        yield process, base_port, samples
        end(process)
    feed.stop.set()


def test_a_running_controller_is_tuned_and_tells_from_when_on(controller):
    process, base_port, samples = controller
    parameters, commands = samples["parameters"], samples["command"]
    # A client that is killed while it waits leaves nothing behind.
    victim = subprocess.Popen([sys.executable, "-c", f"from controller.tuning import *\nwhile True: request(ListRequest(), {base_port})"])
    assert request(SetRequest(changes={SAFE_TIME: 1.8, "ocp.input_bounds.t_r.min": -0.5}, who="ann"), base_port).version == 1
    wait_until(lambda: parameters, 10, "the change on the topic")
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    assert request(RevertRequest(what="all", who="bob"), base_port).version == 2
    wait_until(lambda: len(parameters) == 2 and commands[-1].parameters_version == 2, 10, "the revert in force")
    with contextlib.suppress(TelemetryError):
        ask(Source.CONTROLLER, SERVICE, b"x" * (1 << 22), base_port, timeout_s=0.2)
    assert isinstance(values := request(GetRequest(names=[SAFE_TIME]), base_port), Values)
    assert (values.version, values.in_force, values.parameters[0].value) == (2, 2, 1.2)
    first = parameters[0]
    assert isinstance(first, ParametersSample)
    assert (first.version, first.who, [change.name for change in first.changes]) == (1, "ann", [SAFE_TIME, "ocp.input_bounds.t_r.min"])
    # Every command says with which version it was made, and the topic from which cycle on that was.
    assert all(isinstance(command, CommandSample) for command in commands)
    for sample in parameters:
        assert sample.t_ns >= sample.accepted_ns
        made_with = [command.parameters_version for command in commands if command.t_ns == sample.t_ns]
        assert made_with == [sample.version]
    end(process)
    assert "parameters version 1 by ann: planner.safe_time_s 1.2 -> 1.8" in process.stdout.read()
