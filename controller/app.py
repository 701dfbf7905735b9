"""The controller process: the NMPC between the gateway's states and its own commands, 25 times a second. Start reading here."""

import logging
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

from controller.nmpc import Nmpc, NmpcOptions
from controller.problem import OcpOptions
from controller.reference import ReferencePath
from controller.samples import command_sample, plan_sample
from controller.solver import Solver
from controller.solvers import DEFAULT_SOLVER, make_solver
from dbc.realtime import CONTROLLER_PRIORITY, become_realtime
from dbc.vehicle import Vehicle, load_vehicle
from gateway.channel import Channel
from gateway.loop import PeriodicLoop
from gateway.messages import PLAN_PERIOD_NS, CommandStatus, Mode, VehicleState
from gateway.telemetry import DEFAULT_BASE_PORT, Publisher, Source, new_boot_id

log = logging.getLogger("xilgate.controller")

_WARM_UP_SOLVES = 10


@dataclass(frozen=True)
class ControllerOptions:
    """Settings of the process.

    Args:
        reference_csv: path to follow, see `reference.ReferencePath.from_csv`.
        gateway_socket, controller_socket: paths of the two ends of the control path.
        solver: name in `solvers.SOLVERS`.
    """

    reference_csv: Path
    vehicle_path: Path
    gateway_socket: str
    controller_socket: str
    solver: str = DEFAULT_SOLVER
    telemetry_base_port: int = DEFAULT_BASE_PORT


def run(options: ControllerOptions, stop: threading.Event) -> None:
    """Run the controller until `stop` is set.

    Raises:
        UserMistake: path, vehicle file or solver name are not usable.
        SetupFailure: no compiler, or a socket or port that cannot be opened.
    """
    path = ReferencePath.from_csv(options.reference_csv)
    vehicle = load_vehicle(options.vehicle_path)
    solver = make_solver(options.solver, vehicle.model, OcpOptions(), log.info)
    warm_up(solver, path, vehicle)
    nmpc = Nmpc(solver, path, vehicle, new_boot_id(), NmpcOptions(deadline_ns=PLAN_PERIOD_NS))
    state: VehicleState | None = None
    status = CommandStatus.OK
    with (
        Publisher(Source.CONTROLLER, options.telemetry_base_port) as telemetry,
        Channel(options.controller_socket, options.gateway_socket) as channel,
    ):
        become_realtime(CONTROLLER_PRIORITY)
        loop = PeriodicLoop(PLAN_PERIOD_NS)
        while not stop.is_set():
            now_ns = loop.wait()
            state = channel.newest(VehicleState) or state
            if state is None:
                continue
            output = nmpc.step(state, now_ns)
            channel.send(output.command)
            if output.command.status is not status:
                log.info("command status %s -> %s", status.name, output.command.status.name)
                status = output.command.status
            telemetry.post(command_sample(output, solver.name, time.monotonic_ns() - now_ns))
            if (plan := plan_sample(output)) is not None:
                telemetry.post(plan)


def warm_up(solver: Solver, path: ReferencePath, vehicle: Vehicle) -> None:
    """Solve from the start of the path a few times, so that code and memory are there when the first command counts."""
    nmpc = Nmpc(solver, path, vehicle, boot_id=0)
    start = VehicleState(
        boot_id=0, seq=0, t_ns=0, mode=Mode.READY, is_valid=True, x_m=float(path.x_m[0]), y_m=float(path.y_m[0]),
        yaw_rad=float(path.yaw_rad[0]), vx_mps=float(path.speed_mps[0]), vy_mps=0.0, yaw_rate_radps=0.0, ax_mps2=0.0,
        steer_rad=0.0, drive_norm=0.0,
    )  # fmt: skip
    for cycle in range(_WARM_UP_SOLVES):
        now_ns = cycle * PLAN_PERIOD_NS
        nmpc.step(replace(start, t_ns=now_ns), now_ns)
    solver.reset()
