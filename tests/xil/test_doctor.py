"""The doctor: true findings, advice for every gap and none otherwise, nothing changed by looking."""

import io
import json
import os
import resource
import socket
from pathlib import Path

import pytest
from rich.console import Console

from xil.doctor import Check, as_data, as_table, checks

NAMES = [
    "C compiler",
    "processor cores",
    "SocketCAN",
    "interface vcan0",
    "interface vcan1",
    "interface can0",
    "interface can1",
    "real-time priority",
    "memory locking",
    "processor for control",
    "real-time kernel",
    "browser",
]


def program(path: Path) -> str:
    path.write_text("#!/bin/sh\necho compiler 1.0\n", encoding="ascii")
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def empty_path(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    return tmp_path


def named(name: str) -> Check:
    return next(check for check in checks() if check.name == name)


def test_every_check_says_what_was_found_and_advises_exactly_on_gaps():
    results = checks()
    assert [check.name for check in results] == NAMES
    for check in results:
        assert check.found, check.name
        assert bool(check.advice) is not check.is_ok, check.name
    assert [check.name for check in results if check.is_required] == ["C compiler"]


def test_looking_changes_nothing():
    def state():
        limits = [resource.getrlimit(limit) for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK)]
        policies = {task.name: os.sched_getscheduler(int(task.name)) for task in Path("/proc/self/task").iterdir()}
        return limits, policies, os.sched_getaffinity(0)

    before = state()
    checks()
    assert state() == before


def test_the_compiler_is_the_one_that_builds_take(empty_path):
    program(empty_path / "gcc")
    assert named("C compiler") == Check("C compiler", True, "gcc (compiler 1.0)", "", True)


def test_no_compiler(empty_path, monkeypatch):
    monkeypatch.setattr("dbc.build.importlib.util.find_spec", lambda name: None)
    check = named("C compiler")
    assert (check.is_ok, check.found) == (False, "none")
    assert check.advice.startswith("no C compiler found: install gcc or clang, or `pip install ziglang`")


def test_a_compiler_of_the_users_that_does_not_run(empty_path, monkeypatch):
    monkeypatch.setenv("CC", "nosuch-cc")
    check = named("C compiler")
    assert (check.is_ok, check.found) == (False, "none")
    assert check.advice.startswith("the compiler in $CC does not run: nosuch-cc; ")


def test_socketcan_agrees_with_the_kernel():
    expected = (True, "AF_CAN sockets open")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        expected = (False, os.strerror(error.errno))
    assert (named("SocketCAN").is_ok, named("SocketCAN").found) == expected


def test_realtime_priority_refused(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("dbc.realtime.os.sched_setscheduler", refuse)
    check = named("real-time priority")
    assert not check.is_ok
    assert check.found.startswith("SCHED_FIFO 60 refused, rtprio limit ")
    assert "LimitRTPRIO=60" in check.advice


def test_realtime_priority_is_that_of_the_gateway(monkeypatch):
    asked = []
    monkeypatch.setattr("dbc.realtime.os.sched_setscheduler", lambda _, __, parameter: asked.append(parameter.sched_priority))
    assert named("real-time priority").is_ok
    assert asked == [60]  # a limit below it would let a test with the lowest priority pass


@pytest.mark.parametrize(
    ("text", "finding"), [("1-3\n", (True, "isolated: 1-3")), ("\n", (False, "none isolated")), (None, (False, "none isolated"))]
)
def test_processor_for_control(monkeypatch, tmp_path, text, finding):
    path = tmp_path / "isolated"
    monkeypatch.setattr("xil.doctor._SYS_ISOLATED", path)
    if text is not None:
        path.write_text(text, encoding="ascii")
    check = named("processor for control")
    assert (check.is_ok, check.found) == finding


@pytest.mark.parametrize(
    ("limit", "capabilities", "finding"),
    [
        (resource.RLIM_INFINITY, "0000000000000000", (True, "unlimited")),
        (8 << 20, "0000000000004000", (True, "unlimited")),
        (8 << 20, "000001ffffffbfff", (False, "limit 8192 KiB")),
    ],
)
def test_memory_locking(monkeypatch, tmp_path, limit, capabilities, finding):
    status = tmp_path / "status"
    status.write_text(f"Name:\tpython\nCapEff:\t{capabilities}\n", encoding="ascii")
    monkeypatch.setattr("xil.doctor._PROC_STATUS", status)
    monkeypatch.setattr("xil.doctor.resource.getrlimit", lambda _: (limit, limit))
    check = named("memory locking")
    assert (check.is_ok, check.found) == finding


def test_realtime_kernel(monkeypatch, tmp_path):
    flag = tmp_path / "realtime"
    monkeypatch.setattr("xil.doctor._SYS_REALTIME", flag)
    kernel = os.uname_result(("Linux", "host", "6.1.0-9-amd64", "#1 SMP PREEMPT_DYNAMIC", "x86_64"))
    monkeypatch.setattr("xil.doctor.os.uname", lambda: kernel)
    assert not named("real-time kernel").is_ok
    flag.write_text("1\n", encoding="ascii")
    assert named("real-time kernel").found == "6.1.0-9-amd64 PREEMPT_RT"


def test_too_few_cores(monkeypatch):
    monkeypatch.setattr("xil.doctor.os.sched_getaffinity", lambda _: {0})
    check = named("processor cores")
    assert (check.is_ok, check.found) == (False, "1")


def test_browser(empty_path):
    assert not named("browser").is_ok
    firefox = program(empty_path / "firefox")
    assert named("browser").found == firefox


def test_rendering():
    results = [Check("one", True, "[x]", ""), Check("two", False, "none", "do [this]"), Check("three", False, "none", "do that", True)]
    assert json.loads(json.dumps(as_data(results)))[1] == {
        "name": "two",
        "is_ok": False,
        "found": "none",
        "advice": "do [this]",
        "is_required": False,
    }
    output = io.StringIO()
    Console(file=output, width=100, color_system=None).print(as_table(results))
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.getvalue().splitlines() if line.startswith("│")]
    assert rows == [["ok", "one", "[x]", ""], ["limited", "two", "none", "do [this]"], ["missing", "three", "none", "do that"]]
