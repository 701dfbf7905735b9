"""Mistakes get one line and an exit code, never a traceback."""

import fcntl
import json
import os
import shutil
import signal
import socket

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from tests.support.processes import free_base_port, start_xilgate, wait_until, xilgate
from tests.support.site import SITE_DBC, SITE_MAPPING
from xil.cli_common import show
from xil.scenario import scenario_path


def fails(code, *words, arguments, **options):
    finished = xilgate(*arguments, **options)
    assert finished.returncode == code, finished.stderr
    assert "Traceback" not in finished.stderr
    lines = [line for line in finished.stderr.splitlines() if line.startswith("xilgate: ")]
    assert len(lines) == 1, finished.stderr
    for word in words:
        assert word in lines[0]


def test_unknown_scenario(tmp_path):
    fails(2, "iso3889", "iso3888-1", arguments=["drive", "iso3889", "--out", str(tmp_path)])


@pytest.mark.parametrize("bus", ["canbus", "socketcan:nope7", "xilgate:nobody"])
def test_unknown_bus(tmp_path, bus):
    fails(2, bus, arguments=["drive", "--bus", bus, "--out", str(tmp_path)])


@pytest.mark.parametrize("bus", ["canbus", "socketcan:nope7", "xilgate:nobody"])
def test_unknown_navigation_bus(tmp_path, bus):
    fails(2, "--navigation-bus", bus, arguments=["drive", "--bus", "emulated", "--navigation-bus", bus, "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("process", "exit_code", "said"), [("gateway", 2, "buses.robots = 'virtual'"), ("emulator", 3, "robots: bus 'virtual'")]
)
def test_a_daemon_names_the_bus_that_does_not_open(process, exit_code, said):
    port = ["--telemetry-port", str(free_base_port())]
    fails(exit_code, said, "INTERFACE:CHANNEL", arguments=[process, "--bus", "virtual", *port])
    fails(3, "navigation: bus 'xilgate:nobody'", arguments=[process, "--bus", "virtual:0", "--navigation-bus", "xilgate:nobody", *port])


def test_unknown_solver(tmp_path):
    fails(2, "magic", "casadi-c", arguments=["drive", "--solver", "magic", "--out", str(tmp_path)])


def test_vehil_needs_a_real_bus(tmp_path):
    fails(2, "--bus", arguments=["drive", "--stage", "vehil", "--out", str(tmp_path)])
    one_named = ["--bus", "socketcan:can0", "--navigation-bus", "emulated"]
    fails(2, "--navigation-bus", arguments=["drive", "--stage", "vehil", *one_named, "--out", str(tmp_path)])


@pytest.mark.parametrize("offset", [0, 1, 2, 3])
def test_busy_telemetry_port(tmp_path, offset):
    base = free_base_port()
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", base + offset))
        other.listen()
        arguments = ["drive", "--bus", "emulated", "--telemetry-port", str(base), "--out", str(tmp_path)]
        fails(3, str(base + offset), "busy", "--telemetry-port", arguments=arguments)


@pytest.mark.parametrize("option", [["--bus", "emulated"], ["--navigation-bus", "emulated"], ["--view"]])
def test_lockstep_takes_no_bus_and_no_view(tmp_path, option):
    fails(2, "sil", option[0], arguments=["drive", "--stage", "sil", *option, "--out", str(tmp_path)])


def test_files_that_a_record_could_not_tell_apart(tmp_path):
    for folder, dbc in (("a", ROBOTS_DBC), ("b", GNSS_IMU_DBC)):
        (tmp_path / folder).mkdir()
        shutil.copy(dbc, tmp_path / folder / "car.dbc")
    dbc = ["--dbc", str(tmp_path / "a" / "car.dbc"), "--dbc", str(tmp_path / "b" / "car.dbc")]
    fails(2, "b/car.dbc: named as", "a/car.dbc", arguments=["drive", "--stage", "sil", *dbc, "--out", str(tmp_path / "run")])


def test_run_directory_in_use_is_left_alone(tmp_path):
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    (tmp_path / "summary.json").write_text("theirs")
    fails(2, "in use", "--out", arguments=["drive", "--stage", "sil", "--out", str(tmp_path)])
    os.close(descriptor)
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_a_full_disk(tmp_path):
    (tmp_path / "configuration.json").symlink_to("/dev/full")
    fails(3, f"{tmp_path}: No space left on device", arguments=["drive", "--stage", "sil", "--out", str(tmp_path)])


@pytest.mark.parametrize("stage", ["mil", "sil"])
def test_interrupted_run_leaves_no_verdict_of_an_earlier_one(tmp_path, stage):
    (tmp_path / "summary.json").write_text("stale")
    (tmp_path / "report.html").write_text("stale")
    process = start_xilgate("drive", "--stage", stage, "--out", str(tmp_path))
    wait_until((tmp_path / "bus.log").exists, 60, "the drive to begin")
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 130, output
    assert "Traceback" not in output
    assert not (tmp_path / "summary.json").exists()
    assert not (tmp_path / "report.html").exists()


def test_names_with_brackets_are_names(tmp_path):
    text = scenario_path("iso3888-1").read_text().replace('"gate 1"', '"[/gate] 1"')
    assert "[/gate]" in text
    (tmp_path / "mine.toml").write_text(text)
    out = tmp_path / "[run]"
    finished = xilgate("drive", str(tmp_path / "mine.toml"), "--stage", "sil", "--out", str(out))
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.splitlines() == ["PASS  every limit kept", f"report: {out / 'report.html'}"]
    assert "[/gate] 1" in (out / "report.html").read_text()


SITE = ["--dbc", str(SITE_DBC), "--dbc", str(GNSS_IMU_DBC), "--mapping", str(SITE_MAPPING)]


def test_a_drive_on_the_dbc_of_a_site_passes_and_comes_out_the_same_again(tmp_path):
    finished = xilgate("drive", "--stage", "sil", "--out", str(tmp_path), *SITE)
    assert finished.returncode == 0, finished.stderr
    hashes = json.loads((tmp_path / "summary.json").read_text())["sha256"]
    assert {"site_robots.dbc", "gnss_imu.dbc", "mapping"} <= hashes.keys()
    assert json.loads((tmp_path / "configuration.json").read_text())["mapping"] == str(SITE_MAPPING)
    again = xilgate("resim", str(tmp_path))
    assert again.returncode == 0, again.stdout + again.stderr


def test_late_write_error_is_one_line(tmp_path):
    (tmp_path / "report.html").mkdir()
    fails(3, "report.html", arguments=["drive", "--stage", "sil", "--out", str(tmp_path)])


def test_operating_without_a_gateway(tmp_path):
    fails(3, "no gateway", arguments=["operate", "engage", "--control", str(tmp_path / "nobody")])


def test_busy_page_port():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = str(other.getsockname()[1])
        fails(3, port, arguments=["view", "--port", port, "--telemetry-port", str(free_base_port())])


def test_malformed_scenario_names_the_key(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\ndescription = "x"\ntime_limit_s = "soon"\n')
    finished = xilgate("drive", str(path), "--out", str(tmp_path))
    assert finished.returncode == 2
    assert "Traceback" not in finished.stderr
    assert "mine.toml" in finished.stderr
    assert "time_limit_s" in finished.stderr


def test_dbc_that_does_not_load(tmp_path):
    path = tmp_path / "site.dbc"
    path.write_text(ROBOTS_DBC.read_text()[:900])
    fails(2, "site.dbc", arguments=["drive", "--stage", "sil", "--dbc", str(path), "--out", str(tmp_path)])


def test_dbc_that_lacks_a_message_names_it(tmp_path):
    fails(2, "PosLocal", arguments=["drive", "--stage", "sil", "--dbc", str(ROBOTS_DBC), "--out", str(tmp_path)])


def test_missing_compiler(tmp_path):
    (tmp_path / "blocked" / "ziglang").mkdir(parents=True)
    (tmp_path / "blocked" / "ziglang" / "__main__.py").write_text("raise SystemExit(1)\n")
    (tmp_path / "blocked" / "ziglang" / "__init__.py").write_text("")
    environment = {k: v for k, v in os.environ.items() if k != "CC"} | {
        "PATH": str(tmp_path), "PYTHONPATH": str(tmp_path / "blocked"), "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    fails(3, "compiler", arguments=["drive", "--stage", "sil", "--out", str(tmp_path)], env=environment)


def test_run_directory_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    fails(3, "file", arguments=["drive", "--stage", "sil", "--out", str(tmp_path / "file" / "run")])


def test_doctor_speaks_json():
    finished = xilgate("doctor", "--json")
    assert finished.returncode == 0
    assert {"C compiler"} & {check["name"] for check in json.loads(finished.stdout)}


def test_bench_gateway_prints_the_common_shape():
    finished = xilgate("bench", "gateway", "--json", "--seconds", "1", "--rounds", "2")
    assert finished.returncode == 0, finished.stderr
    result = json.loads(finished.stdout)
    (row,) = result["rows"]
    assert result["machine"]
    assert {"solver", "set", "instances", "rounds", "quiet_mean_us", "quiet_p99_us", "raw_p99_us", "raw_max_us"} <= row.keys()
    assert row["instances"] >= 100
    assert 0.0 < row["quiet_mean_us"] <= row["raw_max_us"]


def test_a_text_is_printed_as_it_is(capsys):
    for text in ("car [/a] x", "/data/[red]/robots.dbc", "x" * 300):
        show(text, as_json=False)
        assert capsys.readouterr().out == text + "\n"
