"""`xilgate` with an eye on the gateway's control thread: `python audited_gateway.py REPORT gateway ...`.

At its end REPORT tells, as JSON, what happened within ticks: functions that were called, and audit events of the interpreter.
"""

import json
import sys
import threading
from pathlib import Path

from gateway.cycle import ControlCycle
from xil.cli import main

calls: set[str] = set()
events: set[str] = set()
ticking = threading.local()
look_of_the_gateway = ControlCycle.look


def note_call(frame, event, called):
    if event == "call":
        calls.add(f"{frame.f_globals.get('__name__', '?')}.{frame.f_code.co_name}")
    elif event == "c_call":
        calls.add(f"{getattr(called, '__module__', None) or type(getattr(called, '__self__', None)).__module__}.{called.__name__}")


def note_event(event, _):
    if getattr(ticking, "is_on", False):
        events.add(event)


def look(cycle, *arguments):
    ticking.is_on = True
    sys.setprofile(note_call)
    try:
        look_of_the_gateway(cycle, *arguments)
    finally:
        sys.setprofile(None)
        ticking.is_on = False


if __name__ == "__main__":
    report = Path(sys.argv.pop(1))
    ControlCycle.look = look
    sys.addaudithook(note_event)
    try:
        main()
    finally:
        report.write_text(json.dumps({"calls": sorted(calls), "events": sorted(events)}), encoding="utf-8")
