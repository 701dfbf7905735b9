"""docs/modes.md, written from the tables of `modes`: `python -m gateway.mode_diagram > docs/modes.md`."""

from collections.abc import Iterator

from gateway import modes
from gateway.causes import Cause
from gateway.messages import Mode
from gateway.modes import REACTIONS, TRANSITIONS, Trigger

_INTRODUCTION = """# Modes of the gateway

Written from the tables in `gateway/modes.py` by `python -m gateway.mode_diagram > docs/modes.md`; a test compares. What arms
and engages is in `gateway/conditions.py`.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([_INTRODUCTION, *_meanings(), "", *_diagram(), "", *_causes(), ""])


def _meanings() -> Iterator[str]:
    yield "| mode | meaning |"
    yield "|---|---|"
    for line in (modes.__doc__ or "").splitlines():
        name, _, meaning = line.strip().partition(" ")
        if name in Mode.__members__:
            yield f"| {name} | {meaning.strip()} |"


def _diagram() -> Iterator[str]:
    yield "```mermaid"
    yield "stateDiagram-v2"
    yield f"    [*] --> {Mode.SILENT.name}"
    for (before, trigger), after in TRANSITIONS.items():
        yield f"    {before.name} --> {after.name} : {trigger.value}"
    yield "```"


def _causes() -> Iterator[str]:
    yield "## Causes of disengagement"
    yield ""
    yield "The number is that of `GW_Status.Cause`. Above stands the graver."
    yield ""
    yield "| cause | number | unit of value and limit | while engaged |"
    yield "|---|---|---|---|"
    for trigger in Trigger:
        for cause in (cause for cause in Cause if REACTIONS[cause] is trigger):
            after = TRANSITIONS[Mode.ENGAGED, trigger].name
            yield f"| {cause.value.text} | {cause.code} | {cause.value.unit} | {after} |"


if __name__ == "__main__":
    print(page(), end="")
