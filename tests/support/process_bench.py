"""Real processes around a gateway process: two emulated buses, stub car, stub controller, an operator, and the bus oracle that judges."""

import contextlib
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Sequence
from pathlib import Path

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.realtime import take_priority
from dbc.vehicle import FOCUS
from gateway.channel import ChannelError, control_path, operator_client
from gateway.messages import Mode, Operation, OperatorReply
from tests.support.lines import Helper
from tests.support.processes import free_base_port, start_xilgate, wait_until
from vehicle_emulator.bus.channel import is_served
from vehicle_emulator.bus.interface import XilgateBus

PROFILE = "nominal"
SPEED_MPS = 12.0
NETWORKS = ("robots", "navigation")
ORACLE_PRIORITY = 5
START_S = 30.0
READY_S = 10.0
SETTLED_S = 0.3
"""After an engagement, before anything is done to it [s]."""


class ProcessBench:
    """One rig with all its processes.

    Args:
        directory: of its own, short: sockets are in it.
        wrapper: command that starts the gateway's command, such as `unshare --mount`.

    Attributes:
        opened: what ends with the bench.
        saboteur: a node on the robots' bus that can destroy frames.
        starts_s: time from each start of the gateway to its answering an operator [s].
    """

    def __init__(self, directory: Path, wrapper: Sequence[str] = ()) -> None:
        self.directory, self._wrapper = directory, tuple(wrapper)
        self.base_port = free_base_port()
        self.metrics_port = self.base_port + 9
        self.channels = {network: f"{network}-{os.getpid()}-{self.base_port}" for network in NETWORKS}
        self.buses = {network: f"xilgate:{channel}" for network, channel in self.channels.items()}
        self.saboteur: XilgateBus
        self._log = (directory / "gateway.log").open("ab")
        self._control = control_path(directory)
        self.starts_s: list[float] = []
        self._helpers: dict[str, Helper] = {}
        self.opened = contextlib.ExitStack()
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        self._write_rig()
        hub = start_xilgate("bus", *self.channels.values())
        self.opened.callback(ended, hub)
        wait_until(lambda: all(map(is_served, self.channels.values())), START_S, "the buses")
        self.saboteur = XilgateBus(self.channels["robots"])
        self.opened.callback(self.saboteur.shutdown)
        self._control.key()
        self.start_car()
        bus_options = [option for network, bus in self.buses.items() for option in ("--bus", f"{network}={bus}")]
        self.oracle = self.start_helper("oracle_process", *bus_options, "--profile", PROFILE)
        take_priority(ORACLE_PRIORITY, self.oracle.pid)  # it has to keep up, however loaded the machine is
        self.start_gateway()
        self.start_controller()
        self.oracle.wait_for(lambda line: "listening" in line)

    def start_car(self) -> None:
        """The stub car."""
        self.car = self.start_helper("car_process", *(f"{network}={bus}" for network, bus in self.buses.items()))
        self.car.wait_for(lambda line: "running" in line)

    def roll(self, speed_mps: float) -> None:
        """The driver has let go of the car, which rolls."""
        self.car.ask(vx_mps=speed_mps, override_of=[])

    def start_helper(self, module: str, *arguments: str) -> Helper:
        """A helper that ends with the bench."""
        helper = Helper(module, *arguments)
        self.opened.callback(helper.close)
        return helper

    def helper(self, module: str, *arguments: str) -> Helper:
        """The helper of that kind, started when it is first asked for."""
        if module not in self._helpers:
            self._helpers[module] = self.start_helper(module, *arguments)
            self._helpers[module].wait_for(lambda line: "running" in line)
        return self._helpers[module]

    def _write_rig(self) -> None:
        (self.directory / "records").mkdir(exist_ok=True)
        (self.directory / "rig.toml").write_text(
            f'name = "process lane"\nprofile = "{PROFILE}"\n'
            f'buses = {{ robots = "{self.buses["robots"]}", navigation = "{self.buses["navigation"]}" }}\n'
            f'car = {{ dbc = ["{ROBOTS_DBC}", "{GNSS_IMU_DBC}"], vehicle = "{FOCUS}" }}\n'
            f'control = {{ directory = "." }}\ntelemetry = {{ base_port = {self.base_port} }}\n'
            f'recorder = {{ directory = "records" }}\nmetrics = {{ port = {self.metrics_port} }}\n',
            encoding="utf-8",
        )

    def close(self) -> None:
        """End everything."""
        self.opened.close()
        self._log.close()

    # ---- processes

    def start_gateway(self) -> None:
        """A new gateway process; the oracle is told."""
        start_s = time.monotonic()
        self.oracle.tell(restart=True)
        command = [*self._wrapper, sys.executable, "-m", "xil", "gateway", "--rig", str(self.directory / "rig.toml")]
        self.gateway = subprocess.Popen(command, stdout=self._log, stderr=self._log, start_new_session=True)
        self.opened.callback(ended, self.gateway)
        wait_until(self._is_answering, START_S, f"the gateway; see {self._log.name}")
        self.starts_s.append(time.monotonic() - start_s)

    def _is_answering(self) -> bool:
        assert self.gateway.poll() is None, (self.directory / "gateway.log").read_text()[-2000:]
        with contextlib.suppress(ChannelError):
            return self._asked(Operation.STOP) is not None  # a silent gateway refuses it
        return False

    def kill_gateway(self) -> int:
        """Kill it; the time just before [ns]."""
        return self.signal_gateway(signal.SIGKILL, waits=True)

    def signal_gateway(self, number: signal.Signals, *, waits: bool = False) -> int:
        """Send the gateway's process a signal; the time just before [ns]."""
        t_ns = time.monotonic_ns()
        self.gateway.send_signal(number)
        if waits:
            self.gateway.wait(10)
        return t_ns

    def restart_gateway(self) -> None:
        """Kill it where it lives, and start it anew."""
        if self.gateway.poll() is None:
            self.signal_gateway(signal.SIGCONT)
            self.kill_gateway()
        self.start_gateway()

    def start_controller(self) -> None:
        """A new controller process."""
        self.controller = self.start_helper("controller_process", str(self.directory))
        self.controller.wait_for(lambda line: "running" in line)

    # ---- the operator

    def _asked(self, operation: Operation) -> OperatorReply:
        with contextlib.closing(operator_client(self._control)) as operator:
            return operator.ask(operation)

    def ask(self, operation: Operation) -> OperatorReply:
        """Ask the gateway for something; the oracle hears of it."""
        self.oracle.tell(request=operation.name, t_ns=time.monotonic_ns())
        return self._asked(operation)

    @property
    def mode(self) -> str:
        """Mode of the gateway, as the controller has last heard it."""
        return str(next(line["mode"] for line in reversed(self.controller.said) if "mode" in line))

    def engage(self, speed_mps: float = SPEED_MPS) -> None:
        """Until the gateway drives the car, which then rolls at that speed."""
        self.roll(speed_mps)
        for operation, mode in ((Operation.ARM, Mode.READY), (Operation.ENGAGE, Mode.ENGAGED)):
            deadline_s, reply = time.monotonic() + READY_S, None
            while reply is None or reply.mode is not mode:
                assert time.monotonic() < deadline_s, f"{operation.name}: {reply}"
                reply = self.ask(operation)
                time.sleep(0.0 if reply.mode is mode else 0.1)
        time.sleep(SETTLED_S)

    def release(self) -> None:
        """Until nobody is driven: the driver takes the wheel, the operator resets a fault."""
        self.car.ask(override_of=["SR"])
        deadline_s, reply = time.monotonic() + READY_S, None
        while reply is None or reply.mode not in (Mode.SILENT, Mode.STANDBY):
            assert time.monotonic() < deadline_s, reply
            reply = self.ask(Operation.RESET)
            if reply.mode is Mode.FAULT:  # it is not left while the car moves
                self.car.ask(vx_mps=0.0)
            time.sleep(0.05)
        self.car.ask(override_of=[])

    # ---- what is seen

    def violations(self, begin: int = 0) -> list[str]:
        """What the oracle has found, from a place in what it said on."""
        return [f"{line['violation']}: {line['detail']}" for line in self.oracle.said[begin:] if "violation" in line]

    def reaction_ms(self, fault: str, begin: int, timeout_s: float) -> float | None:
        """Time that the gateway took to react to a fault [ms]; None when it did not in its time."""

        def is_it(line: dict[str, object]) -> bool:
            return line.get("reaction") == fault or line.get("violation") == "reaction"

        line = self.oracle.look_for(is_it, begin, timeout_s)
        return float(line["latency_ms"]) if line is not None and "reaction" in line else None

    def metrics(self) -> dict[str, float]:
        """What the gateway tells Prometheus: value by name and labels."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics_port}/metrics", timeout=10) as answer:
            lines = [line for line in answer.read().decode().splitlines() if not line.startswith("#")]
        return {name: float(value) for name, _, value in (line.rpartition(" ") for line in lines)}

    def buckets(self, histogram: str) -> dict[float, float]:
        """Counts of a histogram by upper bound [s], cumulated."""
        prefix = f'xilgate_gateway_{histogram}_bucket{{le="'
        return {float(name[len(prefix) : -2]): count for name, count in self.metrics().items() if name.startswith(prefix)}

    def recorder_pid(self) -> int:
        """The recorder, which is a child of the gateway."""
        return int(Path(f"/proc/{self.gateway.pid}/task/{self.gateway.pid}/children").read_text(encoding="ascii").split()[0])


def percentile_s(before: dict[float, float], after: dict[float, float], share: float) -> float:
    """Upper bound of the bucket in which a percentile of what was counted in between lies [s]."""
    counts = {bound: after[bound] - before[bound] for bound in sorted(after)}
    return next(bound for bound, count in counts.items() if count >= share * counts[float("inf")])


def ended(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> None:
    """Whatever it does, it is over."""
    if process.poll() is None:
        process.send_signal(signal.SIGCONT)
        process.kill()
    process.wait(10)
