"""What a control thread asks of the machine: granted, or refused with a reason, and never more than the thread itself."""

import gc
import logging
import os
import subprocess
import sys
import threading

import pytest

from dbc import realtime
from dbc.realtime import Grant, become_ordinary, become_realtime, lift_helpers, lock_memory, pin_to, take_priority
from gateway import practice
from gateway.practice import realtime_practice
from gateway.rig import Realtime


def in_a_thread(work):
    """Result of a call on a thread of its own, so that nothing sticks to that of the tests."""
    results = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    thread.join()
    return results[0]


def refuse(*_):
    raise PermissionError(1, "Operation not permitted")


def test_a_refusal_says_what_and_why(monkeypatch):
    monkeypatch.setattr("dbc.realtime.os.sched_setscheduler", refuse)
    assert take_priority(60) == Grant("SCHED_FIFO 60", "Operation not permitted")
    assert str(take_priority(60)) == "SCHED_FIFO 60: refused, Operation not permitted"
    assert str(Grant("memory locked")) == "memory locked"


def test_priority_is_not_inherited(monkeypatch):
    asked = []
    monkeypatch.setattr("dbc.realtime.os.sched_setscheduler", lambda *arguments: asked.append(arguments))
    assert take_priority(60) == Grant("SCHED_FIFO 60")
    assert asked == [(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(60))]


def test_helpers_get_theirs_and_the_caller_keeps_his(monkeypatch):
    asked = {}
    monkeypatch.setattr("dbc.realtime.os.sched_setscheduler", lambda thread, _, parameter: asked.update({thread: parameter.sched_priority}))
    ends = threading.Event()
    helper = threading.Thread(target=ends.wait)
    helper.start()
    lift_helpers()
    ends.set()
    helper.join()
    assert asked[helper.native_id] == realtime.HELPER_PRIORITY < realtime.CONTROLLER_PRIORITY
    assert threading.get_native_id() not in asked


def test_processors_are_those_of_the_calling_thread_alone():
    before = os.sched_getaffinity(0)
    one = min(before)

    def pinned():
        return pin_to([one]), os.sched_getaffinity(0)

    assert in_a_thread(pinned) == (Grant(f"processor {one}"), {one})
    assert os.sched_getaffinity(0) == before
    assert in_a_thread(lambda: pin_to([])) == Grant("all processors")


def test_processors_that_are_not_there_are_named():
    one = min(os.sched_getaffinity(0))
    assert in_a_thread(lambda: pin_to([1023])).refusal
    assert in_a_thread(lambda: pin_to([one, 1023])) == Grant(f"processor {one}, 1023", "no processor 1023")


LOCKED = """
from dbc.realtime import lock_memory
print(lock_memory())
print(next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmLck")))
"""
UNPRIVILEGED = """
import os, resource
resource.setrlimit(resource.RLIMIT_MEMLOCK, (4096, 4096))
if os.getuid() == 0:
    os.setuid(65534)  # root may lock whatever the limit says
"""


def locked(code):
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    said, kilobytes = finished.stdout.splitlines()
    return said, int(kilobytes)


def test_memory_is_locked_or_it_is_said_that_it_is_not():
    said, kilobytes = locked(LOCKED)
    assert (kilobytes > 0) is (said == "memory locked")


def test_memory_beyond_the_limit_is_not_locked():
    said, kilobytes = locked(f"import dbc.realtime\n{UNPRIVILEGED}{LOCKED}")
    assert said.startswith("memory locked: refused, ")
    assert kilobytes == 0


def test_what_was_taken_is_given_back():
    before = os.sched_getaffinity(0)

    def there_and_back():
        pin_to([min(before)])
        become_realtime(realtime.HELPER_PRIORITY)
        inside = gc.isenabled(), gc.get_freeze_count() > 0
        become_ordinary(before)
        return inside, gc.isenabled(), gc.get_freeze_count(), os.sched_getscheduler(0) & os.SCHED_FIFO, os.sched_getaffinity(0)

    interval_s = sys.getswitchinterval()
    try:
        assert in_a_thread(there_and_back) == ((False, True), True, 0, 0, before)
    finally:
        sys.setswitchinterval(interval_s)


@pytest.mark.parametrize("is_refused", [False, True])
def test_practice_says_what_it_got_and_logs_what_it_did_not(monkeypatch, caplog, is_refused):
    why = "no" if is_refused else ""
    order = []
    monkeypatch.setattr(practice, "become_realtime", lambda priority: order.append("priority") or Grant(f"SCHED_FIFO {priority}", why))
    monkeypatch.setattr(practice, "lock_memory", lambda: Grant("memory locked", why))
    monkeypatch.setattr(practice, "pin_to", lambda cpus: Grant(f"processor {cpus}", why))
    monkeypatch.setattr(practice, "lift_helpers", lambda: order.append("helpers"))
    monkeypatch.setattr(practice, "become_ordinary", lambda _: order.append("ordinary"))
    with caplog.at_level(logging.INFO), realtime_practice(Realtime(cpus=(1,))) as grants:
        assert order == ["priority", "helpers"]
    assert order[-1] == "ordinary"
    assert {name: grant.refusal for name, grant in grants.items()} == dict.fromkeys(("memory", "processors", "priority"), why)
    assert len(caplog.records) == (3 if is_refused else 0)
    assert all("xilgate doctor" in record.message for record in caplog.records)


def test_memory_that_is_not_to_be_locked_is_not(monkeypatch):
    monkeypatch.setattr(practice, "become_realtime", lambda _: Grant("p"))
    monkeypatch.setattr(practice, "lift_helpers", lambda: None)
    monkeypatch.setattr(practice, "lock_memory", lambda: pytest.fail("was locked"))
    with realtime_practice(Realtime(locks_memory=False)) as grants:
        assert str(grants["memory"]) == "memory not locked"


def test_locking_is_all_or_nothing(monkeypatch):
    calls = []

    class Libc:
        def mlockall(self, flags):
            calls.append(flags)
            return -1 if flags != 1 else 0

        def munlockall(self):
            calls.append("munlockall")

    monkeypatch.setattr("dbc.realtime.ctypes.CDLL", lambda *_, **__: Libc())
    assert lock_memory().refusal
    assert calls[-1] == "munlockall"
