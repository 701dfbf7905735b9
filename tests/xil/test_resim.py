"""Cores run again from their journals: the same build answers the same, another is caught at its first other answer."""

import json
import random
import shutil
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from controller.bench.loop import drive
from controller.bench.scenarios import nominal_scenarios
from controller.journal import ControllerSession, RecordedNmpc
from controller.nmpc import NmpcOptions
from controller.parameters import ParameterStore, Refused
from controller.problem import OcpOptions
from controller.record import controller_session, record_in
from controller.solvers import make_solver
from dbc.vehicle import FOCUS, load_vehicle
from gateway.journal import JournalError, JournalReader, pack_blocks, pack_value
from gateway.messages import PLAN_PERIOD_NS, CommandStatus
from tests.support.privilege import may_not_enter
from tests.support.processes import xilgate
from xil import resim as again
from xil.cli import app
from xil.journal_files import find_journals
from xil.resim import differences, resim, told


def silent(_):
    pass


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run at stage sil, with an object and a fault in it."""
    out = tmp_path_factory.mktemp("run") / "out"
    finished = xilgate("drive", "cut-in", "--stage", "sil", "--out", str(out))
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return out


@pytest.fixture
def copy(run, tmp_path):
    """The first nine seconds of its gateway."""
    shutil.copyfile(run / "gateway-0000.journal", tmp_path / "gateway-0000.journal")
    rewrite(tmp_path / "gateway-0000.journal", lambda records: records[:901])
    return tmp_path


def rewrite(path, change):
    """Let a function change the records of a journal."""
    with path.open("rb") as stream:
        records = list(JournalReader(stream, str(path)))
    path.write_bytes(pack_blocks(change(records)))


@pytest.mark.req("G5")
def test_a_run_comes_out_the_same_frame_by_frame_and_command_by_command(run):
    gateway, controller = resim(run, silent)
    assert (gateway.of, gateway.different, gateway.first, gateway.missing, gateway.cut) == ("gateway", 0, None, "", "")
    assert (controller.of, controller.different, controller.first, controller.missing) == ("controller", 0, None, "")
    assert gateway.steps > 1000
    assert controller.steps == pytest.approx(gateway.steps / 4, abs=1)
    sent = [line for line in (run / "bus.log").read_text().splitlines() if " 110#" in line]
    assert gateway.compared > 3 * len(sent) > 1000
    assert gateway.notes == ()


def test_the_command_line_says_so(run):
    result = CliRunner().invoke(app, ["resim", str(run)])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert [line.endswith("the same, byte by byte") for line in lines] == [True, True]
    assert [line.partition(":")[0] for line in lines] == ["gateway", "controller"]
    as_data = json.loads(CliRunner().invoke(app, ["resim", str(run / "controller-0000.journal"), "--json"]).stdout)
    assert [(one["of"], one["different"]) for one in as_data] == [("controller", 0)]


def test_other_limits_are_caught_with_time_message_signal_and_both_values(run, monkeypatch):
    profiles = {name: replace(profile, steering_wheel_rate_radps=0.9) for name, profile in again.PROFILES.items()}
    monkeypatch.setattr(again, "PROFILES", profiles)
    gateway, controller = resim(run, silent)
    assert controller.is_same
    assert 0 < gateway.different <= gateway.steps
    first = gateway.first
    message, _, signal = first.place.partition(".")
    assert (message, signal) == ("SR_Command", "RateLimit")  # travels with every command that the robots obey
    assert first.now == pytest.approx(51.6, abs=2.0)  # 0.9 rad/s in degrees, as finely as the DBC has it
    assert first.recorded > first.now
    assert first.since_start_s == pytest.approx((first.t_ns - 1_010_000_000) * 1e-9)
    assert gateway.notes == (f"limits proving_ground.steering_wheel_rate_radps: recorded 13.9, now {0.9!r}",)
    assert "SR_Command.RateLimit: recorded" in told(gateway)
    result = CliRunner().invoke(app, ["resim", str(run)])
    assert result.exit_code == 1
    assert "steps DIFFER" in result.stdout


def test_another_controller_is_caught_with_its_first_other_command(run, monkeypatch):
    monkeypatch.setattr(again, "OcpOptions", lambda model: OcpOptions(model=model, input_weights=(2.0, 0.1)))
    gateway, controller = resim(run, silent)
    assert gateway.is_same
    assert controller.different > 100
    assert controller.first.place.startswith("ControlCommand.")
    assert isinstance(controller.first.recorded, float)
    assert controller.first.recorded != controller.first.now


def test_a_step_that_was_not_recorded_ends_the_comparison(copy):
    rewrite(copy / "gateway-0000.journal", lambda records: records[:500] + records[503:])
    (gateway,) = resim(copy, silent)
    assert (gateway.steps, gateway.is_same) == (499, True)
    assert gateway.missing.startswith("3 steps before ")
    result = CliRunner().invoke(app, ["resim", str(copy)])
    assert result.exit_code == 2
    assert "3 steps before 6.0" in result.stdout


def test_a_journal_that_a_crash_cut_is_compared_to_its_end(copy):
    path = copy / "gateway-0000.journal"
    path.write_bytes(path.read_bytes() + path.read_bytes()[:-100])
    (gateway,) = resim(copy, silent)
    assert (gateway.is_same, gateway.steps) == (True, 900)
    assert gateway.cut == f"{path} ends within a block"
    assert CliRunner().invoke(app, ["resim", str(copy)]).exit_code == 0


def test_a_journal_in_several_files_is_one(copy):
    path = copy / "gateway-0000.journal"
    with path.open("rb") as stream:
        session, *records = JournalReader(stream, "")
    for index, start in enumerate(range(0, len(records), 300)):
        (copy / f"gateway-{index:04d}.journal").write_bytes(pack_blocks([session, *records[start : start + 300]]))
    (gateway,) = resim(copy, silent)
    assert (gateway.steps, gateway.is_same, gateway.missing) == (len(records), True, "")
    (copy / "gateway-0001.journal").write_bytes(pack_blocks([session.replace(b"0.1.0", b"0.1.9"), *records[300:600]]))
    with pytest.raises(JournalError, match=r"gateway-0001\.journal: of another session than .*gateway-0000\.journal"):
        resim(copy, silent)
    path.unlink()
    with pytest.raises(JournalError, match="the beginning of this record is gone"):
        resim(copy, silent)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda records: [], "an empty journal"),
        (lambda records: [b"\xc1", *records[1:]], "session: "),
        (lambda records: [pack_value({"of": "toaster", "format": 1, "version": "9"})], "journal of 'toaster', expected"),
        (lambda records: [pack_value({"of": "gateway", "format": 7, "version": "9"})], "format 7, expected 1; xilgate 9 wrote it"),
        (lambda records: [records[0], b"\x01", *records[1:]], "gateway-0000.journal: step: Expected `array`"),
        (lambda records: [records[0].replace(b"proving_ground", b"proving_gr\x1b[md"), *records[1:]], "limit profile"),
    ],
)
def test_what_is_no_journal_is_one_clear_line(copy, change, said):
    rewrite(copy / "gateway-0000.journal", change)
    with pytest.raises(JournalError) as mistake:
        resim(copy / "gateway-0000.journal", silent)
    assert said in str(mistake.value)
    assert str(mistake.value).isprintable()


@pytest.mark.parametrize("name", ["nothing-there", "summary.json", "nothing-0000.journal"])
def test_what_is_not_there_is_one_clear_line(run, name):
    with pytest.raises(JournalError, match=name):
        resim(run / name, silent)


def test_a_mistake_is_one_line_and_exit_code_2(tmp_path):
    finished = xilgate("resim", str(tmp_path))
    assert finished.returncode == 2
    assert finished.stderr.startswith(f"xilgate: {tmp_path}: no journal")
    assert len(finished.stderr.splitlines()) == 1
    with pytest.raises(JournalError, match=r"/nothing/there: No such file or directory$"):
        resim(tmp_path / "nothing" / "there", silent)


def test_a_directory_that_may_not_be_entered_is_told(tmp_path):
    closed = tmp_path / "closed"
    with may_not_enter(closed):
        for path in (closed, closed / "records", closed / "gateway-0000.journal"):
            with pytest.raises(JournalError, match=f"{path}: Permission denied"):
                find_journals(path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_garbled_journal_is_never_a_traceback(run, tmp_path, data):
    path = tmp_path / "gateway-0000.journal"
    content = bytearray((run / "gateway-0000.journal").read_bytes()[: data.draw(st.integers(0, 40_000))])
    for _ in range(data.draw(st.integers(0, 3))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        records = [record for journal in find_journals(path) for record in journal.records()]
    except JournalError as error:
        assert str(path) in str(error)  # noqa: PT017 - either is right
    else:
        assert all(isinstance(record, bytes) for record in records)


# --- the controller alone: solve times, deadlines, parameters


@pytest.fixture(scope="module")
def controller_run(tmp_path_factory):
    """A controller that drives, is tuned on the way, and misses its deadline now and then, as its solve times have it."""
    out = tmp_path_factory.mktemp("controller")
    scenario, vehicle, rng = nominal_scenarios()[0], load_vehicle(), random.Random(3)
    scenario.path.to_csv(out / "reference.csv")
    clock = Clock(lambda: PLAN_PERIOD_NS + 5 if rng.random() < 0.1 else rng.randrange(PLAN_PERIOD_NS))
    options = NmpcOptions(deadline_ns=PLAN_PERIOD_NS)
    solver = make_solver("riccati", vehicle.model, OcpOptions(model=again.DRIVE_MODEL), silent, clock)
    store = ParameterStore(solver.options, options.planner)
    session = controller_session(7, "riccati", PLAN_PERIOD_NS, out / "reference.csv", FOCUS)
    with record_in(out, session) as keep:
        nmpc = Tuned(solver, scenario.path, vehicle, 7, options, keep=keep)
        nmpc.store = store
        outputs, _ = drive(nmpc, vehicle, replace(scenario, duration_s=4.0), 1)
    return out, [output.command for output in outputs]


class Clock:
    def __init__(self, solve_time_ns):
        self._now_ns = 0
        self._calls = 0
        self._solve_time_ns = solve_time_ns

    def __call__(self):
        self._calls += 1
        self._now_ns += self._solve_time_ns() if self._calls % 2 == 0 else 1000
        return self._now_ns


class Tuned(RecordedNmpc):
    """Tuned in its twentieth and its sixtieth step."""

    store: ParameterStore
    steps = 0

    def step(self, state, now_ns, objects=()):
        self.steps += 1
        if self.steps in (20, 60):
            self.store.propose({"ocp.input_weights.delta": 1.0 + self.steps, "planner.safe_time_s": 1.8}, "ann", now_ns)
            parameters, _ = self.store.take()
            self.tune(parameters.ocp, parameters.planner)
        return super().step(state, now_ns, objects)


def test_solve_times_and_tuning_are_taken_from_the_record(controller_run):
    out, commands = controller_run
    assert {CommandStatus.OK, CommandStatus.DEGRADED} <= {command.status for command in commands}
    (controller,) = resim(out, silent)
    assert (controller.steps, controller.different, controller.missing) == (len(commands), 0, "")


def test_a_forgotten_change_of_parameters_would_be_noticed(controller_run, monkeypatch):
    monkeypatch.setattr(again, "_tune", lambda *_: None)
    (controller,) = resim(controller_run[0], silent)
    assert controller.different > 0
    assert controller.first.step == 19


def test_parameters_that_this_build_refuses_are_one_clear_line(controller_run, monkeypatch):
    monkeypatch.setattr(ParameterStore, "propose", lambda *_: Refused(reasons=["planner.safe_time_s: unknown"]))
    with pytest.raises(JournalError, match=r"step 19: parameters that this build refuses: planner\.safe_time_s: unknown$"):
        resim(controller_run[0], silent)


def test_a_solve_time_that_decided_would_be_noticed(controller_run, monkeypatch):
    monkeypatch.setattr(again.RecordedClock, "__call__", lambda self: 0)
    (controller,) = resim(controller_run[0], silent)
    assert controller.different > 0


def test_the_session_of_a_controller_tells_what_decided(controller_run):
    (journal,) = find_journals(controller_run[0])
    session = journal.session(ControllerSession)
    assert session.sha256.keys() == {"reference", "vehicle", "controller library"}
    assert (session.solver, session.deadline_ns, session.boot_id) == ("riccati", PLAN_PERIOD_NS, 7)


# --- differences


@pytest.mark.parametrize(
    ("recorded", "now", "found"),
    [
        ({"a": 1, "b": [1, 2]}, {"a": 1, "b": [1, 2]}, []),
        ({"a": 1, "b": [1, 2]}, {"a": 1, "b": [1, 3]}, [("x.b[1]", 2, 3)]),
        ({"a": 1}, {"b": 1}, [("x.a", 1, None), ("x.b", None, 1)]),
        ([1], [1, None], []),
        (float("nan"), float("nan"), []),
        (1, 1.0, [("x", 1, 1.0)]),
        ({"a": [1]}, {"a": 1}, [("x.a", [1], 1)]),
    ],
)
def test_differences_of_plain_data(recorded, now, found):
    assert list(differences(recorded, now, "x")) == found
