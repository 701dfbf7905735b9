"""The faults that were injected into a run, as its record has them."""

from dataclasses import dataclass, replace

from gateway.telemetry import FaultSample
from xil.recording import Recording

_NS_PER_S = 1e9
_BEGINS = "begins"


@dataclass(frozen=True, slots=True)
class InjectedFault:
    """One time for which a fault was there.

    Args:
        what: the fault as it was asked for.
        from_s, to_s: since the start of the record; no end when it was there to the last.
        hits: frames that it had hit by its end, None without one; of a fault that comes and goes, from its first beginning on.
    """

    name: str
    what: str
    from_s: float
    to_s: float | None
    hits: int | None


def injected_faults(recording: Recording) -> list[InjectedFault]:
    """Every time for which a fault was there, in the order of their beginnings."""
    faults: list[InjectedFault] = []
    open_at: dict[str, int] = {}
    for sample in recording.samples("faults"):
        assert isinstance(sample, FaultSample)
        t_s = (sample.t_ns - recording.start_ns) / _NS_PER_S
        if sample.event == _BEGINS:
            open_at[sample.name] = len(faults)
            faults.append(InjectedFault(sample.name, sample.what, t_s, None, None))
        elif (place := open_at.pop(sample.name, None)) is not None:
            faults[place] = replace(faults[place], to_s=t_s, hits=sample.hits)
    return faults
