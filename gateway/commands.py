"""What the gateway believes of a command before anything else looks at it."""

import math
from collections import Counter

from gateway.messages import CommandStatus, ControlCommand

MAX_STATE_LAG = 10
"""Oldest state that a command may answer, in gateway ticks: 100 ms, the age limit of a command."""
MAX_CLOCK_OFFSET_NS = 200_000_000
"""Largest distance between now and the start of a plan [ns]: beyond the delay that any controller compensates."""
STEER_RANGE_RAD = 1.0
DRIVE_RANGE_NORM = 4.0
"""Ranges of a demand that can be meant; the limits that protect the car are applied later and are far inside."""

FORGIVING_NS = 1_000_000_000
"""After so long a time without another of them, commands of a second sender are forgotten while nobody is driven."""
NEVER_NS = 1 << 62

_SECOND_SENDER = "second sender"


class CommandGate:
    """Admits commands of one sender, newest first; counts the others by cause.

    Attributes:
        newest: the last command that carries a usable plan, or None.
        degraded_in_a_row: commands of status DEGRADED since the last other one.
        status: what the last admitted command says of itself.
        good_in_a_row: commands of status OK since the last other one.
        bad_in_a_row: rejected ones since the last admitted one.
        strangers: commands of a second sender since the first was admitted.
        last_cause: why the last rejected one was; empty when none was.
        rejected: count by cause, since the start.
    """

    def __init__(self) -> None:
        self.rejected: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget the sender: the next command may come from another one."""
        self.newest: ControlCommand | None = None
        self.status = CommandStatus.OK
        self.good_in_a_row = 0
        self.degraded_in_a_row = 0
        self.bad_in_a_row = 0
        self.strangers = 0
        self.last_cause = ""
        self._stranger_ns: int | None = None
        self._last: ControlCommand | None = None
        self._admitted_ns: int | None = None

    def release(self) -> None:
        """Let another sender come; what is known of the last one stays, but its good commands do not count for the next."""
        self._last = None
        self.strangers = 0
        self.good_in_a_row = 0

    def forgive(self, now_ns: int) -> None:
        """Forget a second sender who has not been heard for long."""
        if self._stranger_ns is not None and now_ns - self._stranger_ns > FORGIVING_NS:
            self.strangers = 0

    def offer(self, now_ns: int, command: ControlCommand, state_seq: int) -> bool:
        """Take a command in, or count why not.

        Args:
            state_seq: the last state that was sent out.

        Returns:
            Whether it was admitted.
        """
        if (cause := self._reject_cause(now_ns, command, state_seq)) is not None:
            self.rejected[cause] += 1
            self.last_cause = cause
            self.bad_in_a_row += 1
            if cause == _SECOND_SENDER:
                self.strangers += 1
                self._stranger_ns = now_ns
            self.good_in_a_row = 0
            return False
        self.bad_in_a_row = 0
        self._last, self._admitted_ns = command, now_ns
        self.status = command.status
        self.good_in_a_row = self.good_in_a_row + 1 if command.status is CommandStatus.OK else 0
        self.degraded_in_a_row = self.degraded_in_a_row + 1 if command.status is CommandStatus.DEGRADED else 0
        if command.status is not CommandStatus.FAILED:
            self.newest = command
        return True

    def age_ns(self, now_ns: int) -> int:
        """Time since a command was last admitted [ns]; very large when there never was one."""
        return NEVER_NS if self._admitted_ns is None else now_ns - self._admitted_ns

    def _reject_cause(self, now_ns: int, command: ControlCommand, state_seq: int) -> str | None:
        last = self._last
        causes = (
            (_SECOND_SENDER, last is not None and command.boot_id != last.boot_id),
            ("repeated or old sequence number", last is not None and command.seq <= last.seq),
            ("answers an old state", not state_seq - MAX_STATE_LAG <= command.state_seq <= state_seq),
            ("time of another clock", abs(command.t_ns - now_ns) > MAX_CLOCK_OFFSET_NS),
            ("steering out of range", not all(abs(steer) <= STEER_RANGE_RAD for steer in (command.steer_rad, *command.plan_steer_rad))),
            ("drive out of range", not all(abs(drive) <= DRIVE_RANGE_NORM for drive in (command.drive_norm, *command.plan_drive_norm))),
            ("path error is no number", not (math.isfinite(command.lateral_error_m) and math.isfinite(command.heading_error_rad))),
        )
        return next((name for name, is_true in causes if is_true), None)
