"""The bench: the shape of what it prints, and that both solvers see the same problems."""

import json

import pytest
from rich.console import Console

from controller import bench
from controller.solver import Effort


@pytest.fixture(scope="module")
def result(library):
    return bench.bench_solver(instances=4, rounds=1, progress=lambda text: None)


KEYS = {
    "solver", "set", "instances", "rounds", "quiet_mean_us", "quiet_p99_us", "raw_p99_us", "raw_max_us",
    "sqp_iterations_mean", "qp_iterations_mean", "converged",
}  # fmt: skip


def test_rows_have_exactly_the_keys_that_readers_rely_on(result):
    assert set(result) == {"machine", "rows"}
    assert [row["solver"] for row in result["rows"]] == ["casadi-vm", "casadi-c", "riccati"]
    for row in result["rows"]:
        assert set(row) == KEYS
        assert (row["set"], row["instances"], row["rounds"], row["converged"]) == ("nominal", 4, 1, 1.0)
        assert 0 < row["quiet_mean_us"] <= row["quiet_p99_us"] <= row["raw_max_us"]
    json.dumps(result, allow_nan=False)


def test_both_solvers_take_the_same_iterations_and_compiling_pays(result):
    uncompiled, compiled, _ = result["rows"]
    assert uncompiled["sqp_iterations_mean"] == compiled["sqp_iterations_mean"]
    assert compiled["qp_iterations_mean"] >= compiled["sqp_iterations_mean"]
    assert compiled["quiet_mean_us"] < uncompiled["quiet_mean_us"] / 3


def test_quiet_is_the_smallest_of_the_rounds_of_each_problem():
    def solved(microseconds):
        return bench.SolveResult(bench.SolveStatus.CONVERGED, None, None, 0.0, 0.0, Effort(2), microseconds * 1000)

    row = bench._row("x", [[solved(10), solved(50)], [solved(30), solved(20)]])
    assert (row["quiet_mean_us"], row["raw_max_us"], row["instances"], row["rounds"]) == (15.0, 50.0, 2, 2)
    assert (row["sqp_iterations_mean"], row["qp_iterations_mean"]) == (2.0, None)


def test_the_table_names_solvers_and_ratio(result):
    console = Console(width=100, record=True)
    console.print(bench.to_table(result))
    text = console.export_text()
    assert "casadi-vm" in text
    assert "casadi-c" in text
    ratio = result["rows"][0]["quiet_mean_us"] / result["rows"][1]["quiet_mean_us"]
    assert f"1/{ratio:.1f}" in text
