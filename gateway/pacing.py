"""When the gateway steps: once a period, in step with the commands.

A command that had to wait for the next tick of a free-running loop would wait half a period on average. So the loop runs a
little slow while commands come, and a command that arrives shortly before the deadline pulls the step forward to itself: from
then on nearly every command is answered on the bus as it arrives. No two steps are closer than the messages' rate allows, and
a stall is skipped, not caught up with.
"""

PULL_NS = 1_500_000
"""How far a command may pull a step forward [ns]: 8.5 ms between two frames of a cycle time of 10 ms are 1.18 times the nominal rate."""
DRIFT_NS = 250_000
"""How much longer the periods are while commands come [ns]: four of them leave 1 ms for the jitter of a controller at 25 Hz."""
SHIFT_NS = 1_000_000
"""How much later the next step is when a command came at the wrong time [ns]; once a period, so that a flood of them holds nothing up."""
FLOW_NS = 100_000_000
"""Time after the last command for which commands are said to come [ns]: their age limit."""


class Pacer:
    """Decides when a step is due; deadlines are absolute.

    Args:
        start_ns: monotonic time [ns]; the first step is due one period later.

    Attributes:
        deadline_ns: when the next step is due without a command [ns].
        overruns: periods that were skipped because the caller or the machine was late by a whole period or more.
    """

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last_command_ns: int | None = None
        self._is_shifted = False
        self.deadline_ns = start_ns + period_ns
        self.overruns = 0

    def command_arrived(self, now_ns: int) -> None:
        """Tell of a command; when it came too early to be answered at once, the next step is later, and so nearer to the next command."""
        self._last_command_ns = now_ns
        if not self._is_shifted and now_ns < self.deadline_ns - PULL_NS:
            self._is_shifted = True
            self.deadline_ns += SHIFT_NS

    def is_due(self, now_ns: int, has_command: bool) -> bool:
        """Whether to step now."""
        return now_ns >= self.deadline_ns - (PULL_NS if has_command else 0)

    def stepped(self, now_ns: int) -> None:
        """Set the next deadline after a step that was due at `now_ns`."""
        self._is_shifted = False
        pulled_to_ns = min(now_ns, self.deadline_ns)
        skipped = (now_ns - pulled_to_ns) // self._period_ns
        self.overruns += skipped
        is_flowing = self._last_command_ns is not None and now_ns - self._last_command_ns < FLOW_NS
        self.deadline_ns = pulled_to_ns + (skipped + 1) * self._period_ns + (DRIFT_NS if is_flowing else 0)
