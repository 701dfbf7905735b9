"""Lint of DBC files: every rule on a file that breaks it, on the edge of it, and on our own files."""

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.database import read_dbc
from dbc.lint import DEFAULT_MAX_LOAD, BusTiming, Finding, Severity, lint

HEADER = 'VERSION ""\nBU_: A B\n'
DEFINITIONS = """BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_ BO_ "GenMsgTimeout" INT 0 10000;
BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","Event","CyclicAndEvent","None";
BA_DEF_ BO_ "E2EProfile" STRING ;
BA_DEF_ BO_ "E2EDataId" INT 0 300;
BA_DEF_DEF_ "GenMsgCycleTime" 10;
BA_DEF_DEF_ "GenMsgTimeout" 50;
BA_DEF_DEF_ "GenMsgSendType" "Cyclic";
BA_DEF_DEF_ "E2EProfile" "";
BA_DEF_DEF_ "E2EDataId" 0;
"""
GOOD = "S : 16|8@1+ (1,0) [0|255]"
E2E = ("Crc : 0|8@1+ (1,0) [0|255]", "AliveCounter : 8|4@1+ (1,0) [0|15]")


def message(*signals, number=1, name="X", length=8, sender="A", receiver="B"):
    return f"BO_ {number} {name}: {length} {sender}\n" + "".join(f' SG_ {signal} "" {receiver}\n' for signal in signals) + "\n"


def attribute(name, value, number=1):
    return f'BA_ "{name}" BO_ {number} {value};\n'


def protected(number=1, data_id=7):
    return attribute("E2EProfile", '"P02"', number) + attribute("E2EDataId", data_id, number)


def findings(tmp_path, messages, attributes="", **how):
    path = tmp_path / "site.dbc"
    path.write_text(HEADER + messages + DEFINITIONS + attributes)
    return lint([read_dbc(path, is_strict=False)], **how)


def error(text, value, limit, signal="", name="X"):
    return Finding(Severity.ERROR, "site.dbc", name, signal, text, value, limit)


def warning(text, value, limit, signal="", name="X"):
    return Finding(Severity.WARNING, "site.dbc", name, signal, text, value, limit)


def test_a_good_file_has_no_finding(tmp_path):
    two = message(*E2E, GOOD) + message(*E2E, GOOD, number=2, name="Y", sender="B", receiver="A")
    assert findings(tmp_path, two, protected() + protected(2, 8), acted_on={"X", "Y"}) == []


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        (("S : 0|8@1+ (1,0) [0|255]", "T : 7|8@1+ (1,0) [0|255]"), [error("overlaps S", "1 bits from bit 7", "0 bits", "T")]),
        (("S : 0|8@1+ (1,0) [0|255]", "T : 8|8@1+ (1,0) [0|255]"), []),
        # Motorola: bits 3 to 0 of the first byte and 7 to 4 of the second.
        (("S : 3|8@0+ (1,0) [0|255]", "T : 12|2@1+ (1,0) [0|3]"), [error("overlaps S", "2 bits from bit 12", "0 bits", "T")]),
        (("S : 3|8@0+ (1,0) [0|255]", "T : 4|8@1+ (1,0) [0|255]"), []),
        (("M M : 0|8@1+ (1,0) [0|3]", "S m0 : 8|8@1+ (1,0) [0|255]", "T m1 : 8|8@1+ (1,0) [0|255]"), []),
        (
            ("M M : 0|8@1+ (1,0) [0|3]", "S m1 : 8|8@1+ (1,0) [0|255]", "T m1 : 15|8@1+ (1,0) [0|255]"),
            [error("overlaps S", "1 bits from bit 15", "0 bits", "T")],
        ),
        (
            ("M M : 0|8@1+ (1,0) [0|3]", "S m1 : 8|8@1+ (1,0) [0|255]", "T : 8|8@1+ (1,0) [0|255]"),
            [error("overlaps S", "8 bits from bit 8", "0 bits", "T")],
        ),
        (("S : 60|4@1+ (1,0) [0|15]",), []),
        (("S : 60|5@1+ (1,0) [0|31]",), [error("reaches beyond the message", "bit 64", "8 bytes", "S")]),
        (("S : 56|9@0+ (1,0) [0|511]",), [error("reaches beyond the message", "bit 71", "8 bytes", "S")]),
    ],
)
def test_layout(tmp_path, signals, expected):
    assert findings(tmp_path, message(*signals)) == expected


def test_a_signal_that_is_there_twice(tmp_path):
    twice = message("M M : 0|8@1+ (1,0) [0|3]", "S m0 : 8|8@1+ (1,0) [0|255]", "S m1 : 8|8@1+ (1,0) [0|255]")
    assert findings(tmp_path, twice) == [error("defined more than once", "2", "1", "S")]


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        ("S : 0|8@1+ (0.5,-3) [-3|124.5]", []),
        ("S : 0|8@1+ (0.5,-3) [-3.25|124.75]", []),  # half a step is rounding
        ("S : 0|8@1+ (0.5,-3) [-3|125]", [error("range is wider than the bits can hold", "[-3|125]", "[-3|124.5]", "S")]),
        ("S : 0|8@1+ (0.5,-3) [-3.5|9]", [error("range is wider than the bits can hold", "[-3.5|9]", "[-3|124.5]", "S")]),
        ("S : 0|8@1- (-1,0) [-127|128]", []),
        ("S : 0|8@1- (-1,0) [-128|127]", [error("range is wider than the bits can hold", "[-128|127]", "[-127|128]", "S")]),
        ("S : 0|8@1+ (1,0) [5|5]", []),
        ("S : 0|8@1+ (1,0) [6|5]", [error("range is empty", "[6|5]", "minimum below maximum", "S")]),
        ("S : 0|8@1+ (1,0) [0|0]", [warning("states no range", "[|]", "[0|255]", "S")]),
        ("S : 0|8@1+ (1e400,0) [0|9]", [error("factor or offset is no number", "(inf,0)", "finite numbers", "S")]),
        ("S : 0|8@1+ (1,-1e400) [0|9]", [error("factor or offset is no number", "(1,-inf)", "finite numbers", "S")]),
        ("S : 0|64@1+ (1,0) [0|9]", []),
        ("S : 0|8@1+ (0,1) [1|1]", [error("has one value only", "factor 0", "another factor", "S")]),
    ],
)
def test_ranges(tmp_path, signal, expected):
    assert findings(tmp_path, message(signal)) == expected


def test_a_signal_longer_than_a_frame(tmp_path):
    found = findings(tmp_path, message("S : 0|65@1+ (1,0) [0|9]", length=9))
    text = "longer than a classical frame"
    assert found == [error(text, "9 bytes", "8 bytes"), error(text, "65 bits", "64 bits", "S")]
    assert error(text, "99999 bits", "64 bits", "S") in findings(tmp_path, message("S : 0|99999@1+ (0.5,0) [0|9]"))


def test_value_tables(tmp_path):
    messages = message("S : 0|2@1+ (1,0) [0|3]", "T : 8|2@1- (1,0) [-2|1]")
    tables = 'VAL_ 1 S 0 "None" 3 "Last" 4 "Beyond" ;\nVAL_ 1 T -2 "First" -3 "Beyond" 1 "First" ;\n'
    assert findings(tmp_path, messages, tables) == [
        error("entry Beyond does not fit the bits", "4", "[0|3]", "S"),
        error("entry Beyond does not fit the bits", "-3", "[-2|1]", "T"),
        warning("entry First has more than one number", "2", "1", "T"),
    ]


def test_senders_receivers_and_frames(tmp_path):
    assert findings(tmp_path, message(GOOD, sender="Vector__XXX")) == [error("nobody sends it", "no sender", "one node")]
    assert findings(tmp_path, message(GOOD, receiver="Vector__XXX")) == [warning("nobody receives it", "no receiver", "one node", "S")]
    extended = 0x80000000 + 0x1234
    attributes = attribute("GenMsgCycleTime", 10, extended)
    assert findings(tmp_path, message(GOOD, number=extended), attributes) == [error("identifier of 29 bits", "0x1234", "11 bits")]
    assert findings(tmp_path, message(GOOD, length=9)) == [error("longer than a classical frame", "9 bytes", "8 bytes")]


@pytest.mark.parametrize(
    ("cycle_ms", "timeout_ms", "expected", "is_serious"),
    [
        (10, 20, None, True),
        (10, 19, ("one lost frame is a timeout", "19 ms", "from 20 ms"), True),
        (10, 0, ("never missed: no GenMsgTimeout", "0 ms", "from 20 ms"), False),
        (0, 50, ("cyclic without a GenMsgCycleTime", "0 ms", "above 0 ms"), False),
        (0, 0, ("cyclic without a GenMsgCycleTime", "0 ms", "above 0 ms"), False),
    ],
)
def test_times(tmp_path, cycle_ms, timeout_ms, expected, is_serious):
    attributes = attribute("GenMsgCycleTime", cycle_ms) + attribute("GenMsgTimeout", timeout_ms)
    ordinary, acted_on = (error if is_serious else warning), error
    assert findings(tmp_path, message(GOOD), attributes) == ([ordinary(*expected)] if expected else [])
    protection = message(*E2E, GOOD), attributes + protected()
    assert findings(tmp_path, *protection, acted_on={"X"}) == ([acted_on(*expected)] if expected else [])


@pytest.mark.parametrize(
    ("send_type", "is_acted_on", "is_found"), [(1, False, False), (3, False, False), (0, False, True), (3, True, True)]
)
def test_what_is_not_cyclic_needs_no_cycle_unless_somebody_acts_on_it(tmp_path, send_type, is_acted_on, is_found):
    attributes = attribute("GenMsgCycleTime", 0) + attribute("GenMsgSendType", send_type) + protected()
    found = findings(tmp_path, message(*E2E), attributes, acted_on={"X"} if is_acted_on else ())
    assert [finding.text for finding in found] == ["cyclic without a GenMsgCycleTime"] * is_found


def test_protection_that_is_missing(tmp_path):
    """A mistake of a node that protects others, a risk of one that cannot, nothing where nobody acts on it."""
    absent = "acted on without end-to-end protection", "no E2EProfile", "P02"
    assert findings(tmp_path, message(GOOD), acted_on={"X"}) == [warning(*absent)]
    assert findings(tmp_path, message(GOOD)) == []
    two = message(GOOD) + message(*E2E, number=2, name="Y"), protected(2)
    assert findings(tmp_path, *two, acted_on={"X"}) == [error(*absent)]
    assert findings(tmp_path, *two) == []
    other = message(GOOD) + message(*E2E, number=2, name="Y", sender="B"), protected(2)
    assert findings(tmp_path, *other, acted_on={"X"}) == [warning(*absent)]


@pytest.mark.parametrize(
    ("signals", "attributes", "expected"),
    [
        (E2E, protected(data_id=0), error("E2EDataId outside its range", "0", "[1|255]")),
        (E2E, protected(data_id=256), error("E2EDataId outside its range", "256", "[1|255]")),
        (E2E, protected(data_id=232), error("E2EDataId under which a payload of equal bits passes", "232", "another one")),
        (E2E, protected().replace("P02", "P05"), error("unknown E2EProfile", "P05", "P02")),
        (E2E[:1], protected(), error("not where P02 has it", "not there", "bits 8 to 11", "AliveCounter")),
        (E2E[1:], protected(), error("not where P02 has it", "not there", "bits 0 to 7", "Crc")),
        (
            (E2E[0], "AliveCounter : 12|4@1+ (1,0) [0|15]"),
            protected(),
            error("not where P02 has it", "bits 12 to 15", "bits 8 to 11", "AliveCounter"),
        ),
        (("Crc : 7|8@0+ (1,0) [0|255]", "AliveCounter : 11|4@0+ (1,0) [0|15]"), protected(), None),
        (E2E, protected(data_id=1), None),
        (E2E, protected(data_id=255), None),
    ],
)
def test_protection_that_is_wrong(tmp_path, signals, attributes, expected):
    assert findings(tmp_path, message(*signals), attributes, acted_on={"X"}) == ([expected] if expected else [])


def test_what_two_messages_share(tmp_path):
    def text(what, other):
        return f"{what} is also that of {other}"

    two = message(*E2E) + message(*E2E, number=2, name="Y")
    shared = findings(tmp_path, two, protected() + protected(2))
    assert shared == [error(text("E2EDataId", "X"), "7", "one message each", name="Y")]
    same_id = findings(tmp_path, message(GOOD) + message(GOOD, name="Y"))
    assert same_id == [error(text("identifier", "X"), "0x1", "one message each", name="Y")]
    same_name = findings(tmp_path, message(GOOD) + message(GOOD, number=2))
    assert same_name == [error(text("name", "X"), "X", "one message each")]
    # A data id means nothing without a profile.
    assert findings(tmp_path, two, attribute("E2EDataId", 7) + attribute("E2EDataId", 7, 2)) == []


def test_two_files_share_identifiers_and_data_ids_as_well(tmp_path):
    paths = [tmp_path / "one.dbc", tmp_path / "other.dbc"]
    for path, name, number in zip(paths, ("X", "Y"), (1, 2), strict=True):
        path.write_text(HEADER + message(*E2E, number=number, name=name) + DEFINITIONS + protected(number))
    [found] = lint([read_dbc(path) for path in paths])
    assert (found.file, found.message, found.text) == ("other.dbc", "Y", "E2EDataId is also that of X")


@pytest.mark.parametrize(("load", "is_found"), [(0.6, False), (0.6001, True)])
def test_load(tmp_path, load, is_found):
    assert DEFAULT_MAX_LOAD == 0.6
    timing = BusTiming("robots", load, {"X": 1})
    expected = [Finding(Severity.ERROR, "site.dbc", "", "", "load of bus robots", f"{load:.1%}", "60.0%")] * is_found
    assert findings(tmp_path, message(GOOD), timings=[timing]) == expected
    assert len(findings(tmp_path, message(GOOD), timings=[timing], max_load=0.5)) == 1
    assert findings(tmp_path, message(GOOD), timings=[BusTiming("navigation", 0.1, {"X": None})]) == []


@pytest.mark.parametrize(
    ("bound_ns", "value"), [(10_000_000, None), (10_000_001, "10.00 ms"), (12_345_678, "12.35 ms"), (None, "unbounded")]
)
def test_response_times(tmp_path, bound_ns, value):
    found = findings(tmp_path, message(GOOD), timings=[BusTiming("robots", 0.1, {"X": bound_ns})])
    assert found == ([error("may reach the bus robots after its next cycle has begun", value, "10 ms")] if value else [])
    assert findings(tmp_path, message(GOOD), timings=[BusTiming("robots", 0.1, {"Other": None})]) == []


def test_errors_come_first(tmp_path):
    found = findings(tmp_path, message("S : 0|8@1+ (1,0) [0|0]") + message("S : 0|8@1+ (0,1) [1|1]", number=2, name="Y"))
    assert [(finding.severity.value, finding.message) for finding in found] == [("error", "Y"), ("warning", "X")]


def test_our_own_files_have_no_error():
    assert [finding for finding in lint([read_dbc(ROBOTS_DBC), read_dbc(GNSS_IMU_DBC)]) if finding.severity is Severity.ERROR] == []
