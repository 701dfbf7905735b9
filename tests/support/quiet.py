"""Whether the machine itself was fit for a trial in real time: what it stole, and how long it stood still."""

from pathlib import Path

from tests.support.stall import StallProbe

MAX_STEAL_NORM = 0.01
MAX_GAP_S = 0.010
"""Beyond these a trial proves nothing (B3)."""
_STEAL = 7


class Quiet:
    """Watches the machine while it is entered.

    Attributes:
        disturbance: why a trial meanwhile proves nothing; empty when it does.
    """

    def __init__(self) -> None:
        self._probe = StallProbe()
        self._before: list[int] = []
        self.disturbance = ""

    def __enter__(self) -> "Quiet":
        self._before = _cpu_times()
        self._probe.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._probe.__exit__()
        spent = [after - before for before, after in zip(self._before, _cpu_times(), strict=True)]
        steal_norm = spent[_STEAL] / max(sum(spent), 1)
        if steal_norm > MAX_STEAL_NORM:
            self.disturbance = f"{100.0 * steal_norm:.1f} % of the processors' time stolen"
        elif self._probe.worst_s > MAX_GAP_S:
            self.disturbance = f"the machine stood still for {1e3 * self._probe.worst_s:.0f} ms"


def _cpu_times() -> list[int]:
    """Of all processors: user, nice, system, idle, iowait, irq, softirq, steal."""
    return [int(word) for word in Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:9]]
