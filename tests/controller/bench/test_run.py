"""The bench: the shape of what it prints, that solvers see the same problems, and the arithmetic of its figures."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest
from rich.console import Console

from controller.bench import run as bench
from controller.bench import sets as bench_sets
from controller.bench.instructions import CallgrindError, count_instructions, find_valgrind
from controller.bench.library import loadable_bytes
from controller.bench.measure import Measurement, interleaved
from controller.bench.scenarios import active_cases, nominal_cases
from controller.bench.sets import Instance
from controller.bench.table import to_table
from controller.problem import OcpOptions
from controller.solver import Effort, SolveResult, SolveStatus
from controller.solvers import LIBRARIES
from dbc.build import find_compiler
from dbc.errors import UserMistake

SOLVERS = ("casadi-vm", "casadi-c", "riccati")


@pytest.fixture(scope="module")
def _short_cases():
    with pytest.MonkeyPatch.context() as patch:
        for name, cases in (("nominal_cases", nominal_cases()), ("active_cases", active_cases()[:1])):
            shorter = tuple(replace(case, scenario=replace(case.scenario, duration_s=0.4)) for case in cases)
            patch.setattr(bench_sets, name, lambda shorter=shorter: shorter)
        yield


@pytest.fixture(scope="module")
def result(library, _short_cases):
    options = bench.BenchOptions(instances=8, rounds=1, starts=8, solvers=SOLVERS)
    return bench.bench_solver(options, progress=lambda text: None)


KEYS = {
    *("solver", "set", "instances", "rounds", "ratio_mean", "ratio_p99", "ratio_max"),
    *("quiet_mean_us", "quiet_p99_us", "quiet_max_us", "raw_p99_us", "raw_max_us"),
    *("sqp_iterations_mean", "sqp_iterations_p95", "qp_iterations_mean", "work_mean", "work_max", "converged"),
}


def test_the_result_has_exactly_the_keys_that_readers_rely_on(result):
    assert set(result) == {"machine", "unit", "solvers", "rows", "profile", "limit", "hard", "agreement", "instructions", "targets"}
    nominal = [row for row in result["rows"] if row["set"] == "nominal"]
    assert [row["solver"] for row in nominal] == list(SOLVERS)
    for row in result["rows"]:
        assert set(row) == KEYS
        assert 0 < row["quiet_mean_us"] <= row["quiet_p99_us"] <= row["quiet_max_us"] <= row["raw_max_us"]
        assert (row["rounds"], row["converged"]) == (1, 1.0)
    assert [(row["solver"], row["set"]) for row in result["rows"] if row["set"] != "nominal"] == [
        ("casadi-c", "active"), ("riccati", "active"), ("riccati", "active-feasible"),
    ]  # fmt: skip
    assert result["agreement"] == result["instructions"] == []
    assert {row["solver"] for row in result["hard"]} == {row["solver"] for row in result["limit"]} == {"riccati"}
    for library in result["solvers"]:
        assert set(library) == {"solver", "compiler", "flags", "lanes", "library_bytes", "work_bytes", "memory_bytes"}
        assert library["memory_bytes"] == library["library_bytes"] + library["work_bytes"] > 100_000
    for target in result["targets"]:
        assert set(target) == {"what", "target", "measured", "met"}
    json.dumps(result, allow_nan=False)


def test_the_unit_is_the_papers_solver_generated_by_default(result):
    row = next(row for row in result["rows"] if (row["solver"], row["set"]) == ("casadi-c", "nominal"))
    assert row["ratio_mean"] == 1.0
    assert result["unit"] == {"solver": "casadi-c", "set": "nominal", "quiet_mean_us": row["quiet_mean_us"]}


def test_compiling_changes_the_time_and_not_the_iterations(result):
    uncompiled, compiled = result["rows"][:2]
    assert uncompiled["sqp_iterations_mean"] == compiled["sqp_iterations_mean"]
    assert compiled["qp_iterations_mean"] >= compiled["sqp_iterations_mean"]
    assert compiled["quiet_mean_us"] < uncompiled["quiet_mean_us"] / 3


def test_a_whole_solve_takes_longer_than_the_least(result):
    (limit,) = result["limit"]
    assert 0.0 < limit["riccati_us"] < limit["stage_sweep_us"] < limit["least_us"]
    assert limit["alone_mean_us"] > limit["least_us"]


def test_the_table_names_solvers_kinds_and_targets(result):
    console = Console(width=160, record=True)
    console.print(to_table(result))
    text = console.export_text()
    for expected in (*SOLVERS, "wild", "hessian", "qrqp, nominal: mean", "not measured", result["machine"]):
        assert expected in text


@pytest.mark.parametrize("wrong", [{"sets": ("easy",)}, {"solvers": ("fast",)}])
def test_unknown_names_are_the_users_mistake(wrong):
    with pytest.raises(UserMistake, match=r"'(easy|fast)': there are"):
        bench.BenchOptions(**wrong)


def solved(microseconds, sqp=2, work=None, status=SolveStatus.CONVERGED):
    return SolveResult(status, None, None, 0.0, 0.0, Effort(sqp, work=work), microseconds * 1000)


def instance(is_feasible=None):
    return Instance(None, None, None, None, is_feasible=is_feasible)


def test_quiet_is_the_smallest_of_the_rounds_of_each_problem():
    row = Measurement("x", "nominal", [instance()] * 2, [[solved(10), solved(50)], [solved(30), solved(20)]]).row(unit_us=100.0)
    assert (row["quiet_mean_us"], row["quiet_max_us"], row["raw_max_us"], row["instances"], row["rounds"]) == (15.0, 20.0, 50.0, 2, 2)
    assert (row["ratio_mean"], row["ratio_max"], row["ratio_p99"]) == (0.15, 0.2, 0.199)
    assert (row["sqp_iterations_mean"], row["qp_iterations_mean"], row["work_mean"]) == (2.0, None, None)


def test_the_figures_of_feasible_problems_are_those_of_them_alone():
    results = [[solved(10, sqp=1, work=5.0), solved(50, sqp=9, work=99.0, status=SolveStatus.NOT_CONVERGED)]]
    whole = Measurement("x", "active", [instance(True), instance(False)], results)
    assert (whole.row(1.0)["converged"], whole.row(1.0)["work_max"]) == (0.5, 99.0)
    part = whole.feasible().row(1.0)
    assert (part["set"], part["instances"], part["converged"], part["work_max"], part["sqp_iterations_p95"]) == (
        "active-feasible", 1, 1.0, 5.0, 1.0,
    )  # fmt: skip


class CountingSolver:
    warm_start = None

    def __init__(self, name, log):
        self.name, self._log = name, log

    def solve(self, state, previous_input, horizon):
        self._log.append((self.name, state))
        return solved(1)


def test_solvers_take_turns_and_hard_ones_are_spared_what_is_infeasible():
    log = []
    solvers = [CountingSolver(name, log) for name in ("casadi-vm", "casadi-c", "riccati")]
    problems = [Instance("a", None, None, None, is_feasible=True), Instance("b", None, None, None, is_feasible=False)]
    measured = interleaved(solvers, problems, 3, "active")
    one_round = [("casadi-c", "a"), ("riccati", "a"), ("riccati", "b")]
    assert log == [("casadi-vm", "a"), *one_round] * 2 + one_round  # casadi-vm sits the third round out
    assert [(m.solver, m.set_name, len(m.results), len(m.results[0])) for m in measured] == [
        ("casadi-vm", "active-feasible", 2, 1), ("casadi-c", "active-feasible", 3, 1), ("riccati", "active", 3, 2),
    ]  # fmt: skip


def test_memory_counts_what_is_zero_until_it_is_used(tmp_path):
    source, library = tmp_path / "x.c", tmp_path / "x.so"
    source.write_text("static char memory[1000000]; char *address(void) { return memory; }")
    subprocess.run([*find_compiler().command, "-shared", "-fPIC", "-o", library, source], check=True)
    assert library.stat().st_size < 100_000
    assert 1_000_000 <= loadable_bytes(library) < 1_100_000
    assert loadable_bytes(source) == source.stat().st_size


def test_no_valgrind_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CallgrindError, match=r"^valgrind is not installed.*$"):
        find_valgrind()
    with pytest.raises(CallgrindError):
        bench.bench_solver(bench.BenchOptions(callgrind=True), progress=print)


@pytest.mark.usefixtures("_short_cases")
def test_instructions_are_those_of_the_solves_alone(vehicle, tmp_path, monkeypatch):
    """The child runs for real; a script in the place of valgrind runs it and says how much it has counted."""
    script = tmp_path / "valgrind"
    script.write_text('#!/bin/sh\necho "$1 $3 $4" >>"$0.log"\nshift 4\n"$@"\necho "== Collected : 12000" >&2\n')
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    car, options = vehicle.model, OcpOptions()
    problems = bench_sets.nominal(vehicle, 12, lambda text: None)
    warm = sum(i.warm_start is not None for i in problems)
    builds = {name: LIBRARIES[name](car, options, print) for name in ("casadi-c", "riccati")}
    rows = count_instructions(builds, problems, car, options, lambda text: None)
    assert rows == [{"solver": name, "instances": warm, "instructions_per_solve": round(12000 / warm)} for name in builds]
    assert script.with_suffix(".log").read_text().splitlines() == ["--tool=callgrind --toggle-collect=nmpc_solve --toggle-collect=nmpc"] * 2


@pytest.mark.usefixtures("_short_cases")
def test_a_child_that_fails_is_no_count(vehicle, tmp_path, monkeypatch):
    script = tmp_path / "valgrind"
    script.write_text('#!/bin/sh\necho "== Collected : 12000" >&2\n')  # runs nothing
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    builds = {"riccati": LIBRARIES["riccati"](vehicle.model, OcpOptions(), print)}
    problems = bench_sets.nominal(vehicle, 8, lambda text: None)
    with pytest.raises(CallgrindError, match="cannot count the instructions of riccati"):
        count_instructions(builds, problems, vehicle.model, OcpOptions(), lambda text: None)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--set", "easy"), 2, "set 'easy': there are nominal, active, hard and all"),
        (("--solver", "fast"), 2, "solver 'fast': there are casadi-vm, casadi-c"),
        (("--callgrind",), 3, "valgrind is not installed"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, arguments, code, message):
    command = [sys.executable, "-m", "xil", "bench", "solver", *arguments]
    finished = subprocess.run(command, env={"PATH": str(tmp_path), "HOME": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert (finished.returncode, finished.stdout) == (code, "")
    (line,) = finished.stderr.splitlines()
    assert message in line
