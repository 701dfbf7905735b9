"""The car's buses in virtual time: the emulated bus core between the hearts of gateway and emulator."""

from collections.abc import Iterable
from typing import NamedTuple

from dbc.catalogue import NETWORKS, ROBOTS, Catalogue
from dbc.frame import CanFrame
from vehicle_emulator.bus.core import BusCore
from vehicle_emulator.bus.frame import ERROR, BusFrame
from vehicle_emulator.bus.hub import DEFAULT_RESTART_MS

GATEWAY_NODE = "GW"
"""Name of the gateway in the DBC; everybody else on the buses is the emulator's."""
STRANGER_NODE = ""
"""Node of the emulator for frames of a babbling idiot, which the DBC does not know or has for the gateway's; joins a bus with the first."""


class Arrival(NamedTuple):
    """A frame that has reached the end of its transmission.

    Args:
        frame: with the time of its end as `t_ns`.
        is_for_gateway, is_for_car: who hears it.
    """

    network: str
    frame: CanFrame
    is_for_gateway: bool
    is_for_car: bool


class VirtualBuses:
    """One bus core for every network, with every sender of the DBC as a node of its own.

    Robots and navigation system are one process and one step of the emulator, but queue and arbitrate each for itself, as the
    devices do that they stand for.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._buses = {network: _Bus(catalogue, network) for network in NETWORKS}
        self._bus_of = {arbitration_id: self._buses[spec.network] for arbitration_id, spec in catalogue.by_id.items()}
        self._car_route = {
            arbitration_id: (self._bus_of[arbitration_id].core, self._bus_of[arbitration_id].nodes[spec.sender])
            for arbitration_id, spec in catalogue.by_id.items()
            if spec.sender != GATEWAY_NODE
        }

    def send_from_gateway(self, frames: Iterable[CanFrame], now_ns: int) -> None:
        """Queue frames at the gateway's node of their bus; what a node refuses is lost, as on a real bus."""
        for arbitration_id, data, _ in frames:
            bus = self._bus_of[arbitration_id]
            bus.core.transmit(bus.nodes[GATEWAY_NODE], BusFrame(arbitration_id, data, 0, len(data)), now_ns)

    def send_from_car(self, frames: Iterable[CanFrame], now_ns: int) -> None:
        """Queue each frame at the car's node that its message belongs to, and at the stranger's where it belongs to none of them."""
        for arbitration_id, data, _ in frames:
            core, node = self._car_route.get(arbitration_id) or self._route_of_stranger(arbitration_id)
            core.transmit(node, BusFrame(arbitration_id, data, 0, len(data)), now_ns)

    def advance(self, now_ns: int) -> list[Arrival]:
        """Frames whose transmission has ended by `now_ns`, oldest first."""
        arrivals = [
            Arrival(network, CanFrame(frame.arbitration_id, frame.data, t_ns), *bus.hearers(receivers, senders))
            for network, bus in self._buses.items()
            for frame, t_ns, receivers, senders in bus.core.advance(now_ns)
            if not frame.flags & ERROR
        ]
        arrivals.sort(key=_end_ns)
        return arrivals

    def disturb(self, arbitration_id: int | None, count: int) -> None:
        """Destroy the next transmissions of a message on the wire, which its node repeats; None: of any, on each bus.

        See `BusCore.disturb`.
        """
        buses = self._buses.values() if arbitration_id is None else [self._bus_of.get(arbitration_id, self._buses[ROBOTS])]
        for bus in buses:
            bus.core.disturb(arbitration_id, count)

    def _route_of_stranger(self, arbitration_id: int) -> tuple[BusCore, int]:
        bus = self._bus_of.get(arbitration_id, self._buses[ROBOTS])
        if STRANGER_NODE not in bus.nodes:
            bus.join(STRANGER_NODE)
        self._car_route[arbitration_id] = route = bus.core, bus.nodes[STRANGER_NODE]
        return route

    def load(self, now_ns: int) -> dict[str, float]:
        """Share of the time so far in which each bus was busy."""
        return {network: bus.core.mean_load(now_ns) for network, bus in self._buses.items()}


class _Bus:
    """The core of one network and its nodes, by their names in the DBC."""

    def __init__(self, catalogue: Catalogue, network: str) -> None:
        senders = {spec.sender for spec in catalogue.by_name.values() if spec.network == network}
        self.core = BusCore(catalogue.bitrate_bps[network], restart_ms=DEFAULT_RESTART_MS)
        self.nodes: dict[str, int] = {}
        self._car: set[int] = set()
        self._hearers: dict[tuple[tuple[int, ...], tuple[int, ...]], tuple[bool, bool]] = {}
        for name in (GATEWAY_NODE, *sorted(senders - {GATEWAY_NODE})):
            self.join(name)

    def join(self, name: str) -> None:
        """Connect a node."""
        node = self.nodes[name] = len(self.nodes)
        self.core.join(node)
        if name != GATEWAY_NODE:
            self._car.add(node)

    def hearers(self, receivers: tuple[int, ...], senders: tuple[int, ...]) -> tuple[bool, bool]:
        """Whether gateway and car hear a frame: the car's nodes are one process, which does not hear itself."""
        known = self._hearers.get((receivers, senders))
        if known is None:
            is_for_car = not self._car.isdisjoint(receivers) and self._car.isdisjoint(senders)
            known = self._hearers[receivers, senders] = self.nodes[GATEWAY_NODE] in receivers, is_for_car
        return known


def _end_ns(arrival: Arrival) -> int:
    return arrival.frame.t_ns
