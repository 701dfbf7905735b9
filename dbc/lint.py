"""What is wrong, or may be, in DBC files: rules over messages, signals, attributes and the load of the buses.

The rules read files that a catalogue would refuse, so that all mistakes are told at once. How long frames take on a bus is not known
here: who asks brings the figures, see `BusTiming`.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import combinations

from cantools.database.can.message import Message
from cantools.database.can.signal import Signal

from dbc.catalogue import E2E_SIGNALS, MAX_LENGTH_BYTES
from dbc.database import DbcFile, attributes_of
from dbc.e2e import PROFILE, tells_stuck_bits
from dbc.packing import bits_of, pages_of, raw_range, value_range

MIN_TIMEOUT_CYCLES = 2
"""A timeout shorter than this makes one lost frame a missing message."""
DEFAULT_MAX_LOAD = 0.6
"""Share of a bus that its cyclic messages may take: the rest is for retransmission, diagnosis and what is to come."""

_NS_PER_MS = 1e6
_MAX_SIGNAL_BITS = 8 * MAX_LENGTH_BYTES


class Severity(Enum):
    """What a finding means: the file cannot be used as it is, or somebody should look at it."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found.

    Args:
        file, message, signal: where; empty where it is about no single one.
        text: what is wrong.
        value: what is there.
        limit: what is allowed.
    """

    severity: Severity
    file: str
    message: str
    signal: str
    text: str
    value: str
    limit: str


@dataclass(frozen=True, slots=True)
class BusTiming:
    """The cyclic messages of one bus, analysed.

    Args:
        load: share of time in which the bus is busy, with the most stuff bits that there can be.
        bounds_ns: worst-case response time of each message [ns]; None where there is none.
    """

    network: str
    load: float
    bounds_ns: Mapping[str, int | None]


@dataclass(frozen=True, slots=True)
class _Place:
    """What a rule is told of the message it looks at."""

    message: Message
    attributes: Mapping[str, object]
    is_acted_on: bool
    is_sender_able: bool
    """Whether its sender protects other messages."""

    def number(self, name: str) -> int:
        value = self.attributes.get(name)
        return value if isinstance(value, int) else 0


Found = tuple[Severity, str, str, str, str]
"""Severity, signal, text, value, limit."""


def lint(
    files: Sequence[DbcFile], acted_on: Collection[str] = (), timings: Iterable[BusTiming] = (), max_load: float = DEFAULT_MAX_LOAD
) -> list[Finding]:
    """Everything that is to be said of a set of DBC files, errors first.

    Args:
        files: read without strictness.
        acted_on: messages that a robot or the gateway acts on.
        timings: of the buses that the files are about.
        max_load: share of a bus that may be taken.
    """
    protected = (message for file in files for message in file.messages if attributes_of(message).get("E2EProfile"))
    able = {message.senders[0] for message in protected if message.senders}
    findings = []
    for file in files:
        for message in file.messages:
            is_able = bool(message.senders) and message.senders[0] in able
            place = _Place(message, attributes_of(message), message.name in acted_on, is_able)
            findings += [
                Finding(severity, file.path.name, message.name, *rest) for rule in _RULES for severity, *rest in rule(place)
            ]
    findings += [*_shared(files), *_timing(files, timings, max_load)]
    return sorted(findings, key=lambda finding: finding.severity is not Severity.ERROR)


def _frame(place: _Place) -> Iterator[Found]:
    message = place.message
    if message.is_extended_frame:
        yield Severity.ERROR, "", "identifier of 29 bits", f"0x{message.frame_id:X}", "11 bits"
    if message.length > MAX_LENGTH_BYTES:
        yield Severity.ERROR, "", "longer than a classical frame", f"{message.length} bytes", f"{MAX_LENGTH_BYTES} bytes"
    if not message.senders:
        yield Severity.ERROR, "", "nobody sends it", "no sender", "one node"


def _layout(place: _Place) -> Iterator[Found]:
    message = place.message
    for name, count in Counter(signal.name for signal in message.signals).items():
        if count > 1:
            yield Severity.ERROR, name, "defined more than once", str(count), "1"
    for signal in message.signals:
        if max(bits_of(signal)) >= 8 * message.length:
            yield Severity.ERROR, signal.name, "reaches beyond the message", f"bit {max(bits_of(signal))}", f"{message.length} bytes"
    for one, other in combinations(message.signals, 2):
        if _can_be_together(message, one, other) and (shared := set(bits_of(one)) & set(bits_of(other))):
            yield Severity.ERROR, other.name, f"overlaps {one.name}", f"{len(shared)} bits from bit {min(shared)}", "0 bits"


def _can_be_together(message: Message, one: Signal, other: Signal) -> bool:
    """Whether no multiplexer keeps two signals apart."""
    pages = pages_of(message, one)
    return all(set(ids) & set(pages.get(multiplexer, ids)) for multiplexer, ids in pages_of(message, other).items())


def _ranges(place: _Place) -> Iterator[Found]:
    for signal in place.message.signals:
        if signal.scale == 0:
            yield Severity.ERROR, signal.name, "has one value only", "factor 0", "another factor"
            continue
        if signal.length > _MAX_SIGNAL_BITS:
            yield Severity.ERROR, signal.name, "longer than a classical frame", f"{signal.length} bits", f"{_MAX_SIGNAL_BITS} bits"
            continue
        if not (math.isfinite(signal.scale) and math.isfinite(signal.offset)):
            yield Severity.ERROR, signal.name, "factor or offset is no number", f"({signal.scale:g},{signal.offset:g})", "finite numbers"
            continue
        low, high = value_range(signal)
        stated = f"[{_number(signal.minimum)}|{_number(signal.maximum)}]"
        slack = 0.5 * abs(signal.scale)
        if signal.minimum is None or signal.maximum is None:
            yield Severity.WARNING, signal.name, "states no range", stated, f"[{low:g}|{high:g}]"
        elif signal.minimum > signal.maximum:
            yield Severity.ERROR, signal.name, "range is empty", stated, "minimum below maximum"
        elif signal.minimum < low - slack or signal.maximum > high + slack:
            yield Severity.ERROR, signal.name, "range is wider than the bits can hold", stated, f"[{low:g}|{high:g}]"


def _tables(place: _Place) -> Iterator[Found]:
    for signal in place.message.signals:
        table = {raw: str(entry) for raw, entry in (signal.choices or {}).items()}
        lowest, highest = raw_range(signal)
        for raw, entry in table.items():
            if not lowest <= raw <= highest:
                yield Severity.ERROR, signal.name, f"entry {entry} does not fit the bits", str(raw), f"[{lowest}|{highest}]"
        for entry, count in Counter(table.values()).items():
            if count > 1:
                yield Severity.WARNING, signal.name, f"entry {entry} has more than one number", str(count), "1"


def _receivers(place: _Place) -> Iterator[Found]:
    for signal in place.message.signals:
        if not signal.receivers:
            yield Severity.WARNING, signal.name, "nobody receives it", "no receiver", "one node"


def _times(place: _Place) -> Iterator[Found]:
    cycle_ms, timeout_ms = place.number("GenMsgCycleTime"), place.number("GenMsgTimeout")
    serious = Severity.ERROR if place.is_acted_on else Severity.WARNING
    if cycle_ms <= 0:
        if place.is_acted_on or place.attributes.get("GenMsgSendType", "Cyclic") in ("Cyclic", 0):
            yield serious, "", "cyclic without a GenMsgCycleTime", f"{cycle_ms} ms", "above 0 ms"
        return
    if timeout_ms <= 0:
        yield serious, "", "never missed: no GenMsgTimeout", f"{timeout_ms} ms", f"from {MIN_TIMEOUT_CYCLES * cycle_ms} ms"
    elif timeout_ms < MIN_TIMEOUT_CYCLES * cycle_ms:
        yield Severity.ERROR, "", "one lost frame is a timeout", f"{timeout_ms} ms", f"from {MIN_TIMEOUT_CYCLES * cycle_ms} ms"


def _protection(place: _Place) -> Iterator[Found]:
    profile, data_id = place.attributes.get("E2EProfile"), place.attributes.get("E2EDataId")
    if not profile:
        if place.is_acted_on:
            # Nodes that cannot protect anything, such as the car's own, are a risk to know; one that forgets a message is a mistake.
            severity = Severity.ERROR if place.is_sender_able else Severity.WARNING
            yield severity, "", "acted on without end-to-end protection", "no E2EProfile", PROFILE
        return
    if profile != PROFILE:
        yield Severity.ERROR, "", "unknown E2EProfile", str(profile), PROFILE
        return
    if not (isinstance(data_id, int) and 1 <= data_id <= 255):
        yield Severity.ERROR, "", "E2EDataId outside its range", str(data_id), "[1|255]"
    elif place.message.length > 1 and not tells_stuck_bits(data_id, place.message.length):
        yield Severity.ERROR, "", "E2EDataId under which a payload of equal bits passes", str(data_id), "another one"
    places = {signal.name: bits_of(signal) for signal in place.message.signals}
    for name, bits in E2E_SIGNALS.items():
        if places.get(name) != bits:
            found = f"bits {places[name][0]} to {places[name][-1]}" if name in places else "not there"
            yield Severity.ERROR, name, f"not where {PROFILE} has it", found, f"bits {bits[0]} to {bits[-1]}"


_RULES: tuple[Callable[[_Place], Iterator[Found]], ...] = (_frame, _layout, _ranges, _tables, _receivers, _times, _protection)


def _shared(files: Sequence[DbcFile]) -> Iterator[Finding]:
    """What two messages must not have in common."""
    taken: dict[tuple[str, object], Message] = {}
    for file in files:
        for message in file.messages:
            attributes = attributes_of(message)
            facts: list[tuple[str, object]] = [("name", message.name), ("identifier", message.frame_id)]
            if attributes.get("E2EProfile") and attributes.get("E2EDataId"):
                facts.append(("E2EDataId", attributes["E2EDataId"]))
            for what, value in facts:
                other = taken.setdefault((what, value), message)
                if other is not message:
                    shown = f"0x{value:X}" if what == "identifier" else str(value)
                    text = f"{what} is also that of {other.name}"
                    yield Finding(Severity.ERROR, file.path.name, message.name, "", text, shown, "one message each")


def _timing(files: Sequence[DbcFile], timings: Iterable[BusTiming], max_load: float) -> Iterator[Finding]:
    for timing in timings:
        about = [file for file in files if file.network == timing.network]
        if timing.load > max_load:
            names = ", ".join(file.path.name for file in about)
            yield Finding(Severity.ERROR, names, "", "", f"load of bus {timing.network}", f"{timing.load:.1%}", f"{max_load:.1%}")
        for file in about:
            for message in file.messages:
                cycle_ms = attributes_of(message).get("GenMsgCycleTime")
                if message.name not in timing.bounds_ns or not isinstance(cycle_ms, int):
                    continue
                bound_ns = timing.bounds_ns[message.name]
                if bound_ns is None or bound_ns > cycle_ms * _NS_PER_MS:
                    found = "unbounded" if bound_ns is None else f"{bound_ns / _NS_PER_MS:.2f} ms"
                    text = f"may reach the bus {timing.network} after its next cycle has begun"
                    yield Finding(Severity.ERROR, file.path.name, message.name, "", text, found, f"{cycle_ms} ms")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"
