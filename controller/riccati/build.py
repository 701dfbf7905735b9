"""Builds the library of this solver: its C sources, as they are, with the stage functions of one car and one problem."""

import shutil
from collections.abc import Callable
from pathlib import Path

from controller.build import recipe
from controller.problem import OcpOptions
from dbc.build import Build, Compiler, build_from
from dbc.vehicle import ModelParameters

C_SOURCES = Path(__file__).parent / "c"

FLAGS = ("-std=c11", "-Wall", "-Wextra", "-O3", "-fPIC", "-shared", "-ffp-contract=fast", "-fno-math-errno", "-fvisibility=hidden")
"""Fused multiply-add where the target has it. No -ffast-math: rounding and the tests for NaN rely on IEEE arithmetic."""
SCALAR = ("-DLANES=1", "-fno-tree-vectorize", "-fno-tree-slp-vectorize")
"""For a target without vectors of doubles."""
_AVX2 = ("-mavx2", "-mfma")

_KEYED_SOURCES = (
    *("build.py", "integrator.py", "model.py", "ocp.py", "problem.py"),
    *("riccati/build.py", "riccati/emit.py", "riccati/printer.py", "riccati/stage.py"),
)


def build_riccati(
    car: ModelParameters,
    options: OcpOptions,
    progress: Callable[[str], None],
    target_flags: tuple[str, ...] | None = None,
    compiler: Compiler | None = None,
) -> Build:
    """The library for one car and one problem, from the cache or new.

    Args:
        progress: told in one line each what takes time.
        target_flags: what the code may use of the processor; None for what this machine has.
        compiler: None for that of this machine.

    Raises:
        BuildError: no compiler, no place to write, or the compiler refuses.
    """
    flags = (*FLAGS, *(host_flags() if target_flags is None else target_flags))
    sources = tuple(f"riccati/c/{path.name}" for path in sorted(C_SOURCES.iterdir()))
    return build_from(recipe(car, options, (*_KEYED_SOURCES, *sources), flags, write_sources), progress, compiler)


def host_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> tuple[str, ...]:
    """Flags for four lanes where this machine has AVX2 and fused multiply-add, else none: what every one of its kind has."""
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    features = next((set(line.split()) for line in lines if line.startswith("flags")), set())
    return _AVX2 if {"avx2", "fma"} <= features else ()


def write_sources(directory: Path, car: ModelParameters, options: OcpOptions) -> list[str]:
    """Put everything that the library is compiled from into `directory`; names of the C files."""
    from controller.riccati.emit import write_stage_functions  # noqa: PLC0415 - CasADi is loaded only when there is something to build

    for path in C_SOURCES.iterdir():
        shutil.copyfile(path, directory / path.name)
    write_stage_functions(directory, car, options)
    return sorted(path.name for path in directory.glob("*.c"))
