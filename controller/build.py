"""Builds the controller's library: CasADi writes C, a C compiler makes a shared library, a cache keeps it by content.

The key of the cache is a hash of all that goes in: sources of model and problem, their numbers, CasADi's version, compiler and
flags. A hit needs neither CasADi nor a compiler run.
"""

import contextlib
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from controller.problem import OcpOptions
from dbc.errors import SetupFailure
from dbc.vehicle import ModelParameters

LIBRARY_NAME = "nmpc.so"
METADATA_NAME = "nmpc.json"
SOURCE_NAME = "nmpc.c"

MAX_SOLVERS = 64
"""Solvers that one process can hold; each costs the generated code a few hundred bytes."""
FLAGS = (
    "-std=c11",
    "-O3",
    "-fPIC",
    "-shared",
    "-ffp-contract=off",
    "-fvisibility=hidden",
    '-DCASADI_SYMBOL_EXPORT=__attribute__((visibility("default")))',
    f"-DCASADI_MAX_NUM_THREADS={MAX_SOLVERS}",
)
"""No -march, no contraction, no -ffast-math: the same numbers on every machine, and NaN stays NaN. Hidden functions can be inlined."""
_COMPILERS = ("cc", "gcc", "clang")
ZIG = (sys.executable, "-m", "ziglang", "cc")
_ZIG_FLAGS = ("-mcpu=baseline", "-fno-sanitize=undefined", "-s")
"""Zig compiles for the very machine it runs on, with checks and debug information, unless told otherwise."""

_KEYED_SOURCES = ("build.py", "codegen.py", "integrator.py", "model.py", "ocp.py", "problem.py")
_QRQP_SOURCES = ("qrqp.py", "riccati/stage.py")


class BuildError(SetupFailure):
    """The library cannot be built; one line that says why."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler.

    Args:
        command: how to call it.
        version: first line of what it says of itself.
    """

    command: tuple[str, ...]
    version: str

    def __str__(self) -> str:
        return f"{' '.join(Path(part).name for part in self.command)} ({self.version})"


@dataclass(frozen=True)
class Build:
    """A library, ready to load.

    Args:
        sha256: of the library file.
        compiler: which made it.
        seconds: that making it took, now or when it was cached.
        was_cached: whether it was found in the cache.
    """

    library: Path
    sha256: str
    compiler: str
    seconds: float
    was_cached: bool


@dataclass(frozen=True)
class Recipe:
    """All that one library is made from.

    Args:
        keyed_sources: files of this package that its code comes from.
        flags: for the compiler.
        write_sources: writes the C sources for a car and a problem into a directory; names of those to compile.
    """

    car: ModelParameters
    options: OcpOptions
    keyed_sources: tuple[str, ...]
    flags: tuple[str, ...]
    write_sources: Callable[[Path, ModelParameters, OcpOptions], list[str]]


def find_compiler() -> Compiler:
    """The C compiler of this machine: $CC, else cc, gcc or clang, else the one in the Python package ziglang.

    Raises:
        BuildError: there is none, or $CC does not run.
    """
    if chosen := os.environ.get("CC", "").split():
        if compiler := compiler_at(tuple(chosen)):
            return compiler
        raise BuildError(f"the compiler in $CC does not run: {' '.join(chosen)}")
    for name in _COMPILERS:
        if (path := shutil.which(name)) and (compiler := compiler_at((path,))):
            return compiler
    if importlib.util.find_spec("ziglang") and (compiler := compiler_at(ZIG)):
        return replace(compiler, command=(*ZIG, *_ZIG_FLAGS))
    raise BuildError("no C compiler found: install gcc or clang, or `pip install ziglang`, or set CC")


def compiler_at(command: tuple[str, ...]) -> Compiler | None:
    """The compiler that is called so; None when it does not run."""
    try:
        finished = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False)
    except OSError:
        return None
    version = finished.stdout.splitlines()[0].strip() if finished.returncode == 0 and finished.stdout else ""
    return Compiler(command, version) if version else None


def cache_directory() -> Path:
    """Where built libraries are kept: $XDG_CACHE_HOME/xilgate, else ~/.cache/xilgate."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(root) if Path(root).is_absolute() else Path.home() / ".cache") / "xilgate"


def build(car: ModelParameters, options: OcpOptions, progress: Callable[[str], None]) -> Build:
    """The library that CasADi generates for one car and one problem; see `build_from`."""
    return build_from(Recipe(car, options, _KEYED_SOURCES, FLAGS, partial(_generate, "controller.ocp")), progress)


def build_qrqp(car: ModelParameters, options: OcpOptions, progress: Callable[[str], None]) -> Build:
    """The same with the derivatives of `qrqp`."""
    sources = (*_KEYED_SOURCES, *_QRQP_SOURCES)
    return build_from(Recipe(car, options, sources, FLAGS, partial(_generate, "controller.qrqp")), progress)


def build_from(recipe: Recipe, progress: Callable[[str], None], compiler: Compiler | None = None) -> Build:
    """The library of a recipe, from the cache or new.

    Args:
        progress: told in one line each what takes time.
        compiler: None for that of this machine.

    Raises:
        BuildError: no compiler, no place to write, or the compiler refuses.
    """
    compiler = compiler or find_compiler()
    directory = cache_directory() / _key(recipe, compiler)
    if found := _load(directory):
        return found
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        # Built beside its final place and renamed, so that nobody ever sees half a library.
        work = Path(tempfile.mkdtemp(dir=directory.parent, prefix="building-"))
        try:
            _make(work, recipe, compiler, progress)
            _publish(work, directory)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise BuildError(f"cannot write the library cache {directory.parent}: {error.strerror or error}") from error
    if made := _load(directory):
        return Build(made.library, made.sha256, made.compiler, made.seconds, was_cached=False)
    raise BuildError(f"the library cache {directory} does not keep what is written to it")


def _generate(module: str, directory: Path, car: ModelParameters, options: OcpOptions) -> list[str]:
    """Write the C source of the functions that `build_functions` of a module makes."""
    from controller.codegen import generate  # noqa: PLC0415 - CasADi is loaded only when there is something to build

    generate(directory / SOURCE_NAME, importlib.import_module(module).build_functions, car, options)
    return [SOURCE_NAME]


def _make(work: Path, recipe: Recipe, compiler: Compiler, progress: Callable[[str], None]) -> None:
    start = time.monotonic()
    progress("generating C code of the controller")
    sources = recipe.write_sources(work, recipe.car, recipe.options)
    progress(f"compiling the controller with {compiler}")
    command = [*compiler.command, *recipe.flags, *sources, "-o", LIBRARY_NAME, "-lm"]
    finished = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        lines = [line for line in finished.stderr.splitlines() if "error" in line] or finished.stderr.splitlines() or ["no message"]
        raise BuildError(f"{compiler} failed with exit code {finished.returncode}: {lines[0].strip()}")
    metadata = {
        "sha256": _sha256(work / LIBRARY_NAME),
        "compiler": str(compiler),
        "flags": recipe.flags,
        "casadi": importlib.metadata.version("casadi"),
        "seconds": round(time.monotonic() - start, 1),
        "model": recipe.car.model_dump(),
        "options": recipe.options.generated(),
    }
    (work / METADATA_NAME).write_text(json.dumps(metadata, indent=1) + "\n", encoding="utf-8")


def _publish(work: Path, directory: Path) -> None:
    if _load(directory):
        return  # another process was faster
    shutil.rmtree(directory, ignore_errors=True)
    try:
        work.rename(directory)
    except OSError:
        if not _load(directory):
            raise


def _load(directory: Path) -> Build | None:
    """What the cache holds, or None when it is not there or not whole."""
    library = directory / LIBRARY_NAME
    with contextlib.suppress(OSError, ValueError, KeyError):
        metadata = json.loads((directory / METADATA_NAME).read_text(encoding="utf-8"))
        if metadata["sha256"] == _sha256(library):
            return Build(library, metadata["sha256"], metadata["compiler"], metadata["seconds"], was_cached=True)
    return None


def _key(recipe: Recipe, compiler: Compiler) -> str:
    sources = Path(__file__).parent
    ingredients = {
        "sources": {name: _sha256(sources / name) for name in recipe.keyed_sources},
        "equations": _sha256(_equations(recipe.options)),
        "flags": recipe.flags,
        "model": recipe.car.model_dump(),
        "options": recipe.options.generated(),
        "casadi": importlib.metadata.version("casadi"),
        "compiler": (compiler.command, compiler.version),
        "machine": platform.machine(),
    }
    return hashlib.sha256(json.dumps(ingredients, sort_keys=True).encode()).hexdigest()[:24]


def _equations(options: OcpOptions) -> Path:
    """File of the model's equations."""
    module = options.model.equations.partition(":")[0]
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise BuildError(f"model {options.model.name}: no module {module}")
    return Path(spec.origin)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
