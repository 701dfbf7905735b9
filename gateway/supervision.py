"""Judgement on every frame received, and on those that are missing.

A frame counts only when the DBC knows it, its length and ranges fit, and its end-to-end protection holds. All else is
counted by cause and ignored at once: bad data and no data are the same thing. A message of which too many frames are bad
is invalid until it has been good for a while, even though enough good ones come in between.
"""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

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
_NS_PER_S = 1e9


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


class Losses(NamedTuple):
    """What did not come of some messages: losses that no single message shows, because each is soon followed by a good frame.

    Args:
        lost: frames within the last `FLOW_WINDOW_NS`.
        expected: frames in that time.
        messages: how many are counted.
    """

    lost: float
    expected: float
    messages: int

    def finding(self, source: str) -> Finding | None:
        """Whether they are too many; `source` names the messages for people."""
        limit = self.messages + MAX_LOST_FRAMES  # one of each message may just be on its way
        if self.lost <= limit:
            return None
        percent = 100.0 / self.expected
        return Finding(Cause.FRAMES_LOST, percent * self.lost, percent * limit, source)


NOTHING_LOST = Losses(0.0, 0.0, 0)


class Flow:
    """Counts the frames of one bus that come against those that should. A message that comes too often makes up for no other.

    Args:
        specs: the messages to count; those slower than `MAX_FLOW_CYCLE_NS` would say something too late.
    """

    def __init__(self, specs: Iterable[MessageSpec]) -> None:
        fast = [spec for spec in specs if spec.cycle_time_ns and spec.cycle_time_ns <= MAX_FLOW_CYCLE_NS]
        self._rates_hz = [_NS_PER_S / spec.cycle_time_ns for spec in fast]
        self._number = {spec.name: number for number, spec in enumerate(fast)}
        self._good = [0] * len(fast)
        self._paused_ns = self._last_ns = 0
        self._before: tuple[int, int, list[int]] | None = None
        self._within: deque[tuple[int, int, list[int]]] = deque()

    def note_good(self, spec: MessageSpec, t_ns: int) -> None:
        """Count a good frame that arrived at `t_ns`."""
        if (number := self._number.get(spec.name)) is not None:
            self._good[number] += 1
        self._paused_ns += max(t_ns - self._last_ns - MAX_LULL_NS, 0)
        self._last_ns = t_ns

    def losses(self, now_ns: int) -> Losses:
        """What was lost until now; nothing while less than `FLOW_WINDOW_NS` has been seen."""
        paused_ns = self._paused_ns + max(now_ns - self._last_ns - MAX_LULL_NS, 0)
        self._within.append((now_ns, paused_ns, self._good[:]))
        while self._within[0][0] <= now_ns - FLOW_WINDOW_NS:
            self._before = self._within.popleft()
        if self._before is None:
            return NOTHING_LOST
        then_ns, paused_then_ns, good_then = self._before
        elapsed_s = (now_ns - then_ns - min(paused_ns - paused_then_ns, MAX_PAUSE_NS)) / _NS_PER_S
        lost = expected = 0.0
        for number, rate_hz in enumerate(self._rates_hz):
            due = elapsed_s * rate_hz
            lost += max(due - (self._good[number] - good_then[number]), 0.0)
            expected += due
        return Losses(lost, expected, len(self._good))


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
        self._flows = {network: Flow(spec for spec in specs if spec.network == network) for network in NETWORKS}
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
                self._flows[watch.spec.network].note_good(watch.spec, frame.t_ns)
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
        candidates = [impostor, *self._lossy(now_ns), *(watch.finding(now_ns) for watch in self._watches.values())]
        return [finding for finding in candidates if finding is not None]

    def _lossy(self, now_ns: int) -> list[Finding | None]:
        """Each bus that loses too much, and all together: what concerns all of them shows in the sum sooner."""
        found = {network: flow.losses(now_ns) for network, flow in self._flows.items()}
        each = found.values()
        total = Losses(sum(one.lost for one in each), sum(one.expected for one in each), sum(one.messages for one in each))
        return [total.finding("buses"), *(losses.finding(network) for network, losses in found.items())]
