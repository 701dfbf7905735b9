"""Instructions of a solve, counted by callgrind: a figure that a busy machine does not change.

The child is a small C program around the library: callgrind does not see calls begin that Python makes.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from controller.bench.sets import Instance, pack_instance
from controller.problem import Array, OcpOptions
from controller.riccati.build import write_sources
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC
from controller.solver import NlpBuffers
from dbc.build import Build, find_compiler
from dbc.errors import SetupFailure
from dbc.vehicle import ModelParameters

DRIVER = Path(__file__).with_name("driver.c")
_COLLECTED = re.compile(r"Collected : (\d+)")


class CallgrindError(SetupFailure):
    """Instructions cannot be counted here; one line that says why."""


def find_valgrind() -> str:
    """Path of valgrind.

    Raises:
        CallgrindError: it is not installed.
    """
    if path := shutil.which("valgrind"):
        return path
    raise CallgrindError("valgrind is not installed: --callgrind needs it (Debian: apt install valgrind)")


def count_instructions(
    builds: dict[str, Build], instances: list[Instance], car: ModelParameters, options: OcpOptions, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Mean instructions of a solve with each library.

    Args:
        instances: those with a warm start are taken.

    Raises:
        CallgrindError: valgrind is not installed, or the child fails.
    """
    valgrind, warm = find_valgrind(), [i for i in instances if i.warm_start is not None]
    rows = []
    with tempfile.TemporaryDirectory(prefix="xilgate-") as name:
        directory = Path(name)
        problems = directory / "problems"
        np.concatenate([(PENALTY_LINEAR, PENALTY_QUADRATIC), *(_packed(i, options) for i in warm)]).tofile(problems)
        driver = _compiled_driver(directory, car, options)
        for solver, build in builds.items():
            progress(f"counting instructions of {solver} with callgrind")
            total = _counted(valgrind, [str(driver), str(build.library), str(problems)], len(warm), solver)
            rows.append({"solver": solver, "instances": len(warm), "instructions_per_solve": round(total / len(warm))})
    return rows


def _packed(instance: Instance, options: OcpOptions) -> Array:
    """The numbers of one problem in the order of the driver."""
    b = NlpBuffers(options.layout)
    pack_instance(b, instance, options)
    return np.concatenate((b.w0, b.lam_w0, b.lam_g0, b.p, b.lower_w, b.upper_w, b.lower_g, b.upper_g))


def _compiled_driver(directory: Path, car: ModelParameters, options: OcpOptions) -> Path:
    write_sources(directory, car, options)  # for the header, and the sizes in it
    driver = directory / "driver"
    command = [*find_compiler().command, "-std=c11", "-O1", f"-I{directory}", str(DRIVER), "-o", str(driver), "-ldl"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        lines = [line for line in finished.stderr.splitlines() if "error" in line] or ["no message"]
        raise CallgrindError(f"{DRIVER.name} does not compile: {lines[0].strip()}")
    return driver


def _counted(valgrind: str, child: list[str], count: int, solver: str) -> int:
    """Instructions of all solves of a child, from entering the library's function to leaving it."""
    collect = ("--tool=callgrind", "--callgrind-out-file=/dev/null", "--toggle-collect=nmpc_solve", "--toggle-collect=nmpc")
    finished = subprocess.run([valgrind, *collect, *child], capture_output=True, text=True, check=False)
    found = _COLLECTED.search(finished.stderr)
    if finished.returncode != 0 or found is None or int(found[1]) == 0 or finished.stdout.strip() != str(count):
        last = (finished.stderr.strip().splitlines() or ["no message"])[-1]
        raise CallgrindError(f"callgrind cannot count the instructions of {solver}: {last}")
    return int(found[1])
