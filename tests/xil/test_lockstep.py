"""Closed loop in virtual time: real cores, real frame bytes, one process."""

import json
import re

import numpy as np
import pytest

from dbc.catalogue import load
from tests.support.processes import xilgate
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.frame import BusFrame
from xil.buslog import recorded_load

pytestmark = pytest.mark.shared_setup

MAX_RESPONSE_US = 10_000
"""Longest time that a message of the default set can take on its bus, rounded up to the shortest cycle."""


def drive(out, *arguments):
    finished = xilgate("drive", "--out", str(out), *arguments)
    summary = json.loads((out / "summary.json").read_text())
    return finished, summary


@pytest.fixture(scope="module")
def sil(tmp_path_factory):
    runs = [(seed, tmp_path_factory.mktemp("sil")) for seed in (1, 1, 2)]
    return [(*drive(out, "--stage", "sil", "--seed", str(seed)), out) for seed, out in runs]


def metric(summary, name):
    return next(m for m in summary["metrics"] + summary["timing"] if m["name"] == name)


def test_sil_drives_the_double_lane_change(sil):
    finished, summary, out = sil[0]
    assert finished.returncode == 0, finished.stderr
    assert summary["verdict"] == "pass"
    for gate in (1, 2, 3):
        assert metric(summary, f"clearance in gate {gate}")["value"] > 0.0
    assert metric(summary, "disengagements before the end")["value"] == 0
    expected = {"summary.json", "report.html", "bus.log", "scenario.toml", "reference.csv", "road.toml", "configuration.json"}
    expected |= {"gateway-0000.journal", "controller-0000.journal"}
    assert expected == {path.name for path in out.iterdir()}


def test_same_seed_same_bytes(sil):
    logs = [(out / "bus.log").read_bytes() for _, _, out in sil]
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]
    assert sil[0][1]["metrics"] == sil[1][1]["metrics"]


def test_other_seed_passes_as_well(sil):
    assert sil[2][0].returncode == 0, sil[2][1]["reason"]


def record(out):
    """Lines of the bus record: time [us], channel, message, payload."""
    catalogue = load()
    line = re.compile(r"\((\d+)\.(\d{6})\) (robots|navigation) ([0-9A-F]{3})#((?:[0-9A-F]{2})*)")
    for text in (out / "bus.log").read_text().splitlines():
        seconds, micros, channel, identifier, data = line.fullmatch(text).groups()
        yield int(seconds) * 1_000_000 + int(micros), channel, catalogue.by_id[int(identifier, 16)], bytes.fromhex(data)


def test_bus_log_holds_every_cyclic_message_at_its_period(sil):
    lines = list(record(sil[0][2]))
    assert [t_us for t_us, *_ in lines] == sorted(t_us for t_us, *_ in lines)
    times_us = {}
    for t_us, channel, spec, data in lines:
        assert channel == spec.network
        assert len(data) == spec.length_bytes
        times_us.setdefault(spec.name, []).append(t_us)
    by_name = load().by_name
    assert times_us.keys() == {name for name, spec in by_name.items() if spec.cycle_time_ns}
    for name, times in times_us.items():
        cycle_us = by_name[name].cycle_time_ns / 1000
        # Arbitration moves a frame within its cycle, never from one to the next.
        assert np.diff(times).mean() == pytest.approx(cycle_us, rel=0.01), name
        assert np.abs(np.diff(times) - cycle_us).max() < MAX_RESPONSE_US, name


def test_no_bit_of_a_bus_is_used_twice(sil):
    ends_us = {}
    for t_us, channel, spec, data in record(sil[0][2]):
        bits, _ = frame_bits(BusFrame(spec.arbitration_id, data, 0, len(data)))
        assert t_us - 2 * bits >= ends_us.get(channel, 0) + 2 * 3 - 1  # bits of 2 us, an intermission, time stamps cut to 1 us
        ends_us[channel] = t_us
    assert ends_us.keys() == {"robots", "navigation"}


def test_the_load_of_the_buses_is_that_of_the_record(sil):
    _, summary, out = sil[0]
    counted = recorded_load(out / "bus.log", load().bitrate_bps)
    assert summary["bus_load"] == {network: pytest.approx(load, rel=1e-3) for network, load in counted.items()}
    assert 0.1 < counted["robots"] < counted["navigation"] < 0.9


def test_the_run_tells_how_fast_it_was(sil):
    finished, summary, _ = sil[0]
    line = re.search(r"^([\d.]+) s of driving in ([\d.]+) s, ([\d.]+) times real time$", finished.stderr, re.MULTILINE)
    assert summary["realtime_factor"] == pytest.approx(float(line[3]), abs=0.051)
    assert summary["realtime_factor"] == pytest.approx(float(line[1]) / float(line[2]), rel=0.05)


SHORT = """
name = "short"
description = "One bend at 50 km/h from beside the lane's centre, then to rest: short, because the uncompiled controller is slow"
time_limit_s = 12.0
start = { offset_m = -0.3, speed_kmh = 50.0 }
speed = { cruise_kmh = 50.0, acceleration_mps2 = 1.5, deceleration_mps2 = 4.0, stop_m = 70.0 }
path = { start_m = 0.0, curves = [{ start_m = 20.0, end_m = 60.0, radius_m = 150.0, transition_m = 15.0 }] }
road = { left_m = 1.75, right_m = 1.75 }

[judge]
from_m = 30.0
to_m = 45.0
entry_speed_error_kmh = 3.0
lateral_error_max_m = 0.25
heading_error_max_deg = 3.0
"""


def test_mil_passes_with_the_uncompiled_controller(tmp_path):
    path, out = tmp_path / "short.toml", tmp_path / "run"
    path.write_text(SHORT)
    finished, summary = drive(out, str(path), "--stage", "mil")
    assert finished.returncode == 0, summary["reason"]
    assert summary["solver"] == "casadi-vm"
    assert summary["compiler"] == ""


def test_lane_keeping_from_standstill(tmp_path):
    finished, summary = drive(tmp_path, "lane-keeping", "--stage", "sil")
    assert finished.returncode == 0, summary["reason"]
