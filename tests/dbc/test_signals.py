"""Tests made from the DBC files: every message and every signal of robots, navigation system and a site with another layout.

Where bits belong is worked out here once more, naively, and cantools is the independent reader.
"""

import math
import random
from pathlib import Path

import cantools
import numpy as np
import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS, ROBOTS_DBC, Catalogue, DecodeError, EncodeError
from dbc.database import DbcFile
from dbc.frame import CanFrame

SITE_DBC = Path(__file__).parent.parent / "support" / "site_robots.dbc"
FILES = (ROBOTS_DBC, GNSS_IMU_DBC, SITE_DBC)


def unprotected(message):
    """The message without its attribute for protection."""
    message.dbc.attributes.pop("E2EProfile", None)
    return message


READ = {path: cantools.database.load_file(str(path)).messages for path in FILES}
# As layouts alone: protection needs names that the site's file has under its mapping only.
CATALOGUES = {path: Catalogue([DbcFile(path, "", ROBOTS, 500_000, tuple(map(unprotected, messages)))]) for path, messages in READ.items()}
MESSAGES = [(path, message) for path, messages in READ.items() for message in messages]
SIGNALS = [(path, message, signal) for path, message in MESSAGES for signal in message.signals]
EXHAUSTIVE_BITS = 16
SAMPLES = 300


def by_name(value):
    return getattr(value, "name", None)


def kind(signal):
    """All of a signal that the arithmetic of packing sees; where its bits are is another matter."""
    return (signal.length, signal.is_signed, signal.scale, signal.offset, signal.minimum, signal.maximum)


FIRST_OF_KIND = {id(signal) for signal in {kind(signal): signal for _, _, signal in reversed(SIGNALS)}.values()}


def places(signal):
    """Bits of a signal from the lowest on, as (byte, bit), found by walking."""
    byte, bit = divmod(signal.start, 8)
    walked = []
    for _ in range(signal.length):
        walked.append((byte, bit))
        if signal.byte_order == "little_endian":
            byte, bit = (byte, bit + 1) if bit < 7 else (byte + 1, 0)
        else:
            byte, bit = (byte, bit - 1) if bit > 0 else (byte + 1, 7)
    return walked if signal.byte_order == "little_endian" else walked[::-1]


def payloads(path, message, signal, raws):
    """One payload for each raw value, the rest of the message neutral."""
    page = {signal.multiplexer_signal: signal.multiplexer_ids[0]} if signal.multiplexer_ids else {}
    neutral = np.frombuffer(CATALOGUES[path].encode(message.name, page), np.uint8)
    made = np.tile(neutral, (len(raws), 1))
    for index, (byte, bit) in enumerate(places(signal)):
        made[:, byte] = made[:, byte] & ~np.uint8(1 << bit) | ((raws >> index & 1) << bit).astype(np.uint8)
    return [row.tobytes() for row in made]


def raw_values(signal, is_exhaustive):
    """All raw values, or some that set every bit, reach both ends, and are spread over the rest."""
    lowest = -(1 << signal.length - 1) if signal.is_signed else 0
    highest = lowest + (1 << signal.length) - 1
    if is_exhaustive:
        return np.arange(lowest, highest + 1, dtype=np.int64)
    rng = random.Random(f"{signal.name} {signal.start}")
    ends = [lowest, lowest + 1, -1, 0, 1, highest - 1, highest, *(1 << bit for bit in range(signal.length))]
    chosen = {raw for raw in ends if lowest <= raw <= highest} | {rng.randint(lowest, highest) for _ in range(SAMPLES)}
    return np.array(sorted(chosen), dtype=np.int64)


def bits_alone(signal):
    return sum(1 << 8 * byte + bit for byte, bit in places(signal))


def round_trip(path, message, signal, is_exhaustive):
    """Every raw value from its payload and back, and what is half a bit beside it; what is out of range is refused."""
    catalogue, spec = CATALOGUES[path], CATALOGUES[path].by_name[message.name]
    raws = raw_values(signal, is_exhaustive)
    if signal.is_multiplexer:
        raws = raws[raws <= 3]  # pages that are not there have a test of their own
    half = 0.499 * abs(signal.scale)
    values = raws * signal.scale + signal.offset
    is_allowed = (values >= signal.minimum - half) & (values <= signal.maximum + half)
    beside = np.random.default_rng(1).uniform(-0.49, 0.49, len(raws)) * signal.scale
    nearby = np.clip(values + beside, signal.minimum, signal.maximum)
    cases = zip(payloads(path, message, signal, raws), values.tolist(), nearby.tolist(), is_allowed.tolist(), strict=True)
    for payload, value, near, may_be in cases:
        try:
            read = catalogue.decode(spec, CanFrame(spec.arbitration_id, payload, 0))[signal.name]
        except DecodeError as error:
            read = str(error).partition(" outside")[0]
        assert read == (value if may_be else f"{message.name}.{signal.name} = {value}")
        assert not may_be or catalogue.encode(message.name, {signal.name: near}) == payload
    return len(raws), len(raws) - int(is_allowed.sum())


@pytest.mark.req("G3")
@pytest.mark.parametrize(("path", "message", "signal"), SIGNALS, ids=by_name)
def test_round_trip_within_half_a_bit(path, message, signal):
    """Exhaustive for the first of all signals that are alike but for the place of their bits; of the others every bit."""
    is_first = id(signal) in FIRST_OF_KIND and not message.is_multiplexed()
    is_exhaustive = signal.length <= 8 or (signal.length <= EXHAUSTIVE_BITS and is_first)
    count, refused = round_trip(path, message, signal, is_exhaustive)
    assert 0 <= refused < count
    assert count == 1 << signal.length or not is_exhaustive or signal.is_multiplexer


@pytest.mark.long
@pytest.mark.req("G3")
@pytest.mark.parametrize(("path", "message", "signal"), SIGNALS, ids=by_name)
def test_round_trip_of_every_value(path, message, signal):
    count, _ = round_trip(path, message, signal, is_exhaustive=signal.length <= EXHAUSTIVE_BITS)
    assert count == 1 << signal.length or signal.length > EXHAUSTIVE_BITS or signal.is_multiplexer


@pytest.mark.req("G3")
@pytest.mark.parametrize(("path", "message", "signal"), SIGNALS, ids=by_name)
def test_cantools_reads_the_extremes_and_the_bits_of_a_signal_where_they_are(path, message, signal):
    catalogue = CATALOGUES[path]
    for value in (signal.minimum, signal.maximum):
        payload = catalogue.encode(message.name, {signal.name: value})
        read = message.decode(payload, decode_choices=False)
        assert read[signal.name] == pytest.approx(value, abs=0.5 * abs(signal.scale))
        assert catalogue.decode(catalogue.by_name[message.name], CanFrame(0, payload, 0)) == pytest.approx(read, abs=1e-9)
    low, high = (int.from_bytes(catalogue.encode(message.name, {signal.name: v}), "little") for v in (signal.minimum, signal.maximum))
    page = sum(bits_alone(other) for other in message.signals if other.name == signal.multiplexer_signal)
    assert (low ^ high) & ~(bits_alone(signal) | page) == 0


@pytest.mark.req("G3")
@pytest.mark.parametrize(("path", "message", "signal"), SIGNALS, ids=by_name)
def test_no_number_and_no_value_beyond_the_range_is_sent(path, message, signal):
    catalogue, step = CATALOGUES[path], abs(signal.scale)
    for beyond in (math.nan, math.inf, -math.inf, signal.maximum + step, signal.minimum - step, 1e300, -1e300):
        with pytest.raises(EncodeError, match=rf"^{message.name}\.{signal.name} = "):
            catalogue.encode(message.name, {signal.name: beyond})
    for beyond, end in ((math.inf, signal.maximum), (-math.inf, signal.minimum)):
        saturated = catalogue.encode(message.name, {signal.name: beyond}, saturates=True)
        assert saturated == catalogue.encode(message.name, {signal.name: end})


@pytest.mark.parametrize(("path", "message", "signal"), [one for one in SIGNALS if one[2].choices], ids=by_name)
def test_every_entry_of_a_value_table_is_sent_and_read(path, message, signal):
    catalogue, spec = CATALOGUES[path], CATALOGUES[path].by_name[message.name]
    table = catalogue.enumeration(message.name, signal.name)
    assert table == {str(entry): raw for raw, entry in signal.choices.items()}
    raws = np.array(list(table.values()), dtype=np.int64)
    for raw, payload in zip(raws.tolist(), payloads(path, message, signal, raws), strict=True):
        assert catalogue.encode(message.name, {signal.name: raw}) == payload
        assert catalogue.decode(spec, CanFrame(spec.arbitration_id, payload, 0))[signal.name] == raw
        assert str(message.decode(payload)[signal.name]) == str(signal.choices[raw])


@pytest.mark.parametrize(("path", "message"), MESSAGES, ids=by_name)
def test_every_other_length_is_refused(path, message):
    catalogue, spec = CATALOGUES[path], CATALOGUES[path].by_name[message.name]
    for length in {*range(65)} - {message.length}:
        with pytest.raises(DecodeError, match=f"^{message.name}: {length} bytes, expected {message.length}$"):
            catalogue.decode(spec, CanFrame(spec.arbitration_id, bytes(length), 0))


@pytest.mark.parametrize(("path", "message"), MESSAGES, ids=by_name)
def test_identifier_cycle_and_timeout(path, message):
    spec = CATALOGUES[path].by_name[message.name]
    assert CATALOGUES[path].by_id[message.frame_id] is spec
    assert (spec.arbitration_id, spec.length_bytes, spec.sender) == (message.frame_id, message.length, message.senders[0])
    attributes = {name: attribute.value for name, attribute in message.dbc.attributes.items()}
    assert spec.cycle_time_ns == attributes.get("GenMsgCycleTime", 0) * 1_000_000
    assert spec.timeout_ns == attributes.get("GenMsgTimeout", 0) * 1_000_000
    assert spec.timeout_ns >= 3 * spec.cycle_time_ns
    # What the navigation system could send as well is described, but has no cycle time.
    assert (spec.cycle_time_ns > 0) == (spec.timeout_ns > 0)
    assert spec.cycle_time_ns > 0 or spec.sender == "INS"


@pytest.mark.parametrize(("path", "message"), [one for one in MESSAGES if one[1].is_multiplexed()], ids=by_name)
def test_pages(path, message):
    """A page is what its multiplexer says; its signals come with it and no others do."""
    catalogue, spec = CATALOGUES[path], CATALOGUES[path].by_name[message.name]
    [multiplexer] = [signal for signal in message.signals if signal.is_multiplexer]
    pages = {page for signal in message.signals for page in signal.multiplexer_ids or ()}
    for page in pages:
        there = {signal.name for signal in message.signals if page in (signal.multiplexer_ids or (page,))}
        for name in there - {multiplexer.name}:
            payload = catalogue.encode(message.name, {name: 1.0})
            assert message.decode(payload, decode_choices=False)[name] == 1.0
            assert set(catalogue.decode(spec, CanFrame(spec.arbitration_id, payload, 0))) == there
    raws = np.array(sorted(set(range(1 << multiplexer.length)) - pages), dtype=np.int64)
    for payload in payloads(path, message, multiplexer, raws):
        with pytest.raises(DecodeError, match=f"^{message.name}"):
            catalogue.decode(spec, CanFrame(spec.arbitration_id, payload, 0))


@pytest.mark.parametrize(
    ("path", "name", "values", "expected"),
    [
        # 12.5 deg = 250 * 0.05 = 0x00FA in bytes 2 and 3, mode 2 in bits 12 to 14, enable in bit 15.
        (ROBOTS_DBC, "SR_Command", {"AngleCommand": 12.5, "Mode": 2, "Enable": 1}, "00a0fa0000000000"),
        # -540 deg = -10800 * 0.05 = 0xD5D0; -100 Nm = -1000 * 0.1 = 0xC18 in bits 48 to 59.
        (ROBOTS_DBC, "SR_Command", {"AngleCommand": -540.0, "TorqueFeedForward": -100.0}, "0000d0d50000180c"),
        # 100 % = 10000 = 0x2710; 2 kN = 4000 * 0.5 = 0xFA0; clear fault in bit 60.
        (ROBOTS_DBC, "BR_Command", {"PositionCommand": 100.0, "ForceCommand": 2000.0, "ClearFault": 1}, "000010270000a01f"),
        # 123.4567 m = 1234567 = 0x0012D687; -1 m = -10000 = 0xFFFFD8F0.
        (GNSS_IMU_DBC, "PosLocal", {"PosLocalX": 123.4567, "PosLocalY": -1.0}, "87d61200f0d8ffff"),
        # 22.22 m/s = 2222 = 0x08AE; -0.01 m/s = 0xFFFF.
        (GNSS_IMU_DBC, "VelocityLevel", {"VelForward": 22.22, "VelLateral": -0.01}, "ae08ffff00000000"),
        # Motorola: -1 rad = -1250 * 0.0008 = 0xFB1E, high byte first in bytes 2 and 3; -50 Nm = (1000 * 0.1) - 150 = 0x3E8 in the twelve
        # bits from byte 4 on; 10 Nm = 20 * 0.5 = 0x14 in the four bits after it and the upper four of byte 6; mode 5 and clear in byte 1.
        (
            SITE_DBC,
            "STEER_DEMAND",
            {"ANGLE_COMMAND": -1.0, "TORQUE_FEED_FORWARD": -50.0, "TORQUE_LIMIT": 10.0, "MODE": 5, "CLEAR_FAULT": 1},
            "00b0fb1e3e814000",
        ),
    ],
)
def test_golden_vectors(path, name, values, expected):
    assert CATALOGUES[path].encode(name, values).hex() == expected
    spec = CATALOGUES[path].by_name[name]
    read = CATALOGUES[path].decode(spec, CanFrame(spec.arbitration_id, bytes.fromhex(expected), 0))
    assert {signal: read[signal] for signal in values} == pytest.approx(values)
