"""Message catalogue built from the DBC files: the only place that knows identifiers, lengths, cycles and bit positions.

The DBC is the source of truth. Cycle time, timeout and end-to-end protection come from its attributes
`GenMsgCycleTime`, `GenMsgTimeout`, `E2EProfile` and `E2EDataId`; the bus on which the messages of a file travel, and its bit
rate, from `BusName` and `Baudrate`. A site whose DBC has names and units of its own maps them to ours in one TOML file.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from cantools.database.can.message import Message

from dbc.database import NAVIGATION, NETWORKS, ROBOTS, CatalogueError, DbcFile, attributes_of, bitrates, read_dbc
from dbc.e2e import COUNTER_BITS, COUNTER_START_BIT, CRC_BITS, CRC_START_BIT, PROFILE, tells_stuck_bits
from dbc.frame import CanFrame
from dbc.mapping import apply_mapping
from dbc.packing import DecodeError, EncodeError, Packing, bits_of, packing_of

__all__ = [
    "GNSS_IMU_DBC",
    "NAVIGATION",
    "NETWORKS",
    "ROBOTS",
    "ROBOTS_DBC",
    "Catalogue",
    "CatalogueError",
    "DecodeError",
    "EncodeError",
    "MessageSpec",
    "load",
    "read_files",
    "spec_of",
]

ROBOTS_DBC = Path(__file__).with_name("robots.dbc")
GNSS_IMU_DBC = Path(__file__).with_name("gnss_imu.dbc")

MAX_LENGTH_BYTES = 8
"""Payload of a classical frame."""

E2E_SIGNALS = {
    "Crc": list(range(CRC_START_BIT, CRC_START_BIT + CRC_BITS)),
    "AliveCounter": list(range(COUNTER_START_BIT, COUNTER_START_BIT + COUNTER_BITS)),
}
"""Signals of a protected message, and the bits that the profile gives them."""

_NS_PER_MS = 1_000_000


@dataclass(frozen=True, slots=True)
class MessageSpec:
    """What the DBC says about one message.

    Args:
        sender: the node that transmits it, which gives the direction.
        cycle_time_ns: nominal period [ns]; 0 for a message that is not cyclic.
        timeout_ns: age from which a receiver must call it missing [ns]; 0 for no supervision.
        e2e_data_id: AUTOSAR E2E data id, or None for an unprotected message.
        network: the bus that it travels on, one of `NETWORKS`.
    """

    name: str
    arbitration_id: int
    length_bytes: int
    cycle_time_ns: int
    timeout_ns: int
    sender: str
    e2e_data_id: int | None
    network: str


class Catalogue:
    """All messages of a set of DBC files, by name and by arbitration id.

    Attributes:
        sha256: hash of every file that it is made from, by its name.
        bitrate_bps: of every network [bit/s].

    Raises:
        CatalogueError: a message cannot be used; the text names it and its file.
    """

    def __init__(self, files: Iterable[DbcFile]) -> None:
        files = list(files)
        self.sha256 = {file.path.name: file.sha256 for file in files}
        self.bitrate_bps = bitrates(files)
        self._messages: dict[str, Message] = {}
        self._packings: dict[str, Packing] = {}
        self._signals: dict[str, dict[str, None]] = {}
        self.by_name: dict[str, MessageSpec] = {}
        self.by_id: dict[int, MessageSpec] = {}
        for file in files:
            for message in file.messages:
                self._add(message, file)

    def _add(self, message: Message, file: DbcFile) -> None:
        try:
            spec = spec_of(message, file.network)
            if spec.name in self.by_name or spec.arbitration_id in self.by_id:
                raise CatalogueError(f"message {spec.name} (id 0x{spec.arbitration_id:X}) is defined twice")
            self._packings[spec.name] = packing_of(message)
        except (CatalogueError, EncodeError) as error:
            raise CatalogueError(f"{file.path}: {error}") from error
        self.by_name[spec.name] = spec
        self.by_id[spec.arbitration_id] = spec
        self._messages[spec.name] = message
        self._signals[spec.name] = dict.fromkeys(signal.name for signal in message.signals)

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
        return tuple(self._signals[name])

    def bounds(self, name: str, signal: str) -> tuple[float, float]:
        """Smallest and largest physical value of a signal, in the unit of the DBC; infinite where it states none."""
        found = self._messages[name].get_signal_by_name(signal)
        return (
            -math.inf if found.minimum is None else float(found.minimum),
            math.inf if found.maximum is None else float(found.maximum),
        )

    def resolution(self, name: str, signal: str) -> tuple[float, float]:
        """Smallest step of a signal and one value that it can have, in the unit of the DBC; the step is 0 in floating point."""
        found = self._messages[name].get_signal_by_name(signal)
        return 0.0 if found.is_float else abs(float(found.scale)), float(found.offset)

    def enumeration(self, name: str, signal: str) -> dict[str, int]:
        """Value table of a signal: entry name to raw value."""
        choices: Mapping[int, object] = self._messages[name].get_signal_by_name(signal).choices or {}
        return {str(entry): int(raw) for raw, entry in choices.items()}

    def encode(self, name: str, values: Mapping[str, float], saturates: bool = False) -> bytes:
        """Payload of message `name`; signals not given take their neutral value, CRC and counter are left for E2E.

        Of a multiplexed message only one page is there: the one that the multiplexer names, or the one of the signals given.

        Args:
            saturates: whether a value outside the DBC's range becomes the nearest in it, as an instrument does it.

        Raises:
            EncodeError: unknown signal, not a number, or outside the DBC's range.
        """
        if not values.keys() <= (known := self._signals[name].keys()):
            raise EncodeError(f"{name}: no signal {', '.join(sorted(values.keys() - known))}")
        return self._packings[name].pack(values, saturates)

    def decode(self, spec: MessageSpec, frame: CanFrame) -> dict[str, float]:
        """Physical signal values of a frame, in the DBC's units; enumerations stay raw numbers.

        Raises:
            DecodeError: wrong length, or a value outside the range that the DBC allows.
        """
        if len(frame.data) != spec.length_bytes:
            raise DecodeError(f"{spec.name}: {len(frame.data)} bytes, expected {spec.length_bytes}")
        return self._packings[spec.name].unpack(frame.data)


def load(paths: Iterable[Path] = (ROBOTS_DBC, GNSS_IMU_DBC), mapping: Path | None = None) -> Catalogue:
    """The catalogue of these DBC files.

    Args:
        mapping: TOML file that says which names and units of the files are ours, see `dbc.mapping`; None when all are.

    Raises:
        CatalogueError: a file is missing or malformed, or one identifier, name or bus is defined twice.
    """
    catalogue = Catalogue(read_files(paths, mapping))
    if mapping is not None:
        catalogue.sha256[mapping.name] = hashlib.sha256(mapping.read_bytes()).hexdigest()
    return catalogue


def read_files(paths: Iterable[Path], mapping: Path | None = None, is_strict: bool = True) -> list[DbcFile]:
    """These DBC files as they are, or under our names.

    Args:
        mapping: as for `load`.
        is_strict: whether signals that overlap or reach beyond their message make a file unusable.

    Raises:
        CatalogueError: a file is missing or malformed, or the mapping does not fit it.
    """
    files = [read_dbc(path, is_strict) for path in paths]
    return files if mapping is None else apply_mapping(mapping, files, [read_dbc(ROBOTS_DBC), read_dbc(GNSS_IMU_DBC)])


def spec_of(message: Message, network: str) -> MessageSpec:
    """What a message says of itself.

    Raises:
        CatalogueError: it cannot be used; the text names it.
    """
    if message.is_extended_frame or message.length > MAX_LENGTH_BYTES:
        raise CatalogueError(f"message {message.name}: only classical frames with an 11-bit identifier and up to 8 bytes are supported")
    names = [signal.name for signal in message.signals]
    for signal in message.signals:
        if names.count(signal.name) > 1 or signal.scale == 0:
            raise CatalogueError(f"message {message.name}: signal {signal.name} is defined twice or has the factor 0")
    attributes = attributes_of(message)
    return MessageSpec(
        name=message.name,
        arbitration_id=message.frame_id,
        length_bytes=message.length,
        cycle_time_ns=_whole(message, attributes, "GenMsgCycleTime") * _NS_PER_MS,
        timeout_ns=_whole(message, attributes, "GenMsgTimeout") * _NS_PER_MS,
        sender=message.senders[0] if message.senders else "",
        e2e_data_id=_data_id(message, attributes) if attributes.get("E2EProfile") else None,
        network=network,
    )


def _data_id(message: Message, attributes: Mapping[str, object]) -> int:
    if (profile := attributes["E2EProfile"]) != PROFILE:
        raise CatalogueError(f"message {message.name}: E2EProfile {profile!r} is not supported, only {PROFILE!r}")
    data_id = _whole(message, attributes, "E2EDataId")
    if not 1 <= data_id <= 255:
        raise CatalogueError(f"message {message.name}: E2EDataId {data_id} outside [1, 255]")
    for name, bits in E2E_SIGNALS.items():
        if not any(signal.name == name and bits_of(signal) == bits for signal in message.signals):
            raise CatalogueError(f"message {message.name}: E2E profile {PROFILE} needs signal {name} at bits {bits[0]} to {bits[-1]}")
    if not tells_stuck_bits(data_id, message.length):
        raise CatalogueError(f"message {message.name}: E2EDataId {data_id} lets a payload of equal bits pass: allowed: another one")
    return data_id


def _whole(message: Message, attributes: Mapping[str, object], name: str) -> int:
    """An attribute that counts something; 0 where there is none."""
    value = attributes.get(name) or 0
    if not (isinstance(value, int) and value >= 0):
        raise CatalogueError(f"message {message.name}: {name} {value!r}: allowed: a whole number from 0 on")
    return value
