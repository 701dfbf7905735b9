"""Packing by shifts against cantools, bit for bit, and cantools where shifts do not do."""

import math

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.packing import DecodeError, EncodeError, packing_of

MESSAGES = [m for path in (ROBOTS_DBC, GNSS_IMU_DBC) for m in cantools.database.load_file(str(path)).messages]
PLAIN = [message for message in MESSAGES if not message.is_multiplexed()]
PLAIN_SIGNALS = ("S : 4|3@1- (1,0) [-4|3]", "U : 7|1@1+ (2,-1) [-1|1]", "V : 8|8@1+ (1,0) [10|200]")
STRANGE_SIGNALS = {
    "big endian": ("S : 7|16@0+ (0.5,0) [0|100]",),
    "multiplexed": ("Page M : 0|8@1+ (1,0) [0|9]", "A m0 : 8|8@1+ (1,0) [0|100]", "B m1 : 8|8@1+ (0.5,0) [0|100]"),
}


def message_of(*signals: str) -> cantools.database.can.message.Message:
    text = 'VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n' + "".join(f' SG_ {signal} "" A\n' for signal in signals)
    return cantools.database.load_string(text, database_format="dbc").messages[0]


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_every_message_is_packed_as_cantools_does_it(data):
    message = data.draw(st.sampled_from(PLAIN))
    values = {s.name: data.draw(st.floats(float(s.minimum), float(s.maximum))) for s in message.signals}
    payload = packing_of(message).pack(values)
    assert payload == bytes(message.encode(values, strict=False))
    assert packing_of(message).unpack(payload) == message.decode(payload, decode_choices=False)


@given(payload=st.binary(min_size=8, max_size=8), message=st.sampled_from([m for m in PLAIN if m.length == 8]))
@settings(max_examples=300, deadline=None)
def test_every_payload_is_read_as_cantools_does_it_or_refused_for_its_range(payload, message):
    expected = message.decode(payload, decode_choices=False)
    try:
        assert packing_of(message).unpack(payload) == expected
    except DecodeError:
        assert any(not s.minimum - 0.5 * s.scale <= expected[s.name] <= s.maximum + 0.5 * s.scale for s in message.signals)


def test_signs_offsets_and_neutral_values_by_hand():
    packing = packing_of(message_of(*PLAIN_SIGNALS))
    # -4 is 100 in bits 4 to 6, 1 is raw 1 in bit 7, and what is not given is the nearest to zero: 10 in the second byte.
    assert packing.pack({"S": -4, "U": 1.0}).hex() == "c00a000000000000"
    assert packing.unpack(bytes.fromhex("f00b000000000000")) == {"S": -1, "U": 1, "V": 11}


@pytest.mark.parametrize("signals", [PLAIN_SIGNALS, *STRANGE_SIGNALS.values()])
@pytest.mark.parametrize("beyond", [math.nan, math.inf, -math.inf, 201.0, -5.0])
def test_out_of_range_is_refused_by_every_packing(signals, beyond):
    message = message_of(*signals)
    for signal in message.signals:
        with pytest.raises(EncodeError, match=rf"^X\.{signal.name} = "):
            packing_of(message).pack({signal.name: beyond})
    with pytest.raises(DecodeError, match=r"^X\.\w+ = \d"):
        packing_of(message).unpack(b"\x01" + b"\xff" * 7)


@pytest.mark.parametrize("signals", [PLAIN_SIGNALS, *STRANGE_SIGNALS.values()])
@pytest.mark.parametrize(("beyond", "end"), [(math.inf, "maximum"), (1e9, "maximum"), (-math.inf, "minimum"), (-1e9, "minimum")])
def test_an_instrument_saturates(signals, beyond, end):
    message = message_of(*signals)
    for signal in (s for s in message.signals if not s.is_multiplexer):
        payload = packing_of(message).pack({signal.name: beyond}, saturates=True)
        assert payload == packing_of(message).pack({signal.name: float(getattr(signal, end))})
        with pytest.raises(EncodeError):
            packing_of(message).pack({signal.name: math.nan}, saturates=True)


@pytest.mark.parametrize("signal", ["S : 8|8@1+ (0.5,-3) [-100|500]", "S : 8|8@1- (-0.5,0) [0|0]"])
def test_no_value_goes_round_in_its_bits(signal):
    packing = packing_of(message_of(signal))
    for beyond in (1e3, -1e3):
        with pytest.raises(EncodeError):
            packing.pack({"S": beyond})
    low, high = (packing.unpack(packing.pack({"S": beyond}, saturates=True))["S"] for beyond in (-1e3, 1e3))
    # By hand: 0.5 * (0 to 255) - 3, and -0.5 * (-128 to 127).
    assert (low, high) == ((-3.0, 124.5) if "+" in signal else (-63.5, 64.0))
    for edge in (low - 0.26, high + 0.26):
        with pytest.raises(EncodeError):
            packing.pack({"S": edge})
    assert packing.pack({"S": high + 0.2}) == packing.pack({"S": high})


@pytest.mark.parametrize(
    ("layout", "values", "expected_hex"),
    [("big endian", {"S": 2.0}, "0004000000000000"), ("multiplexed", {"Page": 1.0, "B": 2.0}, "0104000000000000")],
)
def test_what_is_not_plain_is_packed_as_well(layout, values, expected_hex):
    packing = packing_of(message_of(*STRANGE_SIGNALS[layout]))
    assert packing.pack(values).hex() == expected_hex
    assert packing.unpack(bytes.fromhex(expected_hex)) == values


def test_a_page_that_is_not_there_is_refused():
    with pytest.raises(DecodeError, match="X"):
        packing_of(message_of(*STRANGE_SIGNALS["multiplexed"])).unpack(b"\x05" + bytes(7))
