"""Judgement on every frame received, and on those that are missing.

A frame counts only when the DBC knows it, its length and ranges fit, and its end-to-end protection holds. All else is
counted by cause and ignored at once: bad data and no data are the same thing. A message of which too many frames are bad
is invalid until it has been good for a while, even though enough good ones come in between.
"""

from collections import Counter, deque
from collections.abc import Iterable, Sequence

from dbc.catalogue import NETWORKS, Catalogue, DecodeError, MessageSpec
from dbc.e2e import E2EReceiver, E2EState, E2EWindow, WindowRules
from dbc.frame import CanFrame
from gateway.causes import Cause, Finding

WINDOW_FRAMES = 10
MAX_BAD_FRAMES = 2
"""Bad frames among the last `WINDOW_FRAMES` of a message that are only counted; one more, and the message is invalid."""
RECOVERY_NS = 1_000_000_000
"""How long an invalid message has to be good before it counts again [ns]."""

FLOW_WINDOW_NS = 130_000_000
"""Time over which losses are counted [ns]: with 20 % lost the reaction is to come within 150 ms."""
MAX_LOST_FRAMES = 5
"""Frames lost in that time that are only counted, of about 80 on each bus: with 1 % lost there is 1, with 20 % there are 16."""
MAX_FLOW_CYCLE_NS = 10_000_000
MAX_LULL_NS = 10_000_000
"""Time without any frame that is usual [ns]: of messages with this cycle time that all come at once."""
MAX_PAUSE_NS = 40_000_000
"""What a pause of all senders may add to it within a window, in which nothing is lost [ns]; after a longer one all messages are missing."""

_RULES = WindowRules(WINDOW_FRAMES, MAX_BAD_FRAMES, clean_ns=RECOVERY_NS)
_MS_PER_NS = 1e-6


class MessageWatch:
    """What is remembered of one needed message.

    Attributes:
        spec: its entry in the catalogue.
        last_good_ns: arrival of the newest good frame [ns]; None when there was none.
    """

    def __init__(self, spec: MessageSpec) -> None:
        self.spec = spec
        self.last_good_ns: int | None = None
        self._receiver = None if spec.e2e_data_id is None else E2EReceiver(spec.e2e_data_id)
        self._window = E2EWindow(spec.timeout_ns, _RULES)

    def reject_cause(self, frame: CanFrame) -> str | None:
        """Why a frame must not be decoded; None when it may."""
        if len(frame.data) != self.spec.length_bytes:
            return "length"
        if self._receiver is not None and not (status := self._receiver.check(frame.data)).is_usable:
            return status.value
        return None

    def note(self, t_ns: int, is_good: bool) -> None:
        """Remember what became of a frame."""
        self._window.add(t_ns, is_good)
        if is_good:
            self.last_good_ns = t_ns

    def finding(self, now_ns: int) -> Finding | None:
        """What is wrong with the message now."""
        spec = self.spec
        age_ns = spec.timeout_ns + 1 if self.last_good_ns is None else now_ns - self.last_good_ns
        if age_ns > spec.timeout_ns:
            return Finding(Cause.MESSAGE_MISSING, age_ns * _MS_PER_NS, spec.timeout_ns * _MS_PER_NS, spec.name)
        if self._window.state is E2EState.INVALID:
            return Finding(Cause.MESSAGE_INVALID, self._window.bad_frames, MAX_BAD_FRAMES, spec.name)
        return None


class Flow:
    """How many of the frames that should come do come: losses that no single message shows, because each is soon followed by a good frame.

    A message that comes more often than it should makes up for no other.

    Args:
        source: of these messages, for people.
        specs: the messages to count; those slower than `MAX_FLOW_CYCLE_NS` would say something too late.
    """

    def __init__(self, source: str, specs: Iterable[MessageSpec]) -> None:
        self._source = source
        cycles_ns = {spec.name: spec.cycle_time_ns for spec in specs if spec.cycle_time_ns}
        self._cycles_ns = {name: cycle_ns for name, cycle_ns in cycles_ns.items() if cycle_ns <= MAX_FLOW_CYCLE_NS}
        self._limit = len(self._cycles_ns) + MAX_LOST_FRAMES  # one of each message may just be on its way
        self._good: Counter[str] = Counter()
        self._paused_ns = 0
        self._last_ns = 0
        self._before: tuple[int, int, Counter[str]] | None = None
        self._within: deque[tuple[int, int, Counter[str]]] = deque()

    def note_good(self, spec: MessageSpec, t_ns: int) -> None:
        """Count a good frame that arrived at `t_ns`."""
        self._good[spec.name] += 1
        self._paused_ns += max(t_ns - self._last_ns - MAX_LULL_NS, 0)
        self._last_ns = max(t_ns, self._last_ns)  # of two buses, one is read after the other

    def finding(self, now_ns: int) -> Finding | None:
        """Whether too many were lost within the last `FLOW_WINDOW_NS`."""
        paused_ns = self._paused_ns + max(now_ns - self._last_ns - MAX_LULL_NS, 0)
        self._within.append((now_ns, paused_ns, self._good.copy()))
        while self._within[0][0] <= now_ns - FLOW_WINDOW_NS:
            self._before = self._within.popleft()
        if self._before is None:
            return None
        then_ns, paused_then_ns, good_then = self._before
        elapsed_ns = now_ns - then_ns - min(paused_ns - paused_then_ns, MAX_PAUSE_NS)
        expected = {name: elapsed_ns / cycle_ns for name, cycle_ns in self._cycles_ns.items()}
        lost = sum(max(expected[name] - (self._good[name] - good_then[name]), 0.0) for name in expected)
        if lost <= self._limit:
            return None
        percent = 100.0 / sum(expected.values())
        return Finding(Cause.FRAMES_LOST, percent * lost, percent * self._limit, self._source)


class Supervisor:
    """Accepts or rejects frames and watches the messages it is told to need.

    Args:
        needed: names of the messages whose absence matters and whose content is decoded; others are ignored.
        node: whose messages nobody else may send.

    Attributes:
        received: frames seen.
        rejected: count by cause.
    """

    def __init__(self, catalogue: Catalogue, needed: Iterable[str], node: str = "GW") -> None:
        self._catalogue = catalogue
        self._watches = {catalogue.by_name[name].arbitration_id: MessageWatch(catalogue.by_name[name]) for name in needed}
        self._by_name = {watch.spec.name: watch for watch in self._watches.values()}
        self._own = {arbitration_id: spec for arbitration_id, spec in catalogue.by_id.items() if spec.sender == node}
        specs = [watch.spec for watch in self._watches.values()]
        self._flow = Flow("buses", specs)  # finds what concerns all of them sooner
        self._flow_of = {network: Flow(network, [spec for spec in specs if spec.network == network]) for network in NETWORKS}
        self._impostor: Finding | None = None
        self.received = 0
        self.rejected: Counter[str] = Counter()

    def observe(self, frames: Sequence[CanFrame]) -> dict[str, dict[str, float]]:
        """Newest good signal values of each needed message among `frames`, in the units of the DBC."""
        values: dict[str, dict[str, float]] = {}
        self.received += len(frames)
        for frame in frames:
            watch = self._watches.get(frame.arbitration_id)
            if watch is None:
                self._note_stranger(frame)
                continue
            cause = watch.reject_cause(frame)
            if cause is None:
                try:
                    values[watch.spec.name] = self._catalogue.decode(watch.spec, frame)
                except DecodeError:
                    cause = "range"
            watch.note(frame.t_ns, cause is None)
            if cause is None:
                self._flow.note_good(watch.spec, frame.t_ns)
                self._flow_of[watch.spec.network].note_good(watch.spec, frame.t_ns)
            else:
                self.rejected[f"{watch.spec.name}: {cause}"] += 1
        return values

    def _note_stranger(self, frame: CanFrame) -> None:
        own = self._own.get(frame.arbitration_id)
        if own is not None:
            self.rejected[f"{own.name}: second sender"] += 1
            self._impostor = Finding(Cause.SECOND_SENDER, self.rejected[f"{own.name}: second sender"], 0, own.name)
        elif frame.arbitration_id not in self._catalogue.by_id:
            self.rejected["unknown id"] += 1

    def arrival_ns(self, name: str) -> int | None:
        """Time at which the newest good frame of a needed message arrived [ns]; None when there has been none."""
        return self._by_name[name].last_good_ns

    def findings(self, now_ns: int) -> list[Finding]:
        """What is wrong with the messages now, and, once, that somebody else has sent ours."""
        impostor, self._impostor = self._impostor, None
        flows = [flow.finding(now_ns) for flow in (self._flow, *self._flow_of.values())]
        candidates = [impostor, *flows, *(watch.finding(now_ns) for watch in self._watches.values())]
        return [finding for finding in candidates if finding is not None]
