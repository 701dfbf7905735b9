"""Emulated CAN bus, pure part: which node hears which frame, and when.

The bus is ideal: a frame occupies no time, is never disturbed, and reaches every node but its sender. Bit timing, arbitration
and error states belong in here; they make deliveries due later than the call that caused them, which is why `transmit`
returns deliveries with their own time instead of simply forwarding the frame.
"""

from dataclasses import dataclass
from typing import NamedTuple

EXTENDED = 0x01
"""29-bit identifier."""
REMOTE = 0x02
"""Remote frame: asks for data and carries none."""
FD = 0x04
"""CAN FD frame."""
ERROR = 0x08
"""Error frame, as python-can reports it."""
BITRATE_SWITCH = 0x10
"""CAN FD data phase at the higher bit rate."""
ERROR_STATE_INDICATOR = 0x20
"""CAN FD sender is error passive."""


class BusFrame(NamedTuple):
    """One frame of any kind on the bus.

    Args:
        arbitration_id: identifier, 11 or 29 bits.
        data: payload, up to 8 bytes, up to 64 in CAN FD; empty in a remote frame.
        flags: sum of the flags of this module.
        length_bytes: payload length; in a remote frame the length asked for.
    """

    arbitration_id: int
    data: bytes
    flags: int
    length_bytes: int


class Delivery(NamedTuple):
    """A frame that arrives at all its receivers at the same time.

    Args:
        frame: the frame as its receivers see it.
        t_ns: time of its end on the bus, on the caller's clock [ns].
        receivers: nodes that hear it.
    """

    frame: BusFrame
    t_ns: int
    receivers: tuple[int, ...]


@dataclass(slots=True)
class NodeStatistics:
    """Frames that one node has transmitted, has been given, and was too slow to take."""

    transmitted: int = 0
    received: int = 0
    lost: int = 0


class BusCore:
    """Nodes on one bus. Calling it for a node that has not joined is the caller's mistake and raises `KeyError`."""

    def __init__(self) -> None:
        self._nodes: dict[int, NodeStatistics] = {}

    @property
    def nodes(self) -> dict[int, NodeStatistics]:
        """Statistics of the nodes that are on the bus."""
        return self._nodes

    def join(self, node: int) -> None:
        """Connect a node; it hears what is transmitted from now on."""
        if node in self._nodes:
            raise ValueError(f"node {node} has joined already")
        self._nodes[node] = NodeStatistics()

    def leave(self, node: int) -> NodeStatistics:
        """Disconnect a node and return its final statistics."""
        return self._nodes.pop(node)

    def transmit(self, node: int, frame: BusFrame, now_ns: int) -> list[Delivery]:
        """Put a frame on the bus.

        Args:
            node: its sender.
            frame: the frame.
            now_ns: time of the request, never decreasing [ns].

        Returns:
            Deliveries that have become due by `now_ns`, oldest first.
        """
        self._nodes[node].transmitted += 1
        receivers = tuple(other for other in self._nodes if other != node)
        for receiver in receivers:
            self._nodes[receiver].received += 1
        return [Delivery(frame, now_ns, receivers)]

    def record_loss(self, node: int) -> None:
        """Note that a node could not take the frame that was just delivered to it."""
        self._nodes[node].received -= 1
        self._nodes[node].lost += 1
