"""How old the navigation data are when they arrive, and when the robots act on them.

Age on arrival: the data tell their time of validity in a clock of their own. It is ahead of ours by what it is ahead when they come
soonest; data that come later are older. So a delay that grows or begins shows, one that has always been there does not.

Age at actuation, from the navigation data to the robots' status and back: every admitted command gets the next of 16 ids and is
remembered with the time of the state that it answers. The robots echo the id when they act on it; the time until then is measured here,
in the gateway's own clock.
"""

from gateway.causes import Cause, Finding

MEASUREMENT_IDS = 16
"""Ids there are: four bits in GW_SafetyCommand and RC_SafetyStatus. At 25 commands a second they come round after 640 ms."""
MAX_AGE_NS = 150_000_000
"""Budget for handling a fault, and so for any way from measurement to actuation: 250 ms less 40 % (docs/safety.md)."""
MAX_LATE_IN_A_ROW = 2
"""Late measurements in a row that are tolerated; one more is a finding."""
BUCKETS_NS = tuple(ms * 1_000_000 for ms in (10, 20, 30, 40, 50, 60, 80, 100, 120, 150, 200, 300))
"""Upper ends of the histogram's buckets, each inclusive; one more bucket takes what is above."""

MAX_DRIFT = 500e-6
"""Rate at which the two clocks may drift apart: the fastest that the kernel lets a clock be corrected; crystals are ten times better."""

MAX_AHEAD_NS = 20_000_000
"""Data that are younger by more than any before [ns] have to be followed by others that are: the message has no checksum."""

_MS_PER_NS = 1e-6
_NS_PER_MS = 1_000_000


class ValidityClock:
    """Puts times of validity on our clock."""

    def __init__(self) -> None:
        self._newest: tuple[int, int, int] | None = None
        self._is_ahead = False

    def restart(self) -> None:
        """Learn anew how far the clocks are apart."""
        self._newest = None

    def arrived(self, arrival_ns: int, validity_ms: int) -> int | None:
        """When data that arrive now were valid [ns], at the latest now; None when they are not newer than those before, or cannot be."""
        validity_ns = validity_ms * _NS_PER_MS
        offset_ns = arrival_ns - validity_ns
        if self._newest is not None:
            before_validity_ns, before_arrival_ns, before_offset_ns = self._newest
            if validity_ns <= before_validity_ns:
                return None
            largest_ns = before_offset_ns + round((arrival_ns - before_arrival_ns) * MAX_DRIFT)
            was_ahead, self._is_ahead = self._is_ahead, offset_ns < largest_ns - MAX_AHEAD_NS
            if self._is_ahead and not was_ahead:
                return None
            offset_ns = min(offset_ns, largest_ns)
        self._newest = validity_ns, arrival_ns, offset_ns
        return validity_ns + offset_ns


class LatencyChain:
    """Measures the age at actuation of every command.

    Attributes:
        newest_ns: the newest age; 0 before the first.
        max_ns: the largest since `restart`.
        histogram: ages by bucket, since the start of the process.
    """

    def __init__(self) -> None:
        self.newest_ns = 0
        self.max_ns = 0
        self.histogram = [0] * (len(BUCKETS_NS) + 1)
        self._id = 0
        self._late_in_a_row = 0
        self._awaited: dict[int, int] = {}

    def restart(self) -> None:
        """An engagement begins: what was before does not count."""
        self.max_ns, self._late_in_a_row = 0, 0
        self._awaited.clear()

    def answered(self, state_t_ns: int) -> int:
        """Id for a newly admitted command that answers the state measured at `state_t_ns`."""
        self._id = (self._id + 1) % MEASUREMENT_IDS
        self._awaited.pop(self._id, None)
        self._awaited[self._id] = state_t_ns
        return self._id

    def echoed(self, measurement_id: int, arrival_ns: int) -> None:
        """The robots act on the command with this id; those before it they have passed over. Only the first echo counts."""
        if measurement_id not in self._awaited:
            return
        awaited = list(self._awaited)
        for passed in awaited[: awaited.index(measurement_id) + 1]:  # in the order of their commands: what is before will not come any more
            state_t_ns = self._awaited.pop(passed)
        self._measure(arrival_ns - state_t_ns)

    def _measure(self, age_ns: int) -> None:
        self.newest_ns = age_ns
        self.max_ns = max(self.max_ns, age_ns)
        self.histogram[sum(age_ns > end_ns for end_ns in BUCKETS_NS)] += 1
        self._late_in_a_row = self._late_in_a_row + 1 if age_ns > MAX_AGE_NS else 0

    def findings(self, now_ns: int) -> list[Finding]:
        """LATENCY when three measurements in a row are too old; one whose echo is overdue is among them."""
        overdue_ns = [now_ns - state_t_ns for state_t_ns in self._awaited.values() if now_ns - state_t_ns > MAX_AGE_NS]
        if self._late_in_a_row + len(overdue_ns) <= MAX_LATE_IN_A_ROW:
            return []
        value_ns = max(overdue_ns, default=self.newest_ns)
        return [Finding(Cause.LATENCY, value_ns * _MS_PER_NS, MAX_AGE_NS * _MS_PER_NS, "robots")]
