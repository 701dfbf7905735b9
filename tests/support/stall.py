"""Notices when the machine itself stood still, so that a real-time trial on a shared machine can be told from a failure."""

import contextlib
import os
import threading
import time

PERIOD_S = 0.005


class StallProbe:
    """A thread of the highest priority that should wake every 5 ms; `worst_s` is by how much it was late."""

    def __init__(self):
        self.worst_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO)))
        while not self._stop.is_set():
            start_s = time.monotonic()
            time.sleep(PERIOD_S)
            self.worst_s = max(self.worst_s, time.monotonic() - start_s - PERIOD_S)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
