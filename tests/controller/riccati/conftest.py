"""The library of this solver in its two forms, its sources for a test's own compilation, and recorded problems."""

import ctypes
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.bench.loop import drive
from controller.bench.scenarios import nominal_scenarios
from controller.bench.sets import RecordingSolver
from controller.compiled import CompiledBackEnd
from controller.nmpc import Nmpc
from controller.problem import OcpOptions
from controller.riccati.build import SCALAR, build_riccati, write_sources
from controller.riccati.solver import RiccatiSolver
from controller.solver import SolveStatus, SqpSolver
from dbc.build import find_compiler


@pytest.fixture(scope="session")
def riccati_library(vehicle):
    return build_riccati(vehicle.model, OcpOptions(), print).library


@pytest.fixture(scope="session")
def scalar_library(vehicle):
    return build_riccati(vehicle.model, OcpOptions(), print, SCALAR).library


@pytest.fixture(params=["vector", "scalar"])
def form(request):
    return request.param


@pytest.fixture
def riccati(request, form):
    library = {"vector": "riccati_library", "scalar": "scalar_library"}[form]
    return RiccatiSolver(request.getfixturevalue(library), OcpOptions())


@pytest.fixture(scope="session")
def sources(vehicle, tmp_path_factory):
    """Directory with all sources, the generated ones among them."""
    directory = tmp_path_factory.mktemp("sources")
    write_sources(directory, vehicle.model, OcpOptions())
    return directory


@pytest.fixture(scope="session")
def compile_c():
    def compiled(output, sources, *flags):
        command = [
            *find_compiler().command,
            "-std=c11",
            "-Wall",
            "-Wextra",
            "-Werror",
            *flags,
            *map(str, sources),
            "-o",
            str(output),
            "-lm",
        ]
        finished = subprocess.run(command, capture_output=True, text=True, check=False)
        assert finished.returncode == 0, finished.stderr
        return output

    return compiled


@pytest.fixture(scope="session")
def load_c(compile_c, tmp_path_factory):
    """Compiles and loads a shared library, every function of it visible."""

    def load(sources, *flags):
        return ctypes.CDLL(str(compile_c(tmp_path_factory.mktemp("library") / "test.so", sources, "-shared", "-fPIC", *flags)))

    return load


@pytest.fixture(scope="session")
def same_under_sanitizers(compile_c, tmp_path_factory):
    """Whether a program that is compiled with the sanitizers, and knows the public header alone, gives the answers of a solver."""

    def check(solver, sources, flags, problems):
        directory = tmp_path_factory.mktemp("sanitized")
        c_files = [Path(__file__).parent / "solve_file.c", *sorted(sources.glob("*.c"))]
        sanitizers = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
        program = compile_c(directory / "solve", c_files, f"-I{sources}", "-O0", *sanitizers, *flags)
        b, expected = solver._buffers, []
        with (directory / "problems").open("wb") as file:
            for state, previous_input, horizon, warm_start in problems:
                solver.warm_start = warm_start
                result = solver.solve(state, previous_input, horizon)
                expected.append((result.status, b.w.copy()))
                np.concatenate((b.w0, b.lam_w0, b.lam_g0, b.p, b.lower_w, b.upper_w, b.lower_g, b.upper_g)).tofile(file)
        subprocess.run([program, directory / "problems", directory / "answers"], check=True, timeout=60)
        answers = np.fromfile(directory / "answers").reshape(len(expected), -1)
        for answer, (status, w) in zip(answers, expected, strict=True):
            assert (answer[0] == 0.0) == (status is SolveStatus.CONVERGED)
            np.testing.assert_allclose(answer[1:], w, rtol=0, atol=1e-4)

    return check


@pytest.fixture(scope="session")
def recorded(vehicle, library):
    """Nominal problems with the warm starts of `casadi-c`: every fifth of the first three seconds of each scenario."""
    recorder = RecordingSolver(SqpSolver("casadi-c", OcpOptions(), lambda buffers: CompiledBackEnd(library, buffers)))
    for scenario in nominal_scenarios():
        recorder.reset()
        drive(Nmpc(recorder, scenario.path, vehicle, boot_id=1), vehicle, replace(scenario, duration_s=3.0), seed=1)
    return recorder.instances[::5]


@pytest.fixture(scope="session")
def hard_starts(recorded):
    """500 seeded hard starts: (state, previous input, horizon, warm start)."""
    rng = np.random.default_rng(1)
    starts = []
    for count in range(500):
        i = recorded[rng.integers(len(recorded))]
        state, previous_input, warm = i.state.copy(), i.previous_input, i.warm_start
        match count % 4:
            case 0:  # cold
                warm = None
            case 1:  # kicked
                state += rng.standard_normal(6) * (1.0, 0.3, 0.15, 0.3, 0.3, 0.08)
            case 2:  # outside the corridor
                state[3:5] += i.horizon.normals()[0] * rng.choice((-1, 1)) * rng.uniform(0.9, 2.0)
                warm = None
            case _:  # wild
                state += rng.uniform(-1, 1, 6) * (3.0, 1.0, 0.6, 1.5, 1.5, 0.4)
                previous_input = rng.uniform((-0.5, -1.0), (0.5, 1.0))
                warm = warm if rng.random() < 0.5 else None
        starts.append((state, previous_input, i.horizon, warm))
    return starts
