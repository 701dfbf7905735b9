"""The solvers that can be chosen by name. A further back end is one more entry of the table."""

import time
from collections.abc import Callable

from controller.build import Build, build
from controller.compiled import CompiledBackEnd
from controller.problem import OcpOptions
from controller.riccati.build import build_riccati
from controller.riccati.solver import RiccatiSolver
from controller.solver import Solver, SqpSolver
from dbc.errors import UserMistake
from dbc.vehicle import ModelParameters

DEFAULT_SOLVER = "casadi-c"

Progress = Callable[[str], None]
Clock = Callable[[], int]


def _compiled(car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    library = build(car, options, progress).library
    return SqpSolver("casadi-c", options, lambda buffers: CompiledBackEnd(library, buffers), clock)


def _interpreted(car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    from controller.interpreted import InterpretedBackEnd  # noqa: PLC0415 - the compiled solver must run without CasADi
    from controller.ocp import build_functions  # noqa: PLC0415

    progress("setting up the controller in CasADi")
    functions = build_functions(car, options)
    return SqpSolver("casadi-vm", options, lambda buffers: InterpretedBackEnd(functions, buffers), clock)


def _riccati(car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    return RiccatiSolver(build_riccati(car, options, progress).library, options, clock)


SOLVERS: dict[str, Callable[[ModelParameters, OcpOptions, Progress, Clock], Solver]] = {
    "casadi-vm": _interpreted,
    "casadi-c": _compiled,
    "riccati": _riccati,
}
"""Makers by name: `casadi-vm` runs uncompiled, `casadi-c` is the same generated to C, `riccati` uses the structure of the
problem and takes its state bounds as soft."""


LIBRARIES: dict[str, Callable[[ModelParameters, OcpOptions, Progress], Build]] = {"casadi-c": build, "riccati": build_riccati}
"""Builders of the solvers that are compiled, by name."""


def make_solver(name: str, car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock = time.perf_counter_ns) -> Solver:
    """The solver of this name for a car and a problem.

    Args:
        progress: told in one line each what takes time.
        clock: that solve times are read from [ns].

    Raises:
        UserMistake: there is no such solver.
        SetupFailure: it cannot be compiled or loaded.
    """
    if name not in SOLVERS:
        raise UserMistake(f"solver {name!r}: there are {', '.join(SOLVERS)}")
    return SOLVERS[name](car, options, progress, clock)
