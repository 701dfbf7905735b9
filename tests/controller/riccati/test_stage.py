"""The stage functions: printed C against CasADi's own derivatives and against finite differences."""

import ctypes

import casadi as ca
import numpy as np
import pytest

from controller.ocp import advance_function, stage_function
from controller.problem import OcpOptions
from controller.riccati.build import host_flags
from controller.riccati.emit import EmitError, c_function
from controller.riccati.stage import stage_functions

NZ = 8
STAGES = np.array([  # v_x, v_y, omega, X, Y, psi, delta, t_r: ordinary, large slip, at rest and turned far, backwards
    (22.0, 0.3, 0.2, 40.0, -3.0, 0.7, 0.05, 0.4),
    (3.0, 4.0, -1.4, -7.0, 900.0, -2.5, -0.5, -1.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 31.0, 0.3, 0.1),
    (-0.8, -0.2, 0.3, 1.0, 2.0, 1.6, 0.1, -0.3),
])  # fmt: skip
MULTIPLIERS = np.random.default_rng(3).standard_normal((4, 6)) * 20.0


@pytest.fixture(scope="module")
def reference(vehicle):
    """(z, lam) to x_next, its Jacobian and the Hessian of lam' x_next, all by CasADi, in the ground frame."""
    z, lam = ca.MX.sym("z", NZ), ca.MX.sym("lam", 6)
    x_next = stage_function(vehicle.model, OcpOptions())(z[:6], z[6:])
    return ca.Function("reference", [z, lam], [x_next, ca.jacobian(x_next, z), ca.hessian(ca.dot(lam, x_next), z)[0]])


@pytest.fixture(scope="module", params=[1, 2, 4])
def lanes(request):
    return request.param


@pytest.fixture(scope="module")
def library(sources, load_c, lanes):
    # Where there is no AVX, the compiler says that code with AVX passes four lanes in another way; here is no such code.
    return load_c([sources / "stage_functions.c"], "-O0", f"-DLANES={lanes}", "-Wno-psabi", *host_flags())


def call(function, inputs, output_sizes, lanes):
    """Call a stage function for as many stages as there are lanes; inputs and outputs have a row for each stage."""
    memory = [aligned(np.ascontiguousarray(values[:lanes].T)) for values in inputs]
    memory += [aligned(np.zeros((size, lanes))) for size in output_sizes]
    function(*(m.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for m in memory))
    return [m.T for m in memory[len(inputs) :]]


def aligned(values):
    room = np.zeros(values.size + 8)
    first = -(room.ctypes.data // 8) % 8
    out = room[first : first + values.size].reshape(values.shape)
    out[:] = values
    return out


@pytest.mark.parametrize("first", [0, 2])
def test_derivatives_are_those_of_casadi(library, lanes, reference, vehicle, first):
    derivatives = stage_functions(vehicle.model, OcpOptions())[1]
    patterns = [derivatives.sparsity_out(name) for name in ("jacobian", "hessian")]
    order = np.roll(np.arange(4), -first)
    z, lam = STAGES[order], MULTIPLIERS[order]
    x_next, jacobian, hessian = call(library.stage_derivatives, (z, lam), (6, *(p.nnz() for p in patterns)), lanes)
    for i in range(lanes):
        expected, J, H = (np.array(value) for value in reference(z[i], lam[i]))
        np.testing.assert_allclose(x_next[i], expected.ravel(), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(ca.DM(patterns[0], jacobian[i]).full(), J, rtol=1e-11, atol=1e-12)
        lower = ca.DM(patterns[1], hessian[i]).full()
        np.testing.assert_allclose(lower + np.tril(lower, -1).T, H, rtol=1e-10, atol=1e-9)


def test_the_adjoint_sweep_agrees(library, lanes, reference):
    x_next, adjoint = call(library.stage_adjoint, (STAGES, MULTIPLIERS), (6, NZ), lanes)
    for i in range(lanes):
        expected, J, _ = (np.array(value) for value in reference(STAGES[i], MULTIPLIERS[i]))
        np.testing.assert_allclose(x_next[i], expected.ravel(), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(adjoint[i], J.T @ MULTIPLIERS[i], rtol=1e-11, atol=1e-10)


def test_derivatives_are_finite_differences(vehicle):
    adjoint, derivatives = stage_functions(vehicle.model, OcpOptions())
    for z, lam in zip(STAGES, MULTIPLIERS, strict=True):
        _, J, H = (np.array(value) for value in derivatives(z, lam))
        H = H + np.tril(H, -1).T
        for j in range(NZ):
            h = 1e-5 * np.eye(NZ)[j]
            (ahead, gradient_ahead), (behind, gradient_behind) = ([np.array(v).ravel() for v in adjoint(z + s * h, lam)] for s in (1, -1))
            np.testing.assert_allclose((ahead - behind) / 2e-5, J[:, j], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose((gradient_ahead - gradient_behind) / 2e-5, H[:, j], rtol=1e-4, atol=1e-4)


def test_advance_is_that_of_the_other_solvers(library, lanes, vehicle):
    duration = np.full((4, 1), 0.013)
    (after,) = call(library.advance, (STAGES[:, :6], STAGES[:, 6:], duration), (6,), lanes)
    expected = advance_function(vehicle.model, OcpOptions())
    for i in range(lanes):
        np.testing.assert_allclose(after[i], np.array(expected(STAGES[i, :6], STAGES[i, 6:], 0.013)).ravel(), rtol=1e-13, atol=1e-13)


def test_an_operation_without_c_code_is_named():
    x = ca.SX.sym("x")
    with pytest.raises(EmitError, match=str(ca.OP_ERF)):
        c_function(ca.Function("f", [x], [ca.erf(x)], ["x"], ["y"]))
