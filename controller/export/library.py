"""`xilgate build`: the library for a target, from the cache or new, and what there is to say about it."""

import ctypes
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Table

from controller.build import METADATA_NAME
from controller.export.targets import TARGETS, TargetName, find_toolchain
from controller.nmpc import DRIVE_MODEL
from controller.problem import OcpOptions
from controller.riccati.build import build_riccati
from controller.solvers import DEFAULT_SOLVER, LIBRARIES
from dbc.build import Build
from dbc.vehicle import load_vehicle

CROSS_SOLVER = "riccati"
"""The solver that other processors get: the one whose code is written for them."""

Progress = Callable[[str], None]


def build_for(target: TargetName, vehicle_path: Path, progress: Progress) -> dict[str, Any]:
    """Build or find the library: of the default solver for this machine, of `CROSS_SOLVER` for another.

    Args:
        progress: told in one line each what takes time.

    Returns:
        What `describe` says.

    Raises:
        UserMistake: the vehicle file cannot be used.
        BuildError: there is no compiler for the target, or it refuses.
    """
    car, options = load_vehicle(vehicle_path).model, OcpOptions(model=DRIVE_MODEL)
    if target is TargetName.HOST:
        return describe(DEFAULT_SOLVER, target, LIBRARIES[DEFAULT_SOLVER](car, options, progress))
    compiler, flags = find_toolchain(target)
    return describe(CROSS_SOLVER, target, build_riccati(car, options, progress, flags, compiler))


def describe(solver: str, target: TargetName, build: Build) -> dict[str, Any]:
    """What there is to say about a library: where it is, what it is made with, and its size."""
    metadata = json.loads(build.library.with_name(METADATA_NAME).read_text(encoding="utf-8"))
    return {
        "solver": solver,
        "target": target.value,
        "library": str(build.library),
        "sha256": build.sha256,
        "compiler": build.compiler,
        "flags": " ".join(metadata["flags"]),
        "lanes": lanes_of_host(build.library) if target is TargetName.HOST else TARGETS[target].lanes,
        "bytes": build.library.stat().st_size,
        "seconds": build.seconds,
        "was_cached": build.was_cached,
    }


def lanes_of_host(library: Path) -> int:
    """Stages that a library of this machine evaluates at once; 1 where it does not know the notion."""
    loaded = ctypes.CDLL(str(library))
    return int(loaded.nmpc_lanes()) if hasattr(loaded, "nmpc_lanes") else 1


def to_table(facts: dict[str, Any]) -> Table:
    """The facts for people, one a line."""
    table = Table(show_header=False, box=None)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for key, value in facts.items():
        table.add_row(key.replace("_", " "), str(value))
    return table
