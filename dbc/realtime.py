"""What the control thread of every real-time process does once, after its set-up and before its loop."""

import contextlib
import gc
import os

GATEWAY_PRIORITY = 60
BUS_PRIORITY = 58
EMULATOR_PRIORITY = 55
CONTROLLER_PRIORITY = 50
"""SCHED_FIFO priorities: the gateway waits for nobody, the controller, which computes longest, for everybody."""


def become_realtime(priority: int) -> bool:
    """Take garbage collection out of the loop and ask for real-time priority for the calling thread.

    A full collection with the libraries of a process loaded takes 9 ms; the cores make no cycles. Threads that exist already,
    such as those of telemetry, keep their ordinary priority: that is why this comes after the set-up.

    Returns:
        Whether the priority was granted; without it deadlines are missed whenever the machine has other work.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False
