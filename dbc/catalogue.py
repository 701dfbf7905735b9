"""Message catalogue built from the DBC files: the only place that knows identifiers, lengths, cycles and bit positions.

The DBC is the source of truth. Cycle time, timeout and end-to-end protection come from its attributes
`GenMsgCycleTime`, `GenMsgTimeout`, `E2EProfile` and `E2EDataId`.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cantools
from cantools.database.can.message import Message
from cantools.database.can.signal import Signal
from cantools.database.errors import Error as CantoolsError

from dbc.e2e import COUNTER_START_BIT, CRC_START_BIT, PROFILE
from dbc.errors import UserMistake
from dbc.frame import CanFrame

ROBOTS_DBC = Path(__file__).with_name("robots.dbc")
GNSS_IMU_DBC = Path(__file__).with_name("gnss_imu.dbc")

_NS_PER_MS = 1_000_000
_CRC_SIGNAL = "Crc"
_COUNTER_SIGNAL = "AliveCounter"


class CatalogueError(UserMistake):
    """A DBC file cannot be used; the text names the file and the message."""


class EncodeError(Exception):
    """Signal values that the DBC does not allow: our own mistake, never the bus's."""


class DecodeError(Exception):
    """A received frame that does not fit its message; the text is the cause."""


@dataclass(frozen=True, slots=True)
class MessageSpec:
    """What the DBC says about one message.

    Args:
        sender: the node that transmits it, which gives the direction.
        cycle_time_ns: nominal period [ns]; 0 for a message that is not cyclic.
        timeout_ns: age from which a receiver must call it missing [ns]; 0 for no supervision.
        e2e_data_id: AUTOSAR E2E data id, or None for an unprotected message.
    """

    name: str
    arbitration_id: int
    length_bytes: int
    cycle_time_ns: int
    timeout_ns: int
    sender: str
    e2e_data_id: int | None


class Catalogue:
    """All messages of a set of DBC files, by name and by arbitration id."""

    def __init__(self, messages: Iterable[Message], sha256: Mapping[str, str]) -> None:
        self.sha256 = dict(sha256)
        self._messages: dict[str, Message] = {}
        self._ranges: dict[str, tuple[tuple[str, float, float], ...]] = {}
        self._start_values: dict[str, dict[str, float]] = {}
        self.by_name: dict[str, MessageSpec] = {}
        self.by_id: dict[int, MessageSpec] = {}
        for message in messages:
            self._add(message)

    def _add(self, message: Message) -> None:
        spec = _spec_of(message)
        if spec.name in self.by_name or spec.arbitration_id in self.by_id:
            raise CatalogueError(f"message {spec.name} (id 0x{spec.arbitration_id:X}) is defined twice")
        self.by_name[spec.name] = spec
        self.by_id[spec.arbitration_id] = spec
        self._messages[spec.name] = message
        self._ranges[spec.name] = tuple(_range_of(s) for s in message.signals)
        # A database need not give start values: neutral is zero, or the nearest value the signal can take.
        self._start_values[spec.name] = {
            name: float(min(max(0.0, minimum), maximum)) for name, minimum, maximum in self._ranges[spec.name]
        }

    def require(self, names: Iterable[str], user: str) -> None:
        """Check that the messages which `user` works with are there.

        Raises:
            CatalogueError: some are not; all of them are named.
        """
        if missing := [name for name in names if name not in self.by_name]:
            files = ", ".join(self.sha256)
            raise CatalogueError(f"{files}: no message {', '.join(missing)}, which the {user} needs")

    def signals(self, name: str) -> tuple[str, ...]:
        """Names of the signals of message `name`, in the order of the DBC."""
        return tuple(signal for signal, _, _ in self._ranges[name])

    def bounds(self, name: str, signal: str) -> tuple[float, float]:
        """Smallest and largest physical value of a signal, in the unit of the DBC; infinite where it states none."""
        found = self._messages[name].get_signal_by_name(signal)
        return (
            -math.inf if found.minimum is None else float(found.minimum),
            math.inf if found.maximum is None else float(found.maximum),
        )

    def enumeration(self, name: str, signal: str) -> dict[str, int]:
        """Value table of a signal: entry name to raw value."""
        choices: Mapping[int, object] = self._messages[name].get_signal_by_name(signal).choices or {}
        return {str(entry): int(raw) for raw, entry in choices.items()}

    def encode(self, name: str, values: Mapping[str, float]) -> bytes:
        """Payload of message `name`; signals not given take their neutral value, CRC and counter are left for E2E.

        Raises:
            EncodeError: unknown signal, not finite, or outside the DBC's range.
        """
        if unknown := values.keys() - self._start_values[name].keys():
            raise EncodeError(f"{name}: no signal {', '.join(sorted(unknown))}")
        complete = {**self._start_values[name], **values}
        for signal, low, high in self._ranges[name]:
            if not low <= complete[signal] <= high:  # NaN fails both comparisons
                raise EncodeError(f"{name}.{signal} = {complete[signal]} outside [{low}, {high}]")
        # cantools' own strict check says the same at three times the cost.
        return bytes(self._messages[name].encode(complete, strict=False))

    def decode(self, spec: MessageSpec, frame: CanFrame) -> dict[str, float]:
        """Physical signal values of a frame, in the DBC's units; enumerations stay raw numbers.

        Raises:
            DecodeError: wrong length, or a value outside the range that the DBC allows.
        """
        if len(frame.data) != spec.length_bytes:
            raise DecodeError(f"{spec.name}: {len(frame.data)} bytes, expected {spec.length_bytes}")
        try:
            values: dict[str, float] = self._messages[spec.name].decode(frame.data, decode_choices=False)  # type: ignore[assignment]
        except (CantoolsError, ValueError) as error:
            raise DecodeError(f"{spec.name}: {error}") from error
        for signal, low, high in self._ranges[spec.name]:
            if signal in values and not low <= values[signal] <= high:
                raise DecodeError(f"{spec.name}.{signal} = {values[signal]} outside [{low}, {high}]")
        return values


def load(paths: Iterable[Path] = (ROBOTS_DBC, GNSS_IMU_DBC)) -> Catalogue:
    """Read DBC files into one catalogue.

    Raises:
        CatalogueError: a file is missing, does not parse, or clashes with another.
    """
    messages: list[Message] = []
    sha256: dict[str, str] = {}
    for path in paths:
        try:
            content = path.read_bytes()
            database = cantools.database.load_string(content.decode("latin-1"), database_format="dbc")
        except OSError as error:
            raise CatalogueError(f"{path}: {error.strerror or error}") from error
        except (CantoolsError, ValueError) as error:
            raise CatalogueError(f"{path}: not a usable DBC: {' '.join(str(error).split())}") from error
        messages += database.messages  # type: ignore[union-attr]
        sha256[path.name] = hashlib.sha256(content).hexdigest()
    return Catalogue(messages, sha256)


def _range_of(signal: Signal) -> tuple[str, float, float]:
    """Name, smallest and largest value, half a bit wider than in the DBC: factors are decimal, floats are not."""
    half_bit = 0.5 * abs(float(signal.scale))
    low = -math.inf if signal.minimum is None else float(signal.minimum) - half_bit
    high = math.inf if signal.maximum is None else float(signal.maximum) + half_bit
    return signal.name, low, high


def _spec_of(message: Message) -> MessageSpec:
    attributes = {name: a.value for name, a in message.dbc.attributes.items()} if message.dbc else {}
    data_id: int | None = None
    if profile := attributes.get("E2EProfile", ""):
        if profile != PROFILE:
            raise CatalogueError(f"message {message.name}: E2EProfile {profile!r} is not supported, only {PROFILE!r}")
        data_id = int(attributes.get("E2EDataId", 0))
        # Data id 0 would let an all-zero frame pass the CRC.
        if not 1 <= data_id <= 255:
            raise CatalogueError(f"message {message.name}: E2EDataId {data_id} outside [1, 255]")
        for signal, start in ((_CRC_SIGNAL, CRC_START_BIT), (_COUNTER_SIGNAL, COUNTER_START_BIT)):
            if not any(s.name == signal and s.start == start for s in message.signals):
                raise CatalogueError(f"message {message.name}: E2E profile {PROFILE} needs signal {signal} at bit {start}")
    return MessageSpec(
        name=message.name,
        arbitration_id=message.frame_id,
        length_bytes=message.length,
        cycle_time_ns=int(attributes.get("GenMsgCycleTime", 0)) * _NS_PER_MS,
        timeout_ns=int(attributes.get("GenMsgTimeout", 0)) * _NS_PER_MS,
        sender=message.senders[0] if message.senders else "",
        e2e_data_id=data_id,
    )
