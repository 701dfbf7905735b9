"""`xilgate fault`, faults in scenarios and in what a run leaves, and faults in closed loop."""

import io
import json
import threading

import can
import pytest
from rich.console import Console

from dbc.catalogue import load
from dbc.errors import UserMistake
from dbc.link import bus_names
from dbc.vehicle import load_vehicle
from gateway.core import TICK_NS, GatewayCore
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Mode, Operation, OperatorRequest
from gateway.telemetry import FaultSample, Publisher, Source, Subscriber, decode
from tests.support.processes import free_base_port, wait_until, xilgate
from vehicle_emulator import app
from vehicle_emulator.app import EmulatorOptions, fault_sample
from vehicle_emulator.emulator import STEP_NS, Emulator, EmulatorSetup, StartPose
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.kinds import KINDS
from vehicle_emulator.faults.operations import fault_operations
from vehicle_emulator.faults.spec import parse_faults
from vehicle_emulator.plants.interface import PlantState
from vehicle_emulator.service import SERVICE, EmulatorService
from xil import fault
from xil.injected import InjectedFault, injected_faults
from xil.recording import Recording
from xil.scenario import SCENARIO_FOLDER, ScenarioError, load_scenario

CATALOGUE = load()
START_NS = 1_000_000_000


@pytest.fixture
def port():
    """Ports on which an emulator serves its faults."""
    base_port, stop = free_base_port(), threading.Event()
    engine = FaultEngine([], 1, 0, CATALOGUE)
    service = EmulatorService(fault_operations(engine, CATALOGUE))

    def step():
        now_ns = 0
        while not stop.wait(0.001):
            now_ns += STEP_NS
            service.run_due(now_ns)
            engine.update(now_ns, Situation(PlantState(), is_engaged=False))

    car = threading.Thread(target=step)
    with Publisher(Source.EMULATOR, base_port) as publisher:
        publisher.serve(SERVICE, service.answer)
        car.start()
        yield base_port
        stop.set()
        car.join()


def shown(table):
    console = Console(width=200, file=io.StringIO(), record=True)
    console.print(table)
    return [line.rstrip() for line in console.export_text().splitlines()]


def test_add_list_and_clear_over_the_wire(port):
    (added,) = fault.add("bad_crc", ["messages=SR_Status", "duration_s=600"], port)
    assert (added.name, added.fault) == ("bad_crc", "bad_crc messages=SR_Status duration_s=600")
    fault.add("gust", ["push_n=-2000", "from_s=600", "name=side wind"], port)
    lines = shown(fault.table(fault.listing(port), "faults"))
    assert lines[0] == "faults: 2"
    assert lines[2].split() == ["bad_crc", "active", "0", "bad_crc", "messages=SR_Status", "duration_s=600"]
    assert lines[3].startswith("side wind  waiting")
    assert [told.name for told in fault.clear("side wind", port)] == ["side wind"]
    assert [told.name for told in fault.clear(None, port)] == ["bad_crc"]
    assert fault.listing(port) == []


@pytest.mark.parametrize(
    ("kind", "words", "told"),
    [
        ("bad_crc", ["messages=SR_Status", "duration_s=-1"], "duration_s = -1.0: allowed: 0.001 to 3600 s"),
        ("bad_crc", ["messages=PosLocal"], "fault bad_crc: messages = 'PosLocal': allowed: messages with end-to-end protection"),
    ],
)
def test_what_is_refused_is_one_line(port, kind, words, told):
    with pytest.raises(UserMistake) as caught:
        fault.add(kind, words, port)
    assert str(caught.value) == told


def test_the_commands(port):
    at = ("--telemetry-port", str(port))
    added = xilgate("fault", "add", "drop", "messages=PosLocal", "condition=engaged and x_m > 30", "--json", *at)
    assert [told["fault"] for told in json.loads(added.stdout)] == ["drop messages=PosLocal condition='engaged and x_m > 30'"]
    assert "drop" in xilgate("fault", "list", *at).stdout
    refused = xilgate("fault", "add", "drop", "message=PosLocal", *at)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.startswith("xilgate: message = 'PosLocal': unknown key; drop takes messages,")
    assert xilgate("fault", "clear", "rain", *at).stderr == "xilgate: fault 'rain' is unknown; known: drop\n"


def test_every_kind_is_told():
    text = "\n".join(shown(fault.kinds_table()))
    assert all(name in text for name in KINDS)
    assert [kind["kind"] for kind in fault.kinds_data()["kinds"]] == list(KINDS)
    json.dumps(fault.kinds_data())


def test_a_running_emulator_takes_faults_from_its_file_and_from_outside(tmp_path):
    path, base_port, stop, told = tmp_path / "faults.toml", free_base_port(), threading.Event(), []
    path.write_text('[[faults]]\nkind = "silence"\nnode = "INS"\n')

    def samples_of(name):
        return [sample for sample in told if isinstance(sample, FaultSample) and sample.name == name]

    options = EmulatorOptions(bus_names(f"virtual:fault-{base_port}"), faults=path, telemetry_base_port=base_port)
    worker = threading.Thread(target=app.run, args=(options, stop))
    with can.Bus(channel=f"fault-{base_port}", interface="virtual") as listener:
        worker.start()
        try:
            with Subscriber(lambda topic, payload: told.append(decode(topic, payload)), ["faults", "world"], base_port):
                wait_until(lambda: told, 10.0, "the emulator runs")
                fault.add("drop", ["messages=SR_Status", "count=3", "name=three"], base_port)
                wait_until(lambda: [s.event for s in samples_of("three")] == ["begins", "ends"], 10.0, "the fault ends")
        finally:
            stop.set()
            worker.join(timeout=10.0)
        senders = {CATALOGUE.by_id[message.arbitration_id].sender for message in iter(lambda: listener.recv(timeout=0), None)}
    ended = samples_of("three")[-1]
    assert (ended.what, ended.hits) == ("drop messages=SR_Status count=3", 3)
    assert "INS" not in senders
    assert "SR" in senders


@pytest.mark.parametrize(("text", "told"), [("[[faults]]\nkind = 1", "faults.0.kind = 1: allowed: drop"), ("x = 1", "faults: missing")])
def test_an_emulator_with_a_bad_file_does_not_start(tmp_path, text, told):
    path = tmp_path / "faults.toml"
    path.write_text(text)
    refused = xilgate("emulator", "--bus", "virtual:nobody", "--faults", str(path))
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"xilgate: {path}: {told}")


FAULTS = '\n[[faults]]\nkind = "silence"\nnode = "INS"\nfrom_s = 4.0\n[[faults]]\nkind = "gust"\npush_n = 2500\ncondition = "x_m > 30"\n'


@pytest.fixture
def scenario(tmp_path):
    """Writes a scenario with something at its end."""

    def write(more):
        path = tmp_path / "mine.toml"
        path.write_text((SCENARIO_FOLDER / "lane-keeping.toml").read_text() + more)
        return str(path)

    return write


def test_a_scenario_has_faults(scenario):
    faults = load_scenario(scenario(FAULTS)).faults
    assert [(spec.name, spec.kind) for spec in faults] == [("silence", "silence"), ("gust", "gust")]
    assert load_scenario("lane-keeping").faults == ()


def test_a_mistake_in_the_faults_of_a_scenario_names_file_and_key(scenario):
    path = scenario(FAULTS.replace("2500", "25e9").replace('"INS"', "3"))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value).splitlines() == [
        f"{path}: faults.0.node = 3: allowed: text of 1 to 200 printable characters",
        f"{path}: faults.1.push_n = 25000000000.0: allowed: -20000 to 20000 N",
    ]


@pytest.mark.parametrize(
    ("node", "stage", "told"),
    [("INSS", "sil", "fault silence: node = 'INSS': allowed: "), ("INS", "vehil", "its faults are injected into the emulated car")],
)
def test_a_run_with_faults_that_cannot_be_is_refused_before_it_starts(scenario, tmp_path, node, stage, told):
    path, bus = scenario(FAULTS.replace('"INS"', f'"{node}"')), "auto" if stage == "sil" else "socketcan:can0"
    refused = xilgate("drive", path, "--stage", stage, "--bus", bus, "--out", str(tmp_path / "run"))
    assert refused.returncode == 2
    assert told in refused.stderr
    assert not (tmp_path / "run").exists()


def test_a_record_tells_every_time_for_which_a_fault_was_there():
    recording = Recording(START_NS)
    told = [
        *(("gust", "begins", 1.0, 0), ("drop", "begins", 2.0, 0), ("gust", "ends", 3.0, 0)),
        *(("gust", "begins", 4.0, 0), ("drop", "cleared", 5.0, 7)),
    ]
    for seq, (name, event, t_s, hits) in enumerate(told):
        recording.add(FaultSample(t_ns=START_NS + round(t_s * 1e9), seq=seq, name=name, what=name, event=event, hits=hits))
    assert injected_faults(recording) == [
        InjectedFault("gust", "gust", 1.0, 3.0, 0),
        InjectedFault("drop", "drop", 2.0, 5.0, 7),
        InjectedFault("gust", "gust", 4.0, None, None),
    ]


class Loop:
    """Gateway and emulated car in virtual time, with faults on the bus between them; the controller asks for straight ahead."""

    def __init__(self, *faults):
        vehicle = load_vehicle()
        self.gateway = GatewayCore(CATALOGUE, vehicle, boot_id=1)
        setup = EmulatorSetup(vehicle, StartPose(speed_mps=10.0), faults=parse_faults(faults), seed=1)
        self.emulator = Emulator(setup, CATALOGUE, START_NS)
        self.now_ns = START_NS
        self.transitions, self.events, self.traffic = [], [], []
        self._to_car, self._to_gateway = [], []
        self._is_to_engage = True

    def run(self, seconds):
        for _ in range(round(seconds * 1e9 / STEP_NS)):
            self.now_ns += STEP_NS
            sent, self._to_car = self.emulator.step(self.now_ns, self._to_car), []
            self._to_gateway += sent
            self.traffic += sent
            self.events += [fault_sample(event, 0) for event in self.emulator.faults.take_events()]
            if self.now_ns % TICK_NS == 0:
                self._tick()
        return self

    def _tick(self):
        operation = {Mode.SILENT: Operation.ARM, Mode.READY: Operation.ENGAGE}.get(self.gateway.mode) if self._is_to_engage else None
        request = None if operation is None else OperatorRequest(9, self.now_ns, operation, self.now_ns)
        output = self.gateway.step(self.now_ns, self._to_gateway, self._command(), request)
        self._is_to_engage = self._is_to_engage and self.gateway.mode is not Mode.ENGAGED
        self._to_car, self._to_gateway = output.frames, []
        if output.transition is not None:
            self.transitions.append(((self.now_ns - START_NS) / 1e9, output.transition.after, output.transition.reason))

    def _command(self):
        if self.now_ns % (4 * TICK_NS):
            return None
        level = (0.05,) * HORIZON_STEPS
        return ControlCommand(
            boot_id=7, seq=self.now_ns // TICK_NS, state_seq=self.gateway.ticks, t_ns=self.now_ns, status=CommandStatus.OK, solve_time_ns=0,
            lateral_error_m=0.0, heading_error_rad=0.0, steer_rad=0.0, drive_norm=0.05,
            plan_steer_rad=(0.0,) * HORIZON_STEPS, plan_drive_norm=level,
        )  # fmt: skip

    def stop_after(self, t_s):
        """When and why the gateway left ENGAGED, after a time."""
        return next((at_s, mode, reason) for at_s, mode, reason in self.transitions if at_s >= t_s)


def test_without_faults_the_loop_stays_engaged():
    assert [mode for _, mode, _ in Loop().run(3.0).transitions] == [Mode.READY, Mode.ENGAGED]


@pytest.mark.parametrize(
    ("kind", "keys", "cause"),
    [
        ("drop", {"messages": "PosLocal"}, "PosLocal"),
        ("silence", {"node": "SR"}, "SR_Status"),
        ("bad_crc", {"messages": "SR_Status"}, "SR_Status"),
        ("corrupt_bits", {"messages": "RC_SafetyStatus", "bits": 3}, "RC_SafetyStatus"),
        ("bad_counter", {"messages": "BR_Status"}, "BR_Status"),
        ("wrong_length", {"messages": "AR_Status", "length": 5}, "AR_Status"),
    ],
)
def test_a_message_that_is_lost_or_bad_brings_the_gateway_to_a_safe_stop(kind, keys, cause):
    loop = Loop({"kind": kind, "condition": "engaged and x_m > 25", **keys}).run(4.5)
    began_s = (loop.events[0].t_ns - START_NS) / 1e9
    at_s, mode, reason = loop.stop_after(began_s)
    assert mode is Mode.SAFE_STOP
    assert cause in reason
    assert at_s - began_s < 0.2


def test_a_short_fault_is_ridden_out():
    loop = Loop({"kind": "drop", "messages": "SR_Status", "condition": "engaged", "count": 2}).run(3.0)
    assert [mode for _, mode, _ in loop.transitions] == [Mode.READY, Mode.ENGAGED]
    assert [(event.event, event.hits) for event in loop.events] == [("begins", 0), ("ends", 2)]


def test_commands_that_do_not_arrive_stop_the_car_by_itself():
    loop = Loop({"kind": "drop", "messages": "GW", "condition": "engaged and x_m > 25", "duration_s": 600}).run(4.5)
    assert not loop.emulator.truth().are_robots_engaged
    assert loop.transitions[-1][1] is not Mode.ENGAGED


def test_what_a_babbling_idiot_says_in_the_name_of_a_robot_is_counted_and_ignored_and_soon_ends_the_drive():
    identifier = CATALOGUE.by_name["SR_Status"].arbitration_id
    loop = Loop({"kind": "babble", "id": identifier, "rate_hz": 500, "from_s": 2.5}).run(3.5)
    assert sum(count for cause, count in loop.gateway.supervisor.rejected.items() if cause.startswith("SR_Status: ")) == 501
    at_s, mode, reason = loop.stop_after(2.5)
    assert at_s == pytest.approx(2.5, abs=0.021)
    assert (mode, reason.partition(":")[0]) == (Mode.SAFE_STOP, "message is invalid")


def test_the_same_seed_gives_the_same_run():
    faults = [{"kind": "corrupt_bits", "messages": "*", "probability": 0.01}, {"kind": "jitter", "messages": "INS", "jitter_ms": 5.0}]
    assert Loop(*faults).run(1.5).traffic == Loop(*faults).run(1.5).traffic
