"""What is left of a run of `mutmut`: every mutant that no test killed must be among those that docs/mutation.md explains.

`python -m tests.support.survivors` after `mutmut run`; it fails on a survivor without a reason and on a reason without a survivor.
"""

import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mutmut.mutation.data import SourceFileMutationData
from mutmut.stats import status_by_exit_code
from mutmut.utils.file_utils import walk_mutatable_files

EXPLAINED = Path(__file__).resolve().parents[2] / "docs" / "mutation.md"
MAX_EXPLAINED = 5
DEAD = ("killed", "timeout", "caught by type check")
"""A change that the type checker refuses cannot be merged; one that makes a test run forever fails it."""
UNCHECKED = ("not checked", "check was interrupted by user")
"""Of a run that was not whole."""

_ROW = re.compile(r"^\| `(?P<module>[^`]+)` \| `(?P<function>[^`]+)` \| `(?P<before>[^`]+)` \| `(?P<after>[^`]+)` \| .+ \|$")
_NAME = re.compile(r"x_(?P<plain>\w+?)__mutmut_\d+$|xǁ(?P<owner>\w+)ǁ(?P<method>\w+?)__mutmut_\d+$")


class Survivor(NamedTuple):
    """One change that no test noticed: where, and the line before and after it."""

    module: str
    function: str
    before: str
    after: str


def explained(text: str) -> list[Survivor]:
    """Rows of the table in docs/mutation.md."""
    return [Survivor(**row.groupdict()) for line in text.splitlines() if (row := _ROW.match(line))]


def survivor(module: str, name: str, diff: str) -> Survivor:
    """What a mutant changes, from its name and its diff."""
    found = _NAME.search(name)
    if found is None:
        raise ValueError(f"{name}: no name of a mutant")
    function = found["plain"] or f"{found['owner']}.{found['method']}"
    before, after = (
        " ".join(line[1:].strip() for line in diff.splitlines() if line.startswith(sign) and not line.startswith(sign * 3)) for sign in "-+"
    )
    return Survivor(module, function, before, after)


def problems(survivors: list[Survivor], reasons: list[Survivor], unchecked: int = 0) -> Iterator[str]:
    """What is wrong; nothing when every mutant was checked, every survivor has its reason, and every reason its survivor."""
    if unchecked:
        yield f"{unchecked} mutants not checked: the run was not whole"
    for found in survivors:
        if found not in reasons:
            yield f"no test fails: {found.module}: {found.function}: `{found.before}` -> `{found.after}`"
    for reason in reasons:
        if reason not in survivors:
            yield f"explained, but no survivor: {reason.module}: {reason.function}: `{reason.before}` -> `{reason.after}`"
    if len(reasons) > MAX_EXPLAINED:
        yield f"{len(reasons)} explained survivors, at most {MAX_EXPLAINED} are allowed"


def main() -> int:
    """Print the figures of each module and what is wrong."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    survivors = []
    for path in sorted(walk_mutatable_files()):
        data = SourceFileMutationData(path=path)
        data.load()
        for name, exit_code in data.exit_code_by_key.items():
            status = status_by_exit_code[exit_code]
            counts[str(path)][status] += 1
            if status not in (*DEAD, *UNCHECKED):
                shown = subprocess.run([Path(sys.executable).with_name("mutmut"), "show", name], capture_output=True, text=True, check=True)
                survivors.append(survivor(str(path), name, shown.stdout))
    for module, count in counts.items():
        print(f"{module}: {count.total()} mutants: " + ", ".join(f"{number} {status}" for status, number in sorted(count.items())))
    unchecked = sum(count[status] for count in counts.values() for status in UNCHECKED)
    wrong = list(problems(survivors, explained(EXPLAINED.read_text(encoding="utf-8")), unchecked))
    print(f"{sum(count.total() for count in counts.values())} mutants, {len(survivors)} survivors, {len(wrong)} without explanation")
    print(*wrong, sep="\n")
    return 1 if wrong or not counts else 0


if __name__ == "__main__":
    sys.exit(main())
