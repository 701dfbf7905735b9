"""The daemon as systemd would run it: real processes on the emulated buses."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.vehicle import FOCUS
from gateway.channel import Channel, OperatorClient, control_path
from gateway.daemon import _heed_signals
from gateway.housekeeping import Orders
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Operation, VehicleState
from tests.support import audited_gateway
from tests.support.processes import end, free_base_port, start_xilgate, wait_until, xilgate
from tests.support.service_manager import ServiceManager
from vehicle_emulator.bus.channel import is_served

CHANNELS = {network: f"daemon-{os.getpid()}-{network}" for network in ("robots", "navigation")}


@pytest.fixture(scope="module")
def hub():
    process = start_xilgate("bus", *CHANNELS.values())
    wait_until(lambda: all(map(is_served, CHANNELS.values())), 30, "hub")
    yield
    end(process)


class Rig:
    """A rig's directory; `start` is what systemd does."""

    def __init__(self, directory):
        self.directory = directory
        self.file = directory / "rig.toml"
        self.port = free_base_port()
        for path in (ROBOTS_DBC, GNSS_IMU_DBC, FOCUS):
            shutil.copy(path, directory)
        for name in ("control", "records"):
            (directory / name).mkdir()
        self.manager = ServiceManager(directory / "notify")
        self.process = None
        self.write()

    def write(self, profile="proving_ground", robots=f"xilgate:{CHANNELS['robots']}", more=""):
        self.file.write_text(f"""
name = "rig under test"
profile = "{profile}"
buses = {{ robots = "{robots}", navigation = "xilgate:{CHANNELS['navigation']}" }}
car = {{ dbc = ["robots.dbc", "gnss_imu.dbc"], vehicle = "focus.toml" }}
control = {{ directory = "control" }}
telemetry = {{ base_port = {self.port} }}
recorder = {{ directory = "records" }}
metrics = {{ port = {self.port + 10} }}
{more}
""", encoding="utf-8")  # fmt: skip

    def start(self, *command):
        command = command or (sys.executable, "-m", "xil")
        self.process = subprocess.Popen(
            [*command, "gateway", "--rig", str(self.file)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | self.manager.environment, start_new_session=True,
        )  # fmt: skip
        self.wait_for("READY=1")

    def wait_for(self, text, times=1):
        def is_told():
            assert self.process.poll() is None, self.process.communicate()
            return self.manager.has_heard(text, times)

        wait_until(is_told, 30, text)

    def signal(self, number):
        self.process.send_signal(number)

    def metrics(self):
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port + 10}/metrics", timeout=10) as answer:
            return answer.read().decode()

    def records(self):
        """All that the ended process has logged; each line must be JSON."""
        _, errors = self.process.communicate(timeout=30)
        return [json.loads(line) for line in errors.splitlines()]

    def close(self):
        if self.process is not None:
            end(self.process)
        self.manager.close()


@pytest.fixture
def rig(tmp_path):
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def messages(records):
    return [record["message"] for record in records]


@pytest.mark.req("S5")
def test_life_of_a_daemon(hub, rig):
    rig.start()
    rig.wait_for("STATUS=SILENT: started")
    rig.wait_for("WATCHDOG=1", times=5)
    assert 'mode{mode="SILENT"} 1.0' in rig.metrics()
    assert re.search(r'messages_unsent_total\{to="controller"\} [1-9]', rig.metrics())  # there is none
    assert re.search(r'messages_unsent_total\{to="telemetry"\} 0', rig.metrics())

    rig.write(more="speed = 3")
    rig.signal(signal.SIGHUP)
    time.sleep(1.0)  # the mistake is in the log below
    rig.write(profile="nominal")
    rig.signal(signal.SIGHUP)
    rig.wait_for("RELOADING=1\nMONOTONIC_USEC=")
    rig.wait_for("READY=1", times=2)
    rig.wait_for("WATCHDOG=1", times=len(rig.manager.heard) + 3)

    rig.signal(signal.SIGTERM)
    records = rig.records()
    assert rig.process.returncode == 0
    assert "STOPPING=1" in rig.manager.hear()
    assert messages(records)[0] == "rig under test begins with limits proving_ground"
    assert f"reload refused: {rig.file}: speed: unknown key" in messages(records)
    assert "rig under test begins with limits nominal" in messages(records)
    assert messages(records)[-2:] == ["asked to end in mode SILENT", "rig under test ended"]
    begun = [record["sha256"]["limits"] for record in records if "sha256" in record]
    assert len(set(begun)) == 2
    assert not list((rig.directory / "control").glob("*.sock"))
    assert len(list((rig.directory / "records").glob("*.journal"))) == 2


@pytest.mark.req("F12")
def test_a_control_loop_that_hangs_starves_the_watchdog_of_the_process(hub, rig):
    hang = (
        "import sys, time\n"
        "from gateway.cycle import ControlCycle\n"
        "from xil.cli import main\n"
        "look = ControlCycle.look\n"
        "def hang_at_last(cycle, *arguments):\n"
        "    look(cycle, *arguments)\n"
        "    if cycle._core.ticks == 50:\n"
        "        time.sleep(3600)\n"
        "ControlCycle.look = hang_at_last\n"
        "main()\n"
    )
    rig.start(sys.executable, "-c", hang)
    rig.manager.hear(1.5)
    fed = rig.manager.texts.count("WATCHDOG=1")
    assert fed >= 2
    rig.manager.hear(1.5)
    assert rig.manager.texts.count("WATCHDOG=1") == fed
    assert rig.process.poll() is None
    assert "tick" in rig.metrics()  # the other threads are well: it is the loop that is watched
    rig.signal(signal.SIGABRT)  # as systemd does then
    _, errors = rig.process.communicate(timeout=30)
    assert rig.process.returncode == -signal.SIGABRT
    assert '"message": "control loop hangs"' in errors
    assert "hang_at_last" in errors  # where it was


@pytest.fixture
def handlers():
    """Signals as they were before."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_every_signal_to_end_counts_and_the_one_to_reload_ends_nothing(handlers):
    orders = Orders()
    _heed_signals(orders)
    for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGINT):
        signal.raise_signal(number)
    assert (orders.ends, orders.is_reload_asked) == (3, False)
    signal.raise_signal(signal.SIGHUP)
    assert (orders.ends, orders.is_reload_asked) == (3, True)


@pytest.mark.parametrize(
    ("changes", "exit_code", "said"),
    [
        ({"profile": "fast", "more": "b = 2"}, 2, ["profile = 'fast': allowed: nominal, proving_ground, lifted, bench", "b: unknown key"]),
        ({"robots": "xilgate:nobody-serves-this"}, 3, ["robots: bus 'xilgate:nobody-serves-this'"]),
    ],
)
def test_what_keeps_it_from_starting_is_told_in_json_and_by_the_exit_code(hub, rig, changes, exit_code, said):
    rig.write(**changes)
    finished = xilgate("gateway", "--rig", str(rig.file))
    assert finished.returncode == exit_code
    records = [json.loads(line) for line in finished.stderr.splitlines()]
    errors = [record["message"] for record in records if record["level"] == "error"]
    assert len(errors) == len(said)
    assert all(text in error for text, error in zip(said, errors, strict=True)), errors


def test_check_prints_the_effective_configuration(hub, rig):
    finished = xilgate("gateway", "--rig", str(rig.file), "--check", "--json")
    assert finished.returncode == 0, finished.stderr
    content = json.loads(finished.stdout)
    assert content["configuration"]["realtime"] == {"priority": 60, "cpus": [], "locks_memory": True}
    assert content["configuration"]["car"]["vehicle"] == str(rig.directory / "focus.toml")
    assert set(content["hashes"]) == {"robots.dbc", "gnss_imu.dbc", "focus.toml", "limits", "configuration"}
    assert content["warnings"] == []
    assert not list((rig.directory / "control").iterdir())
    text = xilgate("gateway", "--rig", str(rig.file), "--check").stdout
    assert "daemon.stop_within_s = 45.0" in text
    assert f"sha256 limits = {content['hashes']['limits']}" in text


def test_check_tells_mistakes_set_up_and_warnings_apart(rig):
    rig.write(robots="xilgate:nobody-serves-this")
    warned = xilgate("gateway", "--rig", str(rig.file), "--check")
    assert warned.returncode == 0
    assert "warning: robots: bus 'xilgate:nobody-serves-this'" in warned.stdout
    rig.write(more="realtime = { priority = 0 }")
    mistaken = xilgate("gateway", "--rig", str(rig.file), "--check")
    assert (mistaken.returncode, mistaken.stderr) == (2, f"xilgate: {rig.file}: realtime.priority = 0: allowed: 1 to 98\n")
    rig.write()
    shutil.rmtree(rig.directory / "records")
    unset = xilgate("gateway", "--rig", str(rig.file), "--check")
    assert unset.returncode == 3
    assert "recorder.directory" in unset.stderr


def test_a_setting_beside_a_rig_file_is_refused(rig):
    finished = xilgate("gateway", "--rig", str(rig.file), "--check", "--telemetry-port", "7447")
    assert finished.returncode == 2
    assert finished.stderr == "xilgate: --telemetry-port: not beside --rig; write it into the rig file\n"


class Controller:
    """Answers states with straight ahead, on a thread of its own."""

    def __init__(self, control):
        key = control.key()
        self.state = None
        self._channel = Channel(control.controller_socket, control.gateway_socket, key)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        plan = (0.0,) * HORIZON_STEPS
        seq = 0
        while not self._ends.wait(0.04):
            self.state = self._channel.newest(VehicleState) or self.state
            if self.state is not None:
                seq += 1
                self._channel.send(ControlCommand(
                    boot_id=7, seq=seq, state_seq=self.state.seq, t_ns=time.monotonic_ns(), status=CommandStatus.OK, solve_time_ns=0,
                    lateral_error_m=0.0, heading_error_rad=0.0, steer_rad=0.0, drive_norm=0.0, plan_steer_rad=plan, plan_drive_norm=plan,
                ))  # fmt: skip

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ends.set()
        self._thread.join()
        self._channel.close()


FORBIDDEN_MODULES = {"zenoh", "json", "prometheus_client", "importlib", "subprocess", "tomllib", "pydantic"}
FORBIDDEN_CALLS = {"_log", "emit", "open", "getaddrinfo", "gethostbyname", "fsync", "stat", "listdir", "print", "collect", "sleep"}
ALLOWED_EVENTS = {"socket.sendto", "socket.connect", "socket.sendmsg", "socket.__new__", "sys.setprofile", "object.__getattr__"}


def test_asked_to_end_while_it_drives_it_stops_the_car_first(hub, rig):
    report = rig.directory / "report.json"
    rig.start(sys.executable, audited_gateway.__file__, str(report))
    control = control_path(rig.directory / "control")
    buses = ["--bus", f"xilgate:{CHANNELS['robots']}", "--navigation-bus", f"xilgate:{CHANNELS['navigation']}"]
    car = start_xilgate("emulator", *buses, "--plant", "bicycle", "--speed-mps", "2.5", "--telemetry-port", str(rig.port))
    operator = OperatorClient(control.operator_socket, control.key())
    try:
        with Controller(control) as controller:
            for operation in (Operation.ARM, Operation.ENGAGE):
                wait_until(lambda operation=operation: not operator.ask(operation).refusals, 30, operation.name)
            assert controller.state.vx_mps > 1.5
            rig.write(profile="nominal")
            rig.signal(signal.SIGHUP)
            time.sleep(0.5)
            rig.signal(signal.SIGTERM)
            time.sleep(1.0)
            assert rig.process.poll() is None  # the car still drives
            records = rig.records()
            assert abs(controller.state.vx_mps) < 0.15
    finally:
        operator.close()
        end(car)
    assert rig.process.returncode == 0
    said = messages(records)
    assert "reload refused: mode ENGAGED" in said
    stop = next(record for record in records if record["message"].startswith("ENGAGED -> "))
    assert (stop["after"], stop["cause"], stop["source"]) == ("COMFORT_STOP", "OPERATOR_STOP", "the gateway is to end")
    assert said.index("asked to end in mode ENGAGED") < said.index(stop["message"])
    assert not any("nominal" in line for line in said)

    done = json.loads(report.read_text())
    assert "gateway.core.step" in done["calls"]  # somebody looked
    assert [call for call in done["calls"] if call.split(".")[0] in FORBIDDEN_MODULES] == []
    assert [call for call in done["calls"] if call.split(".")[-1] in FORBIDDEN_CALLS] == []
    assert set(done["events"]) <= ALLOWED_EVENTS
