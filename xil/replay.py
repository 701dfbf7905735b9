"""`xilgate replay`: a bus record played back onto buses, every frame at its time.

Every frame has an absolute deadline, so that what one frame is late by is no concern of the next: no drift, nothing is skipped.
The frames of each channel keep their order; channels are merged by time, as they were heard.
"""

import contextlib
import heapq
import os
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import can
from can.io.blf import BLFParseError
from rich.table import Table

from dbc.catalogue import Catalogue
from dbc.errors import SetupFailure, UserMistake
from xil.virtual_bus import GATEWAY_NODE

UNNAMED_CHANNEL = "0"
"""Channel of a frame whose record names none."""

_LARGEST_STANDARD_ID = (1 << 11) - 1
_LARGEST_ID = (1 << 29) - 1
_NS_PER_S = 1_000_000_000
_MERGE_WINDOW_NS = _NS_PER_S
"""By how much the channels of a record may be out of step with each other [ns]: far above what listeners of several buses are."""
_LATEST_S = 1e11
"""Three thousand years [s]."""
_RETRY_NS = 1_000_000
_PATIENCE_NS = 5 * _NS_PER_S
"""Time for which a bus may refuse a frame [ns]."""
_READERS: dict[str, type[can.BLFReader | can.ASCReader | can.CanutilsLogReader]] = {
    ".blf": can.BLFReader,
    ".asc": can.ASCReader,
    ".log": can.CanutilsLogReader,
}


class RecordError(UserMistake):
    """A bus record cannot be read; one line that says which and why."""


class RecordedFrame(NamedTuple):
    """One frame of a record.

    Args:
        due_ns: its time since the first frame of the record [ns].
    """

    due_ns: int
    channel: str
    message: can.Message


def read_record(path: Path) -> Iterator[RecordedFrame]:
    """The frames of a record in BLF, ASC or candump format, by time; what is no frame, an error frame say, is not among them.

    A record that ends within a frame, as a crash leaves it, is read up to there.

    Raises:
        RecordError: no such file, not one of the formats, or not what it says it is.
    """
    return _in_step(_timed(_messages(path)))


def _messages(path: Path) -> Iterator[can.Message]:
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordError(f"{path}: a bus record ends in {', '.join(_READERS)}")
    if os.path.exists(path) and not os.path.isfile(path):
        raise RecordError(f"{path}: not a regular file")
    count = 0
    try:
        with reader(path) as messages:
            for message in messages:
                if not abs(message.timestamp) <= _LATEST_S:
                    raise ValueError(f"time {message.timestamp} s")
                count += 1
                yield message
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror or error}") from error
    except struct.error as error:
        # BLF: the file ends within the head of a block.
        if not count:
            raise RecordError(f"{path}: no record of this format: {error}") from error
    except (ValueError, IndexError, can.CanError, BLFParseError, zlib.error) as error:
        raise RecordError(f"{path}: no record of this format after {count} frames: {str(error) or type(error).__name__}") from error


def _timed(messages: Iterable[can.Message]) -> Iterator[RecordedFrame]:
    """Frames with their time since the first; a channel on which time stands still or goes back is played without a pause."""
    start_ns: int | None = None
    newest_ns: dict[str, int] = {}
    for message in messages:
        if message.is_error_frame:
            continue
        t_ns = round(message.timestamp * _NS_PER_S)
        start_ns = t_ns if start_ns is None else start_ns
        channel = UNNAMED_CHANNEL if message.channel is None else str(message.channel)
        newest_ns[channel] = max(newest_ns.get(channel, 0), t_ns - start_ns)
        yield RecordedFrame(newest_ns[channel], channel, message)


def _in_step(frames: Iterable[RecordedFrame]) -> Iterator[RecordedFrame]:
    """The same by time, in so far as a window of a second shows it."""
    waiting: list[tuple[int, int, RecordedFrame]] = []
    for number, frame in enumerate(frames):
        heapq.heappush(waiting, (frame.due_ns, number, frame))
        while waiting[0][0] <= frame.due_ns - _MERGE_WINDOW_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


@dataclass(frozen=True)
class Selection:
    """Which frames are played.

    Args:
        ids: arbitration ids, None for all.
        senders: nodes of the DBC files, None for all; a frame that they do not know has none.
        with_gateway: whether frames of the gateway are played: where a gateway lives they would be those of a second one.
    """

    catalogue: Catalogue
    ids: Collection[int] | None = None
    senders: Collection[str] | None = None
    with_gateway: bool = False

    def is_asked_for(self, message: can.Message) -> bool:
        """Whether it is one of `ids`; an extended frame by a number that needs to be one."""
        return message.arbitration_id in (self.ids or ()) and message.is_extended_id == (message.arbitration_id > _LARGEST_STANDARD_ID)

    def refusal(self, message: can.Message) -> str:
        """Why a frame is left out; empty when it is played."""
        spec = None if message.is_extended_id else self.catalogue.by_id.get(message.arbitration_id)
        sender = "" if spec is None else spec.sender
        if sender == GATEWAY_NODE and not self.with_gateway:
            return "of the gateway"
        if self.ids is not None and not self.is_asked_for(message):
            return "other id"
        if self.senders is not None and sender not in self.senders:
            return "other sender"
        return ""


def select(catalogue: Catalogue, ids: Iterable[str] | None, senders: Iterable[str] | None, *, with_gateway: bool) -> Selection:
    """What the user asked for.

    Args:
        ids: numbers, or names of messages.

    Raises:
        UserMistake: an id or a sender that there is not.
    """
    known = {spec.sender for spec in catalogue.by_name.values()}
    if unknown := [sender for sender in senders or () if sender not in known]:
        raise UserMistake(f"--sender {unknown[0]}: the DBC files know {', '.join(sorted(known))}")
    wanted = None if not ids else {_id_of(catalogue, text) for text in ids}
    return Selection(catalogue, wanted, set(senders) if senders else None, with_gateway)


def _id_of(catalogue: Catalogue, text: str) -> int:
    if text in catalogue.by_name:
        return catalogue.by_name[text].arbitration_id
    try:
        number = int(text, 0)
    except ValueError:
        number = -1
    if not 0 <= number <= _LARGEST_ID:
        raise UserMistake(f"--id {text}: expected a message of the DBC files, or a number from 0 to 0x{_LARGEST_ID:X}")
    return number


@contextlib.contextmanager
def open_buses(names: Sequence[str], log: Path) -> Iterator[dict[str, Callable[[can.Message], None]]]:
    """Where the frames of each channel go.

    Args:
        names: `CHANNEL=INTERFACE:NAME` each, or `INTERFACE:NAME` for all channels of the record.

    Raises:
        UserMistake: a name that is none, or a channel that the record does not have.
        SetupFailure: a bus does not open.
    """
    channels = [content.channel for content in contents(read_record(log))]
    bus_of: dict[str, str] = {}
    for text in names:
        channel, separator, bus = text.rpartition("=")
        if separator and channel not in channels:
            raise UserMistake(f"--bus {text}: {log} has no channel {channel!r}; it has {', '.join(channels) or 'none'}")
        bus_of |= dict.fromkeys([channel] if separator else channels, bus)
    with contextlib.ExitStack() as stack:
        opened = {bus: stack.enter_context(_open(bus)) for bus in dict.fromkeys(bus_of.values())}
        yield {channel: opened[bus].send for channel, bus in bus_of.items()}


def _open(name: str) -> can.BusABC:
    interface, _, channel = name.partition(":")
    if not (interface and channel):
        raise UserMistake(f"--bus {name}: expected INTERFACE:CHANNEL, for example socketcan:vcan0")
    try:
        return can.Bus(channel=channel, interface=interface, ignore_config=True)
    except (can.CanError, OSError, ValueError, ImportError, NotImplementedError, NameError) as error:
        raise SetupFailure(f"bus {name!r} does not open: {error}") from error


@dataclass
class Played:
    """What was played.

    Attributes:
        sent: frames, by channel.
        left_out: frames, by the reason.
        not_found: ids that were asked for and are not in the record.
        latest_ns: by how much the latest frame was late [ns].
        duration_ns: from the first frame sent to the last [ns].
    """

    sent: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    not_found: list[int] = field(default_factory=list)
    latest_ns: int = 0
    duration_ns: int = 0


def sleep_ns(duration_ns: int) -> None:
    """Sleep."""
    time.sleep(duration_ns / _NS_PER_S)


class Player:
    """Plays frames onto buses.

    Args:
        send: of each channel: hands a frame over, or raises `can.CanError` or `OSError` while the bus has no room.
        speed: 2 is twice as fast.
        clock: monotonic time [ns].
        sleep: for a number of nanoseconds.
    """

    def __init__(
        self,
        send: Mapping[str, Callable[[can.Message], None]],
        selection: Selection,
        speed: float = 1.0,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_ns,
    ) -> None:
        self._send = send
        self._selection = selection
        self._speed = speed
        self._clock = clock
        self._sleep = sleep
        self.played = Played()

    def play(self, frames: Iterable[RecordedFrame], is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Play until the record ends, or somebody stops it; `played` tells how far it came.

        Raises:
            SetupFailure: a bus takes no frames.
        """
        start_ns = self._clock()
        awaited = set(self._selection.ids or ())
        for frame in frames:
            if self._selection.is_asked_for(frame.message):
                awaited.discard(frame.message.arbitration_id)
            reason = "other channel" if frame.channel not in self._send else self._selection.refusal(frame.message)
            if reason:
                self.played.left_out[reason] += 1
                continue
            deadline_ns = start_ns + round(frame.due_ns / self._speed)
            if (early_ns := deadline_ns - self._clock()) > 0:
                self._sleep(early_ns)
            if is_stopped():
                return
            self._hand_over(frame)
            now_ns = self._clock()
            self.played.sent[frame.channel] += 1
            self.played.latest_ns = max(self.played.latest_ns, now_ns - deadline_ns)
            self.played.duration_ns = now_ns - start_ns
        self.played.not_found = sorted(awaited)

    def _hand_over(self, frame: RecordedFrame) -> None:
        """Send a frame, again and again while the bus has no room: nothing is skipped."""
        give_up_ns = self._clock() + _PATIENCE_NS
        while True:
            try:
                self._send[frame.channel](frame.message)
            except (can.CanError, OSError) as error:
                if self._clock() >= give_up_ns:
                    raise SetupFailure(f"the bus of channel {frame.channel} takes no frames: {error}") from error
                self._sleep(_RETRY_NS)
            else:
                return


@dataclass(frozen=True)
class ChannelContent:
    """What a record holds of one channel.

    Args:
        from_s, to_s: time of the first frame and of the last, from the first of the record on.
    """

    channel: str
    frames: int
    ids: int
    from_s: float
    to_s: float


def contents(frames: Iterable[RecordedFrame]) -> list[ChannelContent]:
    """What is in a record, channel by channel."""
    ids: dict[str, set[int]] = {}
    times_ns: dict[str, tuple[int, int]] = {}
    count = Counter[str]()
    for due_ns, channel, message in frames:
        count[channel] += 1
        ids.setdefault(channel, set()).add(message.arbitration_id)
        times_ns[channel] = times_ns.get(channel, (due_ns, due_ns))[0], due_ns
    return [
        ChannelContent(channel, count[channel], len(ids[channel]), times_ns[channel][0] / _NS_PER_S, times_ns[channel][1] / _NS_PER_S)
        for channel in count
    ]


def contents_table(title: str, found: Sequence[ChannelContent]) -> Table:
    """What is in a record, for people."""
    table = Table(title=title)
    for heading in ("channel", "frames", "ids", "from [s]", "to [s]"):
        table.add_column(heading, justify="left" if heading == "channel" else "right")
    for content in found:
        table.add_row(
            ascii(content.channel)[1:-1], str(content.frames), str(content.ids), f"{content.from_s:.3f}", f"{content.to_s:.3f}"
        )
    return table


def played_text(played: Played) -> str:
    """What was played, for people."""
    sent = ", ".join(f"{count} on {ascii(channel)[1:-1]}" for channel, count in played.sent.items()) or "nothing"
    left_out = ", ".join(f"{count} {reason}" for reason, count in played.left_out.items()) or "none"
    not_found = "; not in the record: " + ", ".join(f"0x{number:X}" for number in played.not_found) if played.not_found else ""
    seconds, late_ms = played.duration_ns / _NS_PER_S, played.latest_ns * 1e-6
    return f"sent {sent} in {seconds:.3f} s; latest frame {late_ms:.1f} ms late; left out: {left_out}{not_found}"
