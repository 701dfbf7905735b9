"""Mapping of a site's DBC: what is renamed and rescaled, and every mistake in one line with file, key, value and what is allowed."""

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, Catalogue, CatalogueError, load
from dbc.database import read_dbc
from dbc.mapping import apply_mapping

OURS = [read_dbc(ROBOTS_DBC), read_dbc(GNSS_IMU_DBC)]

DBC = """VERSION ""
BU_: HOST ARM
BO_ 80 MOVE: 8 HOST
 SG_ Where : 7|16@0- (0.001,0.5) [-10|11] "rad" ARM
 SG_ How : 23|3@0+ (1,0) [0|7] "" ARM
 SG_ Enable : 20|1@0+ (1,0) [0|1] "" ARM,Other
 SG_ Free : 39|8@0+ (1,0) [0|0] "Nm" ARM

BO_ 81 PAGES: 8 ARM
 SG_ Which M : 7|8@0+ (1,0) [0|3] "" HOST
 SG_ Limit m1 : 15|16@0+ (0.1,0) [0|6000] "deg" HOST

BO_ 82 OWN: 8 ARM
 SG_ Temperature : 0|8@1+ (1,0) [0|255] "K" HOST

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_DEF_ "GenMsgCycleTime" 20;
VAL_ 80 How 1 "GO" 2 "IDLE" 5 "Torque" ;
VAL_ 82 Temperature 255 "SNA" ;
"""
MAPPING = """
[nodes]
GW = "HOST"
SR = "ARM"

[messages.SR_Command]
name = "MOVE"
[messages.SR_Command.signals]
AngleCommand = { name = "Where", factor = -57.0, offset = 1.0 }
Mode = { name = "How", values = { AnglePosition = "GO", Off = "IDLE" } }
TorqueLimit = "Free"

[messages.RC_FaultReport]
name = "PAGES"
[messages.RC_FaultReport.signals]
Page = "Which"
MaxAngle = "Limit"
"""


def loaded(tmp_path, mapping=MAPPING, dbc=DBC):
    (tmp_path / "site.dbc").write_text(dbc)
    (tmp_path / "site.toml").write_text(mapping)
    return Catalogue(files(tmp_path))


def files(tmp_path):
    """What `load` makes a catalogue of; our own files are read once."""
    return apply_mapping(tmp_path / "site.toml", [read_dbc(tmp_path / "site.dbc")], OURS)


def signal_of(tmp_path, message, signal):
    [file] = files(tmp_path)
    return next(one for one in file.messages if one.name == message).get_signal_by_name(signal)


def test_names_units_and_nodes_are_ours(tmp_path):
    catalogue = loaded(tmp_path)
    assert set(catalogue.by_name) == {"SR_Command", "RC_FaultReport", "OWN"}
    spec = catalogue.by_name["SR_Command"]
    assert (spec.arbitration_id, spec.sender, spec.cycle_time_ns) == (80, "GW", 20_000_000)
    assert catalogue.signals("SR_Command") == ("AngleCommand", "Mode", "Enable", "TorqueLimit")
    assert catalogue.enumeration("SR_Command", "Mode") == {"AnglePosition": 1, "Off": 2, "Torque": 5}
    angle = signal_of(tmp_path, "SR_Command", "AngleCommand")
    assert (angle.unit, angle.receivers) == ("deg", ["SR"])
    assert signal_of(tmp_path, "SR_Command", "Enable").receivers == ["SR", "Other"]
    assert signal_of(tmp_path, "OWN", "Temperature").unit == "K"


def test_factor_and_offset_are_applied_to_value_and_range(tmp_path):
    catalogue = loaded(tmp_path)
    # The site's 0.001 * raw + 0.5 rad, from -10 to 11 rad, times -57, plus 1.
    assert catalogue.bounds("SR_Command", "AngleCommand") == (-626.0, 571.0)
    # -570 + 1 is 10 rad: raw 9500 = 0x251C. Nothing is given for the mode: Off, which is 2 here, in the upper three bits of byte 2.
    assert catalogue.encode("SR_Command", {"AngleCommand": -569.0}).hex() == "251c400000000000"
    assert catalogue.encode("SR_Command", {"Mode": 1, "AngleCommand": -569.0}).hex() == "251c200000000000"
    assert catalogue.bounds("SR_Command", "TorqueLimit") == (float("-inf"), float("inf"))


def test_a_multiplexer_keeps_its_pages_under_another_name(tmp_path):
    catalogue = loaded(tmp_path)
    payload = catalogue.encode("RC_FaultReport", {"MaxAngle": 460.0})
    assert payload.hex() == "0111f80000000000"  # page 1, 4600 * 0.1
    assert files(tmp_path)[0].messages[1].decode(payload)["MaxAngle"] == 460.0


def test_what_keeps_its_name_needs_no_key(tmp_path):
    mapping = '[messages.SR_Command]\n[messages.SR_Command.signals]\nEnable = { factor = -1.0, offset = 1.0 }\nMode = { name = "How" }\n'
    dbc = DBC.replace("MOVE", "SR_Command")
    catalogue = loaded(tmp_path, mapping, dbc)
    assert catalogue.encode("SR_Command", {"Enable": 1})[2] & 0x10 == 0
    assert catalogue.encode("SR_Command", {"Enable": 0})[2] & 0x10 == 0x10


def test_names_may_change_places(tmp_path):
    mapping = '[messages.SR_Command]\nname = "AR_Command"\n[messages.AR_Command]\nname = "SR_Command"\n'
    dbc = 'VERSION ""\nBU_: A\nBO_ 1 SR_Command: 8 A\n\nBO_ 2 AR_Command: 8 A\n'
    catalogue = loaded(tmp_path, mapping, dbc)
    assert {name: spec.arbitration_id for name, spec in catalogue.by_name.items()} == {"SR_Command": 2, "AR_Command": 1}


def test_the_hash_of_the_mapping_is_part_of_the_catalogue(tmp_path):
    loaded(tmp_path)
    paths = [tmp_path / "site.dbc"], tmp_path / "site.toml"
    first = load(*paths).sha256
    (tmp_path / "site.toml").write_text(MAPPING + "# changed\n")
    second = load(*paths).sha256
    assert set(first) == {"site.dbc", "site.toml"}
    assert first["site.dbc"] == second["site.dbc"]
    assert first["site.toml"] != second["site.toml"]


def test_a_table_beside_a_scaled_value_is_no_hindrance(tmp_path):
    mapping = '[messages.SR_Diag]\nname = "OWN"\n[messages.SR_Diag.signals.MotorTemperature]\n'
    mapping += 'name = "Temperature"\nfactor = 1.0\noffset = -273.0\n'
    catalogue = loaded(tmp_path, mapping)
    assert catalogue.bounds("SR_Diag", "MotorTemperature") == (-273.0, -18.0)
    assert catalogue.enumeration("SR_Diag", "MotorTemperature") == {"SNA": 255}


ANGLE = "messages.SR_Command.signals.AngleCommand"
TABLE = "messages.SR_Command.signals.Mode: a signal with a value table has no factor and no offset"


@pytest.mark.parametrize(
    ("old", "new", "mistake"),
    [
        ('GW = "HOST"', 'GX = "HOST"', "nodes.GX: unknown key, allowed: AR, BR, CAR, GW, INS, RC, SR"),
        ('GW = "HOST"', 'GW = "HOTS"', "nodes.GW = 'HOTS': not in the DBC, allowed: ARM, HOST, Other"),
        ('SR = "ARM"', 'SR = "HOST"', "nodes.SR = 'HOST': is GW already"),
        ("messages.SR_Command]", "messages.SR_Comand]", "messages.SR_Comand: unknown key, allowed: GW_SafetyCommand, RC_SafetyStatus, "),
        ('name = "MOVE"', 'name = "MOOVE"', "messages.SR_Command.name = 'MOOVE': not in the DBC, allowed: MOVE, PAGES, OWN"),
        ('name = "PAGES"', 'name = "MOVE"', "messages.RC_FaultReport.name = 'MOVE': is SR_Command already"),
        ("AngleCommand =", "Angle =", "messages.SR_Command.signals.Angle: unknown key, allowed: Crc, AliveCounter, Mode, Enable, "),
        ('"Free"', '"Fee"', "messages.SR_Command.signals.TorqueLimit.name = 'Fee': not in the DBC, allowed: Where, How, Enable, Free"),
        ('"Free"', '"How"', "messages.SR_Command.signals.TorqueLimit.name = 'How': is Mode already"),
        ("Off =", "Of =", "messages.SR_Command.signals.Mode.values.Of: unknown key, allowed: SNA, Release, Torque, AngleRate, AnglePo"),
        ('"IDLE"', '"IDEL"', "messages.SR_Command.signals.Mode.values.Off = 'IDEL': not in the DBC, allowed: GO, IDLE, Torque"),
        ('"IDLE"', '"GO"', "messages.SR_Command.signals.Mode.values.Off = 'GO': is AnglePosition already"),
        ("Off =", "Torque =", "messages.SR_Command.signals.Mode.values.Torque = 'IDLE': the DBC has another Torque: rename it there"),
        ("TorqueLimit =", "Enable =", "messages.SR_Command.signals.Enable.name = 'Free': the DBC has another Enable: rename it there"),
        ("factor = -57.0", "factor = 0.0", f"{ANGLE}.factor = 0.0: allowed: any number but 0"),
        ("factor = -57.0", "factor = nan", f"{ANGLE}.factor = nan: Input should be a finite number"),
        ("factor = -57.0", 'factor = "-57"', f"{ANGLE}.factor = '-57': Input should be a valid number"),
        ("factor = -57.0", "fctor = -57.0", f"{ANGLE}.fctor: unknown key"),
        (", factor = -57.0, offset = 1.0", "", f"{ANGLE}: MOVE.Where is in rad, ours in deg: needs a factor, 1.0 when both mean the same"),
        ("factor = -57.0, ", "", f"{ANGLE}: MOVE.Where is in rad, ours in deg: needs a factor"),
        ('"Free"', '"Enable"', "messages.SR_Command.signals.TorqueLimit: MOVE.Enable is in no unit, ours in Nm: needs a factor"),
        ('"How", values', '"How", factor = 2.0, values', TABLE),
        ('"How", values', '"How", offset = 2.0, values', TABLE),
        ('"Free"', '{ name = "Free", values = { A = "B" } }', "messages.SR_Command.signals.TorqueLimit.values.A: unknown key, "),
        ('"Free"', "7", "messages.SR_Command.signals.TorqueLimit = 7: Input should be"),
        ("[nodes]", "[knots]", "knots: unknown key"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, old, new, mistake):
    assert MAPPING.count(old) == 1
    with pytest.raises(CatalogueError) as caught:
        loaded(tmp_path, MAPPING.replace(old, new))
    lines = str(caught.value).splitlines()
    assert any(line.startswith(f"{tmp_path / 'site.toml'}: {mistake}") for line in lines), lines
    assert all(line.startswith(f"{tmp_path / 'site.toml'}: ") for line in lines)


def test_all_mistakes_are_told_at_once(tmp_path):
    with pytest.raises(CatalogueError) as caught:
        loaded(tmp_path, MAPPING.replace("HOST", "HOTS").replace("MOVE", "MOOVE").replace('"Limit"', '"Limits"'))
    assert [line.split(": ")[1].split(" ")[0] for line in str(caught.value).splitlines()] == [
        "nodes.GW",
        "messages.SR_Command.name",
        "messages.RC_FaultReport.signals.MaxAngle.name",
    ]


def test_a_message_that_has_our_name_already_must_go(tmp_path):
    dbc = DBC.replace("OWN", "SR_Command")
    with pytest.raises(CatalogueError, match=r"messages\.SR_Command\.name = 'MOVE': the DBC has another SR_Command: rename it there$"):
        loaded(tmp_path, dbc=dbc)


def test_a_unit_is_compared_for_messages_of_our_name_as_well(tmp_path):
    dbc = GNSS_IMU_DBC.read_text().replace('"deg/s" GW', '"rad/s" GW', 1)
    with pytest.raises(CatalogueError, match=r"messages\.RateVehicle\.signals\.AngRateX: .* is in rad/s, ours in deg/s: needs a factor"):
        loaded(tmp_path, "", dbc)


def test_an_empty_mapping_changes_nothing(tmp_path):
    (tmp_path / "site.toml").write_text("")
    ours, mapped = load(), load(mapping=tmp_path / "site.toml")
    assert mapped.by_name == ours.by_name
    for name in ours.by_name:
        assert mapped.encode(name, {}) == ours.encode(name, {})
        for signal in ours.signals(name):
            assert mapped.bounds(name, signal) == ours.bounds(name, signal)


@pytest.mark.parametrize(("text", "mistake"), [(None, "No such file or directory"), ("[nodes", "not valid TOML: ")])
def test_a_file_that_cannot_be_read_is_one_line(tmp_path, text, mistake):
    if text is not None:
        (tmp_path / "site.toml").write_text(text)
    with pytest.raises(CatalogueError, match=mistake) as caught:
        load(mapping=tmp_path / "site.toml")
    assert str(caught.value).startswith(f"{tmp_path / 'site.toml'}: ")
    assert "\n" not in str(caught.value)
