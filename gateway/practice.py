"""Real-time practice of a process: all that its control thread asks of the machine, and what is said where it does not get it."""

import contextlib
import logging
import os
from collections.abc import Iterator, Mapping

from dbc.realtime import Grant, become_ordinary, become_realtime, lift_helpers, lock_memory, pin_to
from gateway.rig import Realtime

log = logging.getLogger("xilgate.gateway")


@contextlib.contextmanager
def realtime_practice(wanted: Realtime) -> Iterator[Mapping[str, Grant]]:
    """Make the calling thread the control thread; the other Python threads of the process are there already.

    Yields:
        What was asked for, and whether it was granted.
    """
    cpus_before = os.sched_getaffinity(0)
    memory = lock_memory() if wanted.locks_memory else Grant("memory not locked")
    grants = {"memory": memory, "processors": pin_to(wanted.cpus), "priority": become_realtime(wanted.priority)}
    lift_helpers()
    for name, grant in grants.items():
        if grant.refusal:
            log.warning("%s; `xilgate doctor` says how to get it", grant, extra={"asked": name})
    try:
        yield grants
    finally:
        become_ordinary(cpus_before)
