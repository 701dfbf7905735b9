"""Riccati recursion and active-set method on random linear-quadratic problems with known solutions, of several sizes."""

import ctypes
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from controller.riccati.build import C_SOURCES, host_flags

SOURCES = ("riccati.c", "rows.c", "quadratic_program.c", "solver.h", "nmpc.h", "lanes.h", "stage_vector.h")


@dataclass(frozen=True)
class Sizes:
    """Of one form of the problem, and the number of stages that the code works on at once."""

    N: int
    NX: int
    NU: int
    bounded_states: tuple[int, ...]
    position: tuple[int, int]
    lanes: int

    @property
    def n_stage(self):
        return self.NX + self.NU

    @property
    def bounded(self):
        return (*range(self.NX, self.n_stage), *self.bounded_states)

    @property
    def stage_rows(self):
        return len(self.bounded) + 1

    @property
    def rows(self):
        return self.N * self.stage_rows + self.NX + 1

    @property
    def problem(self):
        N, NX, NU, NZ, rows = self.N, self.NX, self.NU, self.n_stage, self.rows
        return np.dtype([
            ("reference", "f8", (N + 1, NX)), ("normal", "f8", (N + 1, 2)), ("previous_input", "f8", NU),
            ("weight", "f8", NZ), ("last_weight", "f8", NX), ("difference_weight", "f8", NU),
            ("lower", "f8", rows), ("upper", "f8", rows), ("linear", "f8", rows), ("quadratic", "f8"),
            ("z", "f8", (N + 1, NZ)), ("row_multiplier", "f8", rows),
            ("jacobian", "f8", (N, NX, NZ)), ("hessian", "f8", (N, NZ, NZ)), ("gap", "f8", (N, NX)), ("gradient", "f8", (N + 1, NZ)),
            ("row_value", "f8", rows),
        ])  # fmt: skip

    @property
    def answer(self):
        return np.dtype([
            ("step", "f8", (self.N + 1, self.n_stage)), ("gap", "f8", (self.N + 1, self.NX)), ("row", "f8", self.rows), ("share", "f8"),
            ("is_solved", "f8"), ("factorizations", "f8"), ("solutions", "f8"),
        ])  # fmt: skip


SIZES = {
    "car, 4 lanes": Sizes(6, 6, 2, (0, 1, 2), (3, 4), 4),
    "car, scalar": Sizes(6, 6, 2, (0, 1, 2), (3, 4), 1),
    "lag, 2 lanes": Sizes(5, 8, 2, (0, 1, 2), (3, 4), 2),
    "kinematic, 4 lanes": Sizes(10, 4, 2, (0,), (1, 2), 4),
    "one input, no bounded state": Sizes(4, 5, 1, (), (0, 1), 4),
    "three inputs, odd": Sizes(3, 7, 3, (6, 0), (2, 5), 1),
}


@pytest.fixture(scope="module", params=list(SIZES))
def sizes(request):
    return SIZES[request.param]


@pytest.fixture(scope="module")
def library(sizes, load_c, tmp_path_factory):
    directory = tmp_path_factory.mktemp("qp")
    (directory / "problem_size.h").write_text(
        f"#define HORIZON_STEPS {sizes.N}\n#define N_STATES {sizes.NX}\n#define N_INPUTS {sizes.NU}\n"
    )
    (directory / "stage_functions.h").write_text(
        f"#define N_BOUNDED {len(sizes.bounded)}\n#define BOUNDED_COMPONENTS {', '.join(map(str, sizes.bounded))}\n"
        f"#define X_COMPONENT {sizes.position[0]}\n#define Y_COMPONENT {sizes.position[1]}\n"
    )
    for name in SOURCES:
        (directory / name).write_text((C_SOURCES / name).read_text())
    (directory / "qp_driver.c").write_text((Path(__file__).parent / "qp_driver.c").read_text())
    return load_c(directory.glob("*.c"), "-O1", f"-DLANES={sizes.lanes}", "-Wno-psabi", *host_flags())


def random_problem(sizes, seed):
    """Stable-ish dynamics, positive definite Hessians, no bounds."""
    rng = np.random.default_rng(seed)
    p = np.zeros((), sizes.problem)
    angle = rng.uniform(-3, 3, sizes.N)
    p["normal"][1:] = np.column_stack((-np.sin(angle), np.cos(angle)))
    p["previous_input"] = rng.standard_normal(sizes.NU)
    for name in ("weight", "last_weight", "difference_weight"):
        p[name] = rng.uniform(0.1, 10.0, p[name].shape)
    p["lower"], p["upper"] = -np.inf, np.inf
    p["linear"], p["quadratic"] = 50.0, 40.0
    p["linear"][(sizes.stage_rows * np.arange(sizes.N)[:, None] + np.arange(sizes.NU)).ravel()] = np.inf
    p["z"] = rng.standard_normal(p["z"].shape)
    p["jacobian"] = 0.5 * rng.standard_normal(p["jacobian"].shape)
    root = 0.5 * rng.standard_normal((sizes.N, sizes.n_stage, sizes.n_stage))
    p["hessian"] = root @ root.transpose(0, 2, 1)
    p["gap"] = rng.standard_normal(p["gap"].shape)
    p["gradient"] = 5.0 * rng.standard_normal(p["gradient"].shape)
    p["gradient"][sizes.N, sizes.NX :] = 0.0  # no input there
    p["row_value"] = 0.1 * rng.standard_normal(sizes.rows)
    return p


def solve(library, sizes, problem, function="qp_solve"):
    answer = np.zeros((), sizes.answer)
    library[function](*(m.ctypes.data_as(ctypes.c_void_p) for m in (problem, answer)))
    return answer


def dense(sizes, p, share=1.0):
    """Hessian, gradient, constraint matrix of the dynamics with right-hand side, and matrix of the rows; variables d_0 to d_N."""
    N, NX, NU, NZ = sizes.N, sizes.NX, sizes.NU, sizes.n_stage
    size = (N + 1) * NZ
    H, g = np.zeros((size, size)), p["gradient"].ravel().copy()
    H[-NU:, -NU:] = np.eye(NU)  # the input that the last stage does not have
    A, b = np.zeros(((N + 1) * NX, size)), np.zeros((N + 1) * NX)
    A[:NX, :NX] = np.eye(NX)
    inputs = np.concatenate((p["previous_input"][None], p["z"][:N, NX:]))
    S = 2.0 * np.diag(p["difference_weight"])
    for k in range(N):
        here, there = slice(k * NZ, (k + 1) * NZ), slice((k + 1) * NZ, (k + 1) * NZ + NX)
        H[here, here] += 2.0 * np.diag(p["weight"]) + share * p["hessian"][k]
        now = slice(k * NZ + NX, (k + 1) * NZ)
        H[now, now] += S
        if k > 0:
            before = slice((k - 1) * NZ + NX, k * NZ)
            H[before, before] += S
            H[now, before] -= S
            H[before, now] -= S
            g[before] -= S @ (inputs[k + 1] - inputs[k])
        rows = slice((k + 1) * NX, (k + 2) * NX)
        A[rows, here], A[rows, there], b[rows] = p["jacobian"][k], -np.eye(NX), -p["gap"][k]
    H[N * NZ : N * NZ + NX, N * NZ : N * NZ + NX] += 2.0 * np.diag(p["last_weight"])
    C, n = np.zeros((sizes.rows, size)), len(sizes.bounded)
    for k in range(N):
        C[sizes.stage_rows * k + np.arange(n), k * NZ + np.array(sizes.bounded)] = 1.0
        C[sizes.stage_rows * k + n, k * NZ + np.array(sizes.position)] = p["normal"][k]
    C[sizes.stage_rows * N + np.arange(NX), N * NZ + np.arange(NX)] = 1.0
    C[-1, N * NZ + np.array(sizes.position)] = p["normal"][N]
    return H, g, A, b, C


def kkt_solution(sizes, problem, share=1.0):
    """Step and multipliers without inequality rows."""
    H, g, A, b, _ = dense(sizes, problem, share)
    zero = np.zeros((A.shape[0], A.shape[0]))
    both = np.linalg.solve(np.block([[H, A.T], [A, zero]]), np.concatenate((-g, b)))
    return both[: H.shape[0]], both[H.shape[0] :]


@pytest.mark.parametrize("seed", range(10))
def test_without_bounds_the_riccati_recursion_solves_the_kkt_system(library, sizes, seed):
    problem = random_problem(sizes, seed)
    step, multipliers = kkt_solution(sizes, problem)
    answer = solve(library, sizes, problem)
    assert answer["is_solved"]
    np.testing.assert_allclose(answer["step"].ravel(), step, rtol=0, atol=1e-9)
    np.testing.assert_allclose(answer["gap"][1:].ravel(), multipliers[sizes.NX :], rtol=1e-8, atol=1e-8)
    assert not answer["row"].any()
    assert answer["factorizations"] == answer["solutions"] == 1


def violation_cost_point(problem, values):
    """Value that each penalty alone would move to, from `values`: the proximal map."""
    lower, upper, linear = (problem[name] for name in ("lower", "upper", "linear"))
    above = np.where(values > upper, values - upper, 0.0)
    below = np.where(values < lower, lower - values, 0.0)
    beyond = np.maximum(above + below - linear, 0.0) / (1.0 + problem["quadratic"])  # what is left of the violation
    return np.clip(values, lower, upper) + np.where(above > 0.0, beyond, -beyond)


def bounded_problem(sizes, seed):
    """Bounds that some rows meet, some pay to violate; on one input in five an equality."""
    rng = np.random.default_rng(1000 + seed)
    problem, rows = random_problem(sizes, seed), sizes.rows
    middle, width = 0.5 * rng.standard_normal(rows), rng.uniform(0.1, 2.0, rows)
    width[rng.random(rows) < 0.2] = 0.0
    bounds = np.arange(rows) >= (sizes.NU if seed % 2 == 0 else sizes.stage_rows)
    bounds[sizes.NU : sizes.stage_rows] = False  # the measured state has none
    problem["lower"][bounds], problem["upper"][bounds] = (middle - width)[bounds], (middle + width)[bounds]
    problem["row_multiplier"][bounds] = np.where(rng.random(rows) < 0.3, 60.0 * rng.standard_normal(rows), 0.0)[bounds]
    return problem


def assert_optimal(sizes, problem, answer):
    H, g, A, b, C = dense(sizes, problem)
    d, row, NX = answer["step"].ravel(), answer["row"], sizes.NX
    assert answer["is_solved"]
    np.testing.assert_allclose(A @ d, b, atol=1e-8)
    gradient = H @ d + g + C.T @ row
    gradient[NX:] += A.T[NX:, NX:] @ answer["gap"][1:].ravel()
    np.testing.assert_allclose(gradient[NX:], 0.0, atol=1e-5)
    np.testing.assert_allclose(problem["row_value"] + C @ d, violation_cost_point(problem, problem["row_value"] + C @ d + row), atol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_with_bounds_the_answer_is_optimal(library, sizes, seed):
    problem = bounded_problem(sizes, seed)
    answer = solve(library, sizes, problem)
    assert_optimal(sizes, problem, answer)
    assert np.count_nonzero(answer["row"]) >= 2


@pytest.mark.parametrize("seed", range(10))
def test_what_is_left_of_the_last_factorization_is_used_rightly(library, sizes, seed):
    """Same matrices, then other bounds, multipliers, gaps and gradients: the stages in front of the first change are not done anew."""
    solve(library, sizes, bounded_problem(sizes, seed))
    problem, other = bounded_problem(sizes, seed), bounded_problem(sizes, seed + 100)
    rng = np.random.default_rng(seed)
    problem["row_multiplier"] = other["row_multiplier"]
    problem["gap"] += 0.1 * rng.standard_normal(problem["gap"].shape)
    problem["gradient"][: sizes.N] += rng.standard_normal((sizes.N, sizes.n_stage))
    assert_optimal(sizes, problem, solve(library, sizes, problem, "qp_solve_again"))


def test_the_same_problem_again_needs_no_factorization(library, sizes):
    problem = bounded_problem(sizes, 3)
    problem["row_multiplier"] = solve(library, sizes, problem)["row"]
    again = solve(library, sizes, problem, "qp_solve_again")
    assert (again["factorizations"], again["solutions"]) == (0, 1)


def test_nearly_dependent_rows_need_few_estimates(library, sizes):
    """Corridor and terminal bound on Y differ by a fiftieth of X: with the first weight alone, ten estimates would not do."""
    problem, eps = random_problem(sizes, 2), 2e-2
    problem["normal"][sizes.N] = np.sin(eps), np.cos(eps)
    problem["row_value"][-1] = 0.0
    last_y, corridor = sizes.rows - 1 - sizes.NX + sizes.position[1], sizes.rows - 1
    problem["row_value"][last_y] = 0.0
    free = solve(library, sizes, problem)["step"][sizes.N]
    X, Y = (free[i] for i in sizes.position)
    problem["linear"][[last_y, corridor]] = 1e9
    for row, value in ((last_y, Y - 0.3), (corridor, np.sin(eps) * (X + 0.2) + np.cos(eps) * (Y - 0.3))):
        problem["lower"][row] = problem["upper"][row] = value
    answer = solve(library, sizes, problem)
    assert_optimal(sizes, problem, answer)
    assert answer["solutions"] <= 11


def test_a_hessian_without_descent_is_made_convex(library, sizes):
    problem = random_problem(sizes, 1)
    problem["hessian"] -= 25.0 * np.eye(sizes.n_stage)
    answer = solve(library, sizes, problem)
    assert answer["is_solved"]
    assert 0.0 <= answer["share"] < 1.0
    step, _ = kkt_solution(sizes, problem, float(answer["share"]))
    np.testing.assert_allclose(answer["step"].ravel(), step, rtol=0, atol=1e-8)


def test_no_convex_form_is_no_solution(library, sizes):
    problem = random_problem(sizes, 1)
    for name in ("weight", "difference_weight", "last_weight"):
        problem[name] = 0.0
    problem["hessian"][:] = 0.0
    assert not solve(library, sizes, problem)["is_solved"]
