"""Message catalogue built from the DBC files: the only place that knows identifiers, lengths, cycles and bit positions.

The DBC is the source of truth. Cycle time, timeout and end-to-end protection come from its attributes
`GenMsgCycleTime`, `GenMsgTimeout`, `E2EProfile` and `E2EDataId`; the bus on which the messages of a file travel, and its bit
rate, from `BusName` and `Baudrate`.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cantools
from cantools.database.can.database import Database
from cantools.database.can.message import Message
from cantools.database.errors import Error as CantoolsError

from dbc.e2e import COUNTER_START_BIT, CRC_START_BIT, PROFILE
from dbc.errors import UserMistake
from dbc.frame import CanFrame
from dbc.packing import DecodeError, EncodeError, Packing, packing_of

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
]

ROBOTS_DBC = Path(__file__).with_name("robots.dbc")
GNSS_IMU_DBC = Path(__file__).with_name("gnss_imu.dbc")

ROBOTS, NAVIGATION = NETWORKS = ("robots", "navigation")
"""The buses of a car with driving robots: what `BusName` of a DBC file may say."""

_DEFAULT_BITRATE_BPS = 500_000
_MAX_BITRATE_BPS = 1_000_000
_NS_PER_MS = 1_000_000
_CRC_SIGNAL = "Crc"
_COUNTER_SIGNAL = "AliveCounter"


class CatalogueError(UserMistake):
    """A DBC file cannot be used; the text names the file and the message."""


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

    Args:
        messages: each with the network that it travels on.
        bitrate_bps: of every network [bit/s].
    """

    def __init__(self, messages: Iterable[tuple[Message, str]], sha256: Mapping[str, str], bitrate_bps: Mapping[str, int]) -> None:
        self.sha256 = dict(sha256)
        self.bitrate_bps = dict(bitrate_bps)
        self._messages: dict[str, Message] = {}
        self._packings: dict[str, Packing] = {}
        self._signals: dict[str, dict[str, None]] = {}
        self.by_name: dict[str, MessageSpec] = {}
        self.by_id: dict[int, MessageSpec] = {}
        for message, network in messages:
            self._add(message, network)

    def _add(self, message: Message, network: str) -> None:
        spec = _spec_of(message, network)
        if spec.name in self.by_name or spec.arbitration_id in self.by_id:
            raise CatalogueError(f"message {spec.name} (id 0x{spec.arbitration_id:X}) is defined twice")
        self.by_name[spec.name] = spec
        self.by_id[spec.arbitration_id] = spec
        self._messages[spec.name] = message
        self._packings[spec.name] = packing_of(message)
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


def load(paths: Iterable[Path] = (ROBOTS_DBC, GNSS_IMU_DBC)) -> Catalogue:
    """Read DBC files into one catalogue.

    Raises:
        CatalogueError: a file is missing, does not parse, or clashes with another.
    """
    messages: list[tuple[Message, str]] = []
    sha256: dict[str, str] = {}
    bitrate_bps: dict[str, int] = {}
    for path in paths:
        try:
            content = path.read_bytes()
            database = cantools.database.load_string(content.decode("latin-1"), database_format="dbc")
        except OSError as error:
            raise CatalogueError(f"{path}: {error.strerror or error}") from error
        except (CantoolsError, ValueError) as error:
            raise CatalogueError(f"{path}: not a usable DBC: {' '.join(str(error).split())}") from error
        network, rate_bps = _network_of(path, database)  # type: ignore[arg-type]
        if bitrate_bps.setdefault(network, rate_bps) != rate_bps:
            raise CatalogueError(f"{path}: Baudrate {rate_bps}: another file gives bus {network} {bitrate_bps[network]} bit/s")
        messages += [(message, network) for message in database.messages]  # type: ignore[union-attr]
        sha256[path.name] = hashlib.sha256(content).hexdigest()
    return Catalogue(messages, sha256, dict.fromkeys(NETWORKS, _DEFAULT_BITRATE_BPS) | bitrate_bps)


def _network_of(path: Path, database: Database) -> tuple[str, int]:
    """The bus that a file is about, and its bit rate; a file that names none is about the robots' bus, as one for everything is."""
    stated: dict[str, object] = {}
    if database.dbc is not None:
        stated = {name: definition.default_value for name, definition in database.dbc.attribute_definitions.items()}
        stated |= {name: attribute.value for name, attribute in database.dbc.attributes.items()}
    network, bitrate_bps = stated.get("BusName") or ROBOTS, stated.get("Baudrate") or _DEFAULT_BITRATE_BPS
    if not (isinstance(network, str) and network in NETWORKS):
        raise CatalogueError(f"{path}: BusName {network!r}: expected {' or '.join(NETWORKS)}")
    if not (isinstance(bitrate_bps, int) and 0 < bitrate_bps <= _MAX_BITRATE_BPS):
        raise CatalogueError(f"{path}: Baudrate {bitrate_bps} outside [1, {_MAX_BITRATE_BPS}]")
    return network, bitrate_bps


def _spec_of(message: Message, network: str) -> MessageSpec:
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
        network=network,
    )
