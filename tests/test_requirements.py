"""The requirement matrix itself."""

import pytest

from tests import conftest

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
    pytester.makeini("[pytest]\nmarkers =\n req\n long\naddopts = -p no:cacheprovider --strict-markers\n")
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
        test_it="import pytest\n@pytest.mark.req('E1')\ndef test_a(): pass\n@pytest.mark.long\n@pytest.mark.req('F12')\ndef test_b(): pass\n"
    )
    result = suite.runpytest("-m", "not long")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["E1 1   F12 0 (1 not run)"])


def test_an_unknown_requirement_is_named(suite):
    suite.makepyfile(test_it="import pytest\n@pytest.mark.req('E9')\ndef test_a(): pass\n")
    result = suite.runpytest()
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*test_it.py::test_a: req E9: not in safety.md*"])
