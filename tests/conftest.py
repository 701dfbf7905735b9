"""The requirement matrix: which tests are evidence for which id of docs/safety.md, and the figures that they found.

Printed at the end of every run. A mark with an unknown id is an error; an id without any test fails a run of the whole suite.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

SAFETY_CONCEPT = Path(__file__).resolve().parent.parent / "docs" / "safety.md"
_ID_ROW = re.compile(r"^\| *([EFGS]\d+) *\|")
_IN_A_ROW = 8

_NODE_IDS = pytest.StashKey[dict[str, set[str]]]()
_OUTCOMES = pytest.StashKey[dict[str, str]]()
_FIGURES = pytest.StashKey[list[str]]()
_IS_WHOLE = pytest.StashKey[bool]()


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
def figure(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Call it with a line that says what was measured; all lines are printed at the end of the run."""
    return request.config.stash[_FIGURES].append


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_NODE_IDS], config.stash[_OUTCOMES], config.stash[_FIGURES] = defaultdict(set), {}, []
    config.stash[_IS_WHOLE] = not config.getoption("file_or_dir") and not config.getoption("keyword") and not config.getoption("deselect")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Called before `-m` takes tests away: one that is left for the long lane is evidence too."""
    known = set(requirement_ids(SAFETY_CONCEPT.read_text(encoding="utf-8")))
    for item in items:
        for mark in item.iter_markers("req"):
            if unknown := set(mark.args) - known:
                raise pytest.UsageError(f"{item.nodeid}: req {', '.join(sorted(unknown))}: not in {SAFETY_CONCEPT.name}")
            for identifier in mark.args:
                config.stash[_NODE_IDS][identifier].add(item.nodeid)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report = yield
    outcomes = item.config.stash[_OUTCOMES]
    if report.when == "call" or (report.outcome != "passed" and outcomes.get(item.nodeid) != "failed"):
        outcomes[item.nodeid] = report.outcome
    return report


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    config = session.config
    if config.stash[_IS_WHOLE] and exitstatus == pytest.ExitCode.OK and _without_a_test(config):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _without_a_test(config: pytest.Config) -> list[str]:
    return unmet(requirement_ids(SAFETY_CONCEPT.read_text(encoding="utf-8")), config.stash[_NODE_IDS])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if figures := config.stash[_FIGURES]:
        terminalreporter.section("figures")
        for line in figures:
            terminalreporter.write_line(line)
    if not config.stash[_NODE_IDS]:
        return
    ids = requirement_ids(SAFETY_CONCEPT.read_text(encoding="utf-8"))
    shown = ids if config.stash[_IS_WHOLE] else [identifier for identifier in ids if identifier in config.stash[_NODE_IDS]]
    entries = list(matrix(shown, config.stash[_NODE_IDS], config.stash[_OUTCOMES]))
    terminalreporter.section(f"requirements of {SAFETY_CONCEPT.name}: tests passed")
    for start in range(0, len(entries), _IN_A_ROW):
        terminalreporter.write_line("   ".join(entries[start : start + _IN_A_ROW]))
    if config.stash[_IS_WHOLE] and (missing := _without_a_test(config)):
        terminalreporter.write_line(f"FAILED: no test for {', '.join(missing)}", red=True)
