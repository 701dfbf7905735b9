"""When the gateway steps: once a period, in step with the commands.

A command that had to wait for the next tick of a free-running loop would wait half a period on average. So the loop runs a
little slow while commands come, and the time that this leaves over is a credit: a command that arrives early pulls the step
forward to itself, as far as the credit goes. From then on nearly every command is answered on the bus as it arrives. The mean
period is never shorter than the nominal one, whatever arrives, and a stall is skipped, not caught up with.
"""

DRIFT_NS = 500_000
"""How much longer the periods are while commands come [ns]: four of them make the deadline of a controller at 25 Hz 2 ms later than its
command, which may then come as much too early or too late; and after five commands of any phase one is in time."""
PULL_NS = 4_000_000
"""How far a command may pull a step forward [ns]: 6 ms are between two frames of a cycle time of 10 ms then."""
CREDIT_NS = 6_000_000
"""Most time that is kept [ns]; what one pull leaves of it is enough for the next."""
FLOW_NS = 100_000_000
"""Time after the last command for which commands are said to come [ns]: their age limit."""


class Pacer:
    """Decides when a step is due; deadlines are absolute.

    Args:
        start_ns: monotonic time [ns]; the first step is due one period later.

    Attributes:
        overruns: periods that were skipped because the caller or the machine was late by a whole period or more.
    """

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last_command_ns: int | None = None
        self._credit_ns = CREDIT_NS
        self._is_pulled = False
        self._grid_ns = start_ns + period_ns
        self._earliest_ns = start_ns
        self.overruns = 0

    @property
    def deadline_ns(self) -> int:
        """When the next step is due without a command [ns]; after a late one not at once, or two demands would come as one."""
        return max(self._grid_ns, self._earliest_ns)

    def command_arrived(self, now_ns: int) -> None:
        """Tell of a command. One that is too early waits for the deadline: to be answered a little sooner would use up the credit."""
        self._last_command_ns = now_ns
        self._is_pulled = now_ns >= max(self._grid_ns - min(self._credit_ns, PULL_NS), self._earliest_ns)

    def is_due(self, now_ns: int) -> bool:
        """Whether to step now."""
        return self._is_pulled or now_ns >= self.deadline_ns

    def stepped(self, now_ns: int) -> None:
        """Set the next deadline after a step that was due at `now_ns`."""
        pulled_to_ns = min(now_ns, self._grid_ns)
        skipped = (now_ns - pulled_to_ns) // self._period_ns
        self.overruns += skipped
        is_flowing = self._last_command_ns is not None and now_ns - self._last_command_ns < FLOW_NS
        drift_ns = DRIFT_NS if is_flowing else 0
        self._credit_ns = min(self._credit_ns - (self._grid_ns - pulled_to_ns) + drift_ns, CREDIT_NS)
        self._is_pulled = False
        self._grid_ns = pulled_to_ns + (skipped + 1) * self._period_ns + drift_ns
        self._earliest_ns = now_ns + self._period_ns - PULL_NS
