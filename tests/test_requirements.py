"""The requirement matrix itself."""

import pytest

from tests import conftest
from tests.support import evidence

pytest_plugins = ("pytester",)

CONCEPT = "| id | requirement |\n|---|---|\n| E1 | silent |\n| F12 | dead |\n\nE2 in a text\n"


def test_ids_are_those_of_the_tables():
    assert conftest.requirement_ids(CONCEPT) == ["E1", "F12"]
    ids = conftest.requirement_ids(conftest.SAFETY_CONCEPT.read_text(encoding="utf-8"))
    expected = [f"E{k}" for k in range(1, 5)] + [f"F{k}" for k in range(1, 19)]
    assert ids == expected + [f"G{k}" for k in range(1, 6)] + [f"S{k}" for k in range(1, 8)]


def test_the_matrix_counts_tests_by_outcome():
    entries = conftest.matrix(["E1", "F12"], {"E1": {"a", "b", "c"}}, {"a": "passed", "b": "failed"})
    assert list(entries) == ["E1 1 (1 failed, 1 not run)", "F12 0"]
    assert conftest.unmet(["E1", "F12"], {"E1": {"a"}}) == ["F12"]


@pytest.fixture
def suite(pytester):
    """A suite of its own with this matrix and a concept of two requirements."""
    (pytester.path / "safety.md").write_text(CONCEPT)
    source = conftest.__file__
    pytester.makeconftest(
        f"import importlib.util, sys\n"
        f"spec = importlib.util.spec_from_file_location('matrix', {source!r})\n"
        f"matrix = sys.modules['matrix'] = importlib.util.module_from_spec(spec)\n"
        f"spec.loader.exec_module(matrix)\n"
        f"from pathlib import Path\n"
        f"matrix.SAFETY_CONCEPT = Path({str(pytester.path / 'safety.md')!r})\n"
        f"globals().update({{name: value for name, value in vars(matrix).items() if name.startswith('pytest_') or name == 'figure'}})\n"
    )
    pytester.makeini("[pytest]\nmarkers =\n req\n long\n realtime\naddopts = -p no:cacheprovider --strict-markers\n")
    return pytester


def test_a_requirement_without_a_test_fails_the_whole_suite_and_no_part_of_it(suite):
    suite.makepyfile(test_it="import pytest\n@pytest.mark.req('E1')\ndef test_a(figure):\n    figure('12 ms of 20')\n")
    whole = suite.runpytest()
    assert whole.ret == 1
    whole.stdout.fnmatch_lines(["*figures*", "12 ms of 20", "*requirements*", "E1 1   F12 0", "FAILED: no test for F12"])
    assert suite.runpytest("test_it.py").ret == 0
    assert suite.runpytest("-k", "test_a").ret == 0


def test_a_test_of_the_long_lane_is_evidence_too(suite):
    suite.makepyfile(
        test_it="import pytest\n@pytest.mark.req('E1')\ndef test_a(): pass\n"
        "@pytest.mark.long\n@pytest.mark.req('F12')\ndef test_b(): pass\n"
    )
    result = suite.runpytest("-m", "not long")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["E1 1   F12 0 (1 not run)"])


def test_an_unknown_requirement_is_named(suite):
    suite.makepyfile(test_it="import pytest\n@pytest.mark.req('E9')\ndef test_a(): pass\n")
    result = suite.runpytest()
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*test_it.py::test_a: req E9: not in safety.md*"])


PARALLEL = ("-n", "2", "--dist", "worksteal")


def test_processes_of_a_run_add_up_to_one_matrix(suite):
    suite.makepyfile(
        test_a="import pytest\n@pytest.mark.req('E1')\ndef test_a(figure):\n    assert figure('age', 12, 'ms', '<= 20')\n",
        test_b="import pytest\n@pytest.mark.req('E1')\ndef test_b(figure):\n    assert not figure('age', 21, 'ms', '<= 20')\n",
    )
    result = suite.runpytest(*PARALLEL)
    assert result.ret == 1
    result.stdout.fnmatch_lines_random(["age: 12 ms (target <= 20 ms)", "age: 21 ms (target <= 20 ms, MISSED)"])
    result.stdout.fnmatch_lines(["E1 2   F12 0", "FAILED: no test for F12"])


def test_a_test_in_real_time_has_the_machine_for_itself(suite):
    begun = "import time, pytest\ndef log(what):\n    with open({path!r}, 'a') as file: file.write(what + '\\n')\n"
    alone = "@pytest.mark.realtime\ndef test_alone_{k}():\n    log('alone'); time.sleep(0.2); log('end')\n"
    path = str(suite.path / "log")
    suite.makepyfile(
        test_it=begun.format(path=path)
        + "".join(alone.format(k=k) for k in range(3))
        + "".join(f"def test_{k}():\n    log('in'); time.sleep(0.05); log('out')\n" for k in range(12))
    )
    suite.runpytest("test_it.py", *PARALLEL).assert_outcomes(passed=15)
    words = (suite.path / "log").read_text().split()
    running = 0
    for word, following in zip(words, [*words[1:], ""], strict=True):
        running += {"in": 1, "out": -1}.get(word, 0)
        if word == "alone":
            assert (running, following) == (0, "end")
    assert words.count("alone") == 3


FOUND = [evidence.Figure("A", "age", 12.5, "ms", "<= 20"), evidence.Figure("A", "1,000 trials, 0 bad")]


def test_new_figures_take_the_place_of_their_section_and_of_no_other():
    old = evidence.merged("", [evidence.Figure("A", "age", 99, "ms", "<= 20"), evidence.Figure("B", "size", 2000)], "yesterday")
    assert "| age | 99 ms | <= 20 ms | **no** |" in old
    new = evidence.merged(old, FOUND, "today")
    head = "| measured | result | target | met |\n| --- | --- | --- | --- |\n"
    first = f"\n## A\n\ntoday\n\n{head}| age | 12.5 ms | <= 20 ms | yes |\n| 1,000 trials, 0 bad |  |  |  |\n"
    assert new == f"{evidence.TITLE}{first}\n## B\n\nyesterday\n\n{head}| size | 2,000 |  |  |\n"
    assert evidence.merged(new, FOUND, "today") == new


@pytest.mark.parametrize(
    ("value", "target", "is_met"), [(5, "= 5", True), (4.9, "= 5", False), (99.6, ">= 99.6", True), (1e-3, "< 1e-3", False)]
)
def test_a_target_is_met_or_not(value, target, is_met):
    assert evidence.Figure("", "", value, "", target).is_met is is_met


def test_a_target_that_says_nothing_is_a_mistake():
    with pytest.raises(ValueError, match="'150': expected a relation"):
        _ = evidence.Figure("", "", 1.0, "", "150").is_met


def test_a_section_is_the_first_sentence_of_its_module():
    assert evidence.section_of("F18: all pairs.\n\nMore.") == "F18: all pairs"
    assert evidence.section_of("G1: no limit. On the bus.") == "G1: no limit"
