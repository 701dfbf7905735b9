"""What is different between two DBC files, and what of it breaks those who stay with the old one."""

import re

import pytest

from dbc.catalogue import ROBOTS_DBC
from dbc.database import read_dbc
from dbc.difference import Change, compare

OLD = """VERSION ""
BU_: A B
BO_ 1 X: 8 A
 SG_ Crc : 0|8@1+ (1,0) [0|255] "" B
 SG_ AliveCounter : 8|4@1+ (1,0) [0|15] "" B
 SG_ S : 16|8@1+ (1,0) [0|255] "km/h" B
 SG_ T : 24|8@1- (0.5,1) [0|9] "" B

BO_ 2 Y: 8 B
 SG_ M M : 0|8@1+ (1,0) [0|3] "" A
 SG_ P m1 : 8|8@1+ (1,0) [0|9] "" A
 SG_ Q m2 : 8|8@1+ (1,0) [0|9] "" A

BA_DEF_ "BusName" STRING ;
BA_DEF_ "Baudrate" INT 0 1000000;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_ BO_ "GenMsgTimeout" INT 0 10000;
BA_DEF_ BO_ "E2EProfile" STRING ;
BA_DEF_ BO_ "E2EDataId" INT 0 255;
BA_DEF_DEF_ "BusName" "robots";
BA_DEF_DEF_ "Baudrate" 500000;
BA_DEF_DEF_ "GenMsgCycleTime" 10;
BA_DEF_DEF_ "GenMsgTimeout" 50;
BA_DEF_DEF_ "E2EProfile" "";
BA_DEF_DEF_ "E2EDataId" 0;
BA_ "E2EProfile" BO_ 1 "P02";
BA_ "E2EDataId" BO_ 1 7;
VAL_ 1 S 0 "None" 1 "Some" ;
"""


def differences(tmp_path, *edits, old=OLD):
    new = old
    for before, after in edits:
        assert new.count(before) == 1, before
        new = new.replace(before, after)
    for name, text in (("old.dbc", old), ("new.dbc", new)):
        (tmp_path / name).write_text(text)
    return compare(read_dbc(tmp_path / "old.dbc"), read_dbc(tmp_path / "new.dbc"))


@pytest.mark.parametrize(
    ("before", "after", "change"),
    [
        ("BO_ 1 X: 8 A", "BO_ 1 Z: 8 A", Change(True, "X", "", "name", "X", "Z")),
        ("BO_ 1 X: 8 A", "BO_ 1 X: 7 A", Change(True, "X", "", "length", "8 bytes", "7 bytes")),
        ("BO_ 1 X: 8 A", "BO_ 1 X: 8 B", Change(True, "X", "", "sender", "A", "B")),
        ('Baudrate" 500000', 'Baudrate" 250000', Change(True, "", "", "bit rate", "500000", "250000")),
        ('BusName" "robots"', 'BusName" "navigation"', Change(True, "", "", "network", "robots", "navigation")),
        ("SG_ T :", "SG_ U :", Change(True, "X", "T", "name", "T", "U")),
        ("24|8@1-", "32|8@1-", Change(True, "X", "T", "layout", "24|8@1-", "32|8@1-")),
        ("24|8@1-", "24|9@1-", Change(True, "X", "T", "layout", "24|8@1-", "24|9@1-")),
        ("24|8@1-", "24|8@1+", Change(True, "X", "T", "layout", "24|8@1-", "24|8@1+")),
        ("24|8@1-", "31|8@0-", Change(True, "X", "T", "layout", "24|8@1-", "31|8@0-")),
        ("(0.5,1)", "(0.25,1)", Change(True, "X", "T", "scale", "(0.5,1)", "(0.25,1)")),
        ("(0.5,1)", "(0.5,-1)", Change(True, "X", "T", "scale", "(0.5,1)", "(0.5,-1)")),
        ("(0.5,1) [0|9]", "(0.5,1) [0|8]", Change(True, "X", "T", "range", "[0|9]", "[0|8]")),
        ("(0.5,1) [0|9]", "(0.5,1) [-1|9]", Change(True, "X", "T", "range", "[0|9]", "[-1|9]")),
        ("(0.5,1) [0|9]", "(0.5,1) [0|0]", Change(True, "X", "T", "range", "[0|9]", "[|]")),
        ('"km/h"', '"m/s"', Change(True, "X", "S", "unit", "km/h", "m/s")),
        ('"km/h"', '""', Change(True, "X", "S", "unit", "km/h", "")),
        ("SG_ Q m2", "SG_ Q m3", Change(True, "Y", "Q", "multiplexing", "M = 2", "M = 3")),
        ('1 "Some"', '1 "Many"', Change(True, "X", "S", "entry 1", "Some", "Many")),
        ('1 "Some" ', "", Change(True, "X", "S", "entry 1", "Some", "")),
        ('1 "Some" ', '1 "Some" 2 "All" ', Change(False, "X", "S", "entry 2", "", "All")),
        ('CycleTime" 10', 'CycleTime" 20', None),
        ("BO_ 1 7", "BO_ 1 8", Change(True, "X", "", "end-to-end protection", "P02, data id 7", "P02, data id 8")),
        ('BO_ 1 "P02"', 'BO_ 1 ""', Change(True, "X", "", "end-to-end protection", "P02, data id 7", "none")),
        ('"km/h" B', '"km/h" B,A', Change(False, "X", "S", "receiver added", "", "A")),
        ('"km/h" B', '"km/h" Vector__XXX', Change(False, "X", "S", "receiver removed", "B", "")),
    ],
)
def test_one_change(tmp_path, before, after, change):
    found = differences(tmp_path, (before, after))
    if change is None:
        assert found == [Change(True, name, "", "cycle time", "10 ms", "20 ms") for name in ("X", "Y")]
    else:
        assert found == [change]


def test_a_node_of_another_name_is_one_change(tmp_path):
    text = ROBOTS_DBC.read_text()
    lines = [re.sub(r"\bRC\b", "SUPERVISOR", line) if re.match(r" SG_|BO_|BU_", line) else line for line in text.splitlines()]
    (tmp_path / "new.dbc").write_text("\n".join(lines) + "\n")
    assert compare(read_dbc(ROBOTS_DBC), read_dbc(tmp_path / "new.dbc")) == [Change(True, "", "", "node", "RC", "SUPERVISOR")]
    # One that does not all that the other did is another node.
    found = differences(tmp_path, ("BU_: A B", "BU_: A B C"), ("BO_ 1 X: 8 A", "BO_ 1 X: 8 C"))
    assert found == [Change(True, "X", "", "sender", "A", "C")]
    # One that only listens breaks nothing by its name; of two that listen alike nobody knows which is which.
    listening = OLD.replace('"km/h" B', '"km/h" B,C').replace("BU_: A B", "BU_: A B C D")
    assert differences(tmp_path, ('"km/h" B,C', '"km/h" B,E'), old=listening) == [Change(False, "", "", "node", "C", "E")]
    both = listening.replace('"km/h" B,C', '"km/h" B,C,D')
    assert differences(tmp_path, ('"km/h" B,C,D', '"km/h" B,E,F'), old=both) == [
        Change(False, "X", "S", "receiver added", "", "E, F"),
        Change(False, "X", "S", "receiver removed", "C, D", ""),
    ]
    assert differences(tmp_path, ('"km/h" B,C,D', '"km/h" B,E'), old=both) == [
        Change(False, "X", "S", "receiver added", "", "E"),
        Change(False, "X", "S", "receiver removed", "C, D", ""),
    ]


def test_no_change(tmp_path):
    assert differences(tmp_path) == []
    assert differences(tmp_path, ('VERSION ""', 'VERSION "2"\n'), ("BU_: A B", "BU_: A B C")) == []
    ours = read_dbc(ROBOTS_DBC)
    assert compare(ours, ours) == []


@pytest.mark.parametrize(
    ("before_ms", "after_ms", "breaks"), [(50, 49, True), (50, 51, False), (50, 0, False), (0, 50, True), (0, 1, True), (50, 50, None)]
)
def test_a_shorter_timeout_breaks(tmp_path, before_ms, after_ms, breaks):
    old = OLD + f'BA_ "GenMsgTimeout" BO_ 2 {before_ms};\n'
    found = differences(tmp_path, (f"BO_ 2 {before_ms};", f"BO_ 2 {after_ms};"), old=old)
    assert found == ([] if breaks is None else [Change(breaks, "Y", "", "timeout", f"{before_ms} ms", f"{after_ms} ms")])


def test_what_is_added_and_removed(tmp_path):
    more = 'BO_ 3 Z: 8 B\n SG_ S : 0|8@1+ (1,0) [0|9] "" A\n\nBO_ 2 Y'
    assert differences(tmp_path, ("BO_ 2 Y", more)) == [Change(False, "Z", "", "added", "", "0x3")]
    signal = ' SG_ U : 40|8@1+ (1,0) [0|9] "" B\n'
    assert differences(tmp_path, ("\nBO_ 2 Y", f"{signal}\nBO_ 2 Y")) == [Change(False, "X", "U", "added", "", "40|8@1+")]
    gone = ' SG_ T : 24|8@1- (0.5,1) [0|9] "" B\n'
    assert differences(tmp_path, (gone, "")) == [Change(True, "X", "T", "removed", "24|8@1-", "")]
    y = OLD[OLD.index("BO_ 2 Y") : OLD.index("BA_DEF_")]
    assert differences(tmp_path, (y, "")) == [Change(True, "Y", "", "removed", "0x2", "")]


def test_a_new_identifier_and_an_extended_one(tmp_path):
    assert differences(tmp_path, ("BO_ 2 Y", "BO_ 4 Y")) == [Change(True, "Y", "", "identifier", "0x2", "0x4")]
    assert differences(tmp_path, ("BO_ 2 Y", "BO_ 2147483650 Y"))[0] == Change(True, "Y", "", "identifier", "0x2", "0x2 extended")


def test_a_multiplexer_that_is_one_no_more(tmp_path):
    pages = ' SG_ P m1 : 8|8@1+ (1,0) [0|9] "" A\n SG_ Q m2 : 8|8@1+ (1,0) [0|9] "" A\n'
    found = differences(tmp_path, (pages, ""), ("SG_ M M", "SG_ M"))
    assert [(change.signal, change.what, change.old, change.new) for change in found] == [
        ("M", "multiplexing", "multiplexer", ""),
        ("P", "removed", "8|8@1+", ""),
        ("Q", "removed", "8|8@1+", ""),
    ]


def test_floats_are_another_layout(tmp_path):
    old = OLD.replace("24|8@1-", "24|32@1-")
    found = differences(tmp_path, ("VAL_ 1", "SIG_VALTYPE_ 1 T : 1;\nVAL_ 1"), old=old)
    assert found == [Change(True, "X", "T", "layout", "24|32@1-", "24|32@1- float")]


def test_a_signal_that_changed_places_is_not_renamed(tmp_path):
    """Two signals that swap their bits keep their names, and a page is not mistaken for another one's."""
    found = differences(tmp_path, ("SG_ P m1", "SG_ R m1"))
    assert found == [Change(True, "Y", "P", "name", "P", "R")]
    found = differences(tmp_path, ("SG_ Crc : 0|8@1+ (1,0) [0|255]", "SG_ Crc : 16|8@1+ (1,0) [0|255]"), ("S : 16|8", "S : 0|8"))
    assert [(change.signal, change.what) for change in found] == [("Crc", "layout"), ("S", "layout")]


def test_what_breaks_comes_first(tmp_path):
    found = differences(tmp_path, ('1 "Some" ', '1 "Some" 2 "All" '), ("(0.5,1) [0|9]", "(0.5,1) [0|8]"))
    assert [change.is_breaking for change in found] == [True, False]
