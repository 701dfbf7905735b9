"""Takes the reports of objects in, on threads of its own; the control thread only reads a reference.

What comes is not ours: any tool may publish, as often and as much as it likes. Of all that arrives within a cycle only the
newest payload is decoded, and only up to a size; the rest costs a copy each.
"""

import logging
import threading
import time
from collections import deque
from typing import Self

from controller.objects import MAX_AGE_NS, ObjectReport, report_of
from gateway.messages import PLAN_PERIOD_NS
from gateway.telemetry import ObjectsSample, Subscriber, decode

MAX_PAYLOAD_BYTES = 1 << 18
"""Some 1,500 objects; a longer payload is none [bytes]."""
_POLL_S = 0.5

log = logging.getLogger("xilgate.controller")


class ObjectInbox:
    """The newest report of objects.

    Attributes:
        report: the newest one, None before the first.
        rejected: things so far that were no report, a report for another time, or no usable object.
    """

    def __init__(self, telemetry_base_port: int) -> None:
        self.report: ObjectReport | None = None
        self.rejected = 0
        self._payloads: deque[bytes] = deque(maxlen=1)
        self._is_reported = False
        self._is_closing = False
        self._news = threading.Event()
        self._thread = threading.Thread(target=self._run, name="objects", daemon=True)
        self._thread.start()
        self._subscriber = Subscriber(self._receive, ["objects"], telemetry_base_port)

    def _receive(self, _: str, payload: bytes) -> None:
        self._payloads.append(payload)
        self._news.set()

    def _run(self) -> None:
        while not self._is_closing:
            self._news.wait(_POLL_S)
            self._news.clear()
            if self._payloads:
                self._take(self._payloads.popleft())
                time.sleep(PLAN_PERIOD_NS * 1e-9)
            self._note_presence()

    def _take(self, payload: bytes) -> None:
        sample = decode("objects", payload) if len(payload) <= MAX_PAYLOAD_BYTES else None
        if not isinstance(sample, ObjectsSample) or abs(time.monotonic_ns() - sample.t_ns) > MAX_AGE_NS:
            self.rejected += 1
            return
        report = report_of(sample)
        self.rejected += report.rejected
        self.report = report

    def _note_presence(self) -> None:
        is_reported = self.report is not None and time.monotonic_ns() - self.report.t_ns <= MAX_AGE_NS
        if is_reported is not self._is_reported:
            log.info("objects are reported" if is_reported else "objects are no longer reported: the road counts as free")
            self._is_reported = is_reported

    def close(self) -> None:
        """Leave."""
        self._subscriber.close()
        self._is_closing = True
        self._news.set()
        self._thread.join(timeout=2.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
