"""Stages hil and vehil: every process on its own, in real time. The runner starts them, plays the operator, and ends them."""

import contextlib
import signal
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from dbc.catalogue import NAVIGATION, ROBOTS
from dbc.errors import SetupFailure
from gateway.channel import ControlPath, OperatorClient, control_path, operator_client
from gateway.modes import DRIVING
from gateway.telemetry import TOPICS, Publisher, Source, StateSample, Subscriber, WorldSample, decode, port_of
from vehicle_emulator.bus.channel import is_served
from xil.buslog import BusListener
from xil.course import Pose
from xil.operator import STANDSTILL_MPS, Advice, Ending, Operator
from xil.processes import Death, Processes
from xil.recording import Recording
from xil.scenario import Stage
from xil.setup import RunSetup
from xil.world import World

START_TIMEOUT_S = 30.0
POLL_S = 0.02
SCENE_PERIOD_NS = 1_000_000_000
OBJECTS_PERIOD_NS = 40_000_000
LINGER_S = 0.3
"""Time after the end in which the last samples arrive [s]."""
SILENCE_S = 5.0
"""A run without any state for this long is over, whatever caused it [s]."""
MOVING_MODES = tuple(mode.name for mode in DRIVING)
"""In these the gateway drives."""
SILENT = "no state of the car any more"
INDISPENSABLE = {"bus", "emulator"}
"""Without these there is no car left to watch."""
ONLOOKERS = {"view"}
"""Whether these live changes nothing for the car."""
STOPPING_S = 30.0
"""Longest time that an interrupted drive of a real car waits for standstill [s]."""

Progress = Callable[[StateSample | None], None]


class RealtimeRun:
    """One run in real time; `drive` does it."""

    def __init__(self, setup: RunSetup, recording: Recording, announce: Callable[[str], None], progress: Progress) -> None:
        self._setup = setup
        self._recording = recording
        self._announce = announce
        self._progress = progress
        self._deaths: dict[str, Death] = {}
        self._refusals: tuple[str, ...] = ()
        self._scene = setup.scenario.scene(setup.stage, setup.vehicle, 0, 0)
        self._next_scene_ns = 0
        self._next_objects_ns = 0
        self._objects_seq = 0

    def drive(self) -> str:
        """Start everything, drive, end everything.

        Returns:
            Why the run was cut short, for people; empty when it was not.

        Raises:
            SetupFailure: a process does not come up.
        """
        setup = self._setup
        self._check_ports()
        topics = [topic for topic, (source, _) in TOPICS.items() if source is not Source.RUNNER]
        with contextlib.ExitStack() as stack:
            control = control_path(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="xilgate-"))))
            scene = stack.enter_context(Publisher(Source.RUNNER, setup.telemetry_base_port))
            # Without objects of its own a run leaves the port of the world to any tool that brings some.
            objects = stack.enter_context(Publisher(Source.WORLD, setup.telemetry_base_port)) if setup.scenario.objects else None
            processes = stack.enter_context(Processes(setup.directory))
            stack.enter_context(Subscriber(self._receive, topics, setup.telemetry_base_port))
            self._bring_up(stack, processes, control)
            gateway = stack.enter_context(operator_client(control))
            try:
                return self._operate(processes, gateway, scene, objects)
            except KeyboardInterrupt:
                if setup.stage is Stage.VEHIL:
                    self._stop_real_car(processes)
                raise

    def _receive(self, topic: str, payload: bytes) -> None:
        if (sample := decode(topic, payload)) is not None:
            self._recording.add(sample)

    def _check_ports(self) -> None:
        """Refuse ports on which somebody else publishes: a stranger's samples must not pass for those of this run."""
        sources = [Source.GATEWAY, Source.CONTROLLER] + ([Source.EMULATOR] if self._setup.stage is Stage.HIL else [])
        for source in sources:
            port = port_of(source, self._setup.telemetry_base_port)
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind(("127.0.0.1", port))
                except OSError:
                    raise SetupFailure(f"telemetry port {port} of the {source} is busy; choose another with --telemetry-port") from None

    def _stop_real_car(self, processes: Processes) -> None:
        """Let the gateway bring a real car to a stop before its processes end: without a controller it does so by itself."""
        self._announce("interrupted: the gateway stops the car; interrupt again to abandon it")
        processes.end_one("controller")
        deadline = time.monotonic() + STOPPING_S
        while time.monotonic() < deadline:
            state = self._recording.latest("state")
            if not isinstance(state, StateSample) or (state.mode not in MOVING_MODES) or abs(state.vx_mps) < STANDSTILL_MPS:
                return
            time.sleep(POLL_S)

    def _bring_up(self, stack: contextlib.ExitStack, processes: Processes, control: ControlPath) -> None:
        setup, bus = self._setup, self._setup.bus
        if bus is None:
            raise ValueError("a real-time stage needs a bus")
        telemetry = ["--telemetry-port", str(setup.telemetry_base_port)]
        vehicle = ["--vehicle", str(setup.vehicle_path)]
        dbc = [argument for path in setup.dbc_paths for argument in ("--dbc", str(path))]
        mapping = [] if setup.mapping_path is None else ["--mapping", str(setup.mapping_path)]
        contract = [*vehicle, *dbc, *mapping, *telemetry]
        sockets = ["--control", str(control.directory)]
        if channels := bus.hub_channels:
            bitrates = [argument for network in channels for argument in ("--bitrate", str(setup.catalogue.bitrate_bps[network]))]
            processes.start("bus", ["bus", *channels.values(), *bitrates])
            self._await(processes, "bus", lambda: all(map(is_served, channels.values())))
        listener = BusListener(bus.names.values(), setup.bus_log)
        stack.callback(lambda: self._announce(listener.problem) if listener.problem else None)
        stack.enter_context(listener)
        buses = ["--bus", bus.names[ROBOTS], "--navigation-bus", bus.names[NAVIGATION]]
        if setup.view_port is not None:
            processes.start("view", ["view", "--port", str(setup.view_port), *telemetry])
            self._announce(f"virtual world: http://127.0.0.1:{setup.view_port}/")
        limits, record = ["--profile", setup.profile.name], ["--record", str(setup.directory)]
        processes.start("gateway", ["gateway", *buses, *contract, *sockets, *limits, *record])
        reference = ["--reference", str(setup.reference_csv), "--solver", setup.solver]
        journal = ["--journal", str(setup.directory)]
        processes.start("controller", ["controller", *reference, *vehicle, *telemetry, *sockets, *journal])
        # The car starts last: in a rolling start every second counts that the others take to come up.
        self._await(processes, "gateway", lambda: self._recording.latest("status") is not None)
        self._await(processes, "controller", control.controller_socket.exists)
        if setup.stage is Stage.HIL:
            pose = setup.scenario.start_pose
            start = ["--x-m", str(pose.x_m), "--y-m", str(pose.y_m), "--yaw-rad", str(pose.yaw_rad), "--speed-mps", str(pose.speed_mps)]
            start += ["--road", str(setup.road_file), "--plant", setup.plant, "--lifted" if setup.is_lifted else "--on-the-road"]
            start += ["--faults", str(setup.scenario_copy)] if setup.scenario.faults else []
            processes.start("emulator", ["emulator", *buses, *start, "--seed", str(setup.seed), *contract])
            self._await(processes, "emulator", lambda: self._recording.latest("world") is not None)

    def _await(self, processes: Processes, name: str, is_up: Callable[[], bool]) -> None:
        deadline = time.monotonic() + START_TIMEOUT_S
        while not is_up():
            if deaths := processes.deaths():
                raise SetupFailure(f"{deaths[0].name} ended while starting: {deaths[0].last_words}")
            if time.monotonic() > deadline:
                raise SetupFailure(f"{name} did not come up within {START_TIMEOUT_S:.0f} s")
            time.sleep(POLL_S)

    def _operate(self, processes: Processes, gateway: OperatorClient, scene: Publisher, objects: Publisher | None) -> str:
        """Play the operator until the run is over; why it was cut short, or nothing."""
        world = World(self._setup.scenario, self._setup.vehicle, time.monotonic_ns())
        operator = Operator(self._setup.scenario.time_limit_s, self._setup.scenario.course(self._setup.vehicle).is_at_end)
        ending, seen, last_news_s = None, 0, time.monotonic()
        try:
            while ending is None:
                time.sleep(POLL_S)
                self._note_deaths(processes)
                self._post_scene(scene)
                if objects is not None:
                    self._post_objects(objects, world)
                states = [state for state in self._recording.samples("state")[seen:] if isinstance(state, StateSample)]
                seen += len(states)
                last_news_s = time.monotonic() if states else last_news_s
                if time.monotonic() - last_news_s > SILENCE_S or self._deaths.keys() & INDISPENSABLE:
                    return self._interruption(SILENT)
                ending = self._follow_advice(operator, states, gateway)
            time.sleep(LINGER_S)
        finally:
            self._progress(None)
        if ending is Ending.NEVER_READY:
            raise SetupFailure("the gateway refuses: " + (", ".join(self._refusals) or "no answer"))
        return self._interruption("" if ending in (Ending.COMPLETED, Ending.STOPPED) else ending.value)

    def _follow_advice(self, operator: Operator, states: list[StateSample], gateway: OperatorClient) -> Ending | None:
        """Let the operator see every new state, pass the last request on, and say whether the run is over."""
        advice = Advice()
        for state in states:
            self._progress(state)
            advice = operator.advise(state)
            if advice.ending is not None:
                break
        if advice.operation is not None:
            gateway.send(advice.operation)
        while (reply := gateway.reply()) is not None:
            self._refusals = reply.refusals
        return advice.ending

    def _post_scene(self, publisher: Publisher) -> None:
        now_ns = time.monotonic_ns()
        if now_ns >= self._next_scene_ns:
            self._next_scene_ns = now_ns + SCENE_PERIOD_NS
            self._scene = msgspec.structs.replace(self._scene, t_ns=now_ns, seq=self._scene.seq + 1)
            publisher.post(self._scene)

    def _post_objects(self, publisher: Publisher, world: World) -> None:
        """Tell what is on the road; where there is no emulated car, its own estimate says how far it has got."""
        now_ns = time.monotonic_ns()
        car = self._recording.latest("world") or self._recording.latest("state")
        if now_ns >= self._next_objects_ns and isinstance(car, WorldSample | StateSample):
            self._next_objects_ns = max(self._next_objects_ns + OBJECTS_PERIOD_NS, now_ns)
            self._objects_seq += 1
            publisher.post(world.sample(now_ns, self._objects_seq, Pose(car.x_m, car.y_m, car.yaw_rad, car.vx_mps)))

    def _note_deaths(self, processes: Processes) -> None:
        for death in processes.deaths():
            if death.name not in self._deaths and death.name not in ONLOOKERS:
                self._deaths[death.name] = death
                self._announce(f"{death.name} ended: {_describe(death)}")

    def _interruption(self, ending: str) -> str:
        """Why the run was cut short: processes that died, then how it ended."""
        return "; ".join([f"{death.name} died ({_describe(death)})" for death in self._deaths.values()] + ([ending] if ending else []))


def _describe(death: Death) -> str:
    if death.exit_code < 0:
        return f"killed by {signal.Signals(-death.exit_code).name}"
    return f"exit code {death.exit_code}: {death.last_words}"
