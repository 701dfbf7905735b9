"""Mean profiles beside the paper's table."""

import numpy as np
import pytest

from controller.profile import PAPER_PROFILE, profile_rows
from controller.solver import PROFILE_PARTS, Effort, SolveResult, SolveStatus, SubFunction


def result(solve_time_ns, profile):
    return SolveResult(SolveStatus.CONVERGED, np.zeros((1, 1)), np.zeros((1, 1)), 0.0, 0.0, Effort(profile=profile), solve_time_ns)


def test_means_per_solve_and_per_evaluation():
    results = [
        result(2_000_000, {"jacobian": SubFunction(400_000, 2), "qp": SubFunction(100_000, 1), "gradient": SubFunction(0, 0)}),
        result(4_000_000, {"jacobian": SubFunction(800_000, 4), "qp": SubFunction(500_000, 2), "gradient": SubFunction(0, 0)}),
    ]
    rows = profile_rows(results)
    assert [row.part for row in rows] == ["total", "qp", "gradient", "jacobian"]
    total, qp, gradient, jacobian = rows
    assert (total.solve_ms, total.call_ms, total.calls) == pytest.approx((3.0, 3.0, 1.0))
    assert (qp.solve_ms, qp.call_ms, qp.calls) == pytest.approx((0.3, 0.2, 1.5))
    assert (gradient.solve_ms, gradient.call_ms, gradient.calls) == (0.0, None, 0.0)
    assert (jacobian.solve_ms, jacobian.call_ms, jacobian.calls) == pytest.approx((0.6, 0.2, 3.0))
    assert (jacobian.paper.uncompiled_ms, jacobian.paper.generated_ms, jacobian.paper.generated_call_ms) == (5.0, 0.545, 0.27)


def test_a_part_that_the_paper_does_not_have_stands_alone():
    sweep = profile_rows([result(50_000, {"stage sweep": SubFunction(20_000, 2)})])[1]
    assert (sweep.part, sweep.paper) == ("stage sweep", None)


def test_without_a_profile_there_are_no_rows():
    assert profile_rows([]) == []
    assert profile_rows([result(1, {"qp": SubFunction(1, 1)}), result(1, None)]) == []


def test_the_papers_table_has_our_parts_and_its_sums():
    assert set(PAPER_PROFILE) == {"total", *PROFILE_PARTS} - {"stage sweep"}
    parts = [times for part, times in PAPER_PROFILE.items() if part != "total"]
    assert sum(times.uncompiled_ms for times in parts) == pytest.approx(20.0)
    assert sum(times.generated_ms for times in parts) == pytest.approx(2.178)
    assert all(times.generated_call_ms <= times.generated_ms for times in parts)
