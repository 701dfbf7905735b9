"""Riccati recursion and active-set method on random linear-quadratic problems with known solutions."""

import ctypes
from pathlib import Path

import numpy as np
import pytest

N, NX, NU, NZ, ROWS = 6, 6, 2, 8, 6 * 6 + 7
BOUNDED = (6, 7, 0, 1, 2)

PROBLEM = np.dtype([
    ("reference", "f8", (N + 1, NX)), ("normal", "f8", (N + 1, 2)), ("previous_input", "f8", NU),
    ("weight", "f8", NZ), ("last_weight", "f8", NX), ("difference_weight", "f8", NU),
    ("lower", "f8", ROWS), ("upper", "f8", ROWS), ("linear", "f8", ROWS), ("quadratic", "f8", ROWS),
])  # fmt: skip
ITERATE = np.dtype([
    ("z", "f8", (N + 1, NZ)), ("gap_multiplier", "f8", (N + 1, NX)), ("row_multiplier", "f8", ROWS), ("state_multiplier", "f8", NX),
])  # fmt: skip
MODEL = np.dtype([
    ("jacobian", "f8", (N, NX, NZ)), ("hessian", "f8", (N, NZ, NZ)), ("gap", "f8", (N, NX)), ("gradient", "f8", (N + 1, NZ)),
    ("adjoint", "f8", (N, NZ)), ("row_value", "f8", ROWS),
])  # fmt: skip


@pytest.fixture(scope="module")
def library(sources, load_c, tmp_path_factory):
    short = tmp_path_factory.mktemp("short")
    (short / "problem_size.h").write_text(f"#define HORIZON_STEPS {N}\n#define N_STATES {NX}\n#define N_INPUTS {NU}\n")
    for name in ("riccati.c", "rows.c", "quadratic_program.c", "solver.h", "nmpc.h"):
        (short / name).write_text((sources / name).read_text())
    (short / "qp_driver.c").write_text((Path(__file__).parent / "qp_driver.c").read_text())
    return load_c(short.glob("*.c"), "-O1")


def random_problem(seed):
    """Stable-ish dynamics, positive definite Hessians, no bounds."""
    rng = np.random.default_rng(seed)
    problem, at, model = (np.zeros((), dtype) for dtype in (PROBLEM, ITERATE, MODEL))
    angle = rng.uniform(-3, 3, N)
    problem["normal"][1:] = np.column_stack((-np.sin(angle), np.cos(angle)))
    problem["previous_input"] = rng.standard_normal(NU)
    for name in ("weight", "last_weight", "difference_weight"):
        problem[name] = rng.uniform(0.1, 10.0, problem[name].shape)
    problem["lower"], problem["upper"] = -np.inf, np.inf
    problem["linear"], problem["quadratic"] = 50.0, 40.0
    hard = (6 * np.arange(N)[:, None] + np.arange(NU)).ravel()
    problem["linear"][hard], problem["quadratic"][hard] = np.inf, 0.0
    at["z"] = rng.standard_normal(at["z"].shape)
    model["jacobian"] = 0.5 * rng.standard_normal(model["jacobian"].shape)
    root = 0.5 * rng.standard_normal((N, NZ, NZ))
    model["hessian"] = root @ root.transpose(0, 2, 1)
    model["gap"] = rng.standard_normal((N, NX))
    model["gradient"] = 5.0 * rng.standard_normal((N + 1, NZ))
    model["gradient"][N, NX:] = 0.0  # no input there
    model["row_value"] = 0.1 * rng.standard_normal(ROWS)
    return problem, at, model


def solve(library, problem, at, model):
    step, gap, row, share = np.zeros((N + 1, NZ)), np.zeros((N + 1, NX)), np.zeros(ROWS), np.zeros(1)
    memory = (problem, at, model, step, gap, row, share)
    is_solved = library.qp_solve(*(m.ctypes.data_as(ctypes.c_void_p) for m in memory))
    return is_solved, step, gap, row, share[0]


def dense(problem, at, model, share=1.0):
    """Hessian, gradient, constraint matrix of the dynamics with right-hand side, and matrix of the rows; variables d_0 to d_N."""
    size = (N + 1) * NZ
    H, g = np.zeros((size, size)), model["gradient"].ravel().copy()
    g[N * NZ + NX :] = 0.0
    H[-NU:, -NU:] = np.eye(NU)  # the input that the last stage does not have
    A, b = np.zeros(((N + 1) * NX, size)), np.zeros((N + 1) * NX)
    A[:NX, :NX] = np.eye(NX)
    inputs = np.concatenate((problem["previous_input"][None], at["z"][:N, NX:]))
    S = 2.0 * np.diag(problem["difference_weight"])
    for k in range(N):
        here, there = slice(k * NZ, (k + 1) * NZ), slice((k + 1) * NZ, (k + 1) * NZ + NX)
        H[here, here] += 2.0 * np.diag(problem["weight"]) + share * model["hessian"][k]
        now = slice(k * NZ + NX, (k + 1) * NZ)
        H[now, now] += S
        if k > 0:
            before = slice((k - 1) * NZ + NX, k * NZ)
            H[before, before] += S
            H[now, before] -= S
            H[before, now] -= S
            g[before] -= S @ (inputs[k + 1] - inputs[k])
        rows = slice((k + 1) * NX, (k + 2) * NX)
        A[rows, here], A[rows, there], b[rows] = model["jacobian"][k], -np.eye(NX), -model["gap"][k]
    H[N * NZ : N * NZ + NX, N * NZ : N * NZ + NX] += 2.0 * np.diag(problem["last_weight"])
    C = np.zeros((ROWS, size))
    for k in range(N):
        C[6 * k + np.arange(5), k * NZ + np.array(BOUNDED)] = 1.0
        C[6 * k + 5, k * NZ + 3 : k * NZ + 5] = problem["normal"][k]
    C[6 * N + np.arange(NX), N * NZ + np.arange(NX)] = 1.0
    C[-1, N * NZ + 3 : N * NZ + 5] = problem["normal"][N]
    return H, g, A, b, C


@pytest.mark.parametrize("seed", range(20))
def test_without_bounds_the_riccati_recursion_solves_the_kkt_system(library, seed):
    problem, at, model = random_problem(seed)
    H, g, A, b, _ = dense(problem, at, model)
    zero = np.zeros((A.shape[0], A.shape[0]))
    expected = np.linalg.solve(np.block([[H, A.T], [A, zero]]), np.concatenate((-g, b)))
    is_solved, step, gap, row, _ = solve(library, problem, at, model)
    assert is_solved
    np.testing.assert_allclose(step.ravel(), expected[: H.shape[0]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(gap[1:].ravel(), expected[H.shape[0] + NX :], rtol=1e-8, atol=1e-8)
    assert not row.any()


def violation_cost_point(problem, values):
    """Value that each penalty alone would move to, from `values`: the proximal map."""
    lower, upper, linear, quadratic = (problem[name] for name in ("lower", "upper", "linear", "quadratic"))
    above = np.where(values > upper, values - upper, 0.0)
    below = np.where(values < lower, lower - values, 0.0)
    beyond = np.maximum(above + below - linear, 0.0) / (1.0 + quadratic)  # what is left of the violation
    return np.clip(values, lower, upper) + np.where(above > 0.0, beyond, -beyond)


def bounded_problem(seed):
    """Bounds that some rows meet, some pay to violate; on one input in five an equality."""
    rng = np.random.default_rng(1000 + seed)
    problem, at, model = random_problem(seed)
    rows = np.arange(ROWS)[6:] if seed % 2 else np.arange(2, ROWS)
    middle, width = 0.5 * rng.standard_normal(ROWS), rng.uniform(0.1, 2.0, ROWS)
    width[rng.random(ROWS) < 0.2] = 0.0
    problem["lower"][rows], problem["upper"][rows] = (middle - width)[rows], (middle + width)[rows]
    problem["lower"][2:6], problem["upper"][2:6] = -np.inf, np.inf
    at["row_multiplier"][rows] = np.where(rng.random(rows.size) < 0.3, 60.0 * rng.standard_normal(rows.size), 0.0)
    at["row_multiplier"][2:6] = 0.0
    return problem, at, model


@pytest.mark.parametrize("seed", range(40))
def test_with_bounds_the_answer_is_optimal(library, seed):
    problem, at, model = bounded_problem(seed)
    H, g, A, b, C = dense(problem, at, model)
    is_solved, step, gap, row, _ = solve(library, problem, at, model)
    d = step.ravel()
    assert is_solved
    assert np.count_nonzero(row) >= 5
    np.testing.assert_allclose(A @ d, b, atol=1e-8)
    gradient = H @ d + g + C.T @ row
    gradient[NX:] += A.T[NX:, NX:] @ gap[1:].ravel()
    np.testing.assert_allclose(gradient[NX:], 0.0, atol=1e-5)
    values = model["row_value"] + C @ d
    np.testing.assert_allclose(values, violation_cost_point(problem, values + row), atol=1e-6)


def test_a_hessian_without_descent_is_made_convex(library):
    problem, at, model = random_problem(1)
    model["hessian"] -= 15.0 * np.eye(NZ)
    is_solved, step, _, _, share = solve(library, problem, at, model)
    assert is_solved
    assert 0.0 <= share < 1.0
    H, g, A, b, _ = dense(problem, at, model, share)
    zero = np.zeros((A.shape[0], A.shape[0]))
    expected = np.linalg.solve(np.block([[H, A.T], [A, zero]]), np.concatenate((-g, b)))
    np.testing.assert_allclose(step.ravel(), expected[: H.shape[0]], rtol=0, atol=1e-8)


def test_no_convex_form_is_no_solution(library):
    problem, at, model = random_problem(1)
    for name in ("weight", "difference_weight", "last_weight"):
        problem[name] = 0.0
    model["hessian"][:] = 0.0
    assert not solve(library, problem, at, model)[0]
