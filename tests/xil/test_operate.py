"""`xilgate operate` and `make-key` against a gateway process: every answer, and everybody who gets none."""

import json
import os
import stat
import tempfile
from pathlib import Path

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.vehicle import FOCUS
from tests.support.processes import end, free_base_port, start_xilgate, wait_until, xilgate
from vehicle_emulator.bus.channel import is_served

OPERATIONS = ("arm", "engage", "disengage", "stop")


@pytest.fixture(scope="module")
def rig():
    """Rig file of a running gateway that hears nobody: no robots, no navigation, no controller."""
    channel = f"operate-{os.getpid()}"
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        file = Path(directory) / "rig.toml"
        file.write_text(
            f'name = "test"\nprofile = "bench"\nbuses.robots = "xilgate:{channel}"\n'
            f'car = {{ dbc = ["{ROBOTS_DBC}", "{GNSS_IMU_DBC}"], vehicle = "{FOCUS}" }}\n'
            f'control = {{ directory = "{directory}", key = "rig.key" }}\ntelemetry.base_port = {free_base_port()}\n'
        )
        assert xilgate("make-key", str(file.parent / "rig.key")).returncode == 0
        hub = start_xilgate("bus", channel)
        wait_until(lambda: is_served(channel), 20, "the bus")
        gateway = start_xilgate("gateway", "--rig", str(file))
        try:
            wait_until((file.parent / "operator.sock").exists, 30, "the gateway")
            assert xilgate("operate", "stop", "--rig", str(file)).returncode == 1  # it steps: what was asked before does not act
            yield file
        finally:
            end(gateway)
            end(hub)


def operate(*arguments):
    finished = xilgate("operate", *arguments)
    assert "Traceback" not in finished.stderr
    return finished


@pytest.mark.req("E2")
@pytest.mark.parametrize("operation", ["arm", "engage"])
def test_every_unmet_condition_is_told_in_a_line_of_its_own(rig, operation):
    finished = operate(operation, "--rig", str(rig))
    assert finished.returncode == 1, finished.stderr
    lines = finished.stdout.splitlines()
    assert lines
    assert all(line.startswith("refused: ") for line in lines)
    if operation == "arm":
        assert len(lines) > 5
        assert any("PosLocal" in line for line in lines)
        assert any("controller" in line for line in lines)


def test_a_granted_request_tells_the_mode_after_it(rig):
    finished = operate("reset", "--rig", str(rig))
    assert (finished.returncode, finished.stdout) == (0, "granted: STANDBY\n"), finished.stderr
    finished = operate("reset", "--rig", str(rig), "--json")  # nothing is left to be reset
    assert finished.returncode == 1
    assert json.loads(finished.stdout) == {
        "operation": "reset", "granted": False, "mode": "STANDBY", "refusals": ["not possible in STANDBY"],
    }  # fmt: skip


@pytest.mark.parametrize("operation", OPERATIONS)
def test_programs_get_one_object(rig, operation):
    finished = operate(operation, "--rig", str(rig), "--json")
    answer = json.loads(finished.stdout)
    assert answer.keys() == {"operation", "granted", "mode", "refusals"}
    assert answer["operation"] == operation
    assert finished.returncode == (0 if answer["granted"] else 1)
    assert answer["granted"] is (answer["refusals"] == [])


@pytest.mark.req("S1", "S2")
def test_who_has_another_key_gets_no_answer_and_changes_nothing(rig, tmp_path):
    xilgate("make-key", str(tmp_path / "key"))
    before = json.loads(operate("disengage", "--rig", str(rig), "--json").stdout)["mode"]
    finished = operate("reset", "--control", str(rig.parent), "--key", str(tmp_path / "key"))
    assert finished.returncode == 3
    assert "another key" in finished.stderr
    assert json.loads(operate("disengage", "--rig", str(rig), "--json").stdout)["mode"] == before


@pytest.mark.req("S1")
def test_the_sockets_of_a_gateway_let_no_others_in(rig):
    for name in ("gateway.sock", "operator.sock"):
        assert stat.S_IMODE((rig.parent / name).stat().st_mode) & 0o007 == 0


def test_settings_beside_a_rig_file_are_refused(rig):
    for command in (["operate", "stop"], ["controller", "--reference", "path.csv"]):
        finished = xilgate(*command, "--rig", str(rig), "--control", "/tmp")
        assert finished.returncode == 2
        assert finished.stderr == "xilgate: --control: not beside --rig; write it into the rig file\n"


def test_a_key_is_not_replaced(tmp_path):
    assert xilgate("make-key", str(tmp_path / "key")).stdout == f"{tmp_path}/key: new key\n"
    before = (tmp_path / "key").read_bytes()
    finished = xilgate("make-key", str(tmp_path / "key"))
    assert finished.returncode == 2
    assert "there is a key already" in finished.stderr
    assert (tmp_path / "key").read_bytes() == before
