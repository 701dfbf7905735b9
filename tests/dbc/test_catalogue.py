"""What a DBC file may be, and what is refused in one line."""

import random
from pathlib import Path

import pytest

from dbc.catalogue import ROBOTS_DBC, CatalogueError, DecodeError, EncodeError, load
from dbc.database import read_dbc
from dbc.frame import CanFrame
from dbc.lint import lint
from dbc.packing import pages_of

CATALOGUE = load()
SITE_DBC = 'VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n SG_ S : 0|8@1+ (1,0) [0|255] "" A\n'
DEFINITIONS = """BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_ BO_ "GenMsgTimeout" INT -5 10000;
BA_DEF_ BO_ "E2EProfile" STRING ;
BA_DEF_ BO_ "E2EDataId" INT 0 255;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgTimeout" 0;
BA_DEF_DEF_ "E2EProfile" "";
BA_DEF_DEF_ "E2EDataId" 0;
"""
PROTECTED = DEFINITIONS + 'BA_ "E2EProfile" BO_ 1 "P02";\nBA_ "E2EDataId" BO_ 1 7;\n'


def message(*signals, length=8, arbitration_id=1):
    return f'VERSION ""\nBU_: A\nBO_ {arbitration_id} X: {length} A\n' + "".join(f' SG_ {signal} "" A\n' for signal in signals)


def written(tmp_path, content):
    path = tmp_path / "site.dbc"
    path.write_text(content, encoding="latin-1")
    return path


def test_a_catalogue_knows_its_messages_by_name_and_by_identifier():
    assert {spec.name for spec in CATALOGUE.by_id.values()} == set(CATALOGUE.by_name)
    assert set(CATALOGUE.sha256) == {"robots.dbc", "gnss_imu.dbc"}
    assert CATALOGUE.sha256["robots.dbc"] == read_dbc(ROBOTS_DBC).sha256
    assert CATALOGUE.signals("PosLocal") == ("PosLocalX", "PosLocalY")
    assert CATALOGUE.bounds("SR_Command", "AngleCommand") == (-1080.0, 1080.0)
    assert CATALOGUE.enumeration("CAR_Powertrain", "Selector") == {"P": 0, "R": 1, "N": 2, "D": 3, "SNA": 7}
    assert CATALOGUE.enumeration("SR_Command", "AngleCommand") == {}


def test_a_signal_without_a_range_has_no_bounds(tmp_path):
    catalogue = load([written(tmp_path, message("S : 0|8@1- (1,0) [0|0]"))])
    assert catalogue.bounds("X", "S") == (float("-inf"), float("inf"))
    assert catalogue.encode("X", {"S": -128}) == b"\x80" + bytes(7)


def test_a_signal_has_steps_or_is_in_floating_point(tmp_path):
    text = message("F : 0|32@1- (2,0) [0|0]", "N : 32|8@1- (-0.25,3) [0|0]", "W : 40|8@1- (3,0) [0|0]") + "SIG_VALTYPE_ 1 F : 1;\n"
    catalogue = load([written(tmp_path, text)])
    assert [catalogue.resolution("X", signal) for signal in "FNW"] == [(0.0, 0.0), (0.25, 3.0), (3.0, 0.0)]


def test_messages_that_are_needed_are_named():
    CATALOGUE.require(["SR_Command", "PosLocal"], "test")
    with pytest.raises(CatalogueError, match=r"^robots\.dbc, gnss_imu\.dbc: no message No, Nor, which the test needs$"):
        CATALOGUE.require(["No", "SR_Command", "Nor"], "test")


def test_a_frame_is_read_when_its_length_fits():
    spec = CATALOGUE.by_name["SR_Command"]
    read = CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, bytes.fromhex("0000fa0000000000"), 0))
    assert (read["AngleCommand"], read["Enable"]) == (12.5, 0)
    for length in (0, 7, 9):
        with pytest.raises(DecodeError, match=rf"^SR_Command: {length} bytes, expected 8$"):
            CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, bytes(length), 0))


def test_unknown_signal_is_named():
    with pytest.raises(EncodeError, match="Angel"):
        CATALOGUE.encode("SR_Command", {"Angel": 1})


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("not a dbc at all", "not a usable DBC"),
        ('VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n SG_ S : 0|8@1+ (1,0) [0|255] "" A\n SG_ T : 4|8@1+ (1,0) [0|255] "" A\n', "not a usable DBC"),
    ],
)
def test_broken_dbc_is_one_line_with_its_path(tmp_path, content, named):
    path = tmp_path / "site.dbc"
    path.write_text(content)
    with pytest.raises(CatalogueError, match=named) as caught:
        load([path])
    assert "site.dbc" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_dbc_and_clash(tmp_path):
    with pytest.raises(CatalogueError, match=r"nowhere\.dbc"):
        load([tmp_path / "nowhere.dbc"])
    with pytest.raises(CatalogueError, match=r"robots\.dbc: message GW_SafetyCommand \(id 0xA0\) is defined twice$"):
        load([ROBOTS_DBC, ROBOTS_DBC])


@pytest.mark.parametrize("changed", ["BO_ 1 Y", "BO_ 2 X"])
def test_one_identifier_and_one_name_for_each_message(tmp_path, changed):
    again = message("S : 0|8@1+ (1,0) [0|255]")[len('VERSION ""\nBU_: A\n') :]
    with pytest.raises(CatalogueError, match=r"is defined twice$"):
        load([written(tmp_path, message() + again.replace("BO_ 1 X", changed))])


@pytest.mark.parametrize(
    ("attributes", "network", "bitrate_bps"),
    [
        ("", "robots", 500_000),
        ('BA_ "BusName" "navigation";\n', "navigation", 500_000),
        ('BA_ "BusName" "robots";\nBA_ "Baudrate" 1000000;\n', "robots", 1_000_000),
        ('BA_DEF_DEF_ "Baudrate" 250000;\n', "robots", 250_000),
    ],
)
def test_a_file_says_which_bus_it_is_about(tmp_path, attributes, network, bitrate_bps):
    path = tmp_path / "site.dbc"
    path.write_text(f'{SITE_DBC}BA_DEF_ "BusName" STRING ;\nBA_DEF_ "Baudrate" INT 0 9000000;\n{attributes}')
    catalogue = load([path])
    assert catalogue.by_name["X"].network == network
    assert catalogue.bitrate_bps == {"robots": 500_000, "navigation": 500_000} | {network: bitrate_bps}


def test_robots_and_navigation_system_are_on_buses_of_their_own():
    assert {(spec.sender, spec.network) for spec in CATALOGUE.by_name.values()} == {
        *((sender, "robots") for sender in ("GW", "RC", "SR", "AR", "BR", "CAR")),
        ("INS", "navigation"),
    }


@pytest.mark.parametrize(
    ("attributes", "named"),
    [
        ('BA_ "BusName" "Chassis";\n', r"site\.dbc: BusName 'Chassis': expected robots or navigation$"),
        ('BA_ "Baudrate" 2000000;\n', r"site\.dbc: Baudrate 2000000 outside \[1, 1000000\]$"),
        ('BA_ "Baudrate" 250000;\n', r"site\.dbc: Baudrate 250000: another file gives bus robots 500000 bit/s$"),
    ],
)
def test_a_bus_that_cannot_be_is_one_line(tmp_path, attributes, named):
    path = tmp_path / "site.dbc"
    path.write_text(f'{SITE_DBC}BA_DEF_ "BusName" STRING ;\nBA_DEF_ "Baudrate" INT 0 9000000;\n{attributes}')
    with pytest.raises(CatalogueError, match=named):
        load([ROBOTS_DBC, path])


HEADER = ("Crc : 0|8@1+ (1,0) [0|255]", "AliveCounter : 8|4@1+ (1,0) [0|15]")
PAGES = ("M M : 0|8@1+ (1,0) [0|1]", "S m0 : 8|8@1+ (1,0) [0|255]", "S m1 : 16|8@1+ (1,0) [0|255]")
MOTOROLA_HEADER = ("Crc : 7|8@0+ (1,0) [0|255]", "AliveCounter : 11|4@0+ (1,0) [0|15]")


@pytest.mark.parametrize("header", [HEADER, MOTOROLA_HEADER])
def test_a_protected_message_in_either_byte_order(tmp_path, header):
    catalogue = load([written(tmp_path, message(*header) + PROTECTED)])
    assert catalogue.by_name["X"].e2e_data_id == 7
    assert catalogue.encode("X", {"Crc": 0x12, "AliveCounter": 5}) == b"\x12\x05" + bytes(6)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (message(*HEADER) + PROTECTED.replace("BO_ 1 7", "BO_ 1 0"), r"E2EDataId 0 outside \[1, 255\]$"),
        (message(*HEADER) + PROTECTED.replace("BO_ 1 7", "BO_ 1 256"), r"E2EDataId 256 outside \[1, 255\]$"),
        (message(*HEADER) + PROTECTED.replace("BO_ 1 7", "BO_ 1 232"), r"E2EDataId 232 lets a payload of equal bits pass: allowed: "),
        (message(*HEADER) + PROTECTED.replace("P02", "P01"), r"E2EProfile 'P01' is not supported, only 'P02'$"),
        (message(HEADER[0]) + PROTECTED, r"E2E profile P02 needs signal AliveCounter at bits 8 to 11$"),
        (message(HEADER[1]) + PROTECTED, r"E2E profile P02 needs signal Crc at bits 0 to 7$"),
        (message(HEADER[1], "Crc : 0|7@1+ (1,0) [0|127]") + PROTECTED, r"needs signal Crc at bits 0 to 7$"),
        (message(HEADER[0], "AliveCounter : 12|4@1+ (1,0) [0|15]") + PROTECTED, r"needs signal AliveCounter at bits 8 to 11$"),
        (message(HEADER[0], "AliveCounter : 8|4@0+ (1,0) [0|15]") + PROTECTED, r"needs signal AliveCounter at bits 8 to 11$"),
        (message("S : 0|8@1+ (1,0) [0|255]", "S : 8|8@1+ (1,0) [0|255]"), r"The signals S and S are overlapping in message X\."),
        (message(*PAGES), r"message X: signal S is defined twice or has the factor 0$"),
        (message("S : 0|8@1+ (0,0) [0|255]"), r"message X: signal S is defined twice or has the factor 0$"),
        (message("S : 0|8@1+ (1,0) [9|5]"), r"X\.S = "),
        (message(arbitration_id=2147483649), r"only classical frames with an 11-bit identifier and up to 8 bytes are supported$"),
        (message(length=9), r"only classical frames with an 11-bit identifier and up to 8 bytes are supported$"),
        (message() + DEFINITIONS + 'BA_ "GenMsgTimeout" BO_ 1 -5;\n', r"GenMsgTimeout -5: allowed: a whole number from 0 on$"),
        (message() + DEFINITIONS.replace("INT -5 10000", "STRING") + 'BA_ "GenMsgTimeout" BO_ 1 "soon";\n', r"GenMsgTimeout 'soon': allow"),
    ],
)
def test_a_message_that_cannot_be_used_is_one_line_with_its_file(tmp_path, content, named):
    with pytest.raises(CatalogueError, match=named) as caught:
        load([written(tmp_path, content)])
    assert str(caught.value).startswith(f"{tmp_path / 'site.dbc'}: ")
    assert "\n" not in str(caught.value)


def test_an_attribute_of_the_file_holds_for_messages_without_their_own(tmp_path):
    text = message() + DEFINITIONS.replace('"GenMsgCycleTime" 0', '"GenMsgCycleTime" 20') + 'BA_ "GenMsgTimeout" BO_ 1 100;\n'
    spec = load([written(tmp_path, text)]).by_name["X"]
    assert (spec.cycle_time_ns, spec.timeout_ns) == (20_000_000, 100_000_000)


def test_a_message_without_a_sender_has_none(tmp_path):
    assert load([written(tmp_path, message().replace("8 A", "8 Vector__XXX"))]).by_name["X"].sender == ""


def test_overlapping_signals_are_read_where_asked_for(tmp_path):
    path = written(tmp_path, message("S : 0|8@1+ (1,0) [0|255]", "T : 4|8@1+ (1,0) [0|255]"))
    assert [signal.name for signal in read_dbc(path, is_strict=False).messages[0].signals] == ["S", "T"]
    with pytest.raises(CatalogueError, match="overlapping"):
        read_dbc(path)


MULTIPLEXED = ("M M : 0|8@1+ (1,0) [0|0]", "S m0 : 8|8@1+ (1,0) [0|0]")


@pytest.mark.parametrize("is_strict", [True, False])
@pytest.mark.parametrize(
    ("content", "named"),
    [
        (message("S : 0|99999999999@1+ (1,0) [0|0]"), r"number too large: \|99999999999@$"),
        (message("S : 7|999999@0+ (1,0) [0|0]"), r"number too large: \|999999@$"),
        (message("S : 100000|8@1+ (1,0) [0|0]"), r"number too large: 100000\|$"),
        (message(length=100000), r"number too large: BO_ 1 X: 100000$"),
        (message() + 'BA_DEF_ "B" INT 0 1e9999999;\n', r"number too large: 1e9999999$"),
        (message() + 'BA_DEF_ "B" INT 0 1.5E+1000;\n', r"number too large: 1\.5E\+1000$"),
        (message(*MULTIPLEXED) + "SG_MUL_VAL_ 1 S M 0-65536;\n", r"more than 65536 pages: 0-65536$"),
        (message(*MULTIPLEXED) + f"SG_MUL_VAL_ 1 S M 3-3, 0-{'9' * 9999};\n", r"more than 65536 pages: 0-9{30}$"),
        ("x" * 16_000_001, r"16000001 bytes: allowed: up to 16000000$"),
    ],
)
def test_a_file_that_would_take_all_memory_is_refused_before_it_is_parsed(tmp_path, content, named, is_strict):
    path = written(tmp_path, content)
    with pytest.raises(CatalogueError, match=named) as caught:
        read_dbc(path, is_strict)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < len(str(path)) + 100


def test_a_device_is_no_dbc():
    with pytest.raises(CatalogueError, match=r"^/dev/zero: not a regular file$"):
        read_dbc(Path("/dev/zero"))


def test_large_numbers_that_mean_something_are_read(tmp_path):
    pages = message(*MULTIPLEXED) + "SG_MUL_VAL_ 1 S M 0-65535;\n"
    assert len(read_dbc(written(tmp_path, pages)).messages[0].signals[1].multiplexer_ids) == 65536
    single = message(*MULTIPLEXED) + "SG_MUL_VAL_ 1 S M 4294967295-4294967295;\n"
    assert read_dbc(written(tmp_path, single)).messages[0].signals[1].multiplexer_ids == [0, 4294967295]
    texts = message("S1e12345 : 0|8@1+ (1e-300,0) [0|0]") + 'CM_ "Revision 5e12345, \\"0|999999@\\"";\n'
    assert read_dbc(written(tmp_path, texts)).messages[0].signals[0].scale == 1e-300


def test_pages_in_a_circle_end(tmp_path):
    circle = message("M m0M : 0|8@1+ (1,0) [0|0]", "N m0M : 8|8@1+ (1,0) [0|0]") + "SG_MUL_VAL_ 1 N M 0-0;\nSG_MUL_VAL_ 1 M N 0-0;\n"
    file = read_dbc(written(tmp_path, circle), is_strict=False)
    assert [pages_of(file.messages[0], signal) for signal in file.messages[0].signals] == [{"N": [0], "M": [0]}, {"M": [0], "N": [0]}]
    assert lint([file]) != []


def test_a_damaged_file_is_refused_or_read_and_nothing_else(tmp_path):
    """Bytes changed, lost and repeated at random: only the declared error, in one line with the path."""
    rng = random.Random(11)
    original = (message(*HEADER, "M M : 16|4@1+ (1,0) [0|1]", "S m0 : 24|16@0- (0.5,1) [-9|9]") + PROTECTED).encode()
    told = []
    for _ in range(400):
        damaged = bytearray(original)
        for _ in range(rng.choice((1, 1, 3))):
            at = rng.randrange(len(damaged))
            what = (b"", b"0", b"-1", b"1e999", b"nan", b"@", rng.randbytes(2), damaged[:20])
            damaged[at : at + rng.choice((0, 1, 1, 9))] = rng.choice(what)
        path = written(tmp_path, bytes(damaged).decode("latin-1"))
        try:
            load([path])
        except CatalogueError as error:
            told.append(str(error))
    assert 100 < len(told) < 400
    assert [text for text in told if not text.startswith(str(path)) or "\n" in text] == []
