"""Closed loop in virtual time: real cores, real frame bytes, one process."""

import json
import re
from itertools import pairwise

import pytest

from dbc.catalogue import load
from tests.support.processes import xilgate


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
    expected = {"summary.json", "report.html", "bus.log", "scenario.toml", "reference.csv", "configuration.json"}
    assert expected == {path.name for path in out.iterdir()}


def test_same_seed_same_bytes(sil):
    logs = [(out / "bus.log").read_bytes() for _, _, out in sil]
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]
    assert sil[0][1]["metrics"] == sil[1][1]["metrics"]


def test_other_seed_passes_as_well(sil):
    assert sil[2][0].returncode == 0, sil[2][1]["reason"]


def test_bus_log_holds_every_cyclic_message_at_its_period(sil):
    catalogue = load()
    line = re.compile(r"\((\d+)\.(\d{6})\) lockstep ([0-9A-F]{3})#((?:[0-9A-F]{2})*)")
    times_us = {}
    for text in (sil[0][2] / "bus.log").read_text().splitlines():
        seconds, micros, identifier, data = line.fullmatch(text).groups()
        spec = catalogue.by_id[int(identifier, 16)]
        assert len(data) == 2 * spec.length_bytes
        times_us.setdefault(spec.name, []).append(int(seconds) * 1_000_000 + int(micros))
    assert times_us.keys() == catalogue.by_name.keys()
    for name, times in times_us.items():
        steps = {b - a for a, b in pairwise(times)}
        assert steps == {catalogue.by_name[name].cycle_time_ns // 1000}, name


def test_mil_passes_with_the_uncompiled_controller(tmp_path):
    finished, summary = drive(tmp_path, "--stage", "mil")
    assert finished.returncode == 0, summary["reason"]
    assert summary["solver"] == "casadi-vm"
    assert summary["compiler"] == ""


def test_lane_keeping_from_standstill(tmp_path):
    finished, summary = drive(tmp_path, "lane-keeping", "--stage", "sil")
    assert finished.returncode == 0, summary["reason"]
