"""The requirement matrix: which tests are evidence for which id of docs/safety.md, and the figures that they found.

Printed at the end of every run. A mark with an unknown id is an error; an id without any test fails a run of the whole suite.
With pytest-xdist the processes of the run collect and run the tests, and the one that started them adds up what they say.
"""

import os
import re
import signal
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.support import evidence
from tests.support.evidence import Figure
from tests.support.machine import machine

SAFETY_CONCEPT = Path(__file__).resolve().parent.parent / "docs" / "safety.md"
_ID_ROW = re.compile(r"^\| *([EFGS]\d+) *\|")
_IN_A_ROW = 8
_FIGURE = "figure"

# Tests share the machine with one another: how long an example takes on the wall's clock says nothing.
settings.register_profile("xilgate", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("xilgate")


def requirement_ids(text: str) -> list[str]:
    """Ids of the tables in a safety concept, in their order."""
    return [found[1] for line in text.splitlines() if (found := _ID_ROW.match(line))]


def unmet(ids: list[str], node_ids: dict[str, set[str]]) -> list[str]:
    """Ids that no test is evidence for."""
    return [identifier for identifier in ids if not node_ids.get(identifier)]


def matrix(ids: list[str], node_ids: dict[str, set[str]], outcomes: dict[str, str]) -> Iterator[str]:
    """One entry for each id: its tests, by outcome."""
    for identifier in ids:
        counts = Counter(outcomes.get(node_id, "not run") for node_id in node_ids.get(identifier, ()))
        details = ", ".join(f"{count} {outcome}" for outcome, count in sorted(counts.items()) if outcome != "passed")
        yield f"{identifier} {counts['passed']}" + (f" ({details})" if details else "")


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[..., bool]:
    """Call it with what was measured, or with that, value, unit and target; all are printed at the end of the run.

    It returns whether the target is met, to be asserted; see `tests.support.evidence.Figure`.
    """
    section = evidence.section_of(request.module.__doc__)

    def record(what: str, value: float | None = None, unit: str = "", target: str = "") -> bool:
        found = Figure(section, what, value, unit, target)
        request.node.user_properties.append((_FIGURE, (section, what, value, unit, target)))
        return found.is_met

    return record


class Run:
    """What the tests of this run are evidence for, what became of them, and what they found."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._node_ids: defaultdict[str, set[str]] = defaultdict(set)
        self._outcomes: dict[str, str] = {}
        self._figures: list[Figure] = []
        self._is_whole = not any(map(config.getoption, ("file_or_dir", "keyword", "deselect")))
        self._ids = requirement_ids(SAFETY_CONCEPT.read_text(encoding="utf-8"))

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Called before `-m` takes tests away: one that is left for the long lane is evidence too."""
        for item in items:
            for mark in item.iter_markers("req"):
                if unknown := set(mark.args) - set(self._ids):
                    raise pytest.UsageError(f"{item.nodeid}: req {', '.join(sorted(unknown))}: not in {SAFETY_CONCEPT.name}")
                for identifier in mark.args:
                    self._node_ids[identifier].add(item.nodeid)
        # A process of `--dist worksteal` without work takes tests from the end of another's: the first and the last of all stay together.
        items.sort(key=lambda item: (item.get_closest_marker("realtime") is not None, item.get_closest_marker("shared_setup") is None))
        # A change of a module fails its own tests, most of the time: mutmut stops at the first that fails.
        mutated, _, _ = os.environ.get("MUTANT_UNDER_TEST", "").rpartition(".")
        items.sort(key=lambda item: item.path.stem != f"test_{mutated.rpartition('.')[2]}")

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        if (run := getattr(self._config, "workerinput", {}).get("testrunuid")) is None:
            return (yield)
        with machine(_lock(run), is_alone=item.get_closest_marker("realtime") is not None):
            return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or (report.outcome != "passed" and self._outcomes.get(report.nodeid) != "failed"):
            self._outcomes[report.nodeid] = report.outcome
        if report.when == "teardown":
            self._figures += [Figure(*value) for name, value in report.user_properties if name == _FIGURE]

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        if (output := getattr(self._config, "workeroutput", None)) is not None:
            output["requirements"] = {identifier: sorted(node_ids) for identifier, node_ids in self._node_ids.items()}
        elif self._is_whole and exitstatus == pytest.ExitCode.OK and unmet(self._ids, self._node_ids):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        for identifier, node_ids in getattr(node, "workeroutput", {}).get("requirements", {}).items():
            self._node_ids[identifier].update(node_ids)
        _lock(node.workerinput["testrunuid"]).unlink(missing_ok=True)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self._figures:
            terminalreporter.section("figures")
            for found in self._figures:
                terminalreporter.write_line(str(found), red=not found.is_met)
            if self._config.getoption("--evidence"):
                old = evidence.EVIDENCE.read_text(encoding="utf-8") if evidence.EVIDENCE.exists() else ""
                evidence.EVIDENCE.write_text(evidence.merged(old, self._figures, evidence.provenance()), encoding="utf-8")
        if not self._node_ids:
            return
        shown = self._ids if self._is_whole else [identifier for identifier in self._ids if identifier in self._node_ids]
        entries = list(matrix(shown, self._node_ids, self._outcomes))
        terminalreporter.section(f"requirements of {SAFETY_CONCEPT.name}: tests passed")
        for start in range(0, len(entries), _IN_A_ROW):
            terminalreporter.write_line("   ".join(entries[start : start + _IN_A_ROW]))
        if self._is_whole and (missing := unmet(self._ids, self._node_ids)):
            terminalreporter.write_line(f"FAILED: no test for {', '.join(missing)}", red=True)


def _lock(run: str) -> Path:
    return Path(tempfile.gettempdir()) / f"xilgate-tests-{run}"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--evidence", action="store_true", help="keep what was measured in docs/evidence.md")


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # A shell that runs us in the background has it ignored, which our processes would inherit; some tests interrupt them.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    config.pluginmanager.register(Run(config))
