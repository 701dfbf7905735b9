"""One fault as data: what is taken, and with which words the rest is refused."""

import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from dbc.catalogue import load
from vehicle_emulator.faults.effects import STATE_EFFECTS
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.frames import FRAME_EFFECTS
from vehicle_emulator.faults.kinds import COUNTING, KINDS, TIMING, Group, Names, Number, Word, keys
from vehicle_emulator.faults.spec import MAX_FAULTS, FaultMistake, fault_of, fault_of_words, load_faults, named, parse_faults
from vehicle_emulator.faults.targets import check

CATALOGUE = load()
SPELLED = {"node": "SR", "code": 16, "messages": ["SR_Status"]}


def smallest(kind):
    """A fault with nothing but what its kind needs."""
    given_keys = {}
    for parameter in kind.parameters:
        if parameter.default is None and not parameter.is_optional:
            domain = parameter.domain
            choices = domain.choices if isinstance(domain, Word) else ()
            usual = domain.high if isinstance(domain, Number) else next(iter(choices), None)
            given_keys[parameter.name] = SPELLED.get(parameter.name, usual)
    if kind.needs_one:
        given_keys[next(parameter.name for parameter in kind.parameters if parameter.default is not None)] = 1.0
    return {"kind": kind.name, **given_keys}


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_every_kind_can_be_used_and_says_what_it_is(kind):
    (spec,) = named([fault_of(smallest(kind))])
    FaultEngine([spec], 1, 0, CATALOGUE)
    assert fault_of(spec.as_data()) == spec
    assert fault_of(json.loads(json.dumps(spec.as_data()))) == spec
    assert spec.text.split()[0] == kind.name


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_a_fault_can_be_typed_in_as_it_is_shown(kind):
    spec = fault_of(smallest(kind) | {"from_s": 1.5, "condition": "engaged"})
    words = spec.text.split()
    assert fault_of_words(words[0], words[1:]) == spec


def test_every_kind_has_an_effect_and_every_effect_a_kind():
    of_group = {group: {kind.name for kind in KINDS.values() if kind.group is group} for group in Group}
    assert set(FRAME_EFFECTS) == of_group[Group.FRAMES]
    assert set(STATE_EFFECTS) == set(KINDS) - of_group[Group.FRAMES] - of_group[Group.WIRE]


def test_no_key_means_two_things():
    common = {parameter.name for parameter in (*TIMING, *COUNTING)} | {"kind", "name"}
    for kind in KINDS.values():
        own = [parameter.name for parameter in kind.parameters]
        assert len(own) == len(set(own))
        assert not set(own) & common


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({}, "kind: allowed: drop, corrupt_bits, "),
        ({"kind": "explode"}, "kind = 'explode': allowed: drop, corrupt_bits, "),
        ({"kind": 3}, "kind = 3: allowed: drop, "),
        ("drop", "'drop' allowed: a table with kind"),
        ({"kind": "drop"}, "messages: missing; allowed: a name or a list of names"),
        ({"kind": "drop", "messages": []}, "messages = []: allowed: a name or a list of names"),
        ({"kind": "drop", "messages": [1]}, "messages = [1]: allowed: a name"),
        ({"kind": "drop", "messages": "SR", "message": "SR"}, "message = 'SR': unknown key; drop takes messages, from_s, "),
        (
            {"kind": "gust", "push_n": 1.0, "count": 3},
            "count = 3: unknown key; gust takes push_n, from_s, until_s, duration_s, condition, name",
        ),
        ({"kind": "gust", "push_n": "strong"}, "push_n = 'strong': allowed: -20000 to 20000 N"),
        ({"kind": "gust", "push_n": True}, "push_n = True: allowed: -20000 to 20000 N"),
        ({"kind": "gust", "push_n": float("nan")}, "push_n = nan: allowed: -20000 to 20000 N"),
        ({"kind": "gust", "push_n": 1e9}, "push_n = 1000000000.0: allowed: -20000 to 20000 N"),
        ({"kind": "corrupt_bits", "messages": "SR", "bits": 1.5}, "bits = 1.5: allowed: a whole number, 1 to 64"),
        ({"kind": "corrupt_bits", "messages": "SR", "bits": 65}, "bits = 65: allowed: a whole number, 1 to 64"),
        ({"kind": "drop", "messages": "SR", "every": 0}, "every = 0: allowed: a whole number, 1 to 1000000"),
        ({"kind": "drop", "messages": "SR", "probability": 1.1}, "probability = 1.1: allowed: 0 to 1"),
        ({"kind": "robot_stuck", "robot": "XR"}, "robot = 'XR': allowed: SR or AR or BR"),
        ({"kind": "gnss_mode", "mode": "Perfect"}, "mode = 'Perfect': allowed: None or Blanked or "),
        ({"kind": "ins_freeze", "from_s": -1.0}, "from_s = -1.0: allowed: 0 to 3600 s"),
        ({"kind": "ins_freeze", "duration_s": 0}, "duration_s = 0: allowed: 0.001 to 3600 s"),
        ({"kind": "ins_freeze", "duration_s": 1, "until_s": 2}, "until_s = 2: allowed: one of until_s and duration_s"),
        ({"kind": "ins_freeze", "from_s": 3, "until_s": 3}, "until_s = 3: allowed: more than from_s, 3"),
        ({"kind": "ins_freeze", "condition": "x > 3"}, "condition = 'x > 3': 'x > 3' is no clause; allowed: engaged"),
        ({"kind": "ins_freeze", "name": "a\nb"}, "name = 'a\\nb': allowed: text of 1 to 200 printable characters"),
        ({"kind": "ins_freeze", "name": 5}, "name = 5: allowed: text"),
        ({"kind": "ins_bias"}, "allowed: at least one of x_m, y_m, z_m, yaw_deg, speed_mps, yaw_rate_degps, ax_mps2 that is not 0"),
        ({"kind": "driver_pedals", "brake": 0.0}, "allowed: at least one of accelerator, brake that is not 0"),
    ],
)
def test_a_mistake_is_told_with_key_value_and_what_is_allowed(content, told):
    with pytest.raises(FaultMistake) as caught:
        fault_of(content)
    line, *others = str(caught.value).splitlines()
    assert line.startswith(told)
    assert others == []


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"kind": "drop", "messages": "SR_Stat"}, "fault drop: messages = 'SR_Stat': allowed: *, AR, BR, "),
        ({"kind": "drop", "messages": "0x7FE"}, "fault drop: messages = '0x7FE': allowed: *, "),
        ({"kind": "drop", "messages": "0xSR"}, "fault drop: messages = '0xSR': allowed: *, "),
        ({"kind": "silence", "node": "SR_Status"}, "fault silence: node = 'SR_Status': allowed: AR, BR, "),
        ({"kind": "bad_crc", "messages": ["SR", "PosLocal"]}, "fault bad_crc: messages = 'PosLocal': allowed: messages with end-to-end"),
        ({"kind": "robot_dtc", "robot": "AR", "code": 7}, "fault robot_dtc: code = 7: allowed: 1 (CmdTimeout), 2 ("),
    ],
)
def test_names_that_the_dbc_does_not_have_are_told(content, told):
    spec = named([fault_of(content)])
    for use in (lambda: check(spec, CATALOGUE), lambda: FaultEngine(spec, 1, 0, CATALOGUE)):
        with pytest.raises(FaultMistake) as caught:
            use()
        assert str(caught.value).startswith(told)
        assert "\n" not in str(caught.value)


def test_names_are_given_and_must_differ():
    content = [{"kind": "ins_freeze"}, {"kind": "ins_freeze", "name": "ins_freeze-2"}, {"kind": "ins_freeze"}, {"kind": "ins_dropout"}]
    assert [spec.name for spec in parse_faults(content)] == ["ins_freeze", "ins_freeze-2", "ins_freeze-3", "ins_dropout"]
    with pytest.raises(ValidationError, match="names that differ"):
        parse_faults([{"kind": "ins_freeze", "name": "a"}, {"kind": "ins_dropout", "name": "a"}])


@pytest.mark.parametrize("content", [None, {}, "drop", 3, [{"kind": "ins_freeze"}] * (MAX_FAULTS + 1)])
def test_what_is_no_list_of_faults_is_refused(content):
    with pytest.raises(ValidationError, match=f"a list of at most {MAX_FAULTS} faults"):
        parse_faults(content)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", ["faults: missing"]),
        ("[[fault]]\nkind = 'ins_freeze'", ["faults: missing"]),
        ("faults = 3", ["faults = 3: allowed: a list"]),
        ("[[faults]]\nkind = 'ins_freeze'\n[[faults]]\nkind = 'gust'\npush_n = 9e9",
         ["faults.1.push_n = 9000000000.0: allowed: -20000 to 20000 N"]),
        (
            "[[faults]]\n[[faults]]\nkind = 'drop'\nevry = 2",
            ["faults.0.kind: allowed: drop", "faults.1.evry = 2: unknown", "faults.1.messages: missing"],
        ),
        ("[[faults]", ["not valid TOML"]),
        ("faults = [ { kind = 'ins_freeze', name = '{0}' }, { kind = 'gust' } ]", ["faults.1.push_n: missing"]),
    ],
)  # fmt: skip
def test_a_mistake_in_a_file_names_the_file(tmp_path, text, told):
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(FaultMistake) as caught:
        load_faults(path)
    lines = str(caught.value).splitlines()
    assert len(lines) == len(told)
    assert all(line.startswith(f"{path}: {start}") for line, start in zip(lines, told, strict=True))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(FaultMistake, match="No such file"):
        load_faults(tmp_path / "none.toml")


def test_what_else_is_in_a_file_is_left_alone(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text("name = 'x'\n[[faults]]\nkind = 'gust'\npush_n = 3000\nfrom_s = 2\n[judge]\nfrom_m = 1")
    (spec,) = load_faults(path)
    assert (spec.name, spec.kind, spec.values["push_n"], spec.values["from_s"]) == ("gust", "gust", 3000, 2)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["ins_freeze", "duration_s"], "'duration_s': KEY=VALUE"),
        (["ins_freeze", "=2"], "'=2': KEY=VALUE"),
        (["ins_freeze", "from_s=1", "from_s=2"], "'from_s=2': from_s is given twice"),
        (["ins_freeze", "kind=gust"], "'kind=gust': kind is given twice"),
        (["ins_freeze", "from_s=soon"], "from_s = 'soon': allowed: 0 to 3600 s"),
        (["babble", "id=0x800"], "id = 2048: allowed: a whole number, 0 to 2047"),
        (["nonsense", "a=b"], "kind = 'nonsense': allowed: drop"),
    ],
)
def test_what_is_typed_wrong_is_one_line(words, told):
    with pytest.raises(FaultMistake) as caught:
        fault_of_words(words[0], words[1:])
    assert str(caught.value).startswith(told)
    assert "\n" not in str(caught.value)


def test_what_is_typed():
    spec = fault_of_words("bad_crc", ["messages=SR_Status,AR", "every=2", "condition=engaged and x_m > 30", "name=status garbled"])
    assert spec.name == "status garbled"
    assert spec.text == "bad_crc messages=SR_Status,AR condition='engaged and x_m > 30' every=2"
    assert fault_of_words("babble", ["id=0x7f"]).values["id"] == 127


KEYS = sorted({key for kind in KINDS.values() for key in keys(kind)} | {"kind", "name", "", "x"})
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12) | st.sampled_from(["SR", "*", "SR_Status", "engaged"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=5,
)
KIND = {"kind": st.sampled_from(list(KINDS))}


@settings(deadline=None, max_examples=300)
@given(st.fixed_dictionaries(KIND, optional={key: VALUES for key in KEYS if key != "kind"}) | VALUES)
def test_anything_is_a_fault_or_refused(content):
    try:
        specs = named([fault_of(content)])
        check(specs, CATALOGUE)
    except FaultMistake:
        return
    assert json.loads(json.dumps(specs[0].as_data()))["kind"] == content["kind"]
    FaultEngine(specs, 1, 0, CATALOGUE)


def test_toml_and_json_mean_the_same():
    toml = tomllib.loads("[[faults]]\nkind = 'drop'\nmessages = ['SR', 'INS']\nevery = 3\nfrom_s = 2\n")["faults"]
    assert parse_faults(toml) == parse_faults(json.loads(json.dumps(toml)))
    assert isinstance(keys(KINDS["drop"])["messages"].domain, Names)


def test_the_page_has_every_kind_as_it_is():
    page = (Path(__file__).parents[3] / "docs" / "faults.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line.startswith("| `")]
    told = {row[0].strip("`"): row[1:] for row in rows}
    assert all(parameter.name in page for parameter in (*TIMING, *COUNTING))
    for kind in KINDS.values():
        parameters = ", ".join(f"`{parameter.name}`" for parameter in kind.parameters) or "-"
        assert told[kind.name] == [kind.group.value, kind.description, parameters, "yes" if kind.is_counted else ""]
