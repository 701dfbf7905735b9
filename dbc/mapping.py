"""A site's own DBC under our names: which of its messages, signals, table entries and nodes is which of ours, and in what unit.

Everything above the catalogue speaks of the messages of `robots.dbc` and `gnss_imu.dbc`, in their units. A site whose robots have
another database writes one TOML file, and its messages are renamed and rescaled as they are read: nothing else has to know. Layout,
cycle times and end-to-end protection stay what the site's DBC says. One message of ours is one message of the site.

    [nodes]
    GW = "ADC"                                # ours = the site's

    [messages.SR_Command]
    name = "STEER_DEMAND"
    [messages.SR_Command.signals]
    AngleCommand = { name = "SWA_Dmd", factor = -57.29578 }    # the site says rad and counts to the right
    Enable = "SWA_On"
    Mode = { values = { AnglePosition = "POSITION" } }
"""

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cantools.database.can.message import Message
from cantools.database.can.signal import Signal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue
from pydantic import AfterValidator, Field, model_validator

from dbc.database import CatalogueError, DbcFile
from dbc.section import Section, misfit, read_section


def _not_zero(factor: float) -> float:
    if factor == 0.0:
        raise misfit("any number but 0")
    return factor


class SignalMapping(Section):
    """A signal of ours at the site; a plain text is its name alone.

    Args:
        name: the site's name of it; None when it is ours.
        factor, offset: our value = factor * the site's + offset. Needed where units differ.
        values: our entry of the value table to the site's; entries that are not here keep their names.
    """

    name: str | None = None
    factor: Annotated[float, AfterValidator(_not_zero)] | None = None
    offset: float = 0.0
    values: dict[str, str] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, content: Any) -> Any:  # noqa: ANN401 - whatever the file says
        return {"name": content} if isinstance(content, str) else content


class MessageMapping(Section):
    """A message of ours at the site, by the site's name; None when it is ours."""

    name: str | None = None
    signals: dict[str, SignalMapping] = Field(default_factory=dict)


class SiteMapping(Section):
    """What a mapping file says; the keys of all tables are our names.

    Args:
        nodes: our name of a node to the site's.
    """

    nodes: dict[str, str] = Field(default_factory=dict)
    messages: dict[str, MessageMapping] = Field(default_factory=dict)


def apply_mapping(path: Path, files: Iterable[DbcFile], ours: Iterable[DbcFile]) -> list[DbcFile]:
    """The files of a site with our names and units in place of its own.

    Args:
        path: mapping file.
        files: of the site.
        ours: the files whose names and units the project speaks.

    Raises:
        CatalogueError: the mapping does not fit; one line for each mistake, with file, key, value and what is allowed.
    """
    mapping = read_section(path, SiteMapping, CatalogueError)
    files = list(files)
    reference = {message.name: message for file in ours for message in file.messages}
    if mistakes := list(_Check(mapping, reference, files).mistakes()):
        raise CatalogueError("\n".join(f"{path}: {mistake}" for mistake in mistakes))
    return [replace(file, messages=tuple(_renamed(message, mapping, reference) for message in file.messages)) for file in files]


def _renamed(message: Message, mapping: SiteMapping, reference: Mapping[str, Message]) -> Message:
    """The message with our names and units."""
    our_names = {at_site.name or ours: ours for ours, at_site in mapping.messages.items()}
    our_nodes = {theirs: ours for ours, theirs in mapping.nodes.items()}
    name = our_names.get(message.name, message.name)
    at_site = mapping.messages.get(name, MessageMapping())
    our_signals = {signal.name or ours: ours for ours, signal in at_site.signals.items()}
    signals = []
    for signal in message.signals:
        renamed = _converted(signal, at_site.signals.get(our_signals.get(signal.name, signal.name), SignalMapping()))
        renamed.name = our_signals.get(signal.name, signal.name)
        renamed.receivers = [our_nodes.get(node, node) for node in signal.receivers]
        if signal.multiplexer_signal:
            renamed.multiplexer_signal = our_signals.get(signal.multiplexer_signal, signal.multiplexer_signal)
        if known := _find(reference, name, renamed.name):
            renamed.unit = known.unit
            renamed.raw_initial = _start(renamed, known)
        signals.append(renamed)
    return Message(
        frame_id=message.frame_id,
        name=name,
        length=message.length,
        signals=signals,
        senders=[our_nodes.get(node, node) for node in message.senders],
        dbc_specifics=message.dbc,
        is_extended_frame=message.is_extended_frame,
        is_fd=message.is_fd,
        strict=False,  # whoever reads the file decides how strict to be
    )


def _converted(signal: Signal, at_site: SignalMapping) -> Signal:
    """A copy of the signal with our values and the names of our table."""
    factor, offset = at_site.factor or 1.0, at_site.offset
    our_entries = {theirs: ours for ours, theirs in at_site.values.items()}
    choices: OrderedDict[int, str | NamedSignalValue] = OrderedDict(
        (raw, our_entries.get(str(entry), str(entry))) for raw, entry in (signal.choices or {}).items()
    )
    scale, shift = factor * signal.scale, factor * signal.offset + offset
    ends = [None if end is None else factor * end + offset for end in (signal.minimum, signal.maximum)]
    converted = copy(signal)
    converted.conversion = BaseConversion.factory(scale, shift, choices or None, signal.is_float)
    converted.minimum, converted.maximum = ends if factor > 0.0 else reversed(ends)
    return converted


def _start(signal: Signal, ours: Signal) -> int | float | None:
    """What a table signal is when nobody gives it: the entry that is 0 in our DBC, whatever number the site gives to it."""
    neutral = [str(entry) for raw, entry in (ours.choices or {}).items() if raw == 0]
    found = [raw for raw, entry in (signal.choices or {}).items() if str(entry) in neutral]
    return found[0] if found else signal.raw_initial


def _find(messages: Mapping[str, Message], message: str, signal: str) -> Signal | None:
    found = messages.get(message)
    return next((one for one in found.signals if one.name == signal), None) if found else None


class _Check:
    """All that can be wrong with a mapping, in the order of the file."""

    def __init__(self, mapping: SiteMapping, reference: Mapping[str, Message], files: list[DbcFile]) -> None:
        self._mapping = mapping
        self._reference = reference
        self._site = {message.name: message for file in files for message in file.messages}

    def mistakes(self) -> Iterator[str]:
        nodes = self._mapping.nodes
        yield from _unknown("nodes", nodes, _nodes(self._reference.values()))
        yield from _not_there("nodes", nodes, _nodes(self._site.values()))
        names = {ours: at_site.name or ours for ours, at_site in self._mapping.messages.items()}
        yield from _unknown("messages", names, self._reference)
        yield from _not_there("messages", names, self._site, ".name")
        yield from _ambiguous("messages", names, self._site, ".name")
        for ours, theirs in names.items():
            if ours in self._reference and theirs in self._site:
                yield from self._message(ours, self._site[theirs])
        yield from self._units(names)

    def _message(self, name: str, theirs: Message) -> Iterator[str]:
        signals = self._mapping.messages[name].signals
        known = {signal.name: signal for signal in self._reference[name].signals}
        there = {signal.name: signal for signal in theirs.signals}
        names = {ours: at_site.name or ours for ours, at_site in signals.items()}
        key = f"messages.{name}.signals"
        yield from _unknown(key, names, known)
        yield from _not_there(key, names, there, ".name")
        yield from _ambiguous(key, names, there, ".name")
        for ours, at_site in signals.items():
            if ours in known and names[ours] in there:
                yield from _table(f"{key}.{ours}", at_site, known[ours], there[names[ours]])

    def _units(self, names: Mapping[str, str]) -> Iterator[str]:
        """Signals that would silently be read in a unit that is not theirs."""
        our_names = {theirs: ours for ours, theirs in names.items()}
        for message in self._site.values():
            name = our_names.get(message.name, message.name)
            signals = self._mapping.messages.get(name, MessageMapping()).signals
            our_signals = {at_site.name or ours: ours for ours, at_site in signals.items()}
            for signal in message.signals:
                ours = our_signals.get(signal.name, signal.name)
                known = _find(self._reference, name, ours)
                is_stated = ours in signals and signals[ours].factor is not None
                if known and not is_stated and (known.unit or "") != (signal.unit or ""):
                    yield (
                        f"messages.{name}.signals.{ours}: {message.name}.{signal.name} is in {signal.unit or 'no unit'}, ours in "
                        f"{known.unit or 'no unit'}: needs a factor, 1.0 when both mean the same"
                    )


def _nodes(messages: Iterable[Message]) -> list[str]:
    messages = list(messages)
    senders = (node for message in messages for node in message.senders)
    receivers = (node for message in messages for signal in message.signals for node in signal.receivers)
    return sorted({*senders, *receivers})


def _table(key: str, at_site: SignalMapping, ours: Signal, theirs: Signal) -> Iterator[str]:
    """Mistakes in the value table of a signal that is there on both sides."""
    if ours.choices and (at_site.factor not in (None, 1.0) or at_site.offset):
        yield f"{key}: a signal with a value table has no factor and no offset"
    entries = [str(entry) for entry in (theirs.choices or {}).values()]
    yield from _unknown(f"{key}.values", at_site.values, [str(entry) for entry in (ours.choices or {}).values()])
    yield from _not_there(f"{key}.values", at_site.values, entries)
    yield from _ambiguous(f"{key}.values", at_site.values, entries)


def _unknown(key: str, ours: Iterable[str], known: Iterable[str]) -> Iterator[str]:
    """Names that are not ours."""
    known = list(known)
    return (f"{key}.{name}: unknown key, allowed: {', '.join(known) or 'none'}" for name in ours if name not in known)


def _not_there(key: str, names: Mapping[str, str], there: Iterable[str], last: str = "") -> Iterator[str]:
    """Names that are not the site's, or that two of ours claim."""
    there = list(there)
    claimed: dict[str, str] = {}
    for ours, theirs in names.items():
        if theirs not in there:
            yield f"{key}.{ours}{last} = {theirs!r}: not in the DBC, allowed: {', '.join(there) or 'none'}"
        elif theirs in claimed:
            yield f"{key}.{ours}{last} = {theirs!r}: is {claimed[theirs]} already"
        claimed.setdefault(theirs, ours)


def _ambiguous(key: str, names: Mapping[str, str], there: Iterable[str], last: str = "") -> Iterator[str]:
    """Names of ours that the site also has, for something else."""
    own = set(there) - set(names.values())
    for ours, theirs in names.items():
        if ours in own:
            yield f"{key}.{ours}{last} = {theirs!r}: the DBC has another {ours}: rename it there"
