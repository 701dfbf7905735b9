"""Three processes in real time on the emulated bus: a drive, and what happens when parts of it die."""

import json
import os
import signal

import can
import pytest

from controller.tuning import SetRequest, request
from dbc.catalogue import GNSS_IMU_DBC
from gateway.conditions import MAX_TICK_GAP_NS
from gateway.telemetry import StateSample, Subscriber, decode
from tests.support.processes import children, end, free_base_port, is_running, start_xilgate, wait_until
from tests.support.site import SITE_DBC, SITE_MAPPING, load_site
from tests.support.stall import StallProbe
from vehicle_emulator.bus.channel import is_served
from xil.resim import resim

pytestmark = pytest.mark.realtime

EVERYONE = {"bus", "gateway", "controller", "emulator"}


class Drive:
    """A running `xilgate drive` and its newest state and status."""

    def __init__(self, out, scenario="iso3888-1", buses=("--bus", "emulated"), dbc=()):
        self.port = port = free_base_port()
        self.out = out
        self.state = None
        self.status = None
        self._subscriber = Subscriber(self._receive, ["state", "status"], port)
        arguments = ["--stage", "hil", *buses, *dbc, "--out", str(out), "--telemetry-port", str(port)]
        self.process = start_xilgate("drive", scenario, *arguments)
        self.children = {}

    def _receive(self, topic, payload):
        if isinstance(sample := decode(topic, payload), StateSample):
            self.state = sample
        else:
            self.status = sample

    def wait_for(self, condition, what):
        def is_there():
            assert self.process.poll() is None, self.process.communicate()[0]
            return self.state is not None and condition(self.state)

        wait_until(is_there, 60, what)
        self.children = children(self.process.pid)

    def is_gone(self):
        return not any(map(is_running, self.children.values()))

    def summary(self):
        return json.loads((self.out / "summary.json").read_text())

    def close(self):
        end(self.process)
        self._subscriber.close()


@pytest.fixture
def drive(tmp_path, request):
    running = Drive(tmp_path, getattr(request, "param", "iso3888-1"))
    yield running
    running.close()


def is_engaged(state):
    return state.mode == "ENGAGED"


def trial(out):
    """One drive to its end: exit code, output, longest stall of the machine meanwhile."""
    drive = Drive(out)
    try:
        with StallProbe() as probe:
            drive.wait_for(lambda state: state.mode in ("READY", "ENGAGED"), "readiness")
            assert drive.children.keys() == EVERYONE
            output, _ = drive.process.communicate(timeout=90)
        assert drive.is_gone()
        return drive.process.returncode, output, probe.worst_s
    finally:
        drive.close()


def test_the_double_lane_change_passes(tmp_path):
    for attempt in range(3):
        out = tmp_path / str(attempt)
        code, output, stall_s = trial(out)
        # A failure counts, unless the machine stood still for as long as the gateway must not: then it proves nothing.
        if code == 0 or stall_s < MAX_TICK_GAP_NS * 1e-9 / 2:
            break
        print(f"attempt {attempt} inconclusive: the machine stood still for {stall_s * 1e3:.0f} ms")
    assert code == 0, output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["verdict"] == "pass"
    assert summary["solver"] == "riccati"
    assert {"controller library", "robots.dbc", "gnss_imu.dbc", "configuration"} <= summary["sha256"].keys()
    assert (out / "bus.log").read_text().count("\n") > 20_000
    # And again from what it recorded.
    compared = [(comparison.of, comparison.different, comparison.missing) for comparison in resim(out, print)]
    assert compared == [("gateway", 0, ""), ("controller", 0, "")]


@pytest.mark.parametrize("drive", ["lane-keeping"], indirect=True)
def test_a_killed_controller_stops_the_car_and_is_named(drive):
    drive.wait_for(lambda state: is_engaged(state) and state.vx_mps > 3.0, "the car to drive")
    os.kill(drive.children["controller"], signal.SIGKILL)
    wait_until(lambda: drive.state.mode == "SAFE_STOP", 5, "the safe stop")
    wait_until(lambda: abs(drive.state.vx_mps) < 0.15, 30, "standstill")
    output, _ = drive.process.communicate(timeout=60)
    assert drive.process.returncode == 1, output
    reason = drive.summary()["reason"]
    assert "controller" in reason
    assert "SIGKILL" in reason
    assert drive.is_gone()


@pytest.mark.parametrize("victim", ["gateway", "emulator", "bus"])
def test_whoever_is_killed_ends_the_run_and_is_named(drive, victim):
    drive.wait_for(is_engaged, "the engagement")
    os.kill(drive.children[victim], signal.SIGKILL)
    output, _ = drive.process.communicate(timeout=60)
    assert drive.process.returncode == 1, output
    assert f"{victim} died (killed by SIGKILL)" in drive.summary()["reason"]
    assert drive.is_gone()


@pytest.mark.parametrize("victim", ["robots", "navigation"])
def test_a_bus_that_dies_alone_ends_the_engagement_and_is_named(tmp_path, victim):
    channels = {network: f"alone-{os.getpid()}-{network}" for network in ("robots", "navigation")}
    hubs = {network: start_xilgate("bus", channel) for network, channel in channels.items()}
    wait_until(lambda: all(map(is_served, channels.values())), 20, "both buses")
    buses = ["--bus", f"xilgate:{channels['robots']}", "--navigation-bus", f"xilgate:{channels['navigation']}"]
    drive = Drive(tmp_path, buses=buses)
    try:
        drive.wait_for(is_engaged, "the engagement")
        assert drive.children.keys() == EVERYONE - {"bus"}
        assert drive.status.dead_buses == []
        hubs[victim].kill()
        wait_until(lambda: drive.state.mode == "FAULT", 5, "the fault")
        wait_until(lambda: drive.status.dead_buses == [victim], 5, "the name of the bus")
        assert drive.process.poll() is None
        drive.process.send_signal(signal.SIGINT)
        drive.process.communicate(timeout=20)
        channels_seen = {line.split()[1] for line in (tmp_path / "bus.log").read_text().splitlines()}
        assert channels_seen == set(channels.values())
    finally:
        drive.close()
        for hub in hubs.values():
            end(hub)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_survives_its_runner(drive, number):
    drive.wait_for(is_engaged, "the engagement")
    assert drive.children.keys() == EVERYONE
    drive.process.send_signal(number)
    drive.process.communicate(timeout=20)
    assert drive.process.returncode == (-9 if number is signal.SIGKILL else 130)
    wait_until(drive.is_gone, 5, "the end of every process")


def test_a_run_tells_the_controller_of_its_objects_and_keeps_what_was_tuned(tmp_path):
    drive = Drive(tmp_path, "cut-in")
    samples = {"objects": [], "command": []}
    try:
        with Subscriber(lambda topic, payload: samples[topic].append(decode(topic, payload)), list(samples), drive.port):
            drive.wait_for(is_engaged, "the engagement")
            request(SetRequest(changes={"planner.safe_time_s": 1.3}, who="a test"), drive.port)
            drive.wait_for(lambda state: samples["command"][-1].objects == 1, "the object in the controller")
            drive.wait_for(lambda state: samples["command"][-1].parameters_version == 1, "the parameter in force")
        assert [thing.name for thing in samples["objects"][-1].objects] == ["slow car"]
        assert samples["objects"][0].objects == []
        assert [sample.seq for sample in samples["objects"]] == sorted({sample.seq for sample in samples["objects"]})
        drive.process.send_signal(signal.SIGINT)
        drive.process.communicate(timeout=20)
        assert "parameters version 1 by a test: planner.safe_time_s 1.2 -> 1.3" in (tmp_path / "controller.log").read_text()
    finally:
        drive.close()


def test_every_process_speaks_the_dbc_of_a_site(tmp_path):
    dbc = ["--dbc", str(SITE_DBC), "--dbc", str(GNSS_IMU_DBC), "--mapping", str(SITE_MAPPING)]
    drive = Drive(tmp_path, "lane-keeping", dbc=dbc)
    try:
        drive.wait_for(lambda state: is_engaged(state) and state.vx_mps > 3.0, "the car to drive")
        assert drive.children.keys() == EVERYONE
        drive.process.send_signal(signal.SIGINT)
        drive.process.communicate(timeout=20)
    finally:
        drive.close()
    frames = [message for message in can.CanutilsLogReader(tmp_path / "bus.log") if not message.is_error_frame]
    site = load_site()
    assert {site.by_id[message.arbitration_id].sender for message in frames} == {"GW", "RC", "SR", "AR", "BR", "CAR", "INS"}


def test_interrupting_a_real_car_stops_it_first(tmp_path):
    port, emulator_port = free_base_port(), free_base_port()
    channel = f"vehil-{os.getpid()}"
    hub = start_xilgate("bus", channel)
    wait_until(lambda: is_served(channel), 20, "the bus")
    emulator = start_xilgate("emulator", "--bus", f"xilgate:{channel}", "--y-m", "-0.3", "--telemetry-port", str(emulator_port))
    states = []
    reader = Subscriber(lambda topic, payload: states.append(decode(topic, payload)), ["state"], port)
    arguments = ["--stage", "vehil", "--bus", f"xilgate:{channel}", "--out", str(tmp_path), "--telemetry-port", str(port)]
    process = start_xilgate("drive", "lane-keeping", *arguments)
    try:
        wait_until(lambda: states and states[-1].mode == "ENGAGED" and states[-1].vx_mps > 5.0, 60, "the car to drive")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=40)
        assert process.returncode == 130, output
        assert states[-1].mode == "SAFE_STOP"
        assert abs(states[-1].vx_mps) < 0.15
    finally:
        reader.close()
        for each in (process, emulator, hub):
            end(each)
