"""The proofs of the closed loop, each on few drives; `xilgate bench loop` has them all."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.nmpc import DRIVE_MODEL
from controller.planning.reference import ReferencePath
from controller.problem import OcpOptions
from controller.solvers import make_solver
from dbc.catalogue import load
from dbc.vehicle import load_vehicle
from xil import bench_loop
from xil.bench_loop import (
    AWARE_OBSERVED,
    BLIND_OBSERVED,
    DRIVEN,
    UNOBSERVED,
    FullDrive,
    distances_m,
    full_drive,
    loss,
    on_grade,
    with_dead_time,
    with_mass,
)
from xil.figures import Row
from xil.lockstep import START_NS, LockstepRun
from xil.recording import Recording
from xil.scenario import Scenario, Stage, load_scenario
from xil.setup import RunSetup

SOLVER = "riccati"
VEHICLE = load_vehicle()


def test_no_car_is_lost_at_the_limits_with_four_times_the_noise(monkeypatch):
    cases = bench_loop.loss_cases()
    monkeypatch.setattr(bench_loop, "loss_cases", lambda: {name: cases[name] for name in ("sat80", "tight90")})
    lost, largest, _ = loss(SOLVER, 1, map)
    assert (lost.measured, lost.is_met) == (0, True)
    assert 0.05 < largest.measured < 0.5


def test_cases_ask_for_more_than_the_car_can_do():
    for name in ("sat80", "sat90"):
        scenario, options = bench_loop.loss_cases()[name]
        assert scenario.speed_mps < scenario.path.speed_mps[0] - 3.0
        assert options.planner.speed_margin_mps > 3.0


def test_a_lost_car_is_counted(monkeypatch):
    drives = {1: (1.6, 0.1, 1.0), 2: (0.9, 0.7, 1.0), 3: (0.9, 0.5, 1.0)}
    monkeypatch.setattr(bench_loop, "loss_cases", lambda: {"one": None})
    lost, *_ = loss(SOLVER, 3, lambda function, tasks: [drives[seed] for _, _, seed in tasks])
    assert (lost.measured, lost.is_met) == (2, False)


def test_knowing_the_delay_calms_the_pedals_and_keeps_the_car_on_its_path():
    vehicle, scenario = with_dead_time(VEHICLE, 0.08), load_scenario("iso3888-1")
    assert {vehicle.robots.steering.dead_time_s, vehicle.robots.accelerator.dead_time_s, vehicle.robots.brake.dead_time_s} == {0.08}
    blind, aware = (full_drive(FullDrive(SOLVER, variant, scenario, vehicle, 1)) for variant in (BLIND_OBSERVED, AWARE_OBSERVED))
    assert aware.pedals_norm < 0.7 * blind.pedals_norm
    assert aware.lateral_error_max_m < 0.2
    assert blind.lateral_error_max_m > 1.0


def test_the_delay_rows_compare_like_with_like():
    """Variants in their order: blind, aware, and both with the observer."""
    drives = iter([bench_loop.Figures(p, m, m, 0.0) for p, m in ((2.0, 0.9), (1.5, 0.2), (1.0, 0.8), (0.6, 0.1))] * 2)
    rows = bench_loop.delay(SOLVER, 1, lambda _, tasks: [next(drives) for _ in tasks])
    saved = [(row.case.partition(", 80 ms, ")[2], row.measured, row.is_met) for row in rows if "saved" in row.row]
    assert saved == [("aware", 0.25, None), ("aware, observer", pytest.approx(0.4), True)] * 2
    judged = [(row.case, row.target) for row in rows if row.row.startswith("lateral") and row.target is not None]
    assert judged == [("iso3888-1, 80 ms, aware, observer", 0.8)]


def test_slope_and_mass_leave_no_speed_error():
    vehicle, scenario = with_mass(VEHICLE, 1.1), on_grade(load_scenario("iso3888-1"), 6.0)
    assert vehicle.multibody.masses.mass_kg == pytest.approx(1.1 * VEHICLE.multibody.masses.mass_kg)
    assert vehicle.model == VEHICLE.model
    without, with_it = (full_drive(FullDrive(SOLVER, variant, scenario, vehicle, 1)) for variant in (UNOBSERVED, DRIVEN))
    assert with_it.speed_error_rms_mps <= 0.1
    assert without.speed_error_rms_mps > 0.25


@pytest.fixture
def short_scenario():
    """20 km/h straight ahead, to rest after 50 m."""
    data = load_scenario("lane-keeping").model_dump()
    data["path"]["curves"] = []
    data["start"] |= {"offset_m": 0.0, "speed_kmh": 20.0}
    data["speed"] |= {"cruise_kmh": 20.0, "stop_m": 50.0}
    data["judge"] |= {"from_m": 20.0, "to_m": 25.0}
    return Scenario.model_validate(data | {"time_limit_s": 18.0})


@pytest.mark.parametrize(("grade_percent", "variant"), [(-6.0, UNOBSERVED), (6.0, DRIVEN)])
def test_a_car_that_stops_on_a_slope_stands(short_scenario, tmp_path, monkeypatch, grade_percent, variant):
    """Downhill even one that has no idea of the slope; uphill that one would not get to the end. Nobody disengages it."""
    monkeypatch.setattr("xil.operator.STANDSTILL_MPS", -1.0)
    scenario, recording = on_grade(short_scenario, grade_percent), Recording(START_NS)
    setup = RunSetup(scenario, Stage.SIL, VEHICLE, load(), SOLVER, None, None, 1, tmp_path, (), Path(), None, 0)
    solver = make_solver(SOLVER, VEHICLE.model, OcpOptions(model=DRIVE_MODEL), print)
    LockstepRun(setup, solver, recording, lambda _: None, lambda: False, options=variant.options).drive()
    assert recording.latest("state").mode == "ENGAGED"
    assert recording.latest("world").x_m == pytest.approx(50.0, abs=1.0)
    assert np.abs(recording.series("world", "vx_mps")[-100:]).max() < 0.001
    assert recording.latest("command").drive_norm == -1.0


def test_distances_are_those_of_the_nearest_segment():
    x_m = np.arange(0.0, 11.0)
    path = ReferencePath(x_m, 0.0 * x_m, 0.0 * x_m, 1.0 + x_m, 1.0 + x_m, 1.0 + x_m)
    np.testing.assert_allclose(distances_m(path, np.array(((2.5, 1.0), (4.0, -2.0), (13.0, 4.0)))), (1.0, 2.0, 5.0))


@pytest.mark.parametrize(
    ("measured", "relation", "target", "is_met"),
    [
        (0.1, "at most", 0.1, True), (0.11, "at most", 0.1, False),
        (0.3, "at least", 0.3, True), (0.2, "at least", 0.3, False), (1.0, "", None, None),
    ],
)
def test_a_row_knows_whether_its_target_is_met(measured, relation, target, is_met):
    assert Row("a", "b", measured, "m", relation, target).is_met is is_met


def test_the_bench_prints_every_row_beside_its_target(monkeypatch):
    row = Row("speed error, RMS", "a hill", 0.02, "m/s", "at most", 0.1)
    for part in ("loss", "delay", "slope"):
        monkeypatch.setattr(bench_loop, part, lambda *_: [row])
    monkeypatch.setattr(bench_loop, "cost", lambda _: [replace(row, target=None, relation="")])
    monkeypatch.setattr(bench_loop, "make_solver", lambda *_: None)
    result = bench_loop.bench_loop(SOLVER, 1, lambda _: None)
    assert [entry["met"] for entry in json.loads(json.dumps(result))["rows"]] == [True] * 3 + [None]
    assert bench_loop.to_table(result).row_count == 4


def test_cost_leaves_out_the_solve():
    (row,) = bench_loop.cost(SOLVER)
    assert row.target is None
    assert row.measured > 0.0
