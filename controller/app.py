"""The controller process: the NMPC between the gateway's states and its own commands, 25 times a second. Start reading here."""

import contextlib
import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from controller.inbox import ObjectInbox
from controller.journal import ControllerSession, RecordedNmpc
from controller.nmpc import DRIVE_MODEL, Nmpc, NmpcOptions
from controller.objects import nearest
from controller.parameters import ParameterStore
from controller.planning.reference import ReferencePath
from controller.problem import OcpOptions
from controller.record import controller_session, fingerprint, record_in
from controller.samples import Circumstances, ProfileMeter, command_sample, parameters_sample, plan_sample
from controller.solver import Solver
from controller.solvers import DEFAULT_SOLVER, make_solver
from controller.tuning import SERVICE, TuningService
from dbc.realtime import CONTROLLER_PRIORITY, become_realtime
from dbc.vehicle import Vehicle, load_vehicle
from gateway.channel import Channel, ControlPath
from gateway.loop import PeriodicLoop
from gateway.messages import PLAN_PERIOD_NS, CommandStatus, Mode, VehicleState
from gateway.telemetry import DEFAULT_BASE_PORT, Publisher, Source, TlsSection, new_boot_id

log = logging.getLogger("xilgate.controller")

_WARM_UP_SOLVES = 10


@dataclass(frozen=True)
class ControllerOptions:
    """Settings of the process.

    Args:
        reference_csv: path to follow, see `reference.ReferencePath.from_csv`.
        control: where the gateway is found.
        solver: name in `solvers.SOLVERS`.
        journal: directory of the journal, None for none.
        tls: telemetry for other machines, None for loopback alone.
    """

    reference_csv: Path
    vehicle_path: Path
    control: ControlPath
    solver: str = DEFAULT_SOLVER
    telemetry_base_port: int = DEFAULT_BASE_PORT
    journal: Path | None = None
    tls: TlsSection | None = None


def run(options: ControllerOptions, stop: threading.Event) -> None:
    """Run the controller until `stop` is set.

    Raises:
        UserMistake: path, vehicle file, key file or solver name are not usable.
        SetupFailure: no compiler, or a socket or port that cannot be opened.
    """
    key = options.control.key()
    path = ReferencePath.from_csv(options.reference_csv)
    vehicle = load_vehicle(options.vehicle_path)
    ocp, numbers = OcpOptions(model=DRIVE_MODEL), NmpcOptions(deadline_ns=PLAN_PERIOD_NS)
    solver = make_solver(options.solver, vehicle.model, ocp, log.info)
    warm_up(solver, path, vehicle)
    store = ParameterStore(ocp, numbers.planner)
    session = controller_session(new_boot_id(), options.solver, numbers.deadline_ns, options.reference_csv, options.vehicle_path)
    with (
        Publisher(Source.CONTROLLER, options.telemetry_base_port, options.tls) as telemetry,
        ObjectInbox(options.telemetry_base_port) as inbox,
        Channel(options.control.controller_socket, options.control.gateway_socket, key) as channel,
        _nmpc(options.journal, session, (solver, path, vehicle, session.boot_id, numbers)) as nmpc,
    ):
        telemetry.serve(SERVICE, TuningService(store).answer)
        cycle = ControlCycle(nmpc, solver.name, channel, telemetry, store=store, inbox=inbox, sha256=fingerprint(session))
        become_realtime(CONTROLLER_PRIORITY)
        loop = PeriodicLoop(PLAN_PERIOD_NS)
        while not stop.is_set():
            cycle.step(loop.wait())


@contextlib.contextmanager
def _nmpc(
    journal: Path | None, session: ControllerSession, parts: tuple[Solver, ReferencePath, Vehicle, int, NmpcOptions]
) -> Iterator[Nmpc]:
    """The controller, recorded where that is asked for."""
    if journal is None:
        yield Nmpc(*parts)
        return
    with record_in(journal, session) as keep:
        yield RecordedNmpc(*parts, keep=keep)


class ControlCycle:
    """What happens 25 times a second. Whatever comes from other threads is taken at the edge, as one reference each."""

    def __init__(
        self,
        nmpc: Nmpc,
        solver_name: str,
        channel: Channel,
        telemetry: Publisher,
        *,
        store: ParameterStore,
        inbox: ObjectInbox,
        sha256: str = "",
    ) -> None:
        self._nmpc = nmpc
        self._solver_name = solver_name
        self._store = store
        self._inbox = inbox
        self._sha256 = sha256
        self._channel = channel
        self._telemetry = telemetry
        self._profile = ProfileMeter(solver_name)
        self._state: VehicleState | None = None
        self._status = CommandStatus.OK

    def step(self, now_ns: int) -> None:
        """Answer the newest state with a command, if there has been any."""
        self._tune(now_ns)
        self._state = state = self._channel.newest(VehicleState) or self._state
        if state is None:
            return
        objects = nearest(self._inbox.report, now_ns, state.x_m, state.y_m)
        output = self._nmpc.step(state, now_ns, objects)
        self._channel.send(output.command)
        made_with = Circumstances(self._store.in_force, len(objects), self._inbox.rejected, self._sha256)
        self._telemetry.post(command_sample(output, self._solver_name, time.monotonic_ns() - now_ns, made_with))
        for sample in (plan_sample(output), self._profile.add(output, now_ns)):
            if sample is not None:
                self._telemetry.post(sample)
        if output.command.status is not self._status:
            log.info("command status %s -> %s", self._status.name, output.command.status.name)
            self._status = output.command.status

    def _tune(self, now_ns: int) -> None:
        """Drive with the newest parameters from this cycle on."""
        if (taken := self._store.take()) is not None:
            parameters, entries = taken
            self._nmpc.tune(parameters.ocp, parameters.planner)
            for entry in entries:
                self._telemetry.post(parameters_sample(entry, now_ns))


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
