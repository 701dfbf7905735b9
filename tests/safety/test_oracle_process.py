"""The bus oracle as a process of its own: it hears an emulated bus, is told what happens, and prints what must not be."""

import json
import subprocess
import sys
import time

import can
import pytest

from tests.support.oracle_wire import Wire
from tests.vehicle_emulator.bus.conftest import runtime_directory, serving  # noqa: F401

WIRE = Wire()
NEUTRAL = {"SR_Command": {"Mode": "Standby"}, "AR_Command": {"Mode": "Standby"}, "BR_Command": {"Mode": "Standby"}}


class Listening:
    """An oracle that listens, and a gateway that is played by the test."""

    def __init__(self, *options):
        self._oracle = subprocess.Popen(
            [sys.executable, "-m", "tests.support.oracle_process", "--bus", "robots=xilgate:robots", *options],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        assert json.loads(self._oracle.stdout.readline()) == {"listening": ["robots=xilgate:robots"]}
        self._bus = can.Bus(interface="xilgate", channel="robots")
        self._counter = 0

    def tell(self, **what):
        self._oracle.stdin.write(json.dumps({"t_ns": time.monotonic_ns(), **what}) + "\n")
        self._oracle.stdin.flush()

    def speak(self, edit=lambda data: data, **safety):
        """One tick of a gateway that has disarmed the robots."""
        self._counter += 1
        messages = {"GW_SafetyCommand": {"SystemRequest": "Disarm", **safety}, **NEUTRAL}
        for name, values in messages.items():
            data = edit(WIRE.by_name[name].compose(values, self._counter))
            self._bus.send(can.Message(arbitration_id=WIRE.by_name[name].arbitration_id, is_extended_id=False, data=data))
        time.sleep(0.01)

    def end(self):
        """Exit code, and what it has said."""
        time.sleep(0.1)
        output, _ = self._oracle.communicate(timeout=60)
        self._bus.shutdown()
        return self._oracle.returncode, [json.loads(line) for line in output.splitlines()]


@pytest.fixture
def served():
    with serving("robots"):
        yield


def test_a_gateway_that_does_as_it_should_is_passed(served):
    oracle = Listening()
    oracle.tell(request="RESET")
    for _ in range(20):
        oracle.speak()
    assert oracle.end() == (0, [])


def test_a_violation_is_printed_and_makes_the_exit_code(served):
    oracle = Listening()
    oracle.tell(request="RESET")
    oracle.speak()
    oracle.speak(edit=lambda data: bytes([data[0] ^ 1]) + data[1:])
    oracle.speak()
    code, said = oracle.end()
    assert code == 1
    assert {line["violation"] for line in said} == {"crc"}
    assert {line["detail"] for line in said} == {"GW_SafetyCommand", *NEUTRAL}


def test_what_was_not_asked_for_is_a_violation_unless_nobody_tells(served):
    oracle = Listening()
    oracle.speak()
    code, said = oracle.end()
    assert (code, [line["violation"] for line in said]) == (1, ["unasked"])
    oracle = Listening("--requests-untold")
    oracle.speak()
    assert oracle.end() == (0, [])


def test_a_bus_that_is_not_there_is_a_set_up_that_failed():
    run = subprocess.run(
        [sys.executable, "-m", "tests.support.oracle_process", "--bus", "robots=xilgate:nowhere"],
        capture_output=True, text=True, timeout=60, check=False,
    )
    assert run.returncode == 3
    assert run.stderr.startswith("oracle: a bus does not open: no hub serves")
