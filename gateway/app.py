"""The gateway process: the core between the car's buses, the controller's socket and telemetry, 100 times a second. Start here."""

import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dbc.catalogue import load
from dbc.link import BusSet
from dbc.realtime import GATEWAY_PRIORITY, become_realtime
from dbc.vehicle import load_vehicle
from gateway.channel import Channel
from gateway.core import TICK_NS, GatewayCore
from gateway.loop import PeriodicLoop
from gateway.messages import ControlCommand, OperatorRequest
from gateway.samples import GatewaySampler, Process
from gateway.telemetry import Publisher, Source, new_boot_id

log = logging.getLogger("xilgate.gateway")


@dataclass(frozen=True)
class GatewayOptions:
    """Settings of the process.

    Args:
        buses: python-can name of the bus of every network, `INTERFACE:CHANNEL`.
        gateway_socket, controller_socket: paths of the two ends of the control path.
    """

    buses: Mapping[str, str]
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
    catalogue = load(options.dbc_paths)
    core = GatewayCore(catalogue, load_vehicle(options.vehicle_path), new_boot_id())
    sampler = GatewaySampler()
    named_dead: set[str] = set()
    with (
        Publisher(Source.GATEWAY, options.telemetry_base_port) as telemetry,
        BusSet(options.buses, catalogue) as buses,
        Channel(options.gateway_socket, options.controller_socket) as channel,
    ):
        if not become_realtime(GATEWAY_PRIORITY):
            log.warning("no real-time priority: `xilgate doctor` says how to get it")
        loop = PeriodicLoop(TICK_NS)
        while not stop.is_set():
            now_ns = loop.wait()
            cpu_start_ns = time.thread_time_ns()
            output = core.step(now_ns, buses.receive(), channel.newest(ControlCommand), channel.newest(OperatorRequest))
            buses.send(output.frames)
            channel.send(output.state)
            cpu_ms = (time.thread_time_ns() - cpu_start_ns) * 1e-6
            if output.transition is not None:
                log.info("%s -> %s: %s", output.transition.before.name, output.transition.after.name, output.transition.reason)
            dead = buses.dead
            if not stop.is_set():  # at the end of a run its buses go as well
                # Once each: a bus that refuses now and then would fill the log.
                for network in set(dead) - named_dead:
                    named_dead.add(network)
                    log.warning("bus %s (%s) refuses frames", network, options.buses[network])
            for sample in sampler.sample(core, output, now_ns, Process(loop.overruns, cpu_ms, dead, buses.dropped)):
                telemetry.post(sample)
