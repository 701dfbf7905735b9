"""Targets beside figures: a slow solver misses its own, and what was not measured is neither met nor missed."""

from copy import deepcopy

import pytest

from controller.bench.targets import TARGETS, judged

NOTHING = {"rows": [], "hard": [], "agreement": [], "solvers": []}


def row(solver, set_name, **figures):
    return {"solver": solver, "set": set_name} | figures


@pytest.fixture
def good():
    """A run that meets every target, by a hair or more."""
    names = ("riccati", "riccati-scalar")
    return deepcopy({
        "rows": [
            row("qrqp", "nominal", ratio_mean=0.65, sqp_iterations_p95=2.0),
            row("riccati", "nominal", ratio_mean=0.06, ratio_p99=0.08),
            row("riccati-scalar", "nominal", ratio_mean=0.16),
            row("riccati", "active", ratio_p99=0.35, ratio_max=0.6),
            row("riccati", "active-feasible", ratio_p99=9.0, ratio_max=9.0),
            row("riccati-scalar", "active", ratio_p99=0.8, ratio_max=1.0),
        ],
        "hard": [row(name, "hard", finite=1.0, true_status=1.0, converged=0.99, ratio_longest=2.5) for name in names],
        "agreement": [{"with": "ipopt", "first_input": 1e-5, "plan": 1e-4}, {"with": "qrqp", "first_input": 1e-5, "plan": 1e-5}],
        "solvers": [{"solver": name, "lanes": lanes, "memory_bytes": 1_000_000} for name, lanes in zip(names, (4, 1), strict=True)],
    })  # fmt: skip


def missed(result):
    return [row["what"] for row in judged(result) if row["met"] is False]


def test_a_run_at_its_limits_meets_all(good):
    assert [row["met"] for row in judged(good)] == [True] * len(TARGETS)


def test_a_run_of_nothing_meets_and_misses_nothing():
    assert {(row["measured"], row["met"]) for row in judged(NOTHING)} == {(None, None)}


@pytest.mark.parametrize(
    ("part", "index", "key", "value", "expected"),
    [
        ("rows", 0, "ratio_mean", 0.66, ["qrqp, nominal: mean"]),
        ("rows", 0, "sqp_iterations_p95", 2.05, ["qrqp, nominal: SQP iterations at p95"]),
        ("rows", 1, "ratio_mean", 0.07, ["riccati with 4 lanes, nominal: mean"]),
        ("rows", 1, "ratio_p99", 0.09, ["riccati with 4 lanes, nominal: p99"]),
        ("rows", 2, "ratio_mean", 0.17, ["riccati-scalar, nominal: mean"]),
        ("rows", 3, "ratio_p99", 0.36, ["riccati with 4 lanes, active: p99"]),
        ("rows", 3, "ratio_max", 0.61, ["riccati with 4 lanes, active: max"]),
        ("rows", 5, "ratio_p99", 0.81, ["riccati-scalar, active: p99"]),
        ("rows", 5, "ratio_max", 1.01, ["riccati-scalar, active: max"]),
        ("hard", 0, "finite", 0.9999, ["riccati, hard starts: finite, share"]),
        ("hard", 0, "true_status", 0.9999, ["riccati, hard starts: status true to recomputed residuals, share"]),
        ("hard", 0, "converged", 0.98, ["riccati, hard starts: converged, share"]),
        ("hard", 1, "ratio_longest", 2.51, ["riccati-scalar, hard starts: longest quiet solve"]),
        ("agreement", 0, "first_input", 2e-5, ["riccati against ipopt, same minimum: first input"]),
        ("agreement", 1, "plan", 2e-5, ["riccati against qrqp, feasible: plan, scaled"]),
        ("solvers", 0, "memory_bytes", 1_000_001, ["riccati, static memory, bytes"]),
    ],
)
def test_a_worse_figure_misses_its_target_and_no_other(good, part, index, key, value, expected):
    good[part][index][key] = value
    assert missed(good) == expected


def test_targets_of_four_lanes_are_not_judged_on_two(good):
    good["solvers"][0]["lanes"] = 2
    good["rows"][1]["ratio_mean"] = 0.2
    assert missed(good) == []
    verdicts = {row["what"]: row["met"] for row in judged(good)}
    assert verdicts["riccati with 4 lanes, nominal: mean"] is None
    assert verdicts["riccati, hard starts: finite, share"] is True
