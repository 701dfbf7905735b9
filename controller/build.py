"""The recipes of the controller's libraries: what `casadi-c` and `qrqp` are generated from."""

import importlib
import importlib.util
from collections.abc import Callable
from functools import partial
from pathlib import Path

from controller.problem import OcpOptions
from dbc import build as builder
from dbc.build import CASADI_EXPORT, Build, BuildError, Recipe, build_from, sha256_of, sha256_of_files
from dbc.vehicle import ModelParameters

NAME = "nmpc"
METADATA_NAME = f"{NAME}{builder.METADATA_SUFFIX}"
SOURCE_NAME = f"{NAME}.c"

MAX_SOLVERS = 64
"""Solvers that one process can hold; each costs the generated code a few hundred bytes."""
FLAGS = (*builder.FLAGS, CASADI_EXPORT, f"-DCASADI_MAX_NUM_THREADS={MAX_SOLVERS}")

_KEYED_SOURCES = ("build.py", "codegen.py", "integrator.py", "model.py", "ocp.py", "problem.py")
_QRQP_SOURCES = ("qrqp.py", "riccati/stage.py")


def build(car: ModelParameters, options: OcpOptions, progress: Callable[[str], None]) -> Build:
    """The library that CasADi generates for one car and one problem; see `dbc.build.build_from`."""
    return build_from(recipe(car, options, _KEYED_SOURCES, FLAGS, partial(_generate, "controller.ocp")), progress)


def build_qrqp(car: ModelParameters, options: OcpOptions, progress: Callable[[str], None]) -> Build:
    """The same with the derivatives of `qrqp`."""
    sources = (*_KEYED_SOURCES, *_QRQP_SOURCES)
    return build_from(recipe(car, options, sources, FLAGS, partial(_generate, "controller.qrqp")), progress)


def recipe(
    car: ModelParameters,
    options: OcpOptions,
    keyed_sources: tuple[str, ...],
    flags: tuple[str, ...],
    write_sources: Callable[[Path, ModelParameters, OcpOptions], list[str]],
) -> Recipe:
    """The recipe of a library of the controller.

    Args:
        keyed_sources: files of this package that its code comes from.
        write_sources: writes the C sources for a car and a problem into a directory; names of those to compile.
    """
    facts = {"model": car.model_dump(), "options": options.generated()}
    sources = {"sources": sha256_of_files(Path(__file__).parent, keyed_sources), "equations": sha256_of(_equations(options))}
    return Recipe("the controller", NAME, sources | facts, facts, flags, lambda directory: write_sources(directory, car, options))


def _generate(module: str, directory: Path, car: ModelParameters, options: OcpOptions) -> list[str]:
    """Write the C source of the functions that `build_functions` of a module makes."""
    from controller.codegen import generate  # noqa: PLC0415 - CasADi is loaded only when there is something to build

    generate(directory / SOURCE_NAME, importlib.import_module(module).build_functions, car, options)
    return [SOURCE_NAME]


def _equations(options: OcpOptions) -> Path:
    """File of the model's equations."""
    module = options.model.equations.partition(":")[0]
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise BuildError(f"model {options.model.name}: no module {module}")
    return Path(spec.origin)
