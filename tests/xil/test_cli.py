"""Mistakes get one line and an exit code, never a traceback."""

import json
import os
import socket

import pytest

from dbc.catalogue import ROBOTS_DBC
from tests.support.processes import free_base_port, xilgate


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


def test_unknown_solver(tmp_path):
    fails(2, "ipopt", "casadi-c", arguments=["drive", "--solver", "ipopt", "--out", str(tmp_path)])


def test_vehil_needs_a_real_bus(tmp_path):
    fails(2, "--bus", arguments=["drive", "--stage", "vehil", "--out", str(tmp_path)])


def test_busy_telemetry_port(tmp_path):
    base = free_base_port()
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", base))
        other.listen()
        fails(3, str(base), "busy", arguments=["drive", "--bus", "emulated", "--telemetry-port", str(base), "--out", str(tmp_path)])


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
    fails(2, "file", arguments=["drive", "--stage", "sil", "--out", str(tmp_path / "file" / "run")])


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
