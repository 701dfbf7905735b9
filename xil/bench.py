"""`xilgate bench gateway`: what one step of the gateway costs, on the frames of a drive."""

import gc
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table

from dbc.catalogue import Catalogue, load
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle, load_vehicle
from gateway.core import TICK_NS, GatewayCore
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS, CommandStatus, ControlCommand, Mode, Operation, OperatorRequest
from vehicle_emulator.emulator import STEP_NS, Emulator, EmulatorSetup, StartPose
from xil.summary import machine

START_NS = 1_000_000_000
START_SPEED_MPS = 20.0
STEER_AMPLITUDE_RAD = 0.02
STEER_PERIOD_S = 4.0


@dataclass(frozen=True, slots=True)
class Tick:
    """All that one step of the gateway is given."""

    now_ns: int
    frames: list[CanFrame]
    command: ControlCommand | None
    request: OperatorRequest | None


def bench_gateway(seconds: float, rounds: int) -> dict[str, Any]:
    """Time every step of a recorded drive, several times; quiet is the minimum over the rounds of each step.

    The drive is an engaged slalom with the emulated car and a scripted controller: every message of the bus, a command every
    fourth tick.
    """
    catalogue, vehicle = load(), load_vehicle()
    ticks = _record(catalogue, vehicle, seconds)
    gc.disable()
    times_us = np.array([_replay(catalogue, vehicle, ticks) for _ in range(rounds)])
    quiet_us = times_us.min(axis=0)
    row = {
        "solver": "gateway-step",
        "set": "slalom",
        "instances": len(ticks),
        "rounds": rounds,
        "quiet_mean_us": float(quiet_us.mean()),
        "quiet_median_us": float(np.median(quiet_us)),
        "quiet_p99_us": float(np.percentile(quiet_us, 99)),
        "raw_median_us": float(np.median(times_us)),
        "raw_p99_us": float(np.percentile(times_us, 99)),
        "raw_max_us": float(times_us.max()),
        "sqp_iterations_mean": None,
        "qp_iterations_mean": None,
        "converged": None,
    }
    facts = machine()
    return {"machine": f"{facts['cpu']}, {facts['cores']} cores, {facts['system']}", "rows": [row]}


def to_table(result: dict[str, Any]) -> Table:
    """The result for people."""
    row = result["rows"][0]
    caption = f"{row['instances']} steps, {row['rounds']} rounds, {result['machine']}"
    table = Table(title="CPU time of one gateway step", caption=caption, width=60)
    for column in ("figure", "µs"):
        table.add_column(column, justify="left" if column == "figure" else "right")
    for key, value in row.items():
        if key.endswith("_us"):
            table.add_row(key.removesuffix("_us").replace("_", " "), f"{value:.0f}")
    return table


_STEPS = {Mode.SILENT: Operation.ARM, Mode.READY: Operation.ENGAGE}
"""What the operator asks for, by the mode."""


def _record(catalogue: Catalogue, vehicle: Vehicle, seconds: float) -> list[Tick]:
    """Drive until the gateway has been engaged for `seconds`, and keep all that it was given."""
    emulator = Emulator(EmulatorSetup(vehicle, StartPose(speed_mps=START_SPEED_MPS), seed=1), catalogue, START_NS)
    gateway = GatewayCore(catalogue, vehicle, boot_id=1)
    ticks: list[Tick] = []
    to_car: list[CanFrame] = []
    to_gateway: list[CanFrame] = []
    now_ns, left = START_NS, round(seconds * 1e9) // TICK_NS
    while left:
        now_ns += STEP_NS
        to_gateway += emulator.step(now_ns, to_car)
        to_car = []
        if now_ns % TICK_NS == 0:
            operation = _STEPS.get(gateway.mode)
            request = None if operation is None else OperatorRequest(3, now_ns, operation, now_ns)
            tick = Tick(now_ns, to_gateway, _command(now_ns, gateway.ticks), request)
            to_car, to_gateway = gateway.step(now_ns, tick.frames, tick.command, request).frames, []
            ticks.append(tick)
            left -= gateway.mode is Mode.ENGAGED
    return ticks


def _command(now_ns: int, state_seq: int) -> ControlCommand | None:
    if now_ns % PLAN_PERIOD_NS:
        return None
    steer_rad = STEER_AMPLITUDE_RAD * math.sin(2.0 * math.pi * now_ns * 1e-9 / STEER_PERIOD_S)
    plan = (steer_rad,) * HORIZON_STEPS, (0.1,) * HORIZON_STEPS
    return ControlCommand(2, now_ns, state_seq, now_ns, CommandStatus.OK, 0, 0.0, 0.0, steer_rad, 0.1, *plan)


def _replay(catalogue: Catalogue, vehicle: Vehicle, ticks: list[Tick]) -> list[float]:
    """CPU time of every step [us]."""
    gateway = GatewayCore(catalogue, vehicle, boot_id=1)
    times_us = []
    for tick in ticks:
        start_ns = time.thread_time_ns()
        gateway.step(tick.now_ns, tick.frames, tick.command, tick.request)
        times_us.append((time.thread_time_ns() - start_ns) * 1e-3)
    return times_us
