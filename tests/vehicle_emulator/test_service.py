"""Requests to a running emulator: prepared where they come in, done at the edge of a step, refused in one line."""

import json
import threading
import time
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbc.catalogue import load
from dbc.errors import UserMistake
from vehicle_emulator import service as service_module
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.operations import fault_operations
from vehicle_emulator.plants.interface import PlantState
from vehicle_emulator.service import EmulatorService

CATALOGUE = load()
SITUATION = Situation(PlantState(), is_engaged=False)


class Car:
    """A service with the operations of the faults and one of its own, and the thread that steps."""

    def __init__(self):
        self.engine = FaultEngine([], 1, 0, CATALOGUE)
        self.threads = []
        self.service = EmulatorService({**fault_operations(self.engine, CATALOGUE), "lift": self._lift})
        self.now_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="car")

    def _lift(self, arguments):
        def action(now_ns):
            self.threads.append(threading.current_thread().name)
            if now_ns < 0 or arguments.get("is_moving"):
                raise UserMistake("the car cannot be raised:\na wheel turns")
            return {"lifted": True}

        return action

    def _run(self):
        while not self._stop.wait(0.001):
            self.now_ns += 1_000_000
            self.service.run_due(self.now_ns)
            self.engine.update(self.now_ns, SITUATION)

    def ask(self, op, **arguments):
        return json.loads(self.service.answer(json.dumps({"op": op, "arguments": arguments}).encode()))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


@pytest.fixture
def car():
    with Car() as running:
        yield running


def test_add_list_clear(car):
    added = car.ask("fault_add", kind="gust", push_n=3000)
    assert added["answer"] == "done"
    assert [(fault["name"], fault["fault"]) for fault in added["result"]] == [("gust", "gust push_n=3000")]
    assert car.ask("fault_add", kind="gust", push_n=1, from_s=100)["result"][0]["name"] == "gust-2"
    listed = car.ask("fault_list")["result"]
    assert [(fault["name"], fault["state"], fault["hits"]) for fault in listed] == [("gust", "active", 0), ("gust-2", "waiting", 0)]
    assert [fault["name"] for fault in car.ask("fault_clear", name="gust")["result"]] == ["gust"]
    assert [fault["name"] for fault in car.ask("fault_clear")["result"]] == ["gust-2"]
    assert car.ask("fault_list")["result"] == []


@pytest.mark.parametrize(
    ("op", "arguments", "reason"),
    [
        ("fault_add", {"kind": "gust"}, "push_n: missing; allowed: -20000 to 20000 N"),
        ("fault_add", {"kind": "drop", "messages": "SRS"}, "fault drop: messages = 'SRS': allowed: "),
        ("fault_add", {"kind": "gust", "push_n": 1, "name": "a\nb"}, "name = 'a\\nb': allowed"),
        ("fault_add", {"kind": "drop", "messages": "SR", "x\ny": 1}, "x"),
        ("fault_list", {"all": True}, "all: unknown key; allowed: none"),
        ("fault_clear", {"name": "x"}, "fault 'x' is unknown; known: there is none"),
        ("fault_clear", {"name": 3}, "name = 3: allowed: the name of a fault"),
        ("fault_clear", {"all": True}, "all: unknown key; allowed: name"),
        ("explode", {}, "op = 'explode': allowed: fault_add, fault_clear, fault_list, lift"),
        ("lift", {"is_moving": True}, "the car cannot be raised:; a wheel turns"),
        ("fault_add", {"kind": "k" * 50_000}, "kind = 'kkk"),
    ],
)
def test_what_is_refused_is_told_in_one_short_line(car, op, arguments, reason):
    answer = car.ask(op, **arguments)
    assert answer["answer"] == "refused"
    assert answer["reason"].startswith(reason)
    assert "\n" not in answer["reason"]
    assert len(answer["reason"]) <= 1_000
    assert car.engine.faults == []


def test_operations_are_done_by_the_thread_of_the_car(car):
    assert car.ask("lift") == {"answer": "done", "result": {"lifted": True}}
    assert car.threads == ["car"]


@given(st.binary(max_size=200) | st.text(alphabet='{}[]":,op arguments1e9null', max_size=60).map(str.encode))
def test_anything_gets_an_answer(payload):
    assert json.loads(EmulatorService({}).answer(payload))["answer"] == "refused"


DEEP = b'{"op":"x","arguments":'


@pytest.mark.parametrize("payload", [DEEP + b'{"a":' * 9_999, DEEP + b'{"a":' + b"[" * 60_000, b'{"op":1}', b"\xff", b""])
def test_what_is_no_request_is_refused(payload):
    assert json.loads(EmulatorService({}).answer(payload))["reason"].startswith("not a request: ")


def test_a_car_that_does_not_step_does_nothing_later_either(monkeypatch):
    monkeypatch.setattr(service_module, "PATIENCE_S", 0.01)
    car = Car()
    assert car.ask("fault_add", kind="gust", push_n=1)["reason"] == "the emulator has not stepped for 0.01 s; nothing was done"
    car.service.run_due(1)
    assert car.engine.faults == []


def test_one_step_does_one_thing():
    car = Car()
    askers = [threading.Thread(target=car.ask, args=("fault_add",), kwargs={"kind": "gust", "push_n": k}) for k in (1, 2, 3)]
    for asker in askers:
        asker.start()
    sizes = [0]
    while sizes[-1] < 3:
        time.sleep(0.001)
        car.service.run_due(1)
        sizes.append(len(car.engine.faults))
    for asker in askers:
        asker.join()
    assert {after - before for before, after in pairwise(sizes)} <= {0, 1}


def test_a_crowd_is_sent_away(monkeypatch):
    monkeypatch.setattr(service_module, "_MAX_WAITING", 0)
    assert Car().ask("lift")["reason"] == "0 requests wait already; ask again"
