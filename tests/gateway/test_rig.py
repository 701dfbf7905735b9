"""The rig file: one object out of a file or of options, and every mistake in one line."""

import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.errors import SetupFailure, UserMistake
from dbc.vehicle import FOCUS
from gateway import check
from gateway.limits import PROFILES
from gateway.preparation import configuration, prepare, start_recorder
from gateway.record.files import BusFormat, FileOptions
from gateway.record.session import gateway_session, origin
from gateway.rig import Rig, RigError, make_rig, read_rig
from tests.support.privilege import may_not_enter
from tests.support.site import SITE_FILES, SITE_MAPPING

EXAMPLE = Path(__file__).parents[2] / "gateway" / "target" / "rig.toml"
SMALLEST = f"""
name = "r"
profile = "bench"
buses = {{ robots = "xilgate:robots" }}
car = {{ dbc = ["{ROBOTS_DBC}", "{GNSS_IMU_DBC}"], vehicle = "{FOCUS}" }}
"""


@pytest.fixture
def rig_file(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "rig.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def with_hashes(*lines: str) -> str:
    return SMALLEST + "[hashes]\n" + "\n".join(lines) + "\n"


def test_smallest_file_has_every_default(rig_file):
    rig = read_rig(rig_file(SMALLEST))
    assert rig.buses.by_network == {"robots": "xilgate:robots", "navigation": "xilgate:robots"}
    assert (rig.recorder, rig.metrics, rig.car.mapping) == (None, None, None)
    assert (rig.realtime.priority, rig.realtime.cpus, rig.realtime.locks_memory) == (60, (), True)
    assert (rig.daemon.watchdog_s, rig.daemon.stop_within_s) == (1.0, 45.0)


def test_the_navigation_system_may_have_a_bus_of_its_own(rig_file):
    rig = read_rig(rig_file(changed('buses = { robots = "xilgate:robots", navigation = "xilgate:ins" }')))
    assert rig.buses.by_network == {"robots": "xilgate:robots", "navigation": "xilgate:ins"}


def test_example_is_a_rig_that_starts(tmp_path):
    for source in (EXAMPLE, ROBOTS_DBC, GNSS_IMU_DBC, FOCUS):
        shutil.copy(source, tmp_path)
    rig = read_rig(tmp_path / "rig.toml")
    assert rig.car.dbc == (tmp_path / "robots.dbc", tmp_path / "gnss_imu.dbc")
    assert rig.control.key == tmp_path / "rig.key"
    assert prepare(rig).profile is PROFILES["proving_ground"]
    sections = {name for name in Rig.model_fields if name not in ("name", "profile", "telemetry", "hashes")}
    assert set(re.findall(r"^\[(\w+)\]", EXAMPLE.read_text(), re.M)) == sections


def test_options_and_file_make_the_same_rig(rig_file, tmp_path):
    tree = {
        "name": "r",
        "profile": "bench",
        "buses": {"robots": "xilgate:robots"},
        "car": {"dbc": [str(ROBOTS_DBC), str(GNSS_IMU_DBC)], "vehicle": str(FOCUS)},
    }
    assert make_rig(Path("command line"), tree, tmp_path) == read_rig(rig_file(SMALLEST))


MISTAKES = {
    'profile = "fast"': ("profile", "'fast'", "nominal, proving_ground, lifted, bench"),
    'name = ""': ("name", "''", "at least 1 character"),
    "speed = 3": ("speed", "unknown key"),
    'buses = { robots = "can0" }': ("buses.robots", "'can0'", "INTERFACE:CHANNEL"),
    'buses = { robots = "socketcan:" }': ("buses.robots", "'socketcan:'", "INTERFACE:CHANNEL"),
    'buses = { robots = "sockecan:can0" }': ("buses.robots", "'sockecan:can0'", "an interface of", "socketcan", "xilgate"),
    'buses = { robots = 3 }': ("buses.robots", "3", "string"),
    'buses = { navigation = "socketcan:can0" }': ("buses.robots", "missing"),
    'car = { dbc = [], vehicle = "v" }': ("car.dbc", "at least one"),
    'car = { dbc = ["a", "a"], vehicle = "v" }': ("car.dbc", "each at most once"),
    'car = { dbc = ["a"] }': ("car.vehicle", "missing"),
    "telemetry = { base_port = 80 }": ("telemetry.base_port", "80", "1024 to 65000"),
    "telemetry = { base_port = true }": ("telemetry.base_port", "True", "integer"),
    "realtime = { priority = 99 }": ("realtime.priority", "99", "1 to 98"),
    "realtime = { priority = 1.5 }": ("realtime.priority", "1.5", "integer"),
    "realtime = { cpus = [-1] }": ("realtime.cpus.0", "-1", "0 to 1023"),
    "realtime = { cpus = [1, 1] }": ("realtime.cpus", "each at most once"),
    'realtime = { locks_memory = "yes" }': ("realtime.locks_memory", "'yes'", "boolean"),
    'recorder = { formats = ["blf"] }': ("recorder.directory", "missing"),
    'recorder = { directory = "d", formats = ["mf4"] }': ("recorder.formats.0", "'mf4'", "'blf', 'candump' or 'asc'"),
    'recorder = { directory = "d", max_file_mb = 0 }': ("recorder.max_file_mb", "0", "1 to 4096"),
    'recorder = { directory = "d", max_files = 1 }': ("recorder.max_files", "1", "2 to 10000"),
    "metrics = { }": ("metrics.port", "missing"),
    "metrics = { port = 70000 }": ("metrics.port", "70000", "1024 to 65000"),
    "daemon = { watchdog_s = 0.0 }": ("daemon.watchdog_s", "0.0", "0.2 to 10"),
    "daemon = { watchdog_s = 10.1 }": ("daemon.watchdog_s", "10.1", "0.2 to 10"),
    "daemon = { stop_within_s = 0.9 }": ("daemon.stop_within_s", "0.9", "1 to 60"),
    "daemon = { stop_within_s = inf }": ("daemon.stop_within_s", "inf", "finite"),
    'hashes = { limits = "abc" }': ("hashes.limits", "'abc'", "64 hexadecimal digits"),
    "control = { key = 7 }": ("control.key", "7", "allowed: a path"),
}


def changed(line: str) -> str:
    key = line.split(" ", 1)[0]
    return "\n".join([*(kept for kept in SMALLEST.splitlines() if not kept.startswith(f"{key} ")), line])


@pytest.mark.parametrize(("line", "said"), MISTAKES.items(), ids=list(MISTAKES))
def test_a_mistake_is_one_line_with_file_key_value_and_what_is_allowed(rig_file, line, said):
    path = rig_file(changed(line))
    with pytest.raises(RigError) as caught:
        read_rig(path)
    (text,) = str(caught.value).splitlines()
    assert text.startswith(f"{path}: {said[0]}")
    assert all(part in text for part in said[1:]), text


def test_all_mistakes_are_told_at_once(rig_file):
    lines = [line for line in MISTAKES if line.split(" ", 1)[0] in ("profile", "telemetry", "realtime", "metrics", "daemon")]
    text = "\n".join(dict(zip([line.split(" ", 1)[0] for line in lines], lines, strict=True)).values())
    with pytest.raises(RigError) as caught:
        read_rig(rig_file(SMALLEST.replace('profile = "bench"', "") + text))
    assert len(str(caught.value).splitlines()) == 5


@pytest.mark.parametrize("text", ["name = ", "\x00", "a = 1\na = 2"])
def test_what_is_no_toml_is_one_line(rig_file, text):
    with pytest.raises(RigError, match="not valid TOML") as caught:
        read_rig(rig_file(text))
    assert str(caught.value).startswith(str(rig_file(text)))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RigError, match=r"nowhere\.toml: No such file"):
        read_rig(tmp_path / "nowhere.toml")


PLAIN = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8))
TREES = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3))


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.sampled_from([*Rig.model_fields, "x"]), TREES, max_size=6))
def test_whatever_a_file_says_is_a_rig_or_a_mistake(tree):
    with pytest.raises(RigError) as caught:  # no tree that is made like this says all that a rig needs
        make_rig(Path("f"), tree, Path("/"))
    assert all(line.startswith("f: ") for line in str(caught.value).splitlines())


# What the rig names.


def test_files_that_cannot_be_used_are_told_at_once(rig_file, tmp_path):
    (tmp_path / "broken.dbc").write_text("BO_ nonsense")
    text = SMALLEST.replace(str(ROBOTS_DBC), "broken.dbc").replace(str(FOCUS), "nowhere.toml")
    with pytest.raises(UserMistake) as caught:
        prepare(read_rig(rig_file(text)))
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert "broken.dbc" in lines[0]
    assert "nowhere.toml" in lines[1]


def test_a_dbc_without_the_messages_that_the_gateway_needs(rig_file):
    with pytest.raises(UserMistake, match="PosLocal"):
        prepare(read_rig(rig_file(SMALLEST.replace(f', "{GNSS_IMU_DBC}"', ""))))


@pytest.mark.req("S5")
def test_files_that_a_record_could_not_tell_apart_are_refused(rig_file, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for source, copy in ((ROBOTS_DBC, "a/car.dbc"), (GNSS_IMU_DBC, "b/car.dbc"), (GNSS_IMU_DBC, "limits"), (FOCUS, "a/focus.toml")):
        shutil.copy(source, tmp_path / copy)
    (tmp_path / "b" / "focus.toml").write_text("")

    def told(dbc: str, more: str) -> list[str]:
        text = re.sub(r"car = .*", f"car = {{ dbc = {dbc}, vehicle = 'a/focus.toml'{more} }}", SMALLEST)
        with pytest.raises(UserMistake) as caught:
            prepare(read_rig(rig_file(text)))
        return str(caught.value).splitlines()

    (same,) = told('["a/car.dbc", "b/car.dbc"]', "")
    assert same == f"{tmp_path}/b/car.dbc: named as {tmp_path}/a/car.dbc, records could not tell them apart; allowed: a name of its own"
    (same,) = told(f'["{ROBOTS_DBC}", "{GNSS_IMU_DBC}"]', ", mapping = 'b/focus.toml'")
    assert f"{tmp_path}/b/focus.toml: named as {tmp_path}/a/focus.toml" in same
    (reserved,) = told('["a/car.dbc", "limits"]', "")
    assert f"{tmp_path}/limits: named as another hash; allowed: any name but configuration, " in reserved


@pytest.mark.req("S5")
def test_hashes_pin_files_and_limits(rig_file):
    found = prepare(read_rig(rig_file(SMALLEST))).hashes
    pinned = with_hashes(*(f'"{name}" = "{found[name]}"' for name in ("robots.dbc", "focus.toml", "limits", "configuration")))
    assert prepare(read_rig(rig_file(pinned))).hashes["limits"] == found["limits"]
    other = "0" * 64
    with pytest.raises(RigError) as caught:
        prepare(read_rig(rig_file(with_hashes(f'limits = "{other}"', f'"other.dbc" = "{other}"'))))
    wrong, unknown = str(caught.value).splitlines()
    assert f"hashes.limits = '{other}'" in wrong
    assert found["limits"] in wrong
    assert "hashes.other.dbc: unknown" in unknown
    assert "robots.dbc" in unknown
    nearly = found["limits"][:-1] + ("0" if found["limits"][-1] != "0" else "1")
    with pytest.raises(RigError, match=nearly):
        prepare(read_rig(rig_file(with_hashes(f'limits = "{nearly}"'))))


@pytest.mark.req("S5")
def test_a_record_has_the_hashes_that_were_pinned(rig_file):
    preparation = prepare(read_rig(rig_file(SMALLEST)))
    found, rig = preparation.hashes, preparation.rig
    pinned = prepare(read_rig(rig_file(with_hashes(f'configuration = "{found["configuration"]}"')))).rig
    session = gateway_session(1, preparation.profile, rig.car.dbc, rig.car.vehicle, configuration(pinned))
    for name in ("limits", "configuration", "robots.dbc"):
        assert session.sha256[name] == found[name]
    assert session.sha256["vehicle"] == found["focus.toml"]


@pytest.mark.req("S5")
def test_a_record_has_the_mapping_of_the_site_and_its_hash():
    session = gateway_session(1, PROFILES["bench"], SITE_FILES, FOCUS, {}, mapping_path=SITE_MAPPING)
    assert session.mapping == SITE_MAPPING.read_text(encoding="utf-8")
    assert session.sha256["mapping"] == hashlib.sha256(SITE_MAPPING.read_bytes()).hexdigest()


def test_a_machine_whose_clock_begins_in_1970_has_a_record_all_the_same(monkeypatch):
    monkeypatch.setattr("gateway.record.session.time", SimpleNamespace(time_ns=lambda: 5, monotonic_ns=lambda: 3))
    found = origin(1, {})
    assert found["started_utc"] == "2000-01-01T00:00:00.000+00:00"
    assert found["wall_offset_ns"] + 3 == 946_684_800 * 10**9


def test_hashes_follow_what_they_stand_for(rig_file, tmp_path):
    base = prepare(read_rig(rig_file(SMALLEST))).hashes
    (tmp_path / "focus.toml").write_text(FOCUS.read_text() + "\n# another file\n")
    other_file = prepare(read_rig(rig_file(SMALLEST.replace(str(FOCUS), "focus.toml")))).hashes
    assert {name for name in base if other_file[name] != base[name]} == {"focus.toml", "configuration"}
    other_limits = prepare(read_rig(rig_file(SMALLEST.replace('"bench"', '"nominal"')))).hashes
    assert {name for name in base if other_limits[name] != base[name]} == {"limits", "configuration"}


@pytest.mark.req("S7")
def test_the_effective_configuration_is_plain_and_holds_no_secret(rig_file, tmp_path):
    (tmp_path / "rig.key").write_text("5e" * 32)
    rig = read_rig(rig_file(SMALLEST + 'control = { key = "rig.key" }'))
    text = json.dumps(configuration(rig))
    assert str(tmp_path / "rig.key") in text
    assert "5e5e" not in text
    assert set(configuration(rig)) == set(Rig.model_fields)


# The machine.


def test_a_key_that_others_can_read_is_refused(rig_file, tmp_path):
    key = tmp_path / "rig.key"
    key.write_text("5e" * 32)
    key.chmod(0o644)
    with pytest.raises(UserMistake, match=r"rig.key: mode 0644"):
        check.check_machine(read_rig(rig_file(SMALLEST + 'control = { key = "rig.key" }')))


def test_a_key_of_the_default_name_that_others_can_read_is_refused(rig_file, tmp_path):
    (tmp_path / "key").write_text("5e" * 32)
    (tmp_path / "key").chmod(0o644)
    with pytest.raises(UserMistake, match=r"key: mode 0644"):
        check.check_machine(read_rig(rig_file(SMALLEST + f'control = {{ directory = "{tmp_path}" }}')))


def test_a_key_that_is_named_must_be_there(rig_file, tmp_path):
    with pytest.raises(UserMistake, match=r"rig\.key: no such file"):
        check.check_machine(read_rig(rig_file(SMALLEST + f'control = {{ directory = "{tmp_path}", key = "rig.key" }}')))


@pytest.mark.req("S1")
def test_a_private_key_of_telemetry_that_others_can_read_is_refused(rig_file, tmp_path):
    for name in ("rig.pem", "rig.pem.key", "readers-ca.pem"):
        (tmp_path / name).touch(0o600)
    files = 'certificate = "rig.pem"\nprivate_key = "rig.pem.key"\nauthority = "readers-ca.pem"\n'
    rig = read_rig(rig_file(f'{SMALLEST}control = {{ directory = "{tmp_path}" }}\n[telemetry.tls]\naddress = "192.0.2.1:7547"\n{files}'))
    check.check_machine(rig)
    (tmp_path / "rig.pem.key").chmod(0o644)
    with pytest.raises(UserMistake, match=r"rig\.pem\.key: mode 0644"):
        check.check_machine(rig)


def test_a_directory_that_may_not_be_written_to_is_a_set_up_failure(rig_file, tmp_path, monkeypatch):
    monkeypatch.setattr(check.os, "access", lambda path, mode: not mode & os.W_OK)  # root may write everywhere
    with pytest.raises(SetupFailure, match=rf"^control\.directory = '{tmp_path}': not writable for this user$"):
        check.check_machine(read_rig(rig_file(SMALLEST + f'control = {{ directory = "{tmp_path}" }}')))


def test_the_recorder_is_told_what_the_rig_file_says(rig_file, tmp_path, monkeypatch):
    monkeypatch.setattr("gateway.preparation.Recorder", lambda options, session, catalogue: (options, session))
    recording = 'directory = "r", formats = ["asc", "blf"], max_file_mb = 3, max_file_s = 50.0, max_files = 7'
    preparation = prepare(read_rig(rig_file(f"{SMALLEST}recorder = {{ {recording} }}")))
    options, session = start_recorder(preparation, preparation.rig.recorder, 9)
    assert re.fullmatch(r"gateway-\d{8}T\d{6}Z", options.stem)
    assert options == FileOptions(tmp_path / "r", options.stem, (BusFormat.ASC, BusFormat.BLF), 3 << 20, 50.0, 7)
    assert (session.boot_id, session.profile, session.mapping) == (9, "bench", None)


def test_directories_that_are_not_there_are_set_up_failures(rig_file, tmp_path):
    sections = f'control = {{ directory = "{tmp_path}/a" }}\nrecorder = {{ directory = "{tmp_path}/b" }}'
    with pytest.raises(SetupFailure) as caught:
        check.check_machine(read_rig(rig_file(SMALLEST + sections)))
    assert [line.split(" = ")[0] for line in str(caught.value).splitlines()] == ["control.directory", "recorder.directory"]


def test_directories_that_may_not_be_entered_are_set_up_failures(rig_file, tmp_path):
    closed = tmp_path / "closed"
    rig = read_rig(rig_file(SMALLEST + f'control = {{ directory = "{closed}" }}\nrecorder = {{ directory = "{closed}/b" }}'))
    with may_not_enter(closed):
        with pytest.raises(SetupFailure) as checked:
            check.check_machine(rig)
        with pytest.raises(SetupFailure) as started:
            FileOptions(closed / "b", "gateway").refuse_existing()
    assert f"recorder.directory = '{closed}/b': Permission denied" in str(checked.value).splitlines()
    assert f"control.directory = '{closed}': " in str(checked.value)
    assert str(started.value) == f"{closed}/b: Permission denied"


def test_a_check_makes_no_key_and_no_socket(rig_file, tmp_path):
    check.check_machine(read_rig(rig_file(SMALLEST + f'control = {{ directory = "{tmp_path}" }}')))
    assert [path.name for path in tmp_path.iterdir()] == ["rig.toml"]


def test_what_is_missing_but_may_come_is_a_warning(rig_file):
    warnings = check.warnings(read_rig(rig_file(SMALLEST + "realtime = { cpus = [0, 1023] }")))
    assert [warning.split(":")[0] for warning in warnings] == ["robots", "navigation", "realtime.cpus", "recorder"]
    assert "1023" in warnings[2]
