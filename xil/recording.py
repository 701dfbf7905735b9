"""What a run told the world, kept for its verdict and its report: telemetry samples by topic, in the order of their arrival."""

import threading
from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from gateway.telemetry import Sample, StateSample, StatusSample, topic_of
from xil.course import Array

_NS_PER_S = 1e9


@dataclass(frozen=True)
class ModeChange:
    """The gateway entered a mode.

    Args:
        t_s: time since the start of the recording.
        reason: the gateway's own words, empty when it gave none.
    """

    t_s: float
    mode: str
    reason: str


@dataclass(frozen=True)
class Gap:
    """The longest time between two samples of a topic.

    Args:
        t_s: when it began.
    """

    t_s: float
    length_s: float


class Recording:
    """Samples of one run; any thread may add to it.

    Args:
        start_ns: time zero of the run on the clock of the samples [ns].
    """

    def __init__(self, start_ns: int) -> None:
        self.start_ns = start_ns
        self._lock = threading.Lock()
        self._samples: defaultdict[str, list[Sample]] = defaultdict(list)

    def add(self, sample: Sample) -> None:
        """Keep one sample."""
        with self._lock:
            self._samples[topic_of(sample)].append(sample)

    def samples(self, topic: str) -> list[Sample]:
        """All samples of a topic so far, in the order of their arrival."""
        with self._lock:
            return list(self._samples[topic])

    def latest(self, topic: str) -> Sample | None:
        """The newest sample of a topic."""
        with self._lock:
            return self._samples[topic][-1] if self._samples[topic] else None

    def series(self, topic: str, field: str) -> Array:
        """A numeric field of every sample of a topic; truth values are 0 and 1."""
        return np.array([getattr(sample, field) for sample in self.samples(topic)], dtype=np.float64)

    def texts(self, topic: str, field: str) -> list[str]:
        """A text field of every sample of a topic."""
        return [getattr(sample, field) for sample in self.samples(topic)]

    def times_s(self, topic: str) -> Array:
        """Times at which the samples of a topic were made, since the start of the recording."""
        return np.array([sample.t_ns - self.start_ns for sample in self.samples(topic)], dtype=np.float64) / _NS_PER_S

    def lost(self, topic: str) -> int:
        """Samples of a topic that were sent and did not arrive, by their sequence numbers; a publisher may start anew."""
        steps = np.diff(np.array([sample.seq for sample in self.samples(topic)], dtype=np.int64))
        return int(np.sum(steps[steps > 1] - 1))

    def longest_gap(self, topic: str, from_s: float, to_s: float) -> Gap:
        """The longest time without a sample of a topic within a span, whose ends count as samples."""
        times_s = self.times_s(topic)
        inside_s = np.concatenate(([from_s], times_s[(times_s > from_s) & (times_s < to_s)], [to_s]))
        k = int(np.argmax(np.diff(inside_s)))
        return Gap(float(inside_s[k]), float(inside_s[k + 1] - inside_s[k]))

    def mode_changes(self) -> list[ModeChange]:
        """The modes of the gateway in order: times from the state at its high rate, reasons from the status where it says more."""
        told = [(s.t_ns, s.mode, "") for s in self.samples("state") if isinstance(s, StateSample)]
        told += [(s.t_ns, s.mode, s.reason) for s in self.samples("status") if isinstance(s, StatusSample)]
        changes: list[ModeChange] = []
        for t_ns, mode, reason in sorted(told, key=lambda entry: entry[0]):
            if not changes or changes[-1].mode != mode:
                changes.append(ModeChange((t_ns - self.start_ns) / _NS_PER_S, mode, reason))
            elif not changes[-1].reason:
                changes[-1] = replace(changes[-1], reason=reason)
        return changes
