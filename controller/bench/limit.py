"""How far a solve is from the least that it can take: one stage sweep and one Riccati recursion, each measured alone."""

import ctypes
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from controller.bench.measure import Measurement, one_quiet_core, solve
from controller.bench.sets import pack_instance
from controller.problem import OcpOptions
from controller.riccati.solver import RiccatiBackEnd
from controller.solver import NlpBuffers, Solver
from dbc.build import Build

CALLS = 20
BATCHES = 200
"""Of calls that are timed together; the fastest batch counts."""
REPEATS = 3
"""Of each solve, when it is measured alone."""


def limit_of(solver: Solver, build: Build, nominal: Measurement, options: OcpOptions) -> dict[str, Any]:
    """Times of the parts of one solver, alone with a warm cache, and the ratio of its nominal mean to their sum.

    Args:
        nominal: the solver's measurement on the nominal set, with all other solvers taking turns.
    """
    buffers = NlpBuffers(options.layout)
    pack_instance(buffers, next(i for i in nominal.instances if i.warm_start is not None), options)
    back_end = RiccatiBackEnd(build.library, buffers)
    library = ctypes.CDLL(str(build.library))
    with one_quiet_core():
        back_end.solve()
        names = ("stage_sweep", "adjoint_sweep", "riccati")
        parts = {f"{name}_us": _fastest_us(library[f"nmpc_run_{name}"], back_end.address) for name in names}
        alone = [min(solve(solver, i).solve_time_ns for _ in range(REPEATS)) * 1e-3 for i in nominal.instances]
    least_us, interleaved_us = parts["stage_sweep_us"] + parts["riccati_us"], float(nominal.quiet_us.mean())
    figures = parts | {
        "least_us": least_us,
        "alone_mean_us": float(np.mean(alone)),
        "alone_ratio": float(np.mean(alone)) / least_us,
        "nominal_mean_us": interleaved_us,
        "nominal_ratio": interleaved_us / least_us,
    }
    return {"solver": solver.name} | {key: round(value, 2) for key, value in figures.items()}


def _fastest_us(function: Callable[[ctypes.c_void_p], object], address: ctypes.c_void_p) -> float:
    """Time of one call in the fastest batch."""
    fastest_ns = min(_batch_ns(function, address) for _ in range(BATCHES))
    return fastest_ns * 1e-3 / CALLS


def _batch_ns(function: Callable[[ctypes.c_void_p], object], address: ctypes.c_void_p) -> int:
    start_ns = time.perf_counter_ns()
    for _ in range(CALLS):
        function(address)
    return time.perf_counter_ns() - start_ns
