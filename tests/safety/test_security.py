"""Security of the whole: who can command, what can leave, what is pinned, and what of others' text reaches a terminal."""

import ast
import io
import json
import logging
import random
import re
import socket
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.parameters import ParameterStore
from controller.planning.options import PlannerOptions
from controller.problem import OcpOptions
from controller.tuning import TuningService
from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load
from dbc.frame import CanFrame
from gateway.channel import OperatorServer
from gateway.logs import JsonFormatter, PlainFormatter
from gateway.messages import Mode, Operation, OperatorRequest, pack, unpack
from gateway.transmit import DIAGNOSTIC_IDS, TransmitGate
from tests.support.drive import GatewayDrive
from tests.support.processes import xilgate
from vehicle_emulator.service import EmulatorService

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("dbc", "gateway", "controller", "vehicle_emulator", "visualiser", "xil")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
KEY = bytes(range(32))
FUZZED = settings(max_examples=5_000, deadline=None)


# S2: one source of commands, and nothing that was recorded acts again


@pytest.mark.req("S2", "F5")
def test_the_first_controller_commands_until_standby_and_then_another_may():
    drive = GatewayDrive().engage()
    drive.tick(100)
    mine = drive.core.commands.newest
    drive.command_boot_id = 8
    drive.tick(2)
    assert drive.core.commands.newest.boot_id == mine.boot_id == 7
    drive.tick(60)  # only the second one speaks: the first is silent, and three strangers in a row end the drive
    assert drive.core.mode is Mode.SAFE_STOP
    assert drive.core.commands.newest.boot_id == 7
    drive.car.vx_mps = 0.0
    drive.tick(50)
    drive.ask(Operation.RESET)
    drive.tick(10)
    assert drive.core.mode is Mode.STANDBY
    assert drive.core.commands.newest.boot_id == 8


@pytest.mark.req("S2", "F5")
def test_commands_of_a_second_controller_beside_the_first_never_act():
    drive = GatewayDrive().engage()
    demands = set()
    for k in range(200):
        drive.now_ns += 10_000_000
        first = replace(drive.command(), seq=1000 + k)
        second = replace(first, boot_id=8, steer_rad=0.3, plan_steer_rad=(0.3,) * 30)
        output = drive.core.step(drive.now_ns, drive.car.speak(drive.now_ns), second if k % 2 else first)
        drive.car.hear(output.frames)
        demands.add(drive.car.told["SR_Command"]["AngleCommand"])
    assert max(map(abs, demands)) < 1.0
    assert drive.core.commands.rejected["second sender"] == 100


@pytest.mark.req("S2")
@pytest.mark.parametrize("after_ticks", [1, 20, 99, 101, 1_000])
def test_a_recorded_request_never_acts_again(after_ticks):
    """The same bytes, signed with the right key, of the same operator, at any later time."""
    drive = GatewayDrive()
    drive.tick(210)
    recorded = pack(OperatorRequest(9, 1, Operation.ARM, drive.now_ns), KEY)
    drive._to_send = unpack(recorded, KEY)
    drive.tick(2)
    assert drive.core.mode is Mode.READY
    drive.car.override = 1
    drive.tick(2)
    drive.car.override = 0
    assert drive.core.mode is Mode.STANDBY
    drive.tick(after_ticks)
    drive._to_send = unpack(recorded, KEY)
    drive.tick(1)
    assert drive.output.reply.refusals != ()
    drive.tick(5)
    assert drive.core.mode is Mode.STANDBY
    drive.ask(Operation.DISENGAGE)  # one that nobody has sent yet is looked at as always
    drive.tick(1)
    assert drive.output.reply.operation is Operation.DISENGAGE


@pytest.mark.req("S2")
@pytest.mark.parametrize("operation", [operation for operation in Operation if operation is not Operation.STOP])
def test_two_requests_and_the_first_again(operation):
    drive = GatewayDrive()
    drive.tick(5)
    first = OperatorRequest(1, 1, operation, drive.now_ns)
    for request in (first, OperatorRequest(2, 1, operation, drive.now_ns + 1), first):
        drive._to_send = request
        drive.tick(1)
    assert any("repeated" in refusal or "old" in refusal for refusal in drive.output.reply.refusals), drive.output.reply


@pytest.mark.req("S2")
def test_a_recorded_stop_does_nothing_but_stop():
    drive = GatewayDrive().engage()
    recorded = OperatorRequest(1, 1, Operation.STOP, drive.now_ns)
    for _ in range(3):
        drive._to_send = recorded
        drive.tick(20)
        assert drive.core.mode is Mode.COMFORT_STOP


@pytest.mark.req("S2")
def test_a_request_of_before_the_start_or_of_the_future_does_not_act():
    for offset_ns in (-10_000_000_000, -10_000_001, 10_000_001, 10**18):
        drive = GatewayDrive()
        drive._to_send = OperatorRequest(9, 1, Operation.RESET, drive.now_ns + 10_000_000 + offset_ns)
        drive.tick(1)
        assert drive.output.reply.refusals != (), offset_ns
        assert drive.core.mode is Mode.SILENT


@pytest.mark.req("S2")
def test_the_reply_goes_to_whoever_asked_and_carries_his_number(tmp_path):
    """From the wire through the core and back, with a datagram that somebody else plays again."""
    drive = GatewayDrive()
    drive.tick(210)
    path = str(tmp_path / "operator")
    with OperatorServer(Path(path), KEY) as server, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as operator:
        operator.bind("")
        operator.settimeout(5.0)
        recorded = pack(OperatorRequest(9, 5, Operation.ARM, drive.now_ns), KEY)
        answers = []
        for _ in range(2):
            operator.sendto(recorded, path)
            drive._to_send = server.next_request()
            drive.tick(1)
            server.reply(drive.output.reply)
            answers.append(unpack(operator.recv(2048), KEY))
    assert [(answer.boot_id, answer.seq, answer.operation) for answer in answers] == [(9, 5, Operation.ARM)] * 2
    assert answers[0].refusals == ()
    assert answers[1].refusals != ()


# S3: no code in data

FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal", "yaml", "ruamel", "joblib", "code", "codeop"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_FUNCTIONS = {"os.system", "os.popen", "tempfile.mktemp", "ctypes.pythonapi"}
FORBIDDEN_SWITCHES = {"shell", "allow_pickle"}


def dangers(source):
    """What in a source would run, or might run, what comes from outside; by line."""
    found = []
    for node in ast.walk(ast.parse(source)):
        names = []
        match node:
            case ast.Import(names=aliases):
                names = [alias.name for alias in aliases if alias.name.split(".")[0] in FORBIDDEN_MODULES]
            case ast.ImportFrom(module=str(module)) if module.split(".")[0] in FORBIDDEN_MODULES:
                names = [module]
            case ast.Call(func=ast.Name(id=name)) if name in FORBIDDEN_CALLS:
                names = [name]
            case ast.Attribute(value=ast.Name(id=module), attr=name) if f"{module}.{name}" in FORBIDDEN_FUNCTIONS:
                names = [f"{module}.{name}"]
            case ast.keyword(arg=str(name), value=value) if name in FORBIDDEN_SWITCHES:
                names = [] if isinstance(value, ast.Constant) and not value.value else [name]
        found += [(node.lineno if hasattr(node, "lineno") else 0, name) for name in names]
    return found


@pytest.mark.req("S3")
@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_that_is_read_is_ever_run(path):
    assert dangers(path.read_text(encoding="utf-8")) == []


@pytest.mark.req("S3")
@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import pickle", ["pickle"]),
        ("def f():\n    from yaml import safe_load", ["yaml"]),
        ("import numpy, marshal as m", ["marshal"]),
        ("eval('1')", ["eval"]),
        ("exec(text)", ["exec"]),
        ("import os\nos.system('ls')", ["os.system"]),
        ("subprocess.run('ls', shell=True)", ["shell"]),
        ("subprocess.run('ls', shell=is_it)", ["shell"]),
        ("numpy.load(f, allow_pickle=True)", ["allow_pickle"]),
        ("import re\nre.compile('x')\nevaluate(1)\nsolver.eval(2)\nsubprocess.run(['ls'], shell=False)", []),
    ],
)
def test_what_would_run_is_found(source, names):
    assert [name for _, name in dangers(source)] == names


@pytest.fixture(scope="module")
def tuning():
    return TuningService(ParameterStore(OcpOptions(), PlannerOptions()))


OPERATIONS = (b"list", b"get", b"set", b"revert", b"history", b"add", b"clear", b"lift")
WORDS = (
    *(b'"names":', b'"changes":', b'"who":', b'"what":', b'"arguments":', b'"planner.safe_time_s":'),
    *(b"[", b"]", b"{", b"}", b",", b'"a"', b"1", b"1e999", b"-0", b"null", b"true", b'"\\ud800"'),
)


@pytest.mark.req("S3")
@FUZZED
@given(choices=st.binary(min_size=1, max_size=12))
def test_whatever_is_asked_of_a_service_gets_an_answer(tuning, choices):
    words = [WORDS[choice % len(WORDS)] for choice in choices[1:]]
    payload = b'{"op":"' + OPERATIONS[choices[0] % len(OPERATIONS)] + b'",' + b"".join(words) + b"}"
    assert json.loads(tuning.answer(payload))["answer"] in {"refused", "values", "history", "accepted"}
    assert json.loads(EmulatorService({}).answer(payload))["answer"] == "refused"


@pytest.mark.req("S3")
@FUZZED
@given(payload=st.binary(max_size=60))
def test_whatever_is_sent_to_a_service_gets_an_answer(tuning, payload):
    assert json.loads(tuning.answer(payload))["answer"] == "refused"
    assert json.loads(EmulatorService({}).answer(payload))["answer"] == "refused"


@pytest.mark.req("S3")
@pytest.mark.parametrize("depth", [1_000, 30_000])
@pytest.mark.parametrize("opening", [b"[", b'{"a":'])
def test_no_depth_of_nesting_breaks_a_service(tuning, depth, opening):
    payload = b'{"op":"list","extra":' + opening * depth
    for service in (tuning, EmulatorService({})):
        assert json.loads(service.answer(payload))["answer"] == "refused"


# S4: no diagnosis


@pytest.mark.req("S4", "G2")
@pytest.mark.parametrize("mode", list(Mode))
def test_no_diagnostic_request_leaves_in_any_mode(mode):
    """OBD and UDS: functional and physical requests and answers, with 11 and 29 bits (ISO 15765-4)."""
    gate = TransmitGate(load())
    rng = random.Random(4)
    long_ids = [kind << 16 | rng.getrandbits(16) for kind in (0x18DA, 0x18DB) for _ in range(2_000)]
    frames = [
        CanFrame(arbitration_id, bytes(rng.getrandbits(8) for _ in range(length)), 0)
        for arbitration_id in [*DIAGNOSTIC_IDS, *long_ids]
        for length in (0, 2, 8)
    ]
    assert gate.admit(0, mode, frames) == []
    assert gate.rejected.total() == len(frames)


@pytest.mark.req("S4")
def test_the_catalogue_names_no_diagnostic_id():
    assert {0x7DF, 0x7E0, 0x7E8, 0x7EF} <= DIAGNOSTIC_IDS
    assert not DIAGNOSTIC_IDS & set(load().by_id)


@pytest.mark.req("S4")
@pytest.mark.parametrize("arbitration_id", [0x7DF, 0x7E0, 0x7E7, 0x7EF])
def test_a_site_cannot_make_the_gateway_send_diagnosis(tmp_path, arbitration_id):
    text = ROBOTS_DBC.read_text(encoding="utf-8")
    heartbeat = load().by_name["GW_Heartbeat"].arbitration_id
    site = tmp_path / "site.dbc"
    site.write_text(re.sub(rf"\b{heartbeat}\b", str(arbitration_id), text), encoding="utf-8")
    with pytest.raises(CatalogueError, match=rf"GW_Heartbeat \(id 0x{arbitration_id:X}\).* are for diagnosis"):
        TransmitGate(load([site, GNSS_IMU_DBC]))


@pytest.mark.req("S4")
def test_a_site_cannot_use_long_ids_at_all(tmp_path):
    site = tmp_path / "site.dbc"
    heartbeat = load().by_name["GW_Heartbeat"].arbitration_id
    text = ROBOTS_DBC.read_text(encoding="utf-8")
    site.write_text(re.sub(rf"\b{heartbeat}\b", str(0x18DAF110 | 1 << 31), text), encoding="utf-8")
    with pytest.raises(CatalogueError, match="only classical frames with an 11-bit identifier"):
        load([site, GNSS_IMU_DBC])


# S6: what is installed is what was looked at


def locked(path):
    """Requirements of a lock file: what each says, and its hashes."""
    text = re.sub(r"\\\n\s*", " ", path.read_text(encoding="utf-8"))
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    return {line.partition(" ")[0]: re.findall(r"--hash=sha256:[0-9a-f]{64}\b", line) for line in lines}


LOCKS = sorted(ROOT.glob("requirements*.lock"))


@pytest.mark.req("S6")
@pytest.mark.parametrize("path", LOCKS, ids=lambda path: path.name)
def test_every_dependency_is_pinned_with_hashes(path):
    requirements = locked(path)
    assert requirements
    for requirement, hashes in requirements.items():
        assert re.fullmatch(r"[A-Za-z0-9._-]+(\[[a-z,]+\])?==[^;=\s]+", requirement), requirement
        assert hashes, requirement


@pytest.mark.req("S6")
def test_the_locks_hold_all_that_the_project_asks_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

    def names(requirements):
        return {re.match(r"[A-Za-z0-9._-]+", requirement)[0].lower() for requirement in requirements}

    assert {path.name for path in LOCKS} >= {"requirements.lock", "requirements-dev.lock"}
    assert names(project["dependencies"]) <= names(locked(ROOT / "requirements.lock"))
    assert names(project["optional-dependencies"]["dev"]) <= names(locked(ROOT / "requirements-dev.lock"))


@pytest.mark.req("S6")
def test_the_set_up_installs_nothing_else():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    installs = [line for line in makefile.splitlines() if ("pip" in line.lower() and " install" in line) or "$(INSTALL)" in line]
    assert installs
    for line in installs:
        assert "--require-hashes" in line or "--no-index" in line or "$(INSTALL) -r" in line, line


# S7: text of others

HOSTILE = "x\nCRITICAL forged line\r\x1b]0;owned\x07\x1b[2J\u2028\x85y"


def logged(formatter, *arguments, **extra):
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter)
    handler.handle(logging.getLogger("test").makeRecord("test", logging.INFO, "f", 1, *arguments, None, extra=extra or None))
    return stream.getvalue()


@pytest.mark.req("S7")
def test_no_text_makes_lines_of_its_own_or_commands_a_terminal():
    for message, arguments in ((HOSTILE, ()), ("mode: %s", (HOSTILE,)), ("%(name)s", ({"name": HOSTILE},))):
        for line in (logged(PlainFormatter(), message, arguments), logged(JsonFormatter("gateway"), message, arguments, cause=HOSTILE)):
            assert line.endswith("\n")
            assert line[:-1].isprintable(), line
            assert "x" in line
            assert "y" in line


@pytest.mark.req("S7")
def test_a_command_line_error_escapes_what_it_quotes(tmp_path):
    """A name in a file of somebody else, told on the terminal."""
    site = tmp_path / "site.dbc"
    text = ROBOTS_DBC.read_text(encoding="utf-8")
    site.write_text(text.replace("BO_ 160 GW_SafetyCommand", "BO_ 160 GW_\x1b[2JSafety"), encoding="utf-8")
    finished = xilgate("dbc", "list", "--dbc", str(site))
    assert finished.returncode == 2
    assert "\x1b" not in finished.stderr + finished.stdout
    assert "Traceback" not in finished.stderr


@pytest.mark.req("S7")
@pytest.mark.parametrize(
    "arguments",
    [
        ["operate", "stop", "--control", "/nowhere/\x1b[2Jx"],
        ["gateway", "--rig", "/nowhere/\x1b[2Jx.toml"],
        ["drive", "\x1b[2Jx"],
        ["params", "set", "\x1b[2Jx=1", "--telemetry-port", "1900"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_mistakes_are_told_without_escape_sequences(arguments):
    finished = xilgate(*arguments)
    assert finished.returncode in (2, 3)
    assert "\x1b[2J" not in finished.stderr + finished.stdout
    assert "Traceback" not in finished.stderr


@pytest.mark.req("S7")
def test_daemons_of_the_bench_escape_as_well():
    code = (
        "import logging, sys, types\n"
        "from xil.cli_common import run_daemon\n"
        "module = types.ModuleType('fake')\n"
        "module.run = lambda options, stop: logging.getLogger('x').info('fault %s', 'a\\nb\\x1b[2J')\n"
        "sys.modules['fake'] = module\n"
        "run_daemon('fake', lambda m: None)\n"
    )
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True, cwd=ROOT)
    (line,) = finished.stderr.splitlines()
    assert line.endswith(r"fault a\nb\x1b[2J")
