"""Measured figures beside their targets, as data and as a table."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class Row:
    """One figure beside its target.

    Args:
        target: None for a figure that is only shown.
        relation: "at most" or "at least".
    """

    row: str
    case: str
    measured: float
    unit: str
    relation: str = ""
    target: float | None = None

    @property
    def is_met(self) -> bool | None:
        """Whether the target is met; None where there is none."""
        if self.target is None:
            return None
        return self.measured <= self.target if self.relation == "at most" else self.measured >= self.target

    def judged(self) -> dict[str, Any]:
        """The figure as data, with `met`."""
        return asdict(self) | {"met": self.is_met}


def figures_table(title: str, caption: str, rows: Sequence[dict[str, Any]]) -> Table:
    """A table for people.

    Args:
        rows: from `Row.judged`.
    """
    table = Table(title=title, caption=caption)
    for heading in ("", "case"):
        table.add_column(heading)
    for heading in ("measured", "target", "met"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        target = "" if row["target"] is None else f"{row['relation']} {row['target']:g}"
        met = {None: "", True: "yes", False: "no"}[row["met"]]
        table.add_row(row["row"], row["case"], f"{row['measured']:.4g} {row['unit']}", target, met)
    return table
