"""The gateway process: the core between the car's buses, the controller's socket and telemetry, 100 times a second. Start here."""

import contextlib
import time
from collections.abc import Callable

from dbc.link import BusSet
from gateway.channel import Channel, OperatorServer
from gateway.core import TICK_NS
from gateway.cycle import ControlCycle, Links
from gateway.housekeeping import Housekeeper, Orders, Pulse
from gateway.logs import LogThread
from gateway.metrics import MetricsServer
from gateway.pacing import Pacer
from gateway.practice import realtime_practice
from gateway.preparation import OWN_NODE, Preparation, start_recorder
from gateway.systemd import Notifier
from gateway.telemetry import Publisher, Source, new_boot_id
from gateway.warm_up import warm_up


def run(
    preparation: Preparation, orders: Orders, notifier: Notifier, logs: LogThread, prepare: Callable[[], Preparation] | None = None
) -> Preparation | None:
    """Run the gateway until it is asked to end, or to go on with another configuration.

    Args:
        prepare: makes that configuration; None where there is nothing to make it from.

    Returns:
        The configuration to go on with; None when it is over.

    Raises:
        UserMistake: the key file is not usable.
        SetupFailure: a bus, socket or port cannot be opened.
    """
    rig, boot_id, pulse = preparation.rig, new_boot_id(), Pulse()
    control = rig.control.path
    key = control.key()
    warm_up(preparation)
    with contextlib.ExitStack() as opened:
        recorder = opened.enter_context(start_recorder(preparation, rig.recorder, boot_id)) if rig.recorder is not None else None
        telemetry = opened.enter_context(Publisher(Source.GATEWAY, rig.telemetry.base_port, rig.telemetry.tls))
        operators = opened.enter_context(OperatorServer(control.operator_socket, key))
        channel = opened.enter_context(Channel(control.gateway_socket, control.controller_socket, key))
        buses = opened.enter_context(BusSet(rig.buses.by_network, preparation.catalogue, OWN_NODE))
        if rig.metrics is not None:
            unsent = {
                "controller": lambda: channel.unsent,
                "operator": lambda: operators.unsent,
                "telemetry": lambda: telemetry.dropped,
            }
            opened.enter_context(MetricsServer(rig.metrics.port, pulse, logs, unsent))
        opened.enter_context(Housekeeper(pulse, orders, notifier, rig.daemon.watchdog_s, prepare))
        pulse.realtime = opened.enter_context(realtime_practice(rig.realtime))
        links = Links(buses, channel, operators, telemetry, recorder)
        cycle = ControlCycle(preparation, boot_id, links, pulse, orders)
        arrivals = links.wait()
        pacer = Pacer(time.monotonic_ns(), TICK_NS)
        while not cycle.is_over:
            cycle.look(arrivals.wait(pacer.deadline_ns, cycle.due_ns), pacer)
    return cycle.successor
