"""The stopwatch of the bus oracle: from a fault to the first safe frame."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from tests.support.oracle_limits import MS, REACTIONS, Kind

SILENT_NS = 30 * MS
"""A gateway that has not commanded for so long has let go: the robots' own timeout stops the car."""
_TICK_NS = 10 * MS
_UNSAFE = {Kind.STOP: ("Engage",), Kind.RELEASE: ("Engage", "Stop"), Kind.SILENCE: ("Engage", "Stop")}
"""What the gateway must no longer claim after a fault, by the reaction that is due."""

Violate = Callable[[int, str, str], None]
"""Called with time [ns], rule and detail."""


class Answer(NamedTuple):
    """How long the gateway took to react to a fault."""

    fault: str
    latency_ns: int


@dataclass
class _Pending:
    """A fault whose reaction is awaited."""

    fault: str
    marked_ns: int
    kind: Kind
    deadline_ns: int
    is_about_first_frame: bool

    @property
    def allowed_ms(self) -> float:
        return (self.deadline_ns - self.marked_ns) / MS


class Stopwatch:
    """Measures and judges reactions.

    Args:
        is_virtual: whether the times for virtual time hold, not those for real processes.

    Attributes:
        answers: of the faults that were answered in time.
        commanded_ns: time of the newest safety command [ns].
    """

    def __init__(self, violate: Violate, jitter_ns: int, *, is_virtual: bool) -> None:
        self._violate, self._jitter_ns, self._is_virtual = violate, jitter_ns, is_virtual
        self._pending: list[_Pending] = []
        self._gap_until_ns = 0
        self.answers: list[Answer] = []
        self.commanded_ns = 0

    def start(self, t_ns: int, fault: str, authority: str | None) -> None:
        """A fault begins at `t_ns`, while the gateway claims `authority`; nothing is due where there is nothing to lose."""
        reaction = REACTIONS[fault]
        if authority == "Engage" or (authority == "Stop" and reaction.kind in (Kind.RELEASE, Kind.SILENCE)):
            within_ns = reaction.within_ns if self._is_virtual else reaction.within_process_ns or reaction.within_ns
            deadline_ns = max(t_ns + within_ns + self._jitter_ns, self._gap_until_ns)
            self._pending.append(_Pending(fault, t_ns, reaction.kind, deadline_ns, is_about_first_frame=within_ns == 0))

    def gap(self, t_ns: int, until_ns: int) -> None:
        """The gateway's process is stopped from `t_ns` to `until_ns`: what is due in this time is due at its first frame after it."""
        self._gap_until_ns = until_ns
        for pending in self._pending:
            if pending.deadline_ns > t_ns:
                pending.deadline_ns = max(pending.deadline_ns, until_ns)

    def end(self, fault: str) -> None:
        """A fault is over."""
        self._pending = [pending for pending in self._pending if pending.fault != fault]

    def undo(self, t_ns: int) -> None:
        """Faults that were to begin after `t_ns` do not."""
        self._pending = [pending for pending in self._pending if pending.marked_ns <= t_ns]

    def command(self, t_ns: int, authority: str) -> None:
        """A safety command, which opens the frames of its tick."""
        self.commanded_ns = t_ns
        self._pending = [pending for pending in self._pending if not self._is_settled(t_ns, authority, pending)]

    def _is_settled(self, t_ns: int, authority: str, pending: _Pending) -> bool:
        latency_ns = t_ns - pending.marked_ns
        is_safe = latency_ns >= 0 and authority not in _UNSAFE.get(pending.kind, ())
        if pending.kind is Kind.NONE:
            if authority == "Engage":
                return False
            self._violate(t_ns, "false reaction", f"{pending.fault}: {authority} after {latency_ns / MS:.1f} ms")
        elif pending.is_about_first_frame and is_safe:
            self.answers.append(Answer(pending.fault, latency_ns))
        elif t_ns > pending.deadline_ns or (pending.is_about_first_frame and latency_ns >= 0):
            what = f"first safe frame only after {latency_ns / MS:.1f} ms" if is_safe else f"{authority} after {latency_ns / MS:.1f} ms"
            self._violate(t_ns, "reaction", f"{pending.fault}: {what}, allowed {pending.allowed_ms:.0f} ms")
        elif is_safe:
            self.answers.append(Answer(pending.fault, latency_ns))
        else:
            return False
        return True

    def expire(self, t_ns: int) -> None:
        """Time passes: silence is an answer too."""
        if not self._pending or t_ns - self.commanded_ns <= SILENT_NS:
            return
        for pending in [p for p in self._pending if p.kind in _UNSAFE and not p.is_about_first_frame and t_ns > p.deadline_ns]:
            self._pending.remove(pending)
            self.answers.append(Answer(pending.fault, max(0, self.commanded_ns + _TICK_NS - pending.marked_ns)))
