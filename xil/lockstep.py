"""Stages mil and sil: the same cores in one process, in virtual time, through the very bytes of the bus.

One tick is a millisecond of the car. Every tenth tick the gateway steps, every fortieth the controller answers the state that
the gateway has just sent; its command reaches the gateway one cycle later, as it does between processes. Nothing reads a
clock, so that a seed determines every frame.
"""

from collections.abc import Callable

from controller.nmpc import Nmpc, NmpcOptions
from controller.objects import nearest, report_of
from controller.samples import command_sample, plan_sample
from controller.solver import Solver
from dbc.errors import SetupFailure
from dbc.frame import CanFrame
from gateway.core import TICK_NS, GatewayCore
from gateway.messages import PLAN_PERIOD_NS, ControlCommand, OperatorRequest
from gateway.samples import GatewaySampler
from gateway.telemetry import StateSample
from vehicle_emulator.app import world_sample
from vehicle_emulator.emulator import STEP_NS, Emulator, StartPose
from xil.buslog import BusLog
from xil.operator import Ending, Operator
from xil.recording import Recording
from xil.setup import RunSetup
from xil.world import World

START_NS = 1_000_000_000
"""Virtual time at which a run begins [ns]; not zero, so that a forgotten zero stands out."""
BUS_CHANNEL = "lockstep"

WORLD_PERIOD_NS = 20_000_000
"""Time between two samples of the ground truth [ns]."""

_GATEWAY_BOOT_ID, _CONTROLLER_BOOT_ID, _OPERATOR_BOOT_ID = 1, 2, 3

Progress = Callable[[StateSample | None], None]


class LockstepRun:
    """One run in virtual time; `drive` does it.

    Args:
        options: of the controller; None for what it drives with otherwise.
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
    ) -> None:
        pose = setup.scenario.start_pose
        start = StartPose(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, 0.01 * setup.scenario.road.grade_percent)
        self._setup = setup
        self._recording = recording
        self._progress = progress
        self._is_interrupted = is_interrupted
        self._emulator = Emulator(setup.vehicle, setup.catalogue, start, setup.seed, START_NS)
        self._world = World(setup.scenario, setup.vehicle, START_NS)
        self._objects = self._world.sample(START_NS, 0, pose.x_m, pose.y_m)
        self._gateway = GatewayCore(setup.catalogue, setup.vehicle, _GATEWAY_BOOT_ID)
        self._nmpc = Nmpc(solver, setup.scenario.reference(setup.vehicle), setup.vehicle, _CONTROLLER_BOOT_ID, options)
        self._operator = Operator(setup.scenario.time_limit_s)
        self._solver_name = solver.name
        self._gateway_sampler = GatewaySampler()
        self._to_car: list[CanFrame] = []
        self._to_gateway: list[CanFrame] = []
        self._command: ControlCommand | None = None
        self._request: OperatorRequest | None = None
        self._requests = 0

    def drive(self) -> str:
        """Drive until the operator ends the run.

        Returns:
            Why the run was cut short, for people; empty when it was not.

        Raises:
            SetupFailure: the gateway never became ready.
        """
        now_ns, ending = START_NS, None
        with BusLog(self._setup.bus_log, BUS_CHANNEL) as log:
            while ending is None:
                now_ns += STEP_NS
                self._step_car(now_ns, log)
                if self._is_interrupted():
                    raise KeyboardInterrupt
                if now_ns % TICK_NS == 0:
                    ending = self._step_gateway(now_ns, log)
        self._progress(None)
        if ending is Ending.NEVER_READY:
            raise SetupFailure("the gateway never became ready: " + ", ".join(self._gateway.blockers))
        return "" if ending in (Ending.COMPLETED, Ending.STOPPED) else ending.value

    def _step_car(self, now_ns: int, log: BusLog) -> None:
        frames = self._emulator.step(now_ns, self._to_car)
        self._to_car = []
        self._to_gateway += frames
        for frame in frames:
            log.write(frame)
        if now_ns % WORLD_PERIOD_NS == 0:
            truth, seq = self._emulator.truth(), now_ns // WORLD_PERIOD_NS
            self._recording.add(world_sample(truth, now_ns, seq))
            self._objects = self._world.sample(now_ns, seq, truth.x_m, truth.y_m)
            if self._objects.objects:
                self._recording.add(self._objects)

    def _step_gateway(self, now_ns: int, log: BusLog) -> Ending | None:
        output = self._gateway.step(now_ns, self._to_gateway, self._command, self._request)
        self._to_gateway, self._command, self._request = [], None, None
        self._to_car = output.frames
        for frame in output.frames:
            log.write(frame)
        if now_ns % PLAN_PERIOD_NS == 0:
            objects = nearest(report_of(self._objects), now_ns, output.state.x_m, output.state.y_m)
            answer = self._nmpc.step(output.state, now_ns, objects)
            self._command = answer.command
            self._recording.add(command_sample(answer, self._solver_name, answer.command.solve_time_ns))
            if (plan := plan_sample(answer)) is not None:
                self._recording.add(plan)
        samples = self._gateway_sampler.sample(self._gateway, output, now_ns, ticks_late=0, step_cpu_ms=0.0)
        for sample in samples:
            self._recording.add(sample)
        states = [sample for sample in samples if isinstance(sample, StateSample)]
        return self._operate(states[-1]) if states else None

    def _operate(self, state: StateSample) -> Ending | None:
        self._progress(state)
        advice = self._operator.advise(state)
        if advice.operation is not None:
            self._requests += 1
            self._request = OperatorRequest(_OPERATOR_BOOT_ID, self._requests, advice.operation)
        return advice.ending
