"""The one way onto the car's CAN buses.

A bus is named as python-can names it, `INTERFACE:CHANNEL`: `socketcan:vcan0`, `xilgate:robots`. `BusSet` is all that a car has,
`CanLink` one of them.
"""

import contextlib
import time
from collections import Counter
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from dbc.can_io import MAX_FRAMES_PER_RECEIVE, MAX_STANDARD_ID, Disturbable
from dbc.can_link import SILENT_STATES, CanLink, LinkError
from dbc.catalogue import NAVIGATION, ROBOTS, Catalogue
from dbc.frame import CanFrame
from dbc.health import BusState, LinkHealth
from dbc.traffic import Traffic

__all__ = ["MAX_FRAMES_PER_RECEIVE", "BusSet", "CanLink", "Disturbable", "LinkError", "bus_names"]


def bus_names(robots: str, navigation: str | None = None) -> dict[str, str]:
    """Name of the bus of every network; the navigation system is on the robots' bus where it has none of its own."""
    return {ROBOTS: robots, NAVIGATION: navigation or robots}


class BusSet:
    """The buses of a car as one: each frame travels on the bus of its message, as the catalogue has it.

    A message that arrives on another bus than its own is counted and dropped: what is true of the robots is said on their bus
    alone. A frame whose identifier the catalogue does not know passes, for whoever judges frames to count; to be sent, it goes
    out on the robots' bus.

    Args:
        buses: bus of every network of the catalogue, `INTERFACE:CHANNEL`; networks that name the same one share a link.
        node: the node of the DBC that sends through this set and is answerable for it: its links are opened with `ids`, see
            `CanLink`, and a frame of its own that is older than the cycle of its message is not sent. None for whoever stands in
            for several nodes, as the emulated car does.

    Attributes:
        misplaced_frames: frames dropped because they came on the wrong bus.

    Raises:
        LinkError: a bus does not open; the text names its network.
    """

    def __init__(self, buses: Mapping[str, str], catalogue: Catalogue, node: str | None = None) -> None:
        self.misplaced_frames = 0
        self._late_frames = 0
        self._links: dict[str, CanLink] = {}
        ids = frozenset(one for one in catalogue.by_id if one <= MAX_STANDARD_ID) if node is not None else None
        with contextlib.ExitStack() as opened:
            for network, bus_name in buses.items():
                if bus_name not in self._links:
                    link = _open(network, bus_name, ids, catalogue.bitrate_bps[network])
                    self._links[bus_name] = opened.enter_context(link)
            self._opened = opened.pop_all()
        self._by_network = {network: self._links[bus_name] for network, bus_name in buses.items()}
        self._by_id = {arbitration_id: self._by_network[spec.network] for arbitration_id, spec in catalogue.by_id.items()}
        own = {arbitration_id: spec for arbitration_id, spec in catalogue.by_id.items() if spec.sender == node}
        self._max_age_ns = {arbitration_id: spec.cycle_time_ns for arbitration_id, spec in own.items() if spec.cycle_time_ns}

    def receive(self) -> list[CanFrame]:
        """All frames of others that have arrived since the last call, bus by bus, oldest first on each."""
        frames: list[CanFrame] = []
        for link in self._links.values():
            arrived = link.receive()
            own = [frame for frame in arrived if self._by_id.get(frame.arbitration_id, link) is link]
            self.misplaced_frames += len(arrived) - len(own)
            frames += own
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames to their buses; what one does not take is counted and dropped, because a later frame supersedes it."""
        if self._max_age_ns:
            frames = self._in_time(frames)
        robots = self._by_network[ROBOTS]
        for link in self._links.values():
            if own := [frame for frame in frames if self._by_id.get(frame.arbitration_id, robots) is link]:
                link.send(own)

    def _in_time(self, frames: list[CanFrame]) -> list[CanFrame]:
        """Frames without those that were made before this process was held up for so long that the next ones are due."""
        now_ns = time.monotonic_ns()
        fresh = [frame for frame in frames if now_ns - frame.t_ns <= self._max_age_ns.get(frame.arbitration_id, now_ns)]
        self._late_frames += len(frames) - len(fresh)
        return fresh

    def health(self) -> dict[str, LinkHealth]:
        """Health of the bus of every network."""
        return {network: link.health() for network, link in self._by_network.items()}

    def traffic(self) -> dict[str, Traffic]:
        """Load and rates of the bus of every network, as far as its filters let it be seen; empty without a node."""
        return {network: link.traffic for network, link in self._by_network.items()}

    def filenos(self, network: str) -> list[int]:
        """Descriptor that is readable when something has arrived on the bus of a network; none where the bus has none."""
        fileno = self._by_network[network].fileno()
        return [fileno] if fileno >= 0 else []

    def recover(self) -> None:
        """Allow all attempts to leave bus-off again, on every bus; for the operator alone to ask for."""
        for link in self._links.values():
            link.recover()

    def disturb(self, arbitration_id: int | None, count: int) -> bool:
        """Destroy the next transmissions of a message on the wire, for a bench; None: of any, on each bus.

        Returns:
            Whether the buses do such a thing.
        """
        links = list(self._links.values())
        if arbitration_id is not None:
            links = [self._by_id.get(arbitration_id, self._by_network[ROBOTS])]
        were_disturbed = [link.disturb(arbitration_id, count) for link in links]
        return all(were_disturbed)

    @property
    def dead(self) -> list[str]:
        """Networks on which nothing can be sent: the bus is down, or our controller bus-off."""
        return [network for network, health in self.health().items() if health.state in SILENT_STATES]

    @property
    def bus_errors(self) -> dict[str, int]:
        """Reports that a frame was destroyed on the wire or that nobody acknowledged it, by network."""
        return {network: link.bus_errors for network, link in self._by_network.items()}

    @property
    def refusals(self) -> dict[str, str]:
        """Why the last attempt to leave bus-off was refused, by network that is in bus-off."""
        return {
            network: link.refusal
            for network, link in self._by_network.items()
            if link.refusal and link.health().state is BusState.BUS_OFF
        }

    @property
    def dropped(self) -> dict[str, int]:
        """Received frames that nobody is shown, by cause."""
        links = self._links.values()
        causes = Counter({"wrong bus": self.misplaced_frames, "not read in time": sum(link.lost for link in links)})
        for link in links:
            causes += link.ignored
        return dict(+causes)

    @property
    def unsent(self) -> dict[str, int]:
        """Frames that were to be sent and were not, by cause."""
        causes = Counter({"older than a cycle": self._late_frames})
        for link in self._links.values():
            causes += link.unsent
        return dict(+causes)

    def close(self) -> None:
        """Leave every bus."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _open(network: str, bus_name: str, ids: frozenset[int] | None, bitrate_bps: int) -> CanLink:
    try:
        return CanLink(bus_name, ids, bitrate_bps)
    except LinkError as error:
        raise LinkError(f"{network}: {error}") from error
