"""Summary and report of a run: complete, readable without a network, and the same thing."""

import hashlib
import json
import re
import subprocess
from dataclasses import asdict
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path

import pytest

from dbc.vehicle import FOCUS, load_vehicle
from gateway.telemetry import ParameterChange, ParametersSample
from tests.support.recorded_drive import RecordedDrive
from xil.injected import InjectedFault
from xil.metrics import evaluate
from xil.report import write_report
from xil.scenario import SCENARIO_FOLDER, Stage, load_scenario
from xil.summary import RunFacts, build_summary, git_revision

VEHICLE = load_vehicle()
LOADING = {"src", "href", "action", "srcset", "data", "xlink:href"}
VOID = {"meta", "line", "path", "rect", "circle", "br", "link", "img", "input"}


class Page(HTMLParser):
    """Reads a report: attributes that could load something, texts by tag, and whether every element is closed."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.loading: list[str] = []
        self.classes: list[str] = []
        self.texts: dict[str, list[str]] = {}
        self.open: list[str] = []
        self.feed(content)

    def handle_starttag(self, tag, attrs):
        self.loading += [f"{tag} {name}={value}" for name, value in attrs if name in LOADING]
        self.classes += [value for name, value in attrs if name == "class"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)


def run(folder: Path, name: str = "iso3888-1", stage: Stage = Stage.HIL, changes=(), faults=(), **spoiled):
    scenario = load_scenario(name)
    recording = RecordedDrive(scenario, VEHICLE, **spoiled).recording
    verdict = evaluate(recording, scenario, VEHICLE, stage)
    files = {"vehicle": FOCUS, "scenario": SCENARIO_FOLDER / f"{name}.toml"}
    started = datetime(2026, 5, 4, 12, 30, tzinfo=UTC)
    facts = RunFacts(scenario, stage, 7, "casadi-c", started, 21.5, "gcc 12.2", files, 6.254, {"robots": 0.19541})
    summary = build_summary(facts, verdict, changes, faults)
    path = folder / "report.html"
    write_report(path, summary, recording, scenario, VEHICLE, verdict)
    return summary, path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def passed(tmp_path_factory):
    return run(tmp_path_factory.mktemp("passed"))


def plots_of(content: str):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', content, re.DOTALL)[1])


def test_report_asks_nobody_for_anything(passed):
    _, content = passed
    assert Page(content).loading == []
    assert re.findall(r"https?://|\burl\(|@import|//[a-z0-9-]+\.[a-z]{2,}/", content) == []
    assert "default-src 'none'" in content


def test_speed_and_bus_load_are_told(passed):
    summary, content = passed
    assert (summary["realtime_factor"], summary["bus_load"]) == (6.25, {"robots": 0.19541})
    told = " ".join(Page(content).texts["dd"])
    assert "6.2 times real time" in told
    assert "19.54 %" in told
    assert "load of bus robots" in Page(content).texts["dt"]


def test_report_parses_and_stays_small(passed):
    _, content = passed
    page = Page(content)
    assert page.open == []
    assert "{{" not in re.sub(r"<script.*?</script>", "", content, flags=re.DOTALL)
    assert len(content.encode()) < 500_000


def test_report_tells_verdict_reason_and_every_figure(passed):
    summary, content = passed
    page = Page(content)
    assert "banner pass" in page.classes
    assert page.texts["strong"] == ["pass"]
    assert "every limit kept" in content
    for metric in summary["metrics"] + summary["timing"]:
        assert metric["name"] in page.texts["td"], metric["name"]
    for value in (*summary["sha256"].values(), summary["git_revision"], summary["compiler"], *summary["versions"].values()):
        assert value in content


def test_plots_hold_what_was_recorded(passed):
    _, content = passed
    data = plots_of(content)
    plots = {plot["title"].partition(",")[0].partition(" (")[0]: plot for plot in data["plots"]}
    assert list(plots) == [
        "Speed", "Yaw", "Lateral error", "Lateral acceleration", "Steering robot", "Accelerator robot", "Brake robot", "Solve time",
    ]  # fmt: skip
    assert all(len({len(column) for column in plot["data"]}) == 1 for plot in data["plots"])
    assert all(100 < len(plot["data"][0]) <= 1500 for plot in data["plots"])
    assert max(plots["Speed"]["data"][2]) == pytest.approx(80.0, abs=0.01)
    assert max(plots["Brake robot"]["data"][2]) > 10.0
    assert plots["Solve time"]["limits"] == [40.0]
    assert [mode["mode"] for mode in data["modes"]] == ["READY", "ENGAGED"]
    assert data["judged_s"] == pytest.approx([5.4, 11.25], abs=0.02)


def test_failed_run_says_so_and_marks_the_row(tmp_path):
    summary, content = run(tmp_path, left_of_reference_m=lambda s: -0.33 if 55.0 < s < 60.0 else 0.0)
    page = Page(content)
    assert summary["verdict"] == "fail"
    assert summary["reason"].startswith("gate 2 touched by ")
    assert "banner fail" in page.classes
    assert page.classes.count("failed") == len([m for m in summary["metrics"] if not m["passed"]]) >= 1
    assert "contact touched" in page.classes


def test_map_of_a_curved_course_has_equal_axes_and_that_of_the_lane_change_says_that_it_has_not(tmp_path, passed):
    _, content = run(tmp_path, "lane-keeping")
    assert "lateral scale equal to the longitudinal" in content
    assert "lateral scale 3 times the longitudinal" in passed[1]


def test_run_without_any_pose_still_has_a_report(tmp_path):
    summary, content = run(tmp_path, keep=lambda topic, t_s: False)
    assert Page(content).open == []
    assert summary["reason"] in content.replace("&#39;", "'")
    assert plots_of(content)["plots"] == []


def test_texts_from_outside_cannot_become_markup(tmp_path):
    reason = "</script><b>x</b>"
    summary, content = run(tmp_path, leaves_engaged=(6.0, "SAFE_STOP", reason))
    assert reason in summary["reason"]
    assert reason not in content
    assert Page(content).open == []


def test_summary_is_json_and_complete(passed):
    summary, _ = passed
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert (summary["scenario"], summary["stage"], summary["seed"], summary["solver"]) == ("iso3888-1", "hil", 7, "casadi-c")
    assert (summary["verdict"], summary["reason"]) == ("pass", "every limit kept")
    assert (summary["started"], summary["duration_s"]) == ("2026-05-04T12:30:00+00:00", 21.5)
    assert set(summary["versions"]) == {"xilgate", "python", "casadi", "cantools", "python-can", "zenoh", "numpy"}
    assert summary["sha256"]["vehicle"] == hashlib.sha256(FOCUS.read_bytes()).hexdigest()
    assert all(set(m) == {"name", "value", "unit", "relation", "limit", "passed"} for m in summary["metrics"] + summary["timing"])


def test_who_tunes_while_it_drives_is_told_of(tmp_path, passed):
    change = ParameterChange(name="planner.safe_time_s", old=1.8, new=1.2)
    sample = ParametersSample(t_ns=5, seq=1, version=1, accepted_ns=4, who="me", changes=[change], reverts=[])
    summary, content = run(tmp_path, changes=[sample])
    (told,) = summary["parameter_changes"]
    assert (told["who"], told["changes"]) == ("me", [{"name": "planner.safe_time_s", "old": 1.8, "new": 1.2}])
    assert "tuned while driving" in content
    assert "tuned while driving" not in passed[1]


def test_two_lockstep_runs_have_the_same_metrics(tmp_path):
    summaries = [run(tmp_path, stage=Stage.SIL, solve_time_ms=lambda t_s, ms=ms: ms)[0] for ms in (2.0, 9.0)]
    assert summaries[0]["metrics"] == summaries[1]["metrics"]


def test_git_revision_says_when_files_differ(tmp_path):
    def git(*arguments: str) -> None:
        author = ("-c", "user.name=n", "-c", "user.email=e@x")
        subprocess.run(["git", "-C", str(tmp_path), *author, *arguments], check=True, capture_output=True)

    assert git_revision(tmp_path) == "unknown"
    git("init", "-q")
    (tmp_path / "file").write_text("a")
    git("add", "file")
    git("commit", "-q", "--no-verify", "-m", "m")
    clean = git_revision(tmp_path)
    assert re.fullmatch("[0-9a-f]{12}", clean)
    (tmp_path / "file").write_text("b")
    assert git_revision(tmp_path) == f"{clean}-dirty"


def test_injected_faults_are_told(tmp_path):
    garbled = InjectedFault("steering garbled", "bad_crc messages=SR_Status", 3.25, 5.25, 200)
    summary, content = run(tmp_path, faults=[garbled, InjectedFault("gust", "gust push_n=1", 6.0, None, 0)])
    assert summary["faults"][0] == asdict(garbled)
    json.dumps(summary)
    page = Page(content)
    assert page.open == []
    cells = page.texts["td"]
    first = cells.index("steering garbled")
    assert [cell.replace("\xa0", " ") for cell in cells[first : first + 10]] == [
        "steering garbled", "3.25 s", "5.25 s", "200", "bad_crc messages=SR_Status", "gust", "6.00 s", "–", "0", "gust push_n=1",
    ]  # fmt: skip
    assert "faults injected: 2" in page.texts["b"]


def test_without_faults_nothing_is_said_of_them(passed):
    summary, content = passed
    assert summary["faults"] == []
    assert "njected" not in content
