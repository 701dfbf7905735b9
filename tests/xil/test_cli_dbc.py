"""`xilgate dbc check|diff|list`: what they say, as tables and as JSON, and their exit codes."""

import json

import pytest
from typer.testing import CliRunner

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load, read_files
from tests.support.processes import xilgate
from tests.support.site import SITE_DBC, SITE_FILES, SITE_MAPPING
from xil.cli import app
from xil.dbc_report import ACTED_ON, timings

DATA_ID = 'BA_ "E2EDataId" BO_ 272 17;'


def run(*arguments):
    """Exit code and output of `xilgate dbc`."""
    result = CliRunner().invoke(app, ["dbc", *map(str, arguments)], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def run_json(*arguments):
    code, output = run(*arguments, "--json")
    return code, json.loads(output)


def changed(tmp_path, *edits):
    text = ROBOTS_DBC.read_text()
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = tmp_path / "robots.dbc"
    path.write_text(text)
    return path


def test_our_files_have_no_errors():
    code, found = run_json("check")
    assert (code, found["errors"]) == (0, 0)
    # The car's own control units and the navigation system protect nothing: known, and told.
    unprotected = {one["message"] for one in found["findings"] if one["text"] == "acted on without end-to-end protection"}
    assert {"PosLocal", "CAR_WheelSpeeds"} <= unprotected
    assert unprotected == {name for name in ACTED_ON if load().by_name[name].e2e_data_id is None}
    code, output = run("check")
    assert code == 0
    assert f"0 errors, {len(found['findings'])} warnings" in output
    assert "CAR_WheelSpeeds" in output


def test_the_site_is_checked_under_our_names():
    code, found = run_json("check", *SITE_FILES, "--mapping", SITE_MAPPING)
    assert (code, found["errors"]) == (0, 0)
    assert "CAR_WheelSpeeds" in {one["message"] for one in found["findings"]}
    code, found = run_json("check", SITE_DBC)
    assert (code, {one["text"] for one in found["findings"] if one["severity"] == "error"}) == (1, {"not where P02 has it"})


def test_an_error_is_named_with_all_that_is_known_of_it(tmp_path):
    code, found = run_json("check", changed(tmp_path, (DATA_ID, DATA_ID.replace("17", "18"))))
    assert code == 1
    assert [one for one in found["findings"] if one["severity"] == "error"] == [
        {
            "severity": "error",
            "file": "robots.dbc",
            "message": "AR_Command",
            "signal": "",
            "text": "E2EDataId is also that of SR_Command",
            "value": "18",
            "limit": "one message each",
        }
    ]


def test_a_command_that_lost_its_protection_is_an_error(tmp_path):
    path = changed(tmp_path, ('BA_ "E2EProfile" BO_ 272 "P02";', ""), (DATA_ID, ""))
    code, output = run("check", path)
    assert code == 1
    [line] = [line for line in output.splitlines() if "SR_Command" in line]
    for word in ("error", "robots.dbc", "acted on without end-to-end protection", "P02"):
        assert word in line


def test_load_and_response_times_are_limited(tmp_path):
    code, found = run_json("check", "--max-load", "0.2")
    assert (code, [one["text"] for one in found["findings"][:2]]) == (1, ["load of bus robots", "load of bus navigation"])
    assert (found["findings"][0]["file"], found["findings"][0]["limit"]) == ("robots.dbc", "20.0%")
    slow = [changed(tmp_path, ('BA_DEF_DEF_ "Baudrate" 500000', 'BA_DEF_DEF_ "Baudrate" 125000'))]
    code, found = run_json("check", *slow)
    late = [one for one in found["findings"] if "next cycle" in one["text"]]
    assert code == 1
    # 1.08 ms each: the first ten of 10 ms and the longest of the others fill a cycle; what comes behind them never ends.
    assert {one["value"] for one in late} >= {"unbounded"}
    assert "SR_Command" not in {one["message"] for one in late}


def test_what_a_parser_warns_of_is_a_finding(tmp_path, caplog):
    twice = changed(tmp_path, ("BO_ 1792 GW_Heartbeat", "BO_ 1793 GW_Heartbeat"))
    code, found = run_json("check", twice)
    assert code == 1
    assert "identifier is also that of GW_Heartbeat" in {one["text"] for one in found["findings"]}
    assert caplog.records == []


def test_diff_of_a_file_with_itself():
    assert run_json("diff", ROBOTS_DBC, ROBOTS_DBC) == (0, {"breaking": 0, "changes": []})
    code, output = run("diff", ROBOTS_DBC, ROBOTS_DBC)
    assert code == 0
    assert "0 that break, 0 compatible" in output


def test_diff_says_what_breaks(tmp_path):
    new = changed(tmp_path, (DATA_ID, DATA_ID.replace("17", "20")), ('3 "D"', '4 "S" 3 "D"'))
    code, found = run_json("diff", ROBOTS_DBC, new)
    assert (code, found["breaking"]) == (1, 1)
    assert found["changes"][0] == {
        "is_breaking": True,
        "message": "SR_Command",
        "signal": "",
        "what": "end-to-end protection",
        "old": "P02, data id 17",
        "new": "P02, data id 20",
    }
    code, output = run("diff", ROBOTS_DBC, new)
    assert code == 1
    assert "1 that break, 1 compatible" in output
    assert "P02, data id 20" in output
    assert run_json("diff", ROBOTS_DBC, changed(tmp_path, ('3 "D"', '4 "S" 3 "D"')))[0] == 0


def test_list_as_json():
    code, found = run_json("list")
    assert code == 0
    assert len(found["messages"]) == len(load().by_name)
    by_name = {row["name"]: row for row in found["messages"]}
    # By hand: the longest frame of 8 bytes is 135 bits, 270 us at 500 kbit/s, 2.7 % of a cycle of 10 ms. Of the highest priority it
    # waits for one frame that has begun, and its own; the next in line waits for one more.
    assert by_name["GW_SafetyCommand"] == {
        "id": 0xA0,
        "name": "GW_SafetyCommand",
        "sender": "GW",
        "network": "robots",
        "length_bytes": 8,
        "cycle_ms": 10.0,
        "timeout_ms": 100.0,
        "e2e_data_id": 160,
        "load": pytest.approx(0.027),
        "worst_response_ms": pytest.approx(0.54),
        "file": "robots.dbc",
    }
    assert by_name["RC_SafetyStatus"]["worst_response_ms"] == pytest.approx(0.81)
    assert (by_name["IsoOrientation"]["worst_response_ms"], by_name["IsoOrientation"]["load"]) == (None, 0.0)
    for network, load_share in found["loads"].items():
        assert load_share == pytest.approx(sum(row["load"] for row in found["messages"] if row["network"] == network))
    assert "signals" not in found


def test_list_as_table():
    code, output = run("list", ROBOTS_DBC)
    assert code == 0
    [line] = [line for line in output.splitlines() if "SR_Command" in line]
    for cell in ("0x110", "GW", "robots", "10 ms", "100 ms", "17", "2.70%", "1.08 ms"):
        assert f" {cell} " in line
    assert "PosLocal" not in output
    assert "navigation" not in output
    assert "AngleCommand" not in output


def test_list_with_signals_under_our_names():
    code, found = run_json("list", SITE_DBC, "--mapping", SITE_MAPPING, "--signals")
    assert code == 0
    [angle] = [row for row in found["signals"] if (row["message"], row["name"]) == ("SR_Command", "AngleCommand")]
    assert (angle["unit"], angle["start"], angle["byte_order"], angle["receivers"]) == ("deg", 23, "big_endian", ["SR", "RC"])
    assert angle["scale"] == pytest.approx(-57.29578 * 0.0008)
    assert (angle["minimum"], angle["maximum"]) == (pytest.approx(-1080.03, abs=0.01), pytest.approx(1080.03, abs=0.01))
    [selector] = [row for row in found["signals"] if row["name"] == "Selector"]
    assert selector["values"] == {"P": 1, "R": 2, "N": 3, "D": 4, "SNA": 0}
    code, output = run("list", SITE_DBC, "--mapping", SITE_MAPPING, "--signals")
    assert code == 0
    assert "0x090" in output
    assert "23|16@0-" in output


def test_a_signal_without_a_range_has_that_of_its_bits(tmp_path):
    path = tmp_path / "x.dbc"
    path.write_text('VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n SG_ S : 0|8@1- (0.5,0) [0|0] "" A\n')
    [row] = run_json("list", path, "--signals")[1]["signals"]
    assert (row["minimum"], row["maximum"]) == (-64.0, 63.5)


def test_an_overloaded_bus_has_no_response_time(tmp_path):
    path = changed(tmp_path, ('BA_DEF_DEF_ "Baudrate" 500000', 'BA_DEF_DEF_ "Baudrate" 100000'))
    code, output = run("list", path)
    assert code == 0
    [line] = [line for line in output.splitlines() if "GW_Status" in line]
    assert " none " in line


def test_every_bus_is_analysed_on_its_own():
    robots, navigation = timings(read_files([ROBOTS_DBC, GNSS_IMU_DBC]))
    assert (robots.network, navigation.network) == ("robots", "navigation")
    assert not set(robots.bounds_ns) & set(navigation.bounds_ns)
    assert robots.bounds_ns["GW_SafetyCommand"] == 540_000


@pytest.mark.parametrize("command", ["check", "list", "diff"])
def test_a_file_that_is_not_there_is_one_line(command, tmp_path):
    missing = tmp_path / "nowhere.dbc"
    with pytest.raises(CatalogueError, match=r"nowhere\.dbc: No such file or directory$"):
        run(command, missing, *([ROBOTS_DBC] if command == "diff" else []))


def test_the_process_ends_with_the_exit_code_of_a_mistake(tmp_path):
    finished = xilgate("dbc", "check", str(tmp_path / "nowhere.dbc"))
    assert (finished.returncode, finished.stdout) == (2, "")
    assert finished.stderr == f"xilgate: {tmp_path / 'nowhere.dbc'}: No such file or directory\n"
    assert xilgate("dbc", "diff", str(ROBOTS_DBC), str(GNSS_IMU_DBC)).returncode == 1
