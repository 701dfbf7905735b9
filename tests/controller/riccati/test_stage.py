"""The stage functions: printed C against CasADi's own derivatives and against finite differences, for each model."""

import ctypes
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from controller.ocp import advance_function, stage_function
from controller.problem import SINGLE_TRACK_LAG, OcpOptions
from controller.riccati.build import C_SOURCES, host_flags, write_sources
from controller.riccati.printer import EmitError, Phase, Printed
from controller.riccati.stage import stage_functions
from tests.support.kinematic import kinematic_options

LARGE_SLIP, FAR_TURNED = 1, 2
STAGES = {  # ordinary, large slip, at rest and turned far, backwards
    "v_x": (22.0, 3.0, 0.0, -0.8), "v_y": (0.3, 4.0, 0.0, -0.2), "omega": (0.2, -1.4, 0.0, 0.3), "X": (40.0, -7.0, 0.0, 1.0),
    "Y": (-3.0, 900.0, 0.0, 2.0), "psi": (0.7, -2.5, 31.0, 1.6), "delta_a": (0.04, -0.3, 0.1, 0.0), "t_a": (0.2, -1.0, 0.0, 0.1),
    "delta": (0.05, -0.5, 0.3, 0.1), "t_r": (0.4, -1.0, 0.1, -0.3), "a_x": (0.4, -3.0, 0.1, -0.3),
}  # fmt: skip

FORMS = {
    "single track, scalar": (OcpOptions(), 1),
    "single track, 2 lanes": (OcpOptions(), 2),
    "single track, 4 lanes": (OcpOptions(), 4),
    "lag, 4 lanes": (OcpOptions(model=SINGLE_TRACK_LAG, integrator_steps=3), 4),
    "kinematic, scalar": (kinematic_options(), 1),
}


@dataclass(frozen=True)
class Form:
    """A problem, its printed code, and its stages; z and lam have a row for each of four stages."""

    options: OcpOptions
    lanes: int
    library: ctypes.CDLL
    z: np.ndarray
    lam: np.ndarray

    @property
    def n_states(self):
        return self.options.model.n_states


@pytest.fixture(scope="module", params=list(FORMS))
def form(request, vehicle, load_c, tmp_path_factory):
    options, lanes = FORMS[request.param]
    directory = tmp_path_factory.mktemp("stage")
    names = write_sources(directory, vehicle.model, options)
    # Where there is no AVX, the compiler says that code with AVX passes four lanes in another way; here is no such code.
    library = load_c([directory / name for name in names], "-O0", f"-DLANES={lanes}", "-Wno-psabi", *host_flags())
    z = np.column_stack([STAGES[name] for name in (*options.model.states, *options.model.inputs)])
    return Form(options, lanes, library, z, np.random.default_rng(3).standard_normal((4, options.model.n_states)) * 20.0)


@pytest.fixture(scope="module")
def reference(form, vehicle):
    """(z, lam) to x_next, its Jacobian and the Hessian of lam' x_next, all by CasADi, in the ground frame."""
    n = form.n_states
    z, lam = ca.MX.sym("z", form.z.shape[1]), ca.MX.sym("lam", n)
    x_next = stage_function(vehicle.model, form.options)(z[:n], z[n:])
    return ca.Function("reference", [z, lam], [x_next, ca.jacobian(x_next, z), ca.hessian(ca.dot(lam, x_next), z)[0]])


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


@pytest.mark.parametrize("first", [0, LARGE_SLIP, FAR_TURNED, 3])
def test_derivatives_are_those_of_casadi(form, reference, vehicle, first):
    derivatives = stage_functions(vehicle.model, form.options)[1]
    patterns = [derivatives.sparsity_out(name) for name in ("jacobian", "hessian")]
    z, lam = np.roll(form.z, -first, axis=0), np.roll(form.lam, -first, axis=0)
    sizes = (form.n_states, *(p.nnz() for p in patterns))
    x_next, jacobian, hessian = call(form.library.stage_derivatives, (z, lam), sizes, form.lanes)
    for i in range(form.lanes):
        expected, J, H = (np.array(value) for value in reference(z[i], lam[i]))
        np.testing.assert_allclose(x_next[i], expected.ravel(), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(ca.DM(patterns[0], jacobian[i]).full(), J, rtol=1e-11, atol=1e-12)
        lower = ca.DM(patterns[1], hessian[i]).full()
        np.testing.assert_allclose(lower + np.tril(lower, -1).T, H, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("first", [0, LARGE_SLIP])
def test_the_adjoint_sweep_agrees(form, reference, first):
    z, lam = np.roll(form.z, -first, axis=0), np.roll(form.lam, -first, axis=0)
    x_next, adjoint = call(form.library.stage_adjoint, (z, lam), (form.n_states, z.shape[1]), form.lanes)
    for i in range(form.lanes):
        expected, J, _ = (np.array(value) for value in reference(z[i], lam[i]))
        np.testing.assert_allclose(x_next[i], expected.ravel(), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(adjoint[i], J.T @ lam[i], rtol=1e-11, atol=1e-10)


def test_derivatives_are_finite_differences(form, vehicle):
    adjoint, derivatives = stage_functions(vehicle.model, form.options)
    for z, lam in zip(form.z, form.lam, strict=True):
        _, J, H = (np.array(value) for value in derivatives(z, lam))
        H = H + np.tril(H, -1).T
        for j in range(z.size):
            h = 1e-5 * np.eye(z.size)[j]
            (ahead, gradient_ahead), (behind, gradient_behind) = ([np.array(v).ravel() for v in adjoint(z + s * h, lam)] for s in (1, -1))
            np.testing.assert_allclose((ahead - behind) / 2e-5, J[:, j], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose((gradient_ahead - gradient_behind) / 2e-5, H[:, j], rtol=1e-4, atol=1e-4)


def test_advance_is_that_of_the_other_solvers(form, vehicle):
    expected, n = advance_function(vehicle.model, form.options), form.n_states
    for z in form.z:
        x, u, after = z[:n].copy(), z[n:].copy(), np.zeros(n)
        x_in, u_in, x_out = (values.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for values in (x, u, after))
        form.library.nmpc_advance(x_in, u_in, ctypes.c_double(0.013), x_out)
        np.testing.assert_allclose(after, np.array(expected(x, u, 0.013)).ravel(), rtol=1e-13, atol=1e-13)


def test_what_is_always_zero_is_not_computed(vehicle):
    """The actuators know nothing of the car."""
    jacobian = stage_functions(vehicle.model, OcpOptions(model=SINGLE_TRACK_LAG))[1].sparsity_out("jacobian")
    names = (*SINGLE_TRACK_LAG.states, *SINGLE_TRACK_LAG.inputs)
    expected = {"delta_a": {"delta_a", "delta"}, "t_a": {"t_a", "t_r"}}
    for row, name in enumerate(SINGLE_TRACK_LAG.states):
        if name in expected:
            assert {names[j] for j in np.flatnonzero(ca.DM(jacobian, 1).full()[row])} == expected[name]


def test_phases_compute_what_the_function_does_and_keep_what_is_used_again(load_c, tmp_path):
    """A function of x, then of y: sin(x) is computed once and left on the tape; x, a pure input, is read again."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("f", [x, y], [x / ca.sin(x), x * y / ca.sin(x) + ca.cos(x)], ["x", "y"], ["a", "b"])
    printed = Printed.of(function, (Phase("there", ("x",), ("a",), "tape"), Phase("back", ("y",), ("b",))))
    assert printed.tape_sizes["THERE_TAPE"] == 2  # 1 / sin(x) and cos(x); x / sin(x) is not among the operands of b
    texts = [[signature, "{", *lines, "}"] for signature, lines in printed.definitions]
    assert sum("sincos" in line for line in texts[0]) == 1
    assert not any("sincos" in line for line in texts[1])
    source = tmp_path / "phases.c"
    source.write_text('#include "lanes.h"\n' + "\n".join(line for text in texts for line in text))
    library = load_c([source], "-DLANES=1", f"-I{C_SOURCES}")
    at, tape, a, b = (np.array([0.7]), np.zeros(2), np.zeros(1), np.zeros(1))
    pointers = {name: v.ctypes.data_as(ctypes.c_void_p) for name, v in (("x", at), ("tape", tape), ("a", a), ("b", b))}
    library.there(pointers["x"], pointers["a"], pointers["tape"])
    y_in = np.array([3.0])
    library.back(pointers["tape"], pointers["x"], y_in.ctypes.data_as(ctypes.c_void_p), pointers["b"])
    np.testing.assert_allclose((a[0], b[0]), [float(v) for v in function(0.7, 3.0)], rtol=1e-14)


def test_an_operation_without_c_code_is_named():
    x = ca.SX.sym("x")
    with pytest.raises(EmitError, match=str(ca.OP_ERF)):
        Printed.of(ca.Function("f", [x], [ca.erf(x)], ["x"], ["y"]), (Phase("f", ("x",), ("y",)),))
