"""`xilgate params`: what people type and what they read."""

import io
import json
import os
import threading
import time

import pytest
from rich.console import Console

from controller.parameters import ParameterStore
from controller.planning.options import PlannerOptions
from controller.problem import OcpOptions
from controller.samples import parameters_sample
from controller.tuning import SERVICE, TuningService
from gateway.telemetry import CommandSample, Publisher, Source, TelemetryError, read_tls
from tests.support.certificates import make_authority, make_certificate
from tests.support.processes import end, free_base_port, start_xilgate, wait_until, xilgate
from tests.visualiser.feeder import samples_at
from xil import params

SAFE_TIME = "planner.safe_time_s"


@pytest.fixture
def controller():
    """What a controller serves: its store, its publisher, and the ports."""
    base_port, store = free_base_port(), ParameterStore(OcpOptions(), PlannerOptions())
    with Publisher(Source.CONTROLLER, base_port) as publisher:
        publisher.serve(SERVICE, TuningService(store).answer)
        yield store, publisher, base_port


@pytest.fixture
def port(controller):
    return controller[2]


@pytest.fixture
def remote(tmp_path):
    """A controller that a reader and a tuner reach with TLS; the files that say how."""
    authority = make_authority(tmp_path, "ours")
    base_port = free_base_port()
    address = f"127.0.0.1:{base_port + 7000 if base_port < 50_000 else base_port - 7000}"
    for name in ("rig", "reader", "tuner"):
        make_certificate(tmp_path, name, authority)
        files = f'certificate = "{name}.pem"\nprivate_key = "{name}.key"\nauthority = "ours.pem"\n'
        (tmp_path / f"{name}.toml").write_text(f'address = "{address}"\n{files}writers = ["tuner"]\n')
    with Publisher(Source.CONTROLLER, base_port, read_tls(tmp_path / "rig.toml")) as publisher:
        publisher.serve(SERVICE, TuningService(ParameterStore(OcpOptions(), PlannerOptions())).answer)
        yield publisher, {name: str(tmp_path / f"{name}.toml") for name in ("reader", "tuner")}


def shown(table, width=200):
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(table)
    return [line.rstrip() for line in console.export_text().splitlines()]


@pytest.mark.parametrize("text", ["", "=", "=1", SAFE_TIME, *(f"{SAFE_TIME}={number}" for number in ("", "fast", "nan", "1e999", "1=2"))])
def test_what_is_no_assignment_is_one_line(text):
    with pytest.raises(params.ParameterMistake, match="NAME=VALUE") as caught:
        params.parsed([f"{SAFE_TIME}=1", text])
    assert "\n" not in str(caught.value)


def test_assignments():
    assert params.parsed([f"{SAFE_TIME}=1.8", "ocp.input_bounds.delta.min=-5e-1"]) == {SAFE_TIME: 1.8, "ocp.input_bounds.delta.min": -0.5}
    with pytest.raises(params.ParameterMistake, match="twice"):
        params.parsed(["a=1", "a=2"])


def test_set_get_revert_and_history(controller):
    store, _, port = controller
    accepted = params.change([f"{SAFE_TIME}=1.8", "ocp.input_bounds.t_r.min=-0.5"], port)
    assert shown(params.changes_table(accepted))[:3] == [
        "parameters, version 1", "name                      old   new", "planner.safe_time_s       1.2   1.8",
    ]  # fmt: skip
    rows = shown(params.values_table(params.values([SAFE_TIME, "planner.detection_range_m"], port)))
    assert rows[2].split()[:8] == [SAFE_TIME, "1.8", "s", "0", "to", "5", "1.2", "changed"]
    assert "changed" not in rows[3]
    assert len(params.values([], port).parameters) == len(store.table)
    assert params.revert("1", port).version == 2
    trail = shown(params.history_table(params.history(port)))
    assert [row.split()[0] for row in trail[2:]] == ["1", "ocp.input_bounds.t_r.min", "2", "ocp.input_bounds.t_r.min"]
    assert trail[4].split()[3:] == ["1", SAFE_TIME, "1.8", "1.2"]
    assert "@" in store.newest.history[0].who


def test_a_name_is_shown_as_it_is(controller):
    store, _, port = controller
    store.propose({SAFE_TIME: 1.8}, "[red]ann[/red]", time.monotonic_ns())
    assert "[red]ann[/red]" in shown(params.history_table(params.history(port)))[2]


@pytest.mark.parametrize("what", ["first", "-1", "1.5", "", "²"])
def test_what_cannot_be_taken_back_is_the_users_mistake(what, port):
    with pytest.raises(params.ParameterMistake, match="number of a change, last or all"):
        params.revert(what, port)


def test_refusals_are_the_users_mistake(port):
    with pytest.raises(params.ParameterMistake, match="from 0 to 5 s"):
        params.change([f"{SAFE_TIME}=9"], port)
    with pytest.raises(params.ParameterMistake, match=SAFE_TIME):
        params.values(["planner.safe_tme_s"], port)
    with pytest.raises(params.ParameterMistake, match="no change"):
        params.revert("last", port)


def test_following_tells_what_comes_in_force(controller):
    store, publisher, port = controller
    stop, lines = threading.Event(), []
    thread = threading.Thread(target=params.follow, args=(port, stop, lambda sample: lines.append(params.line(sample))))
    thread.start()
    store.propose({SAFE_TIME: 1.8}, "ann", 0)
    _, (entry,) = store.take()

    def is_told():
        publisher.post(parameters_sample(entry, time.monotonic_ns()))
        return lines

    wait_until(is_told, 10, "a change")
    stop.set()
    thread.join(5)
    assert not thread.is_alive()
    assert lines[0].split(maxsplit=1)[1] == "version 1 by ann: planner.safe_time_s 1.2 -> 1.8"


def test_without_a_controller_nothing_is_followed():
    with pytest.raises(TelemetryError, match="no controller on port"):
        params.follow(free_base_port(), threading.Event(), print)


def test_the_commands(controller):
    store, _, port = controller
    ports = ["--telemetry-port", str(port)]
    finished = xilgate("params", "set", f"{SAFE_TIME}=1.8", "--json", *ports)
    assert finished.returncode == 0, finished.stderr
    assert json.loads(finished.stdout) == {"answer": "accepted", "version": 1, "changes": [{"name": SAFE_TIME, "old": 1.2, "new": 1.8}]}
    finished = xilgate("params", "list", *ports, env=os.environ | {"COLUMNS": "140"})
    assert finished.returncode == 0, finished.stderr
    assert [name for name in store.table if f"\n{name} " not in finished.stdout] == []
    finished = xilgate("params", "set", f"{SAFE_TIME}=9", "ocp.nothing=1", *ports)
    assert finished.returncode == 2
    assert finished.stdout == ""
    assert [line[:9] for line in finished.stderr.splitlines()] == ["xilgate: "] * 2
    assert store.newest.version == 1


def test_the_commands_without_a_controller():
    port = free_base_port()
    finished = xilgate("params", "list", "--telemetry-port", str(port))
    assert finished.returncode == 3
    (line,) = finished.stderr.splitlines()
    assert str(port + 1) in line
    assert "--telemetry-port" in line


@pytest.mark.req("S1")
def test_a_rig_that_is_another_machine_is_tuned_by_its_writers_and_watched_by_its_readers(remote, tmp_path):
    publisher, files = remote
    tuned = xilgate("params", "set", f"{SAFE_TIME}=1.9", "--tls", files["tuner"])
    assert tuned.returncode == 0, tuned.stderr
    refused = xilgate("params", "set", f"{SAFE_TIME}=1.7", "--tls", files["reader"])
    assert (refused.returncode, len(refused.stderr.splitlines())) == (3, 1)
    assert refused.stderr.endswith(f"serves no parameters, or the rig does not name {tmp_path}/reader.pem among its writers\n")
    assert "1.9" in xilgate("params", "get", SAFE_TIME, "--tls", files["tuner"]).stdout

    watching = start_xilgate("watch", "--tls", files["reader"])
    try:
        seen = []
        reading = threading.Thread(target=lambda: seen.extend(iter(watching.stdout.readline, "")), daemon=True)
        reading.start()

        def is_seen():
            publisher.post(next(sample for sample in samples_at(3.0, 1, 1) if isinstance(sample, CommandSample)))
            return any("command OK" in line for line in seen)

        wait_until(is_seen, 20, "a command of the rig")
        assert "lost" not in seen[-1]  # the clock of another machine says nothing about age
    finally:
        end(watching)

    mistaken = tmp_path / "mistaken.toml"
    mistaken.write_text('address = "127.0.0.1:7547"\ncertificate = "none.pem"\nprivate_key = "none.key"\n')
    for command in (["watch"], ["view"], ["params", "list"]):
        finished = xilgate(*command, "--tls", str(mistaken))
        assert (finished.returncode, finished.stderr) == (2, f"xilgate: {mistaken}: authority: missing\n")
    mistaken.write_text(mistaken.read_text() + 'authority = "none.pem"\n')
    for command in (["watch"], ["params", "list"]):
        finished = xilgate(*command, "--tls", str(mistaken))
        assert (finished.returncode, finished.stderr) == (2, f"xilgate: {tmp_path}/none.pem: No such file or directory\n")


@pytest.mark.parametrize("command", [["watch"], ["view"], ["params", "list"], ["params", "set", f"{SAFE_TIME}=1.9"]])
def test_a_port_of_this_machine_and_another_machine_exclude_each_other(command, tmp_path):
    port, machine = ["--telemetry-port", "47500"], ["--tls", str(tmp_path / "tls.toml")]
    for options in ([*port, *machine], [*machine, *port]):
        finished = xilgate(*command, *options)
        assert finished.returncode == 2
        assert finished.stderr.startswith("xilgate: --telemetry-port: not beside --tls")
