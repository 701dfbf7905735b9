"""What the control thread of every real-time process does once, after its set-up and before its loop."""

import ctypes
import gc
import os
import sys
import threading
from collections.abc import Collection
from dataclasses import dataclass

GATEWAY_PRIORITY = 60
BUS_PRIORITY = 58
EMULATOR_PRIORITY = 55
CONTROLLER_PRIORITY = 50
HELPER_PRIORITY = 10
"""SCHED_FIFO priorities: the gateway waits for nobody, the controller, which computes longest, for everybody.
The helper is any other Python thread of a control process: it holds the interpreter's lock now and then, and must not be kept from
giving it back by ordinary work."""

_SWITCH_INTERVAL_S = 0.5e-3
"""Longest time that Python code on another thread of this process keeps the control thread waiting; Python's own choice is 5 ms."""
# From Linux's mman.h.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


@dataclass(frozen=True, slots=True)
class Grant:
    """What a process asked of the machine for its control thread, and whether it got it.

    Args:
        refusal: why not, for people; empty when it was granted or not asked for.
    """

    what: str
    refusal: str = ""

    def __str__(self) -> str:
        return f"{self.what}: refused, {self.refusal}" if self.refusal else self.what


def become_realtime(priority: int) -> Grant:
    """Take garbage collection out of the loop and ask for real-time priority for the calling thread.

    A full collection with the libraries of a process loaded takes 9 ms; the cores make no cycles. Threads that exist already,
    such as those of telemetry, keep their ordinary priority: that is why this comes after the set-up. Threads and processes that
    are started later do not inherit the priority.

    Returns:
        The priority; where it was refused, deadlines are missed whenever the machine has other work.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    return take_priority(priority)


def lift_helpers() -> None:
    """Ask for the helpers' priority for every other Python thread of the process."""
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and thread.native_id is not None:
            take_priority(HELPER_PRIORITY, thread.native_id)


def take_priority(priority: int, thread_id: int = 0) -> Grant:
    """Ask for SCHED_FIFO for a thread, and for none that it starts.

    Args:
        thread_id: as Linux numbers threads; 0 is the calling one.
    """
    what = f"SCHED_FIFO {priority}"
    try:
        os.sched_setscheduler(thread_id, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        return Grant(what, error.strerror or str(error))
    return Grant(what)


def lock_memory() -> Grant:
    """Keep all memory of the process in RAM: what it has now at once, what it will have from its first use on."""
    libc = ctypes.CDLL(None, use_errno=True)
    for flags in (_MCL_CURRENT, _MCL_FUTURE | _MCL_ONFAULT):
        if libc.mlockall(flags):
            refusal = os.strerror(ctypes.get_errno())
            libc.munlockall()
            return Grant("memory locked", refusal)
    return Grant("memory locked")


def pin_to(cpus: Collection[int]) -> Grant:
    """Keep the calling thread on these processors, numbered as Linux does; none leaves it on all."""
    if not cpus:
        return Grant("all processors")
    what = f"processor {', '.join(map(str, sorted(cpus)))}"
    try:
        os.sched_setaffinity(0, cpus)
    except OSError as error:
        return Grant(what, error.strerror or str(error))
    if missing := set(cpus) - os.sched_getaffinity(0):
        return Grant(what, f"no processor {', '.join(map(str, sorted(missing)))}")
    return Grant(what)


def become_ordinary(cpus: Collection[int]) -> None:
    """Take back what the calling thread was granted, before it does slow work again, and let it run on these processors."""
    gc.enable()
    gc.unfreeze()
    if os.sched_getscheduler(0) & os.SCHED_FIFO:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.sched_setaffinity(0, cpus)
