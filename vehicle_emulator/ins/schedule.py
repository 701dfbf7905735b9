"""Which messages of the navigation system are due."""

from dbc.catalogue import Catalogue
from vehicle_emulator.ins.messages import NAVIGATION, STATUS

REFERENCE_CYCLE_NS = 10_000_000
"""The cycle times of the DBC are those of an instrument of 100 Hz: a message of 10 ms comes every cycle, at any rate."""
_NS_PER_S = 1_000_000_000


class Schedule:
    """The instrument's cycles, counted from one cycle after the start.

    Args:
        rate_hz: cycles per second.
        start_ns: when the run starts [ns].
    """

    def __init__(self, catalogue: Catalogue, rate_hz: float, start_ns: int) -> None:
        sent = {name: spec for name, spec in catalogue.by_name.items() if spec.cycle_time_ns > 0}
        self._ids = {name: spec.arbitration_id for name, spec in sent.items()}
        self._channels = tuple(name for name in STATUS if name in sent)
        self._every = {name: max(1, round(sent[name].cycle_time_ns / REFERENCE_CYCLE_NS)) for name in NAVIGATION if name in sent}
        self._cycle_ns = round(_NS_PER_S / rate_hz)
        self._start_ns = start_ns
        self._cycle = 0

    def due(self, now_ns: int) -> tuple[str, ...]:
        """Names of the messages of the cycle that has begun since the last call, if any, in the order of their identifiers."""
        cycle = (now_ns - self._start_ns) // self._cycle_ns
        if cycle <= self._cycle:
            return ()
        self._cycle = cycle
        names = [name for name, every in self._every.items() if cycle % every == 0]
        if self._channels:
            names.append(self._channels[(cycle - 1) % len(self._channels)])
        return tuple(sorted(names, key=self._ids.__getitem__))
