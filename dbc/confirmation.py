"""Which of our own frames were handed to the bus and have not been seen on it yet.

On a bus that is blocked, frames wait in the queues of kernel and controller and would all be sent, out of date, when it is free
again. So no more than two of a message are ever on their way: the one that waits and the one that takes its place.
"""

from collections import deque

MAX_ON_THE_WAY = 2
"""Of one message."""
FORGET_NS = 1_000_000_000
"""A frame is lost, not late, when another that was handed over so much later has been seen [ns]."""


_NONE: deque[tuple[bytes, int]] = deque(maxlen=0)


class Confirmation:
    """Frames on their way, message by message; on a bus those of one message keep their order."""

    def __init__(self) -> None:
        self._on_the_way: dict[int, deque[tuple[bytes, int]]] = {}

    def has_room(self, arbitration_id: int) -> bool:
        """Whether another frame of this message may be handed over."""
        return len(self._on_the_way.get(arbitration_id, ())) < MAX_ON_THE_WAY

    def sent(self, arbitration_id: int, data: bytes, now_ns: int) -> None:
        """A frame was handed over."""
        self._on_the_way.setdefault(arbitration_id, deque()).append((data, now_ns))

    def seen(self, arbitration_id: int, data: bytes) -> None:
        """A frame of ours was on the bus: those of its message that were handed over before it have been, or are lost."""
        waiting = self._on_the_way.get(arbitration_id, _NONE)
        t_ns = next((t_ns for other, t_ns in waiting if other == data), None)
        if t_ns is None:
            return
        while waiting.popleft() != (data, t_ns):
            pass
        for others in self._on_the_way.values():
            while others and others[0][1] <= t_ns - FORGET_NS:
                others.popleft()

    def oldest_ns(self, now_ns: int) -> int:
        """Age of the oldest frame that is on its way [ns]; 0 when there is none."""
        return max((now_ns - waiting[0][1] for waiting in self._on_the_way.values() if waiting), default=0)

    def clear(self) -> None:
        """Whatever is on its way is lost: the bus went away, or its controller went bus-off."""
        for waiting in self._on_the_way.values():
            waiting.clear()
