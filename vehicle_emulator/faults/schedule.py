"""When a fault is active, to the step."""

from vehicle_emulator.faults.condition import Condition, Situation
from vehicle_emulator.faults.spec import FaultSpec

NEVER_NS = 1 << 63


class Schedule:
    """The times of one fault.

    Args:
        base_ns: time from which `from_s` and `until_s` count [ns].

    Attributes:
        is_active: whether the fault is there since the last `update`.
        is_over: whether it can never come again.
        wake_ns: time before which `update` changes nothing [ns].
    """

    def __init__(self, spec: FaultSpec, base_ns: int) -> None:
        values = spec.values
        self._condition = Condition(str(values["condition"])) if "condition" in values else None
        self._from_ns = base_ns + _nanoseconds(spec.number("from_s"))
        self._until_ns = base_ns + _nanoseconds(spec.number("until_s")) if "until_s" in values else NEVER_NS
        self._duration_ns = _nanoseconds(spec.number("duration_s")) if "duration_s" in values else None
        self._is_latched = False
        self.is_active = False
        self.is_over = False
        self.wake_ns = self._from_ns

    def update(self, now_ns: int, situation: Situation) -> None:
        """Take note of the time and of what the car does."""
        if self.is_over or now_ns < self._from_ns:
            return
        if now_ns >= self._until_ns:
            self.end()
            return
        if not self._is_latched:
            self.is_active = self._condition is None or self._condition.holds(situation)
            if self.is_active and self._duration_ns is not None:
                self._latch(now_ns, self._duration_ns)
        self.wake_ns = self._until_ns if self._is_latched or self._condition is None else now_ns

    def _latch(self, now_ns: int, duration_ns: int) -> None:
        """Begin for a fixed time, whatever the condition says from now on."""
        self._is_latched = True
        began_ns = self._from_ns if self._condition is None else now_ns
        self._until_ns = min(self._until_ns, began_ns + duration_ns)

    def end(self) -> None:
        """End for good."""
        self.is_active, self.is_over, self.wake_ns = False, True, NEVER_NS


def _nanoseconds(time_s: float) -> int:
    return round(time_s * 1e9)
