"""What tests measured, beside its targets: as lines of a run, and as docs/evidence.md, which keeps the last results of each module."""

import operator
import os
import platform
import re
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

EVIDENCE = Path(__file__).resolve().parents[2] / "docs" / "evidence.md"
TITLE = "# Evidence\n\nWhat the tests last measured, by `make test-long`. Each part was written by one run, which it names.\n"
COLUMNS = ("measured", "result", "target", "met")
_RELATIONS = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt, "=": operator.eq}
_TARGET = re.compile(r"(<=|>=|<|>|=) (-?[\d.e+-]+)")


@dataclass(frozen=True)
class Figure:
    """One thing that a test found.

    Args:
        section: what the module of the test is about.
        what: was measured; the whole finding where there is no value.
        unit: "" for a count.
        target: "<= 150", ">= 99.6", "= 0"; "" where there is none.
    """

    section: str
    what: str
    value: float | None = None
    unit: str = ""
    target: str = ""

    @property
    def is_met(self) -> bool:
        """Whether the value meets the target; without one it does."""
        if not self.target or self.value is None:
            return True
        matched = _TARGET.fullmatch(self.target)
        if matched is None:
            raise ValueError(f"target {self.target!r}: expected a relation and a number, as in '<= 150'")
        return _RELATIONS[matched[1]](self.value, float(matched[2]))

    @property
    def cells(self) -> tuple[str, ...]:
        """A row of the table."""
        if self.value is None:
            return self.what, "", "", ""
        number = f"{self.value:,}" if isinstance(self.value, int) else f"{self.value:.4g}"
        target = f"{self.target} {self.unit}".strip() if self.target else ""
        return self.what, f"{number} {self.unit}".strip(), target, ("yes" if self.is_met else "**no**") if self.target else ""

    def __str__(self) -> str:
        what, result, target, _ = self.cells
        return what + (f": {result}" if result else "") + (f" (target {target}{'' if self.is_met else ', MISSED'})" if target else "")


def section_of(docstring: str | None) -> str:
    """What a module is about: the first sentence of its docstring."""
    first = (docstring or "Other tests").strip().splitlines()[0]
    return re.split(r"\. |\.$", first)[0]


def merged(old: str, figures: list[Figure], origin: str) -> str:
    """A document with new figures in place of the former ones of the same sections; the others stay as they are."""
    parts = re.split(r"^## (.+)\n", old, flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], (body.strip() for body in parts[2::2]), strict=True))
    for section in dict.fromkeys(figure.section for figure in figures):
        rows = [COLUMNS, ("---",) * len(COLUMNS), *(figure.cells for figure in figures if figure.section == section)]
        sections[section] = "\n".join([origin, "", *(f"| {' | '.join(row)} |" for row in rows)])
    return "\n".join([TITLE, *(f"## {section}\n\n{sections[section]}\n" for section in sorted(sections))])


def provenance() -> str:
    """Date, revision and machine of this run."""
    root = EVIDENCE.parents[1]
    revision = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True, check=False).stdout
    model = re.search(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    processor = f"{len(os.sched_getaffinity(0))} x {model[1] if model else platform.machine()}"
    system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    return f"{datetime.now(UTC):%Y-%m-%d}, revision {revision.strip() or 'unknown'}, {processor}, {system}"
