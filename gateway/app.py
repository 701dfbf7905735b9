"""The gateway process: the core between a bus, the controller's socket and telemetry, 100 times a second. Start reading here."""

import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from dbc.catalogue import load
from dbc.link import CanLink
from dbc.realtime import GATEWAY_PRIORITY, become_realtime
from dbc.vehicle import load_vehicle
from gateway.channel import Channel
from gateway.core import TICK_NS, GatewayCore
from gateway.loop import PeriodicLoop
from gateway.messages import ControlCommand, OperatorRequest
from gateway.samples import GatewaySampler
from gateway.telemetry import Publisher, Source, new_boot_id

log = logging.getLogger("xilgate.gateway")


@dataclass(frozen=True)
class GatewayOptions:
    """Settings of the process.

    Args:
        bus_name: python-can name of the bus, `INTERFACE:CHANNEL`.
        gateway_socket, controller_socket: paths of the two ends of the control path.
    """

    bus_name: str
    dbc_paths: tuple[Path, ...]
    vehicle_path: Path
    gateway_socket: str
    controller_socket: str
    telemetry_base_port: int


def run(options: GatewayOptions, stop: threading.Event) -> None:
    """Run the gateway until `stop` is set.

    Raises:
        CatalogueError, VehicleError, LinkError, ChannelError, TelemetryError: the set-up is not usable.
    """
    core = GatewayCore(load(options.dbc_paths), load_vehicle(options.vehicle_path), new_boot_id())
    sampler = GatewaySampler()
    with (
        Publisher(Source.GATEWAY, options.telemetry_base_port) as telemetry,
        CanLink(options.bus_name) as link,
        Channel(options.gateway_socket, options.controller_socket) as channel,
    ):
        if not become_realtime(GATEWAY_PRIORITY):
            log.warning("no real-time priority: `xilgate doctor` says how to get it")
        loop = PeriodicLoop(TICK_NS)
        while not stop.is_set():
            now_ns = loop.wait()
            cpu_start_ns = time.thread_time_ns()
            output = core.step(now_ns, link.receive(), channel.newest(ControlCommand), channel.newest(OperatorRequest))
            link.send(output.frames)
            channel.send(output.state)
            cpu_ms = (time.thread_time_ns() - cpu_start_ns) * 1e-6
            if output.transition is not None:
                log.info("%s -> %s: %s", output.transition.before.name, output.transition.after.name, output.transition.reason)
            for sample in sampler.sample(core, output, now_ns, loop.overruns, cpu_ms):
                telemetry.post(sample)
