"""Stages mil and sil: the same cores in one process, in virtual time, through the very bytes of the buses.

One tick is a millisecond of the car. Every tenth tick the gateway steps, every fortieth the controller answers the state that
the gateway has just sent; its command reaches the gateway one cycle later, as it does between processes. Between gateway and car
frames take the time that they take on a bus: each reaches the other side with its next tick, stamped with the end of its
transmission. Nothing reads a clock, so that a seed determines every frame.
"""

from collections.abc import Callable

from controller.journal import RecordedNmpc
from controller.nmpc import Nmpc, NmpcOptions
from controller.objects import nearest, report_of
from controller.record import controller_session
from controller.samples import command_sample, plan_sample
from controller.solver import Solver
from dbc.errors import SetupFailure
from dbc.frame import CanFrame
from gateway.core import TICK_NS, GatewayCore
from gateway.journal import StepArguments
from gateway.messages import PLAN_PERIOD_NS, ControlCommand, OperatorRequest
from gateway.record.session import gateway_session
from gateway.samples import GatewaySampler, Process
from gateway.telemetry import StateSample
from vehicle_emulator.app import fault_sample, world_sample
from vehicle_emulator.emulator import STEP_NS, Emulator
from xil.buslog import BusLog
from xil.course import Pose
from xil.journals import Journals
from xil.operator import Ending, Operator
from xil.recording import Recording
from xil.setup import RunSetup
from xil.virtual_bus import VirtualBuses
from xil.world import World

START_NS = 1_000_000_000
"""Virtual time at which a run begins [ns]; not zero, so that a forgotten zero stands out."""
WORLD_PERIOD_NS = 20_000_000
"""Time between two samples of the ground truth [ns]."""

_GATEWAY_BOOT_ID, _CONTROLLER_BOOT_ID, _OPERATOR_BOOT_ID = 1, 2, 3

Progress = Callable[[StateSample | None], None]


def journals_of(setup: RunSetup) -> Journals:
    """The journals of a run, in its directory, in which the inputs of the run are already."""
    return Journals(
        setup.directory,
        gateway_session(
            _GATEWAY_BOOT_ID,
            setup.profile,
            setup.dbc_paths,
            setup.vehicle_path,
            {"stage": setup.stage.value},
            mapping_path=setup.mapping_path,
        ),
        controller_session(_CONTROLLER_BOOT_ID, setup.solver, None, setup.reference_csv, setup.vehicle_path),
    )


class LockstepRun:
    """One run in virtual time; `drive` does it.

    Args:
        options: of the controller; None for what it drives with otherwise.
        journals: of the run, see `journals_of`; None for none.

    Attributes:
        driven_s: virtual time of the finished run [s].
        bus_load: share of that time in which each bus was busy.
    """

    def __init__(
        self,
        setup: RunSetup,
        solver: Solver,
        recording: Recording,
        progress: Progress,
        is_interrupted: Callable[[], bool],
        *,
        options: NmpcOptions | None = None,
        journals: Journals | None = None,
    ) -> None:
        pose = setup.scenario.start_pose
        self._setup = setup
        self._recording = recording
        self._progress = progress
        self._is_interrupted = is_interrupted
        self._buses = VirtualBuses(setup.catalogue)
        self._emulator = Emulator(setup.emulator, setup.catalogue, START_NS)
        self._world = World(setup.scenario, setup.vehicle, START_NS)
        self._objects = self._world.sample(START_NS, 0, pose)
        self._gateway = GatewayCore(setup.catalogue, setup.vehicle, _GATEWAY_BOOT_ID, setup.profile)
        self._nmpc = self._make_nmpc(solver, options or NmpcOptions(), journals)
        self._journals = journals
        self._operator = Operator(setup.scenario.time_limit_s, setup.scenario.course(setup.vehicle).is_at_end)
        self._solver_name = solver.name
        self._gateway_sampler = GatewaySampler()
        self._to_car: list[CanFrame] = []
        self._to_gateway: list[CanFrame] = []
        self._command: ControlCommand | None = None
        self._request: OperatorRequest | None = None
        self._requests = 0
        self._refusals: tuple[str, ...] = ()
        self.driven_s = 0.0
        self.bus_load: dict[str, float] = {}

    def _make_nmpc(self, solver: Solver, options: NmpcOptions, journals: Journals | None) -> Nmpc:
        vehicle, path = self._setup.vehicle, self._setup.scenario.reference(self._setup.vehicle)
        if journals is None:
            return Nmpc(solver, path, vehicle, _CONTROLLER_BOOT_ID, options)
        return RecordedNmpc(solver, path, vehicle, _CONTROLLER_BOOT_ID, options, keep=journals.keep_cycle)

    def drive(self) -> str:
        """Drive until the operator ends the run.

        Returns:
            Why the run was cut short, for people; empty when it was not.

        Raises:
            SetupFailure: the gateway never became ready.
        """
        now_ns, ending = START_NS, None
        with BusLog(self._setup.bus_log) as log:
            while ending is None:
                now_ns += STEP_NS
                self._carry(now_ns, log)
                self._step_car(now_ns)
                if self._is_interrupted():
                    raise KeyboardInterrupt
                if now_ns % TICK_NS == 0:
                    ending = self._step_gateway(now_ns)
        self._progress(None)
        self.bus_load = self._buses.load(now_ns)
        self.driven_s = (now_ns - START_NS) / 1e9
        if ending is Ending.NEVER_READY:
            raise SetupFailure("the gateway refuses: " + ", ".join(self._refusals))
        return "" if ending in (Ending.COMPLETED, Ending.STOPPED) else ending.value

    def _carry(self, now_ns: int, log: BusLog) -> None:
        """Bring what has ended on the buses by now to those who hear it, and into the record."""
        for network, frame, is_for_gateway, is_for_car in self._buses.advance(now_ns):
            log.write(network, frame)
            if is_for_gateway:
                self._to_gateway.append(frame)
            if is_for_car:
                self._to_car.append(frame)

    def _step_car(self, now_ns: int) -> None:
        self._buses.send_from_car(self._emulator.step(now_ns, self._to_car), now_ns)
        self._to_car = []
        for arbitration_id, transmissions in self._emulator.disturbances:
            self._buses.disturb(arbitration_id, transmissions)
        for event in self._emulator.faults.take_events():
            self._recording.add(fault_sample(event, len(self._recording.samples("faults"))))
        if now_ns % WORLD_PERIOD_NS == 0:
            truth, seq = self._emulator.truth(), now_ns // WORLD_PERIOD_NS
            self._recording.add(world_sample(truth, now_ns, seq))
            car = truth.state
            self._objects = self._world.sample(now_ns, seq, Pose(car.x_m, car.y_m, car.yaw_rad, car.vx_mps))
            if self._objects.objects:
                self._recording.add(self._objects)

    def _step_gateway(self, now_ns: int) -> Ending | None:
        arguments = StepArguments(now_ns, self._to_gateway, self._command, self._request)
        output = arguments.step(self._gateway)
        if self._journals is not None:
            self._journals.keep_step(arguments, output)
        self._to_gateway, self._command, self._request = [], None, None
        self._buses.send_from_gateway(output.frames, now_ns)
        if output.reply is not None:
            self._refusals = output.reply.refusals
        if now_ns % PLAN_PERIOD_NS == 0:
            objects = nearest(report_of(self._objects), now_ns, output.state.x_m, output.state.y_m)
            answer = self._nmpc.step(output.state, now_ns, objects)
            self._command = answer.command
            self._recording.add(command_sample(answer, self._solver_name, answer.command.solve_time_ns))
            if (plan := plan_sample(answer)) is not None:
                self._recording.add(plan)
        samples = self._gateway_sampler.sample(self._gateway, output, now_ns, Process())
        for sample in samples:
            self._recording.add(sample)
        states = [sample for sample in samples if isinstance(sample, StateSample)]
        return self._operate(states[-1]) if states else None

    def _operate(self, state: StateSample) -> Ending | None:
        self._progress(state)
        advice = self._operator.advise(state)
        if advice.operation is not None:
            self._requests += 1
            self._request = OperatorRequest(_OPERATOR_BOOT_ID, self._requests, advice.operation, state.t_ns)
        return advice.ending
