"""Packing by shifts against cantools, bit for bit, and cantools where shifts do not do."""

import math

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.packing import DecodeError, EncodeError, bits_of, packing_of, raw_range, value_range

MESSAGES = [m for path in (ROBOTS_DBC, GNSS_IMU_DBC) for m in cantools.database.load_file(str(path)).messages]
PLAIN = [message for message in MESSAGES if not message.is_multiplexed()]
SHIFTS, CANTOOLS = "_Shifts", "_Cantools"
PLAIN_SIGNALS = ("S : 4|3@1- (1,0) [-4|3]", "U : 7|1@1+ (2,-1) [-1|1]", "V : 8|8@1+ (1,0) [10|200]")
STRANGE_SIGNALS = {
    "big endian": ("S : 7|16@0+ (0.5,0) [0|100]",),
    "multiplexed": ("Page M : 0|8@1+ (1,0) [0|9]", "A m0 : 8|8@1+ (1,0) [0|100]", "B m1 : 8|8@1+ (0.5,0) [0|100]"),
}


def message_of(*signals, length=8, floats="") -> cantools.database.can.message.Message:
    text = f'VERSION ""\nBU_: A\nBO_ 1 X: {length} A\n' + "".join(f' SG_ {signal} "" A\n' for signal in signals)
    return cantools.database.load_string(text + floats, database_format="dbc").messages[0]


@st.composite
def layouts(draw):
    """A message of some length, full of signals of one byte order or of both, side by side or apart."""
    length = draw(st.integers(1, 8))
    order = draw(st.sampled_from(["little", "big", "both"]))
    signals, free = [], set(range(8 * length))
    for index in range(draw(st.integers(1, 6))):
        is_little = order == "little" or (order == "both" and draw(st.booleans()))
        start, size = draw(st.integers(0, 8 * length - 1)), draw(st.integers(1, 24))
        # Motorola bits follow each other in the order of transmission: of each byte the highest first.
        bits = {start + bit if is_little else ((start ^ 7) + bit) ^ 7 for bit in range(size)}
        if bits <= free:
            free -= bits
            sign, scale, offset = draw(st.sampled_from("+-")), draw(st.sampled_from(["1", "0.05", "-0.1", "3"])), draw(st.integers(-9, 9))
            signals.append(f"S{index} : {start}|{size}@{int(is_little)}{sign} ({scale},{offset}) [0|0]")
    return message_of(*signals, length=length), order


@given(layouts(), st.data())
@settings(max_examples=300, deadline=None)
def test_every_layout_is_packed_and_read_as_cantools_does_it(layout, data):
    message, order = layout
    packing = packing_of(message)
    assert order == "both" or type(packing).__name__ == SHIFTS
    payload = data.draw(st.binary(min_size=message.length, max_size=message.length))
    values = message.decode(payload, decode_choices=False)
    assert packing.unpack(payload) == values
    # What no signal has is zero when it is packed.
    assert packing.pack(values) == bytes(message.encode(values, strict=False))
    assert packing.unpack(packing.pack(values)) == values


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        (("A : 0|16@1+ (1,0) [0|0]", "B : 16|12@1+ (1,0) [0|0]"), SHIFTS),
        (("A : 7|16@0+ (1,0) [0|0]", "B : 23|12@0+ (1,0) [0|0]"), SHIFTS),
        (("A : 7|16@0+ (1,0) [0|0]", "B : 16|8@1+ (1,0) [0|0]"), SHIFTS),  # within a byte there is no order
        (("A : 3|4@0+ (1,0) [0|0]", "B : 8|16@1+ (1,0) [0|0]"), SHIFTS),
        (("A : 7|16@0+ (1,0) [0|0]", "B : 16|9@1+ (1,0) [0|0]"), CANTOOLS),
        ((), SHIFTS),
    ],
)
def test_one_byte_order_is_packed_by_shifts(signals, expected):
    packing = packing_of(message_of(*signals))
    assert type(packing).__name__ == expected
    values = {signal.split()[0]: 5.0 for signal in signals}
    assert packing.unpack(packing.pack(values)) == values


START_DEFINITIONS = 'BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 100000;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'
STARTS = START_DEFINITIONS + 'BA_ "GenSigStartValue" SG_ 1 S 7;\nBA_ "GenSigStartValue" SG_ 1 T 0;\n'


@pytest.mark.parametrize("last", ["U : 16|8@1+ (1,0) [0|255]", "U : 17|9@0+ (1,0) [0|511]"])
def test_a_signal_that_is_not_given_has_its_start_value(last):
    """Raw, as the attribute says it: 7 * 0.5 + 2 = 5.5, and 0 * 1 - 4 = -4, which is not the value nearest to zero; without one zero."""
    signals = ("S : 0|8@1+ (0.5,2) [0|100]", "T : 8|8@1+ (1,-4) [-4|100]", last)
    packing = packing_of(message_of(*signals, floats=STARTS))
    assert packing.unpack(packing.pack({})) == {"S": 5.5, "T": -4.0, "U": 0.0}
    assert packing.unpack(packing.pack({"S": 2.0})) == {"S": 2.0, "T": -4.0, "U": 0.0}
    without = packing_of(message_of(*signals))
    assert without.unpack(without.pack({})) == {"S": 2.0, "T": 0.0, "U": 0.0}


def test_a_start_value_out_of_range_is_refused():
    start = START_DEFINITIONS + 'BA_ "GenSigStartValue" SG_ 1 S 7;\n'
    with pytest.raises(EncodeError, match=r"^X\.S = 5\.5 outside \[1\.7505, 5\.2495\]$"):
        packing_of(message_of("S : 0|8@1+ (0.5,2) [0|5]", floats=start))


@pytest.mark.parametrize("order", ["15|8@0+", "8|8@1+"])
def test_what_rounds_into_the_range_is_in_it_to_the_last_digit(order):
    packing = packing_of(message_of(f"V : {order} (1,0) [10.499|199.501]"))
    for value, raw in ((10.0, 10), (200.0, 200)):
        payload = bytes([0, raw, 0, 0, 0, 0, 0, 0])
        assert packing.unpack(payload) == {"V": value}
        assert packing.pack({"V": value}) == payload
    for beyond in (math.nextafter(10.0, 0.0), math.nextafter(200.0, 300.0)):
        with pytest.raises(EncodeError, match=rf"^X\.V = {beyond} outside \[10\.0, 200\.0\]$"):
            packing.pack({"V": beyond})
    for raw in (9, 201):
        with pytest.raises(DecodeError, match=rf"^X\.V = {raw}(\.0)? outside \[10\.0, 200\.0\]$"):
            packing.unpack(bytes([0, raw, 0, 0, 0, 0, 0, 0]))


def test_table_entries_stay_numbers_in_every_packing():
    table = 'VAL_ 1 Page 0 "First" 1 "Second" ;\nVAL_ 1 A 3 "Three" ;\n'
    packing = packing_of(message_of(*STRANGE_SIGNALS["multiplexed"], floats=table))
    assert packing.unpack(packing.pack({"A": 3.0})) == {"Page": 0, "A": 3}
    assert all(isinstance(value, int) for value in packing.unpack(packing.pack({"A": 3.0})).values())
    plain = packing_of(message_of("A : 8|8@1+ (1,0) [0|100]", floats='VAL_ 1 A 3 "Three" ;\n'))
    assert plain.unpack(plain.pack({"A": 3.0})) == {"A": 3}


def test_bits_of_a_signal_from_the_lowest_on():
    intel, motorola = message_of("I : 6|4@1+ (1,0) [0|0]", "M : 17|4@0+ (1,0) [0|0]").signals
    assert bits_of(intel) == [6, 7, 8, 9]
    # Bits 1 and 0 of the third byte are the upper ones, bits 7 and 6 of the fourth the lower ones.
    assert bits_of(motorola) == [30, 31, 16, 17]


@pytest.mark.parametrize(
    ("signal", "raw", "physical"),
    [
        ("S : 0|8@1+ (0.5,-3) [0|0]", (0, 255), (-3.0, 124.5)),
        ("S : 0|8@1- (-0.5,1) [0|0]", (-128, 127), (-62.5, 65.0)),
        ("S : 0|1@1+ (1,0) [0|0]", (0, 1), (0, 1)),
        ("S : 0|1@1- (1,0) [0|0]", (-1, 0), (-1, 0)),
    ],
)
def test_what_the_bits_can_hold(signal, raw, physical):
    [read] = message_of(signal).signals
    assert (raw_range(read), value_range(read)) == (raw, physical)


FLOAT = "F : 0|32@1- (1,0) [0|0]"
DOUBLE = "D : 7|64@0- (2,0) [0|0]"
FLOATS = "SIG_VALTYPE_ 1 F : 1;\n"
DOUBLES = "SIG_VALTYPE_ 1 D : 2;\n"


def test_floats():
    message = message_of(FLOAT, "S : 32|8@1+ (1,0) [0|9]", floats=FLOATS)
    packing = packing_of(message)
    for value in (0.0, -1.5, 3.4028234663852886e38, -3.4028234663852886e38, 1e-40):
        payload = packing.pack({"F": value, "S": 9})
        assert packing.unpack(payload) == message.decode(payload)
        assert packing.unpack(payload)["F"] == pytest.approx(value)
    # 1.5 is 0x3FC00000, IEEE 754.
    assert packing.pack({"F": 1.5}).hex() == "0000c03f00000000"
    for beyond in (math.nan, math.inf, -math.inf, 3.5e38, -3.5e38):
        with pytest.raises(EncodeError, match=r"^X\.F = "):
            packing.pack({"F": beyond})
    for pattern in ("0000c07f", "0000807f", "000080ff"):  # not a number, infinity, minus infinity
        with pytest.raises(DecodeError, match=r"^X\.F = "):
            packing.unpack(bytes.fromhex(pattern + "00000000"))
    assert packing.pack({"F": math.inf}, saturates=True) == packing.pack({"F": 3.4028234663852886e38})


def test_doubles_and_the_range_of_floats():
    packing = packing_of(message_of(DOUBLE, floats=DOUBLES))
    # 0.75 at a scale of 2 is 0x3FD8000000000000 for 0.375, high byte first.
    assert packing.pack({"D": 0.75}).hex() == "3fd8000000000000"
    assert packing.unpack(packing.pack({"D": 1.7e308})) == {"D": 1.7e308}
    with pytest.raises(DecodeError, match=r"^X\.D = inf"):
        packing.unpack(bytes.fromhex("7fefffffffffffff"))  # the largest double, twice
    ranged = packing_of(message_of(FLOAT.replace("[0|0]", "[-1|2]"), floats=FLOATS))
    assert ranged.unpack(ranged.pack({"F": -1.0})) == {"F": -1.0}
    for beyond in (-1.001, 2.001):
        with pytest.raises(EncodeError, match=r"outside \[-1(\.0)?, 2(\.0)?\]$"):
            ranged.pack({"F": beyond})
    assert value_range(message_of(FLOAT.replace("|32@", "|16@"), floats=FLOATS).signals[0]) == (-65504.0, 65504.0)


NESTED = ("M M : 0|4@1+ (1,0) [0|9]", "N m3M : 4|4@1+ (1,0) [0|9]", "A m7 : 8|8@1+ (1,0) [0|99]", "B m2 : 8|8@1+ (1,0) [0|99]")
NESTING = "SG_MUL_VAL_ 1 N M 3-3;\nSG_MUL_VAL_ 1 A N 7-7;\nSG_MUL_VAL_ 1 B M 2-2;\n"


def test_a_page_within_a_page_brings_both():
    packing = packing_of(message_of(*NESTED, floats=NESTING))
    assert packing.pack({"A": 5.0}).hex() == "7305000000000000"
    assert packing.unpack(bytes.fromhex("7305000000000000")) == {"M": 3, "N": 7, "A": 5}
    assert packing.pack({"B": 6.0}).hex() == "0206000000000000"


def test_a_page_that_is_not_there_cannot_be_packed():
    with pytest.raises(EncodeError, match=r"^X: .*multiplexer"):
        packing_of(message_of(*STRANGE_SIGNALS["multiplexed"])).pack({"Page": 5.0})


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
