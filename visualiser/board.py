"""The newest sample of every topic, and how old it is. Pure: time is an argument."""

from dataclasses import dataclass

from gateway.telemetry import Sample, SceneSample, decode

LOST_AFTER_MS = 500.0
"""Age from which a topic counts as lost [ms]; `page/link.js` says the same."""
SCENE_LOST_AFTER_MS = 2500.0
"""The scene comes once per second only."""
EVENT_TOPICS = ("parameters", "faults")
"""These come when something happens, not regularly."""

_LOCKSTEP_STAGES = ("mil", "sil")


@dataclass(frozen=True, slots=True)
class Received:
    """A sample as it came.

    Args:
        received_ns: monotonic time of arrival [ns].
        number: how many samples of its topic came up to this one.
    """

    sample: Sample
    received_ns: int
    number: int


class Board:
    """Keeps one sample per topic; what is not a sample is counted and forgotten.

    Args:
        is_clock_shared: whether who sends and who receives are one host.
    """

    def __init__(self, is_clock_shared: bool = True) -> None:
        self._is_clock_shared = is_clock_shared
        self.newest: dict[str, Received] = {}
        self.rejected = 0

    def accept(self, topic: str, payload: bytes, now_ns: int) -> bool:
        """Take a payload of a topic. False when it is not a sample of that topic."""
        sample = decode(topic, payload)
        if sample is None:
            self.rejected += 1
            return False
        before = self.newest.get(topic)
        self.newest[topic] = Received(sample, now_ns, before.number + 1 if before else 1)
        return True

    def age_ms(self, topic: str, now_ns: int) -> float:
        """Age of the newest sample of a topic [ms].

        Where the sender's clock is ours, a sample that waited in a socket shows its true age. From another machine, and from
        lockstep stages, which run in virtual time, the age counts from arrival.

        Raises:
            KeyError: nothing of this topic has come yet.
        """
        received = self.newest[topic]
        born_ns = received.sample.t_ns if self._is_clock_shared and not self._is_lockstep() else received.received_ns
        return max(0.0, (now_ns - born_ns) * 1e-6)

    def is_lost(self, topic: str, now_ns: int) -> bool:
        """True when a topic that once came has become too old; what comes once per event cannot."""
        if topic in EVENT_TOPICS:
            return False
        limit_ms = SCENE_LOST_AFTER_MS if topic == "scene" else LOST_AFTER_MS
        return topic in self.newest and self.age_ms(topic, now_ns) > limit_ms

    def _is_lockstep(self) -> bool:
        scene = self.newest.get("scene")
        return scene is not None and isinstance(scene.sample, SceneSample) and scene.sample.stage in _LOCKSTEP_STAGES
