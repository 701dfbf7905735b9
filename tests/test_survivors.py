"""The judge of mutation testing: a survivor without a reason fails, and so does a reason without a survivor."""

import pytest

from tests.support.survivors import EXPLAINED, MAX_EXPLAINED, Survivor, explained, problems, survivor

ROW = "| `gateway/core.py` | `Core.step` | `self.x = 0` | `self.x = 1` | overwritten before it is read |"
FOUND = Survivor("gateway/core.py", "Core.step", "self.x = 0", "self.x = 1")
DIFF = """# gateway.core.xǁCoreǁstep__mutmut_12: survived
--- gateway/core.py
+++ gateway/core.py
@@ -1,3 +1,3 @@
 def step(self):
-    self.x = 0
+    self.x = 1
     return
"""


def test_a_row_of_the_page_is_a_survivor_with_a_reason():
    assert explained(f"# Title\n\n| module | function |\n|---|---|\n{ROW}\n") == [FOUND]


@pytest.mark.parametrize(
    ("name", "function"), [("gateway.core.xǁCoreǁstep__mutmut_12", "Core.step"), ("gateway.core.x__step__mutmut_1", "_step")]
)
def test_a_survivor_is_told_by_what_it_changes_not_by_its_number(name, function):
    assert survivor("gateway/core.py", name, DIFF) == FOUND._replace(function=function)


def test_every_survivor_has_its_reason_and_every_reason_its_survivor():
    assert list(problems([FOUND], [FOUND])) == []
    assert list(problems([FOUND], [])) == ["no test fails: gateway/core.py: Core.step: `self.x = 0` -> `self.x = 1`"]
    assert list(problems([], [FOUND])) == ["explained, but no survivor: gateway/core.py: Core.step: `self.x = 0` -> `self.x = 1`"]


def test_a_run_that_was_not_whole_says_nothing_of_the_rest():
    assert list(problems([FOUND], [FOUND], 3)) == ["3 mutants not checked: the run was not whole"]


def test_few_may_be_explained():
    many = [FOUND._replace(function=f"f{k}") for k in range(MAX_EXPLAINED + 1)]
    assert list(problems(many, many)) == ["6 explained survivors, at most 5 are allowed"]


def test_the_page_is_one_that_the_judge_can_read():
    text = EXPLAINED.read_text(encoding="utf-8")
    assert len(explained(text)) == sum(line.startswith("| `") for line in text.splitlines()) <= MAX_EXPLAINED
