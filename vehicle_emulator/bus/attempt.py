"""One occupation of the bus: who wins arbitration, who hears, whether it fails, and how long it lasts."""

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from dbc.frame_length import CLASSICAL_TAIL_BITS
from vehicle_emulator.bus.bits import AFTER_ACKNOWLEDGE_BITS, FD_TAIL_BITS, frame_bits
from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR_STATE_INDICATOR, FD, BusFrame
from vehicle_emulator.bus.node import Node

FLAG_BITS = 6
"""Error flag of one node. The flags of the others answer it, because six equal bits break the rule of stuffing."""
DELIMITER_BITS = 8
"""Error delimiter."""


class Outcome(Enum):
    """How an attempt ends."""

    SENT = 1
    DESTROYED = 2
    UNACKNOWLEDGED = 3


@dataclass(slots=True, eq=False)
class Attempt:
    """One attempt to send a frame.

    Args:
        outcome: how it ends.
        frame: the frame, as the winner sends it.
        senders: nodes that send it, more than one when they send the same.
        receivers: nodes that hear it.
        beaten: of the receivers those that sent another frame with the same identifier until they met the first bit that differs.
        start_ns: start of frame [ns].
        end_ns: end of frame, or of the error delimiter [ns].
    """

    outcome: Outcome
    frame: BusFrame
    senders: tuple[Node, ...]
    receivers: tuple[Node, ...]
    beaten: tuple[Node, ...]
    start_ns: int
    end_ns: int


class BitTiming(NamedTuple):
    """Bit times.

    Args:
        bit_ns: of the nominal bit rate [ns].
        data_bit_ns: of the data phase of frames that switch [ns].
    """

    bit_ns: int
    data_bit_ns: int

    def duration_ns(self, frame: BusFrame, outcome: Outcome, *, has_receivers: bool) -> int:
        """Time from start of frame to end of frame or of the error delimiter [ns].

        A frame is destroyed in the last bit of its CRC sequence, which costs the bus most of what a bit error can.
        """
        nominal, in_data_phase = frame_bits(frame)
        whole_ns = nominal * self.bit_ns + in_data_phase * self.data_bit_ns
        if outcome is Outcome.SENT:
            return whole_ns
        signalling_ns = ((2 if has_receivers else 1) * FLAG_BITS + DELIMITER_BITS) * self.bit_ns
        if outcome is Outcome.UNACKNOWLEDGED:
            return whole_ns - AFTER_ACKNOWLEDGE_BITS * self.bit_ns + signalling_ns
        if frame.flags & BITRATE_SWITCH:
            return whole_ns - FD_TAIL_BITS * self.bit_ns - self.data_bit_ns + signalling_ns
        return whole_ns - CLASSICAL_TAIL_BITS * self.bit_ns + signalling_ns


def arbitrate(online: Collection[Node], disturbed: Collection[int | None], start_ns: int, timing: BitTiming) -> Attempt:
    """The attempt that begins at a time.

    Args:
        online: nodes that are not in bus-off; at least one has a frame to send at that time.
        disturbed: identifiers whose next frame is destroyed on the wire; None for any.
        start_ns: start of frame [ns].
        timing: bit times.
    """
    senders = _winners(online, start_ns)
    beaten: tuple[Node, ...] = ()
    is_destroyed = False
    if len(senders) > 1:
        senders, beaten, is_destroyed = _resolve(senders)
    frame = _as_sent(senders[0])
    receivers = tuple([node for node in online if node not in senders])
    if is_destroyed or (disturbed and (None in disturbed or frame.arbitration_id in disturbed)):
        outcome = Outcome.DESTROYED
    else:
        outcome = Outcome.SENT if receivers else Outcome.UNACKNOWLEDGED
    end_ns = start_ns + timing.duration_ns(frame, outcome, has_receivers=bool(receivers))
    return Attempt(outcome, frame, senders, receivers, beaten, start_ns, end_ns)


def _winners(online: Collection[Node], start_ns: int) -> tuple[Node, ...]:
    """Nodes whose frame has the lowest identifier of those that start then."""
    winners: tuple[Node, ...] = ()
    lowest = -1
    for node in online:
        if node.queue and node.suspended_until_ns <= start_ns:
            key = node.queue[0][0]
            if not winners or key < lowest:
                winners, lowest = (node,), key
            elif key == lowest:
                winners += (node,)
    return winners


def _resolve(senders: tuple[Node, ...]) -> tuple[tuple[Node, ...], tuple[Node, ...], bool]:
    """Two nodes that send the same identifier: who goes on, who is beaten, and whether an error flag destroys it all.

    Arbitration does not part them. Where their frames first differ, those that send a recessive bit there see a bit error; while
    one of them is error active, its flag destroys the frame. Error passive ones leave the others undisturbed.
    """
    dominant = min(_after_arbitration(node) for node in senders)
    beaten = tuple(node for node in senders if _after_arbitration(node) != dominant)
    if any(not node.counters.is_passive for node in beaten):
        return senders, (), True
    return tuple(node for node in senders if node not in beaten), beaten, False


def _after_arbitration(node: Node) -> tuple[int, int, int, bytes]:
    """What follows the arbitration field, in the order of the wire; the smaller is the dominant one."""
    frame = _as_sent(node)
    flags = frame.flags
    return flags & FD, flags & BITRATE_SWITCH, flags & ERROR_STATE_INDICATOR, bytes((frame.length_bytes, *frame.data))


def _as_sent(node: Node) -> BusFrame:
    """The first of a node's frames; an error passive node says so in a CAN FD frame."""
    frame = node.queue[0][2]
    if frame.flags & FD and node.counters.is_passive:
        return frame._replace(flags=frame.flags | ERROR_STATE_INDICATOR)
    return frame
