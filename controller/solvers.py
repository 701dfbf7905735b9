"""The solvers that can be chosen by name. A further back end is one more entry of the table."""

import time
from collections.abc import Callable
from functools import partial

from controller.build import build, build_qrqp
from controller.compiled import CompiledBackEnd
from controller.problem import OcpOptions
from controller.riccati.build import SCALAR, build_riccati
from controller.riccati.solver import RiccatiSolver
from controller.solver import Solver, SqpSolver
from dbc.build import Build
from dbc.errors import UserMistake
from dbc.vehicle import ModelParameters

DEFAULT_SOLVER = "riccati"

Progress = Callable[[str], None]
Clock = Callable[[], int]


def _compiled(name: str, car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    library = LIBRARIES[name](car, options, progress).library
    return SqpSolver(name, options, lambda buffers: CompiledBackEnd(library, buffers), clock)


def _ipopt(car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    from controller.ipopt import make_ipopt  # noqa: PLC0415 - a compiled solver must run without CasADi

    progress("setting up IPOPT in CasADi")
    return make_ipopt(car, options, clock)


def _interpreted(car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    from controller.interpreted import InterpretedBackEnd  # noqa: PLC0415 - the compiled solver must run without CasADi
    from controller.ocp import build_functions  # noqa: PLC0415

    progress("setting up the controller in CasADi")
    functions = build_functions(car, options)
    return SqpSolver("casadi-vm", options, lambda buffers: InterpretedBackEnd(functions, buffers), clock)


def _riccati(name: str, car: ModelParameters, options: OcpOptions, progress: Progress, clock: Clock) -> Solver:
    return RiccatiSolver(LIBRARIES[name](car, options, progress).library, options, clock, name)


SOLVERS: dict[str, Callable[[ModelParameters, OcpOptions, Progress, Clock], Solver]] = {
    "casadi-vm": _interpreted,
    "casadi-c": partial(_compiled, "casadi-c"),
    "qrqp": partial(_compiled, "qrqp"),
    "riccati": partial(_riccati, "riccati"),
    "riccati-scalar": partial(_riccati, "riccati-scalar"),
    "ipopt": _ipopt,
}
"""Makers by name: `casadi-vm` runs uncompiled, `casadi-c` is the same generated to C, `qrqp` is that with derivatives assembled
from the stages, `riccati` uses the structure of the problem and takes its state bounds as soft, `riccati-scalar` is that for a processor
without vectors, `ipopt` is the oracle for that."""


LIBRARIES: dict[str, Callable[[ModelParameters, OcpOptions, Progress], Build]] = {
    "casadi-c": build,
    "qrqp": build_qrqp,
    "riccati": build_riccati,
    "riccati-scalar": partial(build_riccati, target_flags=SCALAR),
}
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
