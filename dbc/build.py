"""Builds a shared library from C and keeps it in a cache by content: the controller's solvers and the emulated car.

The key of the cache is a hash of all that goes in: what the caller names, CasADi's version, compiler and flags. A hit needs
neither CasADi nor a compiler run.
"""

import contextlib
import hashlib
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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dbc.errors import SetupFailure

METADATA_SUFFIX = ".json"

FLAGS = ("-std=c11", "-O3", "-fPIC", "-shared", "-ffp-contract=off", "-fvisibility=hidden")
"""For code that CasADi writes. No -march, no contraction, no -ffast-math: the same numbers on every machine, and NaN stays NaN."""
CASADI_EXPORT = '-DCASADI_SYMBOL_EXPORT=__attribute__((visibility("default")))'
"""What makes the functions that CasADi generates visible again; hidden functions can be inlined."""
_COMPILERS = ("cc", "gcc", "clang")
ZIG = (sys.executable, "-m", "ziglang", "cc")
_ZIG_FLAGS = ("-mcpu=baseline", "-fno-sanitize=undefined", "-s")
"""Zig compiles for the very machine it runs on, with checks and debug information, unless told otherwise."""


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
        what: what it is, for people.
        name: of the library file and of its metadata, without suffix.
        ingredients: everything that shapes the code, as JSON can hold it; see `sha256_of_files` for sources.
        facts: more for the metadata beside the library.
        flags: for the compiler.
        write_sources: writes the C sources into a directory; names of those to compile.
    """

    what: str
    name: str
    ingredients: Mapping[str, Any]
    facts: Mapping[str, Any]
    flags: tuple[str, ...]
    write_sources: Callable[[Path], list[str]]


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
    if found := _load(directory, recipe.name):
        return found
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        # Built beside its final place and renamed, so that nobody ever sees half a library.
        work = Path(tempfile.mkdtemp(dir=directory.parent, prefix="building-"))
        try:
            _make(work, recipe, compiler, progress)
            _publish(work, directory, recipe.name)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise BuildError(f"cannot write the library cache {directory.parent}: {error.strerror or error}") from error
    if made := _load(directory, recipe.name):
        return Build(made.library, made.sha256, made.compiler, made.seconds, was_cached=False)
    raise BuildError(f"the library cache {directory} does not keep what is written to it")


def _make(work: Path, recipe: Recipe, compiler: Compiler, progress: Callable[[str], None]) -> None:
    start = time.monotonic()
    progress(f"generating C code of {recipe.what}")
    sources = recipe.write_sources(work)
    progress(f"compiling {recipe.what} with {compiler}")
    command = [*compiler.command, *recipe.flags, *sources, "-o", f"{recipe.name}.so", "-lm"]
    finished = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        lines = [line for line in finished.stderr.splitlines() if "error" in line] or finished.stderr.splitlines() or ["no message"]
        raise BuildError(f"{compiler} failed with exit code {finished.returncode}: {lines[0].strip()}")
    metadata = {
        "sha256": sha256_of(work / f"{recipe.name}.so"),
        "compiler": str(compiler),
        "flags": recipe.flags,
        "casadi": importlib.metadata.version("casadi"),
        "seconds": round(time.monotonic() - start, 1),
        **recipe.facts,
    }
    (work / f"{recipe.name}{METADATA_SUFFIX}").write_text(json.dumps(metadata, indent=1) + "\n", encoding="utf-8")


def _publish(work: Path, directory: Path, name: str) -> None:
    try:
        work.rename(directory)  # fails where there is one already
    except OSError:
        if _load(directory, name):
            return  # another process was faster
        shutil.rmtree(directory, ignore_errors=True)
        work.rename(directory)


def _load(directory: Path, name: str) -> Build | None:
    """What the cache holds, or None when it is not there or not whole."""
    library = directory / f"{name}.so"
    with contextlib.suppress(OSError, ValueError, KeyError):
        metadata = json.loads((directory / f"{name}{METADATA_SUFFIX}").read_text(encoding="utf-8"))
        if metadata["sha256"] == sha256_of(library):
            return Build(library, metadata["sha256"], metadata["compiler"], metadata["seconds"], was_cached=True)
    return None


def _key(recipe: Recipe, compiler: Compiler) -> str:
    everything = {
        "name": recipe.name,
        "ingredients": recipe.ingredients,
        "builder": sha256_of(Path(__file__)),
        "flags": recipe.flags,
        "casadi": importlib.metadata.version("casadi"),
        "compiler": (compiler.command, compiler.version),
        "machine": platform.machine(),
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()[:24]


def sha256_of_files(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """Hash of each of the named files."""
    return {name: sha256_of(directory / name) for name in names}


def sha256_of(path: Path) -> str:
    """Hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
