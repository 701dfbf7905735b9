"""When a fault begins: comparisons of what the car does with numbers, joined by `and`.

    engaged and x_m > 30
    vx_mps < 5.5 and not engaged

Grammar: CONDITION = CLAUSE {"and" CLAUSE}; CLAUSE = ["not"] "engaged" | SIGNAL OPERATOR NUMBER. Nothing is evaluated but this.
"""

import math
import operator
import re
from collections.abc import Callable
from typing import NamedTuple

from vehicle_emulator.plants.interface import PlantState


class Situation(NamedTuple):
    """What a condition can ask about: the car as it is, and whether the robots follow commands."""

    state: PlantState
    is_engaged: bool


class ConditionError(ValueError):
    """A text is no condition; it says what is."""


_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "==": operator.eq, "!=": operator.ne, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
_FLAG = "engaged"
SIGNALS = tuple(name for name, default in PlantState._field_defaults.items() if not isinstance(default, tuple))
"""Signals that can be compared: the fields of `PlantState` that are one number."""
_CLAUSE = re.compile(r"\s*(?:(not)\s+)?([A-Za-z_]\w*)\s*(?:(<=|>=|==|!=|<|>)\s*(\S+)\s*)?", re.ASCII)
_AND = re.compile(r"\band\b")


class Condition:
    """A condition, ready to be asked.

    Raises:
        ConditionError: the text is none.
    """

    def __init__(self, text: str) -> None:
        self._clauses = [_clause(part) for part in _AND.split(text)]

    def holds(self, situation: Situation) -> bool:
        """Whether it holds now."""
        return all(clause(situation) for clause in self._clauses)


def _clause(text: str) -> Callable[[Situation], bool]:
    match = _CLAUSE.fullmatch(text)
    negation, name, sign, number = match.groups() if match else ("", "", "", "")
    if name == _FLAG and not sign:
        return (lambda situation: not situation.is_engaged) if negation else (lambda situation: situation.is_engaged)
    limit = _number(number) if sign else math.nan
    if negation or name not in SIGNALS or not math.isfinite(limit):
        raise ConditionError(
            f"{text.strip()!r} is no clause; allowed: engaged, not engaged, SIGNAL < NUMBER (or <= > >= == !=), joined by and;"
            f" signals: {', '.join(SIGNALS)}"
        )
    compare = _OPERATORS[sign]
    return lambda situation: compare(getattr(situation.state, name), limit)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
