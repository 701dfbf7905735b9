"""What is different between two DBC files, and whether nodes that stay with the old one can still talk to those with the new.

A change breaks when a frame of one side is refused or misread by the other, in either direction: a wider range is as bad as a
narrower one. What only adds is compatible.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from cantools.database.can.message import Message
from cantools.database.can.signal import Signal

from dbc.database import DbcFile, attributes_of

_Item = TypeVar("_Item", Message, Signal)


@dataclass(frozen=True, slots=True)
class Change:
    """One difference.

    Args:
        message, signal: by their old name, where they had one; empty where it is about no single one.
        what: that is different.
        old, new: empty where there is none.
    """

    is_breaking: bool
    message: str
    signal: str
    what: str
    old: str
    new: str


def compare(old: DbcFile, new: DbcFile) -> list[Change]:
    """All differences, those that break first."""
    nodes, senders = _renamed_nodes(old, new), {node for message in old.messages for node in message.senders}
    changes = [*_file(old, new), *(Change(before in senders, "", "", "node", before, after) for before, after in nodes.items())]
    names = _counterparts(old.messages, new.messages, lambda message: message.frame_id)
    for before in old.messages:
        changes += _message(before, names[before.name], nodes)
    kept = {after.name for after in names.values() if after}
    added = (message for message in new.messages if message.name not in kept)
    changes += [Change(False, message.name, "", "added", "", f"0x{message.frame_id:X}") for message in added]
    return sorted(changes, key=lambda change: not change.is_breaking)


def _file(old: DbcFile, new: DbcFile) -> Iterator[Change]:
    for what, before, after in (("network", old.network, new.network), ("bit rate", old.bitrate_bps, new.bitrate_bps)):
        if before != after:
            yield Change(True, "", "", what, str(before), str(after))


def _renamed_nodes(old: DbcFile, new: DbcFile) -> dict[str, str]:
    """Nodes that are gone, each with the one new node that sends and receives exactly what it did."""
    before, after = _places(old), _places(new)
    gone = [node for node in before if node not in after]
    come = [node for node in after if node not in before]
    places, new_places = [before[node] for node in gone], [after[node] for node in come]
    return {
        node: come[new_places.index(found)]
        for node, found in zip(gone, places, strict=True)
        if places.count(found) == 1 and new_places.count(found) == 1
    }


def _places(file: DbcFile) -> dict[str, set[tuple[int, int]]]:
    """What each node sends (the identifier and -1) and receives (the identifier and the first bit)."""
    places: dict[str, set[tuple[int, int]]] = {}
    for message in file.messages:
        for node in message.senders:
            places.setdefault(node, set()).add((message.frame_id, -1))
        for signal in message.signals:
            for node in signal.receivers:
                places.setdefault(node, set()).add((message.frame_id, signal.start))
    return places


def _counterparts(old: Sequence[_Item], new: Sequence[_Item], identity: Callable[[_Item], object]) -> dict[str, _Item | None]:
    """What became of each old item: the new one of its name, else one of another name that is the same otherwise, else None."""
    by_name = {item.name: item for item in new}
    old_names = {item.name for item in old}
    others = {identity(item): item for item in new if item.name not in old_names}
    return {item.name: by_name.get(item.name) or others.get(identity(item)) for item in old}


def _message(old: Message, new: Message | None, nodes: Mapping[str, str]) -> Iterator[Change]:
    if new is None:
        yield Change(True, old.name, "", "removed", f"0x{old.frame_id:X}", "")
        return
    for what, fact in _MESSAGE_FACTS.items():
        if (before := fact(old)) != (after := fact(new)):
            yield Change(True, old.name, "", what, before, after)
    if [nodes.get(node, node) for node in old.senders] != new.senders:
        yield Change(True, old.name, "", "sender", ", ".join(old.senders), ", ".join(new.senders))
    timeouts_ms = [_whole(message, "GenMsgTimeout") for message in (old, new)]
    if timeouts_ms[0] != timeouts_ms[1]:
        # No timeout is the longest. Who sends as late as the old one allows must not be called missing by the new.
        is_shorter = (timeouts_ms[1] or math.inf) < (timeouts_ms[0] or math.inf)
        yield Change(is_shorter, old.name, "", "timeout", *(f"{timeout_ms} ms" for timeout_ms in timeouts_ms))
    signals = _counterparts(old.signals, new.signals, lambda signal: (_layout(signal), _multiplexing(signal)))
    for before_signal in old.signals:
        yield from _signal(old.name, before_signal, signals[before_signal.name], nodes)
    kept = {after.name for after in signals.values() if after}
    for signal in new.signals:
        if signal.name not in kept:
            yield Change(False, old.name, signal.name, "added", "", _layout(signal))


def _signal(message: str, old: Signal, new: Signal | None, nodes: Mapping[str, str]) -> Iterator[Change]:
    if new is None:
        yield Change(True, message, old.name, "removed", _layout(old), "")
        return
    for what, fact in _SIGNAL_FACTS.items():
        if (before := fact(old)) != (after := fact(new)):
            yield Change(True, message, old.name, what, before, after)
    receivers = {nodes.get(node, node) for node in old.receivers}
    if added := sorted(set(new.receivers) - receivers):
        yield Change(False, message, old.name, "receiver added", "", ", ".join(added))
    if removed := sorted(receivers - set(new.receivers)):
        yield Change(False, message, old.name, "receiver removed", ", ".join(removed), "")
    before_table, after_table = _table(old), _table(new)
    for raw in sorted(before_table.keys() | after_table.keys()):
        before, after = before_table.get(raw, ""), after_table.get(raw, "")
        if before != after:
            yield Change(bool(before), message, old.name, f"entry {raw}", before, after)


def _layout(signal: Signal) -> str:
    """Place and kind of the bits, as a DBC writes them."""
    order, sign = 1 if signal.byte_order == "little_endian" else 0, "-" if signal.is_signed else "+"
    return f"{signal.start}|{signal.length}@{order}{sign}{' float' if signal.is_float else ''}"


def _multiplexing(signal: Signal) -> str:
    page = f"{signal.multiplexer_signal} = {', '.join(map(str, signal.multiplexer_ids))}" if signal.multiplexer_ids else ""
    return f"multiplexer {page}".strip() if signal.is_multiplexer else page


def _table(signal: Signal) -> Mapping[int, str]:
    return {raw: str(entry) for raw, entry in (signal.choices or {}).items()}


def _whole(message: Message, name: str) -> int:
    value = attributes_of(message).get(name)
    return value if isinstance(value, int) else 0


def _protection(message: Message) -> str:
    attributes = attributes_of(message)
    return f"{attributes['E2EProfile']}, data id {attributes.get('E2EDataId')}" if attributes.get("E2EProfile") else "none"


_MESSAGE_FACTS: Mapping[str, Callable[[Message], str]] = {
    "name": lambda message: message.name,
    "identifier": lambda message: f"0x{message.frame_id:X}{' extended' if message.is_extended_frame else ''}",
    "length": lambda message: f"{message.length} bytes",
    "cycle time": lambda message: f"{_whole(message, 'GenMsgCycleTime')} ms",
    "end-to-end protection": _protection,
}
_SIGNAL_FACTS: Mapping[str, Callable[[Signal], str]] = {
    "name": lambda signal: signal.name,
    "layout": _layout,
    "multiplexing": _multiplexing,
    "scale": lambda signal: f"({signal.scale:.10g},{signal.offset:.10g})",
    "range": lambda signal: f"[{_number(signal.minimum)}|{_number(signal.maximum)}]",
    "unit": lambda signal: signal.unit or "",
}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"
