"""`xilgate bench plant`: what one millisecond of the emulated car costs, and how far its integrator is from its limit."""

import gc
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from dbc.build import Build
from dbc.catalogue import load
from dbc.vehicle import load_vehicle
from vehicle_emulator.emulator import STEP_NS, Emulator, EmulatorSetup, StartPose
from vehicle_emulator.plants.interface import Level, PlantInputs, SteeringInputs
from vehicle_emulator.plants.multibody.library import build
from vehicle_emulator.plants.multibody.parameters import car_parameters
from vehicle_emulator.plants.multibody.plant import MultibodyPlant
from vehicle_emulator.plants.multibody.stability import largest_pole
from xil.figures import Row, figures_table
from xil.summary import machine

STEP_S = STEP_NS * 1e-9
START_SPEED_MPS = 20.0
START_NS = 1_000_000_000
SLALOM_RAD, SLALOM_PERIOD_S = 0.6, 4.0
WARM_UP_STEPS = 200
MAX_STEP_POLE = 2.5
"""The classical Runge-Kutta method is stable up to 2.8."""


def bench_plant(vehicle_path: Path, seconds: float, progress: Callable[[str], None]) -> dict[str, Any]:
    """Time every step of a slalom.

    Args:
        seconds: simulated, of each measurement.
        progress: told in one line each what takes time.

    Returns:
        `{"machine": ..., "library": ..., "vehicle": ..., "rows": [...]}`, one row for each figure.

    Raises:
        SetupFailure: no compiler.
    """
    vehicle = load_vehicle(vehicle_path)
    library = build(car_parameters(vehicle), progress)
    steps = round(seconds / STEP_S)
    plant = MultibodyPlant(vehicle, Level(), speed_mps=START_SPEED_MPS)
    progress(f"timing {3 * steps} steps")
    gc.disable()
    rows = _timed("compiled step, called singly", _compiled_us(plant, steps), 12.0)
    rows += _timed("plant with gearbox and road", _plant_us(plant, steps), 35.0)
    emulator = Emulator(EmulatorSetup(vehicle, StartPose(speed_mps=START_SPEED_MPS), seed=1), load(), START_NS)
    rows.append(Row("emulator without buses at 1 kHz", "share of one core", _emulator_share(emulator, steps), "", "at most", 0.25))
    gc.enable()
    progress("linearising over the operating range")
    pole, where = largest_pole(vehicle)
    rows.append(Row("step times largest pole", where, pole * STEP_S, "", "at most", MAX_STEP_POLE))
    facts = machine()
    return {
        "machine": f"{facts['cpu']}, {facts['cores']} cores, {facts['system']}",
        "library": _described(library),
        "vehicle": vehicle.name,
        "rows": [row.judged() for row in rows],
    }


def to_table(result: dict[str, Any]) -> Table:
    """The result for people."""
    return figures_table(f"Emulated car: {result['vehicle']}", f"{result['library']}\n{result['machine']}", result["rows"])


def _timed(what: str, times_us: np.ndarray[Any, Any], target_us: float) -> list[Row]:
    return [
        Row(what, "median", float(np.median(times_us)), "µs", "at most", target_us),
        Row(what, "p99", float(np.percentile(times_us, 99)), "µs"),
        Row(what, "min", float(times_us.min()), "µs"),
    ]


def _compiled_us(plant: MultibodyPlant, steps: int) -> np.ndarray[Any, Any]:
    """Time of every step of the compiled code, the call from Python included."""
    car = plant.car
    for k in range(WARM_UP_STEPS):
        plant.step(STEP_S, _slalom(k))
    return _times_us(lambda _: car.advance(STEP_S), steps)


def _plant_us(plant: MultibodyPlant, steps: int) -> np.ndarray[Any, Any]:
    inputs = [_slalom(k) for k in range(steps)]
    return _times_us(lambda k: plant.step(STEP_S, inputs[k]), steps)


def _times_us(step: Callable[[int], object], steps: int) -> np.ndarray[Any, Any]:
    times_ns = np.empty(steps)
    for k in range(steps):
        start_ns = time.perf_counter_ns()
        step(k)
        times_ns[k] = time.perf_counter_ns() - start_ns
    return times_ns * 1e-3


def _emulator_share(emulator: Emulator, steps: int) -> float:
    """CPU time over simulated time, while the safety driver drives and the robots are not engaged."""
    start_ns = time.thread_time_ns()
    for k in range(steps):
        emulator.step(START_NS + (k + 1) * STEP_NS, ())
    return (time.thread_time_ns() - start_ns) / (steps * STEP_NS)


def _slalom(k: int) -> PlantInputs:
    angle_rad = SLALOM_RAD * math.sin(2.0 * math.pi * k * STEP_S / SLALOM_PERIOD_S)
    return PlantInputs(SteeringInputs(angle_rad, torque_limit_nm=60.0), accelerator_norm=0.2)


def _described(library: Build) -> str:
    return f"{library.compiler}, {library.seconds:g} s to build"
