"""The shape of the project, read from its sources: who may import whom, what is pure, and that ids stand in the DBC alone."""

import ast
import io
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from dbc import catalogue

ROOT = Path(__file__).resolve().parent.parent

# What a package may import of the project, besides itself. A name allows itself and all that is in it.
ALLOWED_IMPORTS = {
    "dbc": (),
    "gateway": ("dbc",),
    "controller": ("dbc", "gateway.messages", "gateway.telemetry", "gateway.channel", "gateway.loop", "gateway.journal", "gateway.record"),
    "vehicle_emulator": ("dbc", "gateway.telemetry"),
    "visualiser": ("dbc.errors", "gateway.telemetry"),
    "xil": ("dbc", "gateway", "controller", "vehicle_emulator", "visualiser"),
}

# Modules that decide: same input, same output, in virtual time as in real time.
PURE_MODULES = {
    "dbc": (
        *("frame", "catalogue", "packing", "e2e", "database", "mapping", "lint", "difference", "vehicle", "section", "multibody"),
        *("health", "watchdog", "error_frames", "bus_monitor", "recovery", "confirmation", "traffic", "frame_length"),
    ),
    "gateway": (
        *("messages", "codec", "supervision", "commands", "conditions", "modes"),
        *("limits", "actuation", "safe_stop", "transmit", "plausibility", "latency", "core", "journal"),
    ),
    "controller": (
        *("problem", "model", "integrator", "ocp", "delay", "disturbance", "estimator", "nmpc", "fallback", "parameters", "objects"),
        "journal",
        *(f"planning/{name}" for name in ("planner", "options", "localiser", "obstacles", "corridor", "shift", "linking", "passing")),
        *("planning/speed", "planning/reference", "planning/reference_sources"),
    ),
    "vehicle_emulator": (
        *(f"faults/{name}" for name in ("kinds", "spec", "condition", "schedule", "frames", "effects", "targets", "instance")),
        *("faults/engine", "faults/operations", "operation", "driver"),
        *("actuators", "car_bus", "emulator", "lift", "safety_driver"),
        *(f"robots/{name}" for name in ("faults", "receiver", "states", "supervisor", "robot", "steering", "pedal", "reports", "system")),
        *(f"plants/multibody/{name}" for name in ("layout", "symbols", "parameters", "chassis", "tyre", "bristle", "brake", "steering")),
        *(f"plants/multibody/{name}" for name in ("equations", "stability", "plant", "powertrain", "gearbox")),
        *("road", "plants/interface", "plants/bicycle", "plants/column", "plants/commonroad", "plants/fmu_mapping"),
        *(f"bus/{name}" for name in ("analysis", "attempt", "bits", "confinement", "core")),
        *(f"bus/{name}" for name in ("error_frames", "frame", "load", "node", "wire")),
        *(f"ins/{name}" for name in ("axes", "errors", "instrument", "messages", "motion", "receiver", "schedule", "solution")),
    ),
}
IMPURE = {"can", "zenoh", "time", "threading", "os", "logging", "socket", "asyncio"}

SOURCES = [path for package in ALLOWED_IMPORTS for path in sorted((ROOT / package).rglob("*.py"))]
PURE_SOURCES = [ROOT / package / f"{module}.py" for package, modules in PURE_MODULES.items() for module in modules]


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imports(source: str, package: str) -> Iterator[str]:
    """Full name of everything that a module in `package` imports, wherever in the module it does so."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            origin = ".".join([*parents, *([node.module] if node.module else [])])
            yield from (f"{origin}.{alias.name}" for alias in node.names)


def imports_of(path: Path) -> list[str]:
    return list(imports(path.read_text(encoding="utf-8"), ".".join(path.parent.relative_to(ROOT).parts)))


def is_within(name: str, allowed: str) -> bool:
    return name == allowed or name.startswith(f"{allowed}.")


def forbidden_imports(names: list[str], package: str) -> list[str]:
    ours = [name for name in names if name.split(".")[0] in ALLOWED_IMPORTS]
    return [name for name in ours if not any(is_within(name, allowed) for allowed in (package, *ALLOWED_IMPORTS[package]))]


def impure_imports(names: list[str]) -> set[str]:
    return {name.split(".")[0] for name in names} & IMPURE


def hexadecimal_literals(source: str) -> set[int]:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {int(token.string, 16) for token in tokens if token.type == tokenize.NUMBER and token.string.lower().startswith("0x")}


@pytest.fixture(scope="module")
def arbitration_ids() -> set[int]:
    ids = set(catalogue.load().by_id)
    assert ids
    return ids


def test_the_table_names_every_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]) == set(ALLOWED_IMPORTS)


def test_no_package_hides_one_of_the_standard_library():
    assert not set(ALLOWED_IMPORTS) & sys.stdlib_module_names


@pytest.mark.parametrize("path", SOURCES, ids=named)
def test_imports_follow_the_dependency_direction(path):
    assert forbidden_imports(imports_of(path), path.relative_to(ROOT).parts[0]) == []


@pytest.mark.parametrize("path", PURE_SOURCES, ids=named)
def test_pure_modules_know_neither_clock_nor_bus(path):
    assert path.is_file(), f"{named(path)} is in the table and not in the project"
    assert impure_imports(imports_of(path)) == set()


@pytest.mark.parametrize("path", [path for path in SOURCES if path.relative_to(ROOT).parts[0] != "dbc"], ids=named)
def test_arbitration_ids_stand_in_the_dbc_alone(path, arbitration_ids):
    assert hexadecimal_literals(path.read_text(encoding="utf-8")) & arbitration_ids == set()


@pytest.mark.parametrize(
    ("source", "package", "expected"),
    [
        ("import gateway.core", "visualiser", ["gateway.core"]),
        ("import gateway", "visualiser", ["gateway"]),
        ("from gateway import core, telemetry", "visualiser", ["gateway.core"]),
        ("from gateway.telemetry import Sample", "visualiser", []),
        ("from gateway.telemetry_extra import x", "visualiser", ["gateway.telemetry_extra.x"]),
        ("from .board import Board", "visualiser", []),
        ("def f():\n    if True:\n        from xil import cli", "dbc", ["xil.cli"]),
        ("import gateway.core as time", "vehicle_emulator", ["gateway.core"]),
        ("import numpy, dbc.frame", "gateway", []),
    ],
)
def test_forbidden_imports_are_found(source, package, expected):
    assert forbidden_imports(list(imports(source, package)), package) == expected


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import os.path", {"os"}),
        ("from time import monotonic_ns", {"time"}),
        ("def f():\n    import can", {"can"}),
        ("import math, canal, timeit", set()),
        ("from .bus import can", set()),
    ],
)
def test_impure_imports_are_found(source, expected):
    assert impure_imports(list(imports(source, "vehicle_emulator"))) == expected


def test_relative_imports_are_resolved():
    assert list(imports("from ..bus.core import BusCore\nfrom . import wire", "vehicle_emulator.bus")) == [
        "vehicle_emulator.bus.core.BusCore",
        "vehicle_emulator.bus.wire",
    ]


def test_hexadecimal_literals_are_found_and_nothing_else():
    assert hexadecimal_literals("a = 0x110  # 0x120\nb = '0x130'\nc = 272\nd = [0X1_0]") == {0x110, 0x10}
