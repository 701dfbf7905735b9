"""The one way onto the car's CAN buses: python-can behind three calls that never raise on what a bus does.

A bus is named as python-can names it, `INTERFACE:CHANNEL`: `socketcan:vcan0`, `xilgate:robots`. `BusSet` is all that a car has,
`CanLink` one of them.
"""

import contextlib
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import can

from dbc.catalogue import NAVIGATION, ROBOTS, Catalogue
from dbc.errors import SetupFailure
from dbc.frame import CanFrame

MAX_FRAMES_PER_RECEIVE = 512
"""Bound on one call, so that a flood of frames cannot hold the caller's loop."""


class LinkError(SetupFailure):
    """The bus cannot be opened; one line that says why."""


@runtime_checkable
class Disturbable(Protocol):
    """A bus on which errors can be made, as the emulated one is."""

    def disturb(self, arbitration_id: int | None, count: int) -> None:
        """Destroy the next transmissions of a message on the wire; None: of any. Replaces an earlier call for it; 0 takes back."""


class CanLink:
    """A CAN bus that is polled, never waited for.

    Frames carry the monotonic time of the poll that fetched them. What is not a classical data frame with an 11-bit
    identifier is counted and dropped.

    Args:
        bus_name: `INTERFACE:CHANNEL`.

    Attributes:
        is_alive: False from the first refusal of the bus until it next delivers or accepts a frame. It stays False when the
            interface was removed or the hub has gone.
        send_errors: frames that the bus refused.
        receive_errors: polls that the bus refused.
        ignored_frames: frames dropped because of their kind.

    Raises:
        LinkError: no such bus, or it does not open.
    """

    def __init__(self, bus_name: str) -> None:
        interface, separator, channel = bus_name.partition(":")
        if not (separator and interface and channel):
            raise LinkError(f"bus {bus_name!r}: expected INTERFACE:CHANNEL, for example socketcan:vcan0")
        try:
            # A python-can configuration file of the user's must not change what was asked for.
            self._bus = can.Bus(channel=channel, interface=interface, ignore_config=True)
        except (can.CanError, OSError, ValueError, ImportError, NotImplementedError, NameError) as error:
            # NameError: what python-can's Kvaser interface raises where the maker's library is not installed.
            raise LinkError(f"bus {bus_name!r} does not open: {error}") from error
        self.name = bus_name
        self.is_alive = True
        self.send_errors = 0
        self.receive_errors = 0
        self.ignored_frames = 0

    def receive(self) -> list[CanFrame]:
        """All frames that have arrived since the last call, oldest first."""
        now_ns = time.monotonic_ns()
        frames: list[CanFrame] = []
        is_refused = False
        for _ in range(MAX_FRAMES_PER_RECEIVE):
            try:
                message = self._bus.recv(timeout=0)
            except (can.CanError, OSError):
                # SocketCAN reports an error ahead of the frames that came before it; a second error says there are none.
                if is_refused:
                    break
                is_refused = True
                continue
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame or message.is_extended_id or message.is_fd:
                self.ignored_frames += 1
                continue
            frames.append(CanFrame(message.arbitration_id, bytes(message.data), now_ns))
        if is_refused:
            self.receive_errors += 1
            self.is_alive = False
        elif frames:
            self.is_alive = True
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames to the bus; what it refuses is counted and dropped, because a later frame supersedes it."""
        for frame in frames:
            try:
                self._bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False))
            except (can.CanError, OSError):
                self.send_errors += 1
                self.is_alive = False
            else:
                self.is_alive = True

    def disturb(self, arbitration_id: int | None, count: int) -> bool:
        """Destroy the next transmissions of a message on the wire, for a bench; None: of any.

        Returns:
            Whether the bus does such a thing.
        """
        if not isinstance(self._bus, Disturbable):
            return False
        try:
            self._bus.disturb(arbitration_id, count)
        except (can.CanError, OSError):
            self.send_errors += 1
            self.is_alive = False
        return True

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


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

    Attributes:
        misplaced_frames: frames dropped because they came on the wrong bus.

    Raises:
        LinkError: a bus does not open; the text names its network.
    """

    def __init__(self, buses: Mapping[str, str], catalogue: Catalogue) -> None:
        self.misplaced_frames = 0
        self._links: dict[str, CanLink] = {}
        with contextlib.ExitStack() as opened:
            for network, bus_name in buses.items():
                if bus_name not in self._links:
                    self._links[bus_name] = opened.enter_context(_open(network, bus_name))
            self._opened = opened.pop_all()
        self._by_network = {network: self._links[bus_name] for network, bus_name in buses.items()}
        self._by_id = {arbitration_id: self._by_network[spec.network] for arbitration_id, spec in catalogue.by_id.items()}

    def receive(self) -> list[CanFrame]:
        """All frames that have arrived since the last call, bus by bus, oldest first on each."""
        frames: list[CanFrame] = []
        for link in self._links.values():
            arrived = link.receive()
            own = [frame for frame in arrived if self._by_id.get(frame.arbitration_id, link) is link]
            self.misplaced_frames += len(arrived) - len(own)
            frames += own
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames to their buses; what one refuses is counted and dropped, because a later frame supersedes it."""
        robots = self._by_network[ROBOTS]
        for link in self._links.values():
            if own := [frame for frame in frames if self._by_id.get(frame.arbitration_id, robots) is link]:
                link.send(own)

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
        """Networks whose bus refuses to deliver or to accept frames; silence alone is no refusal."""
        return [network for network, link in self._by_network.items() if not link.is_alive]

    @property
    def dropped(self) -> dict[str, int]:
        """Received frames that nobody is shown, by cause."""
        causes = {"wrong bus": self.misplaced_frames, "no classical data frame": sum(link.ignored_frames for link in self._links.values())}
        return {cause: count for cause, count in causes.items() if count}

    def close(self) -> None:
        """Leave every bus."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _open(network: str, bus_name: str) -> CanLink:
    try:
        return CanLink(bus_name)
    except LinkError as error:
        raise LinkError(f"{network}: {error}") from error
