"""`xilgate bench latency`: how long a frame takes through the gateway process to the controller, and a command to the bus.

Real processes: a hub with two emulated buses, and the gateway with its recorder. The bench plays a standing car, ready to be
driven, from frames that were made beforehand, and a controller that answers every fourth state after the time that a solve takes.
Both times are taken by one clock: from the end of the frame with which navigation data are complete to the state that is made of them,
and from the sending of a command to the end of the first frame that answers it, its 0.25 ms on the wire included. The hub says when
a frame ended on the wire; how soon the bench hears of it does not count.
"""

import os
import select
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import numpy as np
from rich.table import Table

from dbc.catalogue import NAVIGATION, NETWORKS, ROBOTS, Catalogue, load
from dbc.errors import SetupFailure
from dbc.frame import CanFrame
from dbc.link import CanLink
from dbc.realtime import CONTROLLER_PRIORITY, become_realtime
from dbc.vehicle import load_vehicle
from gateway.channel import Channel, ControlPath, control_path, operator_client
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Mode, Operation, VehicleState
from vehicle_emulator.bus.channel import is_served
from vehicle_emulator.emulator import STEP_NS, Emulator, EmulatorSetup, StartPose
from xil.processes import Processes
from xil.summary import machine

SOLVE_S = 0.0005
"""Time between a state and the command that answers it [s]."""
STATES_PER_COMMAND = 4
WARM_UP_S = 4.0
"""Time until the gateway is ready and in step with the commands [s]."""
MAX_MS = 1.0
"""Target of both medians [ms]."""
MAX_CPU_SHARE = 0.2
"""Target of the share of a core that the gateway process takes."""

_ASK_S = 0.2
_TIMEOUT_S = 20.0


@dataclass
class _Times:
    """What was measured, in nanoseconds."""

    frame_to_state: list[int] = field(default_factory=list)
    command_to_frame: list[int] = field(default_factory=list)


def bench_latency(seconds: float) -> dict[str, Any]:
    """Measure for a time.

    Raises:
        SetupFailure: a process does not come up, or the gateway is not ready in time.
    """
    catalogue = load()
    traffic = _traffic(catalogue, seconds + WARM_UP_S + _TIMEOUT_S)
    with tempfile.TemporaryDirectory(prefix="xilgate-") as directory:
        control = control_path(Path(directory))
        channels = {network: f"bench-{os.getpid()}-{network}" for network in NETWORKS}
        buses = {network: f"xilgate:{channel}" for network, channel in channels.items()}
        with Processes(Path(directory)) as processes:
            processes.start("bus", ["bus", *channels.values()])
            _await(lambda: all(map(is_served, channels.values())), "hub")
            arguments = ["--bus", buses[ROBOTS], "--navigation-bus", buses[NAVIGATION], "--control", directory, "--record", directory]
            processes.start("gateway", ["gateway", *arguments, "--telemetry-port", "47447"])
            _await(control.operator_socket.exists, "gateway")
            times, cpu_share = _Bench(catalogue, buses, control).run(traffic, seconds, processes.pid("gateway"))
    rows = [
        _row("frame in, state out", times.frame_to_state, MAX_MS),
        _row("command in, frame out", times.command_to_frame, MAX_MS),
    ]
    facts = machine()
    return {
        "machine": f"{facts['cpu']}, {facts['cores']} cores, {facts['system']}",
        "frames_per_s": len(traffic) / (traffic[-1][0] * STEP_NS * 1e-9),
        "rows": rows,
        "gateway_cpu_share": cpu_share,
        "gateway_cpu_target": MAX_CPU_SHARE,
    }


def to_table(result: dict[str, Any]) -> Table:
    """The result for people."""
    caption = (
        f"gateway process {100 * result['gateway_cpu_share']:.1f} % of a core, target {100 * result['gateway_cpu_target']:.0f} %; "
        f"{result['frames_per_s']:.0f} frames/s; {result['machine']}"
    )
    table = Table(title="Through the gateway process", caption=caption, width=100)
    for column in ("way", "n", "p50 ms", "p99 ms", "max ms", "target p50 ms"):
        table.add_column(column, justify="left" if column == "way" else "right")
    for row in result["rows"]:
        table.add_row(row["way"], str(row["n"]), *(f"{row[key]:.2f}" for key in ("p50_ms", "p99_ms", "max_ms", "target_p50_ms")))
    return table


def _row(way: str, times_ns: list[int], target_ms: float) -> dict[str, Any]:
    times_ms = np.array(times_ns) * 1e-6
    p50_ms, p99_ms = (float(np.percentile(times_ms, share)) for share in (50, 99))
    return {"way": way, "n": len(times_ms), "p50_ms": p50_ms, "p99_ms": p99_ms, "max_ms": float(times_ms.max()), "target_p50_ms": target_ms}


def _traffic(catalogue: Catalogue, seconds: float) -> list[tuple[int, CanFrame]]:
    """Frames of a car that stands, each with its millisecond."""
    emulator = Emulator(EmulatorSetup(load_vehicle(), StartPose(), seed=1), catalogue, 0)
    steps = range(1, round(seconds * 1e9) // STEP_NS)
    return [(step, frame) for step in steps for frame in emulator.step(step * STEP_NS, [])]


def _await(is_up: Callable[[], bool], name: str) -> None:
    deadline_s = time.monotonic() + _TIMEOUT_S
    while not is_up():
        if time.monotonic() > deadline_s:
            raise SetupFailure(f"{name} did not come up within {_TIMEOUT_S:.0f} s")
        time.sleep(0.05)


class _Bench:
    """Plays car, controller and operator, and takes the times."""

    def __init__(self, catalogue: Catalogue, buses: dict[str, str], control: ControlPath) -> None:
        self._catalogue = catalogue
        self._buses = buses
        self._control = control
        self._time_id = catalogue.by_name["MilliTime"].arbitration_id
        self._safety = catalogue.by_name["GW_SafetyCommand"]
        self._times = _Times()
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._end_ns = 0
        self._valid_ns = 0
        self._sent_ns = 0
        self._answer: tuple[int, int] | None = None
        self._measurement_id = -1.0
        self._states = 0
        self._is_measuring = False

    def run(self, traffic: list[tuple[int, CanFrame]], seconds: float, gateway_pid: int) -> tuple[_Times, float]:
        """Times, and the share of a core that the gateway took."""
        stop = threading.Event()
        sender = threading.Thread(target=self._play, args=(traffic, stop), daemon=True)
        sender.start()
        try:
            with (
                _opened(self._buses[ROBOTS]) as robots,
                _opened(self._buses[NAVIGATION]) as navigation,
                Channel(self._control.controller_socket, self._control.gateway_socket, self._control.key()) as channel,
            ):
                self._get_ready(robots, navigation, channel)
                self._listen(robots, navigation, channel, WARM_UP_S)
                self._is_measuring, cpu_start_s = True, _cpu_s(gateway_pid)
                self._listen(robots, navigation, channel, seconds)
                return self._times, (_cpu_s(gateway_pid) - cpu_start_s) / seconds
        finally:
            stop.set()
            sender.join()

    def _play(self, traffic: list[tuple[int, CanFrame]], stop: threading.Event) -> None:
        """Send every frame at its millisecond."""
        become_realtime(CONTROLLER_PRIORITY)
        with CanLink(self._buses[ROBOTS]) as robots, CanLink(self._buses[NAVIGATION]) as navigation:
            links = {ROBOTS: robots, NAVIGATION: navigation}
            start_ns = time.monotonic_ns()
            for step, frame in traffic:
                if stop.is_set():
                    return
                while (wait_ns := start_ns + step * STEP_NS - time.monotonic_ns()) > 0:
                    time.sleep(wait_ns * 1e-9)
                links[self._catalogue.by_id[frame.arbitration_id].network].send([frame])

    def _get_ready(self, robots: can.BusABC, navigation: can.BusABC, channel: Channel) -> None:
        deadline_s = time.monotonic() + _TIMEOUT_S
        with operator_client(self._control) as operator:
            while (reply := operator.ask(Operation.ARM)).mode is not Mode.READY:
                if time.monotonic() > deadline_s:
                    raise SetupFailure("the gateway refuses: " + ", ".join(reply.refusals))
                self._listen(robots, navigation, channel, _ASK_S)

    def _listen(self, robots: can.BusABC, navigation: can.BusABC, channel: Channel, seconds: float) -> None:
        stop_ns = time.monotonic_ns() + round(seconds * 1e9)
        while (now_ns := time.monotonic_ns()) < stop_ns:
            due_ns = stop_ns if self._answer is None else min(stop_ns, self._answer[0])
            select.select([robots.fileno(), navigation.fileno(), channel.fileno()], [], [], max(due_ns - now_ns, 0) * 1e-9)
            state, heard_ns = channel.newest(VehicleState), time.monotonic_ns()
            # Whatever the state is made of is there by now.
            for message, end_ns in self._messages(navigation):
                if message.arbitration_id == self._time_id:
                    self._end_ns = end_ns
            self._hear_robots(robots)
            if state is not None:
                self._note_state(state, heard_ns)
            if self._answer is not None and time.monotonic_ns() >= self._answer[0]:
                self._command(channel, self._answer[1])

    def _messages(self, bus: can.BusABC) -> Iterator[tuple[can.Message, int]]:
        """What has arrived, each with its end on the wire [ns]."""
        while (message := bus.recv(timeout=0)) is not None:
            yield message, round(message.timestamp * 1e9) - self._epoch_ns

    def _note_state(self, state: VehicleState, heard_ns: int) -> None:
        if state.t_ns != self._valid_ns and self._is_measuring:  # made of new navigation data
            self._times.frame_to_state.append(heard_ns - self._end_ns)
        self._valid_ns = state.t_ns
        self._states += 1
        if self._states % STATES_PER_COMMAND == 0:
            self._answer = heard_ns + round(SOLVE_S * 1e9), state.seq

    def _command(self, channel: Channel, state_seq: int) -> None:
        plan = (0.0,) * HORIZON_STEPS
        now_ns = time.monotonic_ns()
        channel.send(ControlCommand(1, self._states, state_seq, now_ns, CommandStatus.OK, 0, 0.0, 0.0, 0.0, 0.0, plan, plan))
        self._answer, self._sent_ns = None, now_ns

    def _hear_robots(self, robots: can.BusABC) -> None:
        for message, end_ns in self._messages(robots):
            if message.arbitration_id != self._safety.arbitration_id:
                continue
            frame = CanFrame(message.arbitration_id, bytes(message.data), end_ns)
            measurement_id = self._catalogue.decode(self._safety, frame)["MeasurementId"]
            if measurement_id != self._measurement_id and self._is_measuring:
                self._times.command_to_frame.append(end_ns - self._sent_ns)
            self._measurement_id = measurement_id


def _opened(bus_name: str) -> can.BusABC:
    interface, channel = bus_name.split(":")
    return can.Bus(interface=interface, channel=channel, ignore_config=True)


def _cpu_s(pid: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
