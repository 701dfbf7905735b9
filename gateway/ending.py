"""How a gateway that is asked to end comes to its end: not while the car moves by its hand, if it can be helped."""

from gateway.conditions import STANDING_MPS
from gateway.messages import Mode, Operation

STANDSTILL_NS = 1_000_000_000
"""How long the car must have stood, so that it does not roll on from a nod."""
DISARM_NS = 100_000_000
"""Time in which robots that were armed hear that they are not any more: ten frames."""


class Ending:
    """Decides, tick by tick from the first one on, what to ask of the core and when it is over.

    A car that is driven is stopped gently first, and left with the brake on: the robots then hold it by themselves, because the
    gateway falls silent. Robots that may be armed hear that they are not. Where nothing is sent, there is nothing to wait for.

    Args:
        within_ns: longest time that it may take [ns].
    """

    def __init__(self, now_ns: int, within_ns: int) -> None:
        self._deadline_ns = now_ns + within_ns
        self._standing_since_ns: int | None = None
        self._disarmed_ns: int | None = None

    def request(self, mode: Mode) -> Operation | None:
        """What to ask of the core in this tick."""
        return {Mode.ENGAGED: Operation.STOP, Mode.READY: Operation.DISENGAGE}.get(mode)

    def is_over(self, now_ns: int, mode: Mode, speed_mps: float, is_speed_valid: bool) -> bool:
        """Whether the process may end after this tick.

        Args:
            speed_mps, is_speed_valid: speed of the car [m/s], and whether it is known.
        """
        if now_ns >= self._deadline_ns:
            return True
        if mode in (Mode.SILENT, Mode.FAULT):
            return True
        if mode is Mode.STANDBY:
            self._disarmed_ns = self._disarmed_ns or now_ns
            return now_ns - self._disarmed_ns >= DISARM_NS
        if mode is Mode.READY:
            return False
        if not (is_speed_valid and abs(speed_mps) < STANDING_MPS):
            self._standing_since_ns = None
            return False
        self._standing_since_ns = self._standing_since_ns or now_ns
        return now_ns - self._standing_since_ns >= STANDSTILL_NS
