"""`xilgate build --export`: the solver `riccati` as a directory of C that needs nothing of this project any more."""

import hashlib
import importlib.metadata
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from controller.bench.library import describe_library, describe_machine
from controller.export.targets import TARGETS, TargetName
from controller.export.vectors import Vector, record, write_vectors
from controller.nmpc import DRIVE_MODEL
from controller.problem import OcpOptions
from controller.riccati.build import FLAGS, build_riccati, host_flags, write_sources
from controller.riccati.emit import SIZES_NAME
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC
from dbc.build import Build
from dbc.errors import UserMistake
from dbc.vehicle import Vehicle, load_vehicle

VECTORS_PER_SET = 12
HEADER_NAME = "nmpc.h"

_FILES = Path(__file__).parent / "files"
_TEMPLATES = Environment(
    loader=FileSystemLoader(_FILES), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
)
_SET_BY_MAKEFILE = ("-std=c11", "-Wall", "-Wextra", "-fPIC", "-shared", "-fvisibility=hidden")

Progress = Callable[[str], None]


class ExportError(UserMistake):
    """The directory cannot be exported to; one line that says why."""


def export(
    directory: Path,
    vehicle_path: Path,
    target: TargetName,
    progress: Progress,
    *,
    options: OcpOptions | None = None,
    vectors_per_set: int = VECTORS_PER_SET,
) -> dict[str, Any]:
    """Write the directory.

    Args:
        directory: new or empty.
        target: that its Makefile builds for when not told otherwise; the recorded answers are always this machine's.
        progress: told in one line each what takes time.
        vectors_per_set: problems of each of the sets nominal, active and hard.

    Returns:
        Where it is, the number of files and of vectors, and what to do next.

    Raises:
        ExportError: the directory is in use, or cannot be written.
        BuildError: this machine has no compiler.
    """
    vehicle = load_vehicle(vehicle_path)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()):
            raise ExportError(f"{directory}: is not empty; name a new or an empty directory")
        # Made inside, and moved to its place when whole.
        with tempfile.TemporaryDirectory(dir=directory, prefix="making-") as made:
            ocp = options or OcpOptions(model=DRIVE_MODEL)
            vectors = _write(Path(made), vehicle, ocp, target=target, progress=progress, vectors_per_set=vectors_per_set)
            for path in Path(made).iterdir():
                path.rename(directory / path.name)
    except OSError as error:
        raise ExportError(f"{directory}: {error.strerror or error}") from error
    return {
        "directory": str(directory),
        "target": target.value,
        "files": sum(path.is_file() for path in directory.rglob("*")),
        "vectors": vectors,
        "next": f"make -C {directory} check",
    }


def _write(made: Path, vehicle: Vehicle, options: OcpOptions, *, target: TargetName, progress: Progress, vectors_per_set: int) -> int:
    """Write everything into `made`; the number of vectors."""
    build = build_riccati(vehicle.model, options, progress)
    vectors = record(vehicle, options, build, vectors_per_set, progress)
    _write_code(made, vehicle, options, target)
    write_vectors(made / "check", vectors)
    facts = _facts(vehicle, options, target, build, vectors)
    _render("README.md", made, facts)
    (made / "LICENSE").write_text(importlib.metadata.distribution("xilgate").read_text("licenses/LICENSE") or "", encoding="utf-8")
    _write_manifest(made, facts)
    return len(vectors)


def _write_code(made: Path, vehicle: Vehicle, options: OcpOptions, target: TargetName) -> None:
    """Sources, the public header, checker and Makefile."""
    for name in ("src", "include", "check"):
        (made / name).mkdir()
    write_sources(made / "src", vehicle.model, options)
    header, sizes = made / "src" / HEADER_NAME, made / "src" / SIZES_NAME
    include = f'#include "{SIZES_NAME}"\n'
    before, found, after = header.read_text(encoding="utf-8").partition(include)
    if not found:
        raise ValueError(f"{HEADER_NAME} does not include {SIZES_NAME}")
    defines = "".join(line for line in sizes.read_text(encoding="utf-8").splitlines(keepends=True) if line.startswith("#define"))
    (made / "include" / HEADER_NAME).write_text(before + defines + after, encoding="utf-8")
    header.unlink()
    sizes.unlink()
    for path in (made / "src").iterdir():
        path.write_text(path.read_text(encoding="utf-8").replace(include, f'#include "{HEADER_NAME}"\n'), encoding="utf-8")
    for path in _FILES.glob("*.[ch]"):
        shutil.copyfile(path, made / "check" / path.name)
    optimisation = " ".join(flag for flag in FLAGS if flag not in _SET_BY_MAKEFILE)
    _render("Makefile", made, {"target": target.value, "optimisation": optimisation, "rows": _rows()})


def _rows() -> list[dict[str, str]]:
    """What the Makefile knows of each target."""
    rows = [{"name": TargetName.HOST.value, "prefix": "", "flags": " ".join(host_flags()), "run": "", "check_ldflags": ""}]
    for name, target in TARGETS.items():
        flags, run = (" ".join(words) for words in (target.toolchains[0].flags, target.emulator))
        rows.append({"name": name.value, "prefix": target.prefix, "flags": flags, "run": run, "check_ldflags": "-static"})
    return rows


def _facts(vehicle: Vehicle, options: OcpOptions, target: TargetName, build: Build, vectors: list[Vector]) -> dict[str, Any]:
    """All that the README and the manifest say."""
    solved = [vector for vector in vectors if vector.status == 0]
    times_us, works = [vector.time_us for vector in solved], [vector.effort.work or 0.0 for vector in solved]
    layout = options.layout
    return {
        "xilgate": importlib.metadata.version("xilgate"),
        "casadi": importlib.metadata.version("casadi"),
        "solver": "riccati",
        "target": target.value,
        "vehicle": vehicle.model.model_dump(),
        "options": asdict(options),
        "penalties": {"linear": PENALTY_LINEAR, "quadratic": PENALTY_QUADRATIC},
        "sizes": {"variables": layout.n_variables, "constraints": layout.n_constraints, "parameters": layout.n_parameters},
        "exported_on": {"machine": describe_machine(), "sha256": build.sha256, **describe_library("riccati", build)},
        "vectors": [{"name": vector.name, "status": vector.status, "work": vector.effort.work} for vector in vectors],
        "measured": {
            "mean_us": round(float(np.mean(times_us)), 1),
            "largest_us": round(max(times_us), 1),
            "largest_work": round(max(works), 1),
        },
    }


def _write_manifest(made: Path, facts: dict[str, Any]) -> None:
    files = sorted(path for path in made.rglob("*") if path.is_file())
    sums = {path.relative_to(made).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    (made / "manifest.json").write_text(json.dumps(facts | {"files": sums}, indent=1) + "\n", encoding="utf-8")


def _render(name: str, made: Path, facts: dict[str, Any]) -> None:
    (made / name).write_text(_TEMPLATES.get_template(f"{name}.jinja").render(facts), encoding="utf-8")
