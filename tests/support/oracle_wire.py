"""What the bus oracle reads off the wire: its own bit extraction and its own CRC, so that no mistake of the product is repeated here.

Only the text of the DBC files is shared with the product; cantools parses it, and nothing else of cantools is used.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cantools

_DBC = Path(__file__).resolve().parents[2] / "dbc"
DBC_FILES = (_DBC / "robots.dbc", _DBC / "gnss_imu.dbc")
GATEWAY = "GW"
_DEFAULT_NETWORK = "robots"

_POLYNOMIAL = 0x2F  # AUTOSAR SWS_CRCLibrary: CRC-8H2F, initial value and final XOR 0xFF
_PROTECTED_FROM = 1  # AUTOSAR SWS_E2ELibrary, profile 2: byte 0 is the CRC, low nibble of byte 1 the counter


def crc8h2f(content: bytes) -> int:
    """CRC-8H2F bit by bit, as the standard's definition reads."""
    crc = 0xFF
    for byte in content:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ 0xFF


_SHIFTED = [crc8h2f(bytes([0xFF ^ byte])) ^ 0xFF for byte in range(256)]
"""What eight shifts make of each value of the register, from the same definition."""


def profile2_crc(payload: bytes, data_id: int) -> int:
    """CRC of a protected payload: over all but byte 0, then the data id."""
    crc = 0xFF
    for byte in payload[_PROTECTED_FROM:]:
        crc = _SHIFTED[crc ^ byte]
    return _SHIFTED[crc ^ data_id] ^ 0xFF


def counter_of(payload: bytes) -> int:
    """Alive counter of a protected payload."""
    return payload[1] & 0x0F


def bit_positions(start: int, length: int, *, is_motorola: bool) -> list[tuple[int, int]]:
    """(byte, bit) of each bit of a signal, the most significant first.

    A DBC names the least significant bit of an Intel signal and the most significant one of a Motorola signal; Motorola signals go down
    within a byte and on at bit 7 of the next.
    """
    if not is_motorola:
        return [divmod(position, 8) for position in range(start + length - 1, start - 1, -1)]
    positions = [divmod(start, 8)]
    while len(positions) < length:
        byte, bit = positions[-1]
        positions.append((byte, bit - 1) if bit else (byte + 1, 7))
    return positions


def signal_reader(start: int, length: int, *, is_motorola: bool, is_signed: bool, scale: float, offset: float) -> Callable[[bytes], float]:
    """Function from a payload to the physical value of one signal."""
    sign = 1 << length - 1 if is_signed else 0
    if not is_motorola:
        mask = (1 << length) - 1
        return lambda data: (((int.from_bytes(data, "little") >> start & mask) ^ sign) - sign) * scale + offset
    positions = bit_positions(start, length, is_motorola=True)

    def read(data: bytes) -> float:
        raw = 0
        for byte, bit in positions:
            raw = raw << 1 | (data[byte] >> bit & 1)
        return ((raw ^ sign) - sign) * scale + offset

    return read


class Field(NamedTuple):
    """Place and scale of a signal; its bits as (byte, bit), the most significant first."""

    bits: list[tuple[int, int]]
    scale: float
    offset: float


@dataclass(frozen=True)
class WireMessage:
    """One message as the DBC has it.

    Args:
        cycle_ns: nominal period [ns]; 0 when it is not cyclic.
        data_id: of AUTOSAR E2E profile 2, None for an unprotected message.
        readers: by signal.
        choices: of each enumerated signal, raw value to name.
        fields: by signal, for composing.
    """

    name: str
    arbitration_id: int
    length: int
    network: str
    sender: str
    cycle_ns: int
    data_id: int | None
    readers: dict[str, Callable[[bytes], float]]
    choices: dict[str, dict[int, str]]
    fields: "dict[str, Field]"

    def compose(self, values: dict[str, float | str], counter: int = 0) -> bytes:
        """Payload with these physical values, or names of enumerated ones, all else zero; protected where the DBC asks for it."""
        return self.sealed(self.changed(bytes(self.length), values), counter)

    def changed(self, data: bytes, values: dict[str, float | str]) -> bytes:
        """The payload with these values, and protection that no longer fits."""
        content = bytearray(data)
        for signal, value in values.items():
            field = self.fields[signal]
            if isinstance(value, str):
                raw = next(raw for raw, name in self.choices[signal].items() if name == value)
            else:
                raw = round((value - field.offset) / field.scale)
            for k, (byte, bit) in enumerate(reversed(field.bits)):
                content[byte] = content[byte] & ~(1 << bit) | (raw >> k & 1) << bit
        return bytes(content)

    def sealed(self, data: bytes, counter: int) -> bytes:
        """The payload with this counter and the CRC that fits; as it is where the message is not protected."""
        if self.data_id is None:
            return data
        content = bytearray(data)
        content[1] = content[1] & 0xF0 | counter % 16
        content[0] = profile2_crc(bytes(content), self.data_id)
        return bytes(content)

    def value(self, data: bytes, signal: str) -> float:
        """Physical value of a signal."""
        return self.readers[signal](data)

    def choice(self, data: bytes, signal: str) -> str:
        """Name of the value of an enumerated signal."""
        return self.choices[signal].get(int(self.readers[signal](data)), "?")


class Wire:
    """All messages, by (network, identifier) and by name. Copies of an oracle share it."""

    def __init__(self, files: Iterable[Path] = DBC_FILES) -> None:
        self.by_name: dict[str, WireMessage] = {}
        self.by_id: dict[tuple[str, int], WireMessage] = {}
        for path in files:
            database: Any = cantools.database.load_file(path, database_format="dbc", strict=False, encoding="latin-1")
            stated = {name: attribute.value for name, attribute in database.dbc.attributes.items()}
            for message in database.messages:
                read = _read(message, str(stated.get("BusName") or _DEFAULT_NETWORK))
                self.by_name[read.name] = self.by_id[read.network, read.arbitration_id] = read

    def __deepcopy__(self, memo: dict[int, object]) -> "Wire":
        return self

    def of_gateway(self) -> list[WireMessage]:
        """The messages that the gateway may send: its allow-list."""
        return [message for message in self.by_name.values() if message.sender == GATEWAY]


def _read(message: Any, network: str) -> WireMessage:
    attributes = {name: attribute.value for name, attribute in message.dbc.attributes.items()}
    readers = {
        signal.name: signal_reader(
            signal.start, signal.length, is_motorola=signal.byte_order == "big_endian",
            is_signed=signal.is_signed, scale=signal.scale, offset=signal.offset,
        )
        for signal in message.signals
    }
    fields = {
        signal.name: Field(
            bit_positions(signal.start, signal.length, is_motorola=signal.byte_order == "big_endian"), signal.scale, signal.offset
        )
        for signal in message.signals
    }
    choices = {
        signal.name: {int(raw): str(name) for raw, name in signal.choices.items()} for signal in message.signals if signal.choices
    }
    return WireMessage(
        name=message.name, arbitration_id=message.frame_id, length=message.length, network=network,
        sender=message.senders[0] if message.senders else "", cycle_ns=int(attributes.get("GenMsgCycleTime", 0)) * 1_000_000,
        data_id=int(attributes["E2EDataId"]) if attributes.get("E2EProfile") else None, readers=readers, choices=choices, fields=fields,
    )
