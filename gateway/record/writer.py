"""Takes records from whoever must not wait, and brings them to their files from a thread of its own, twice a second."""

import threading
import time
from collections import deque
from typing import Protocol

WRITE_PERIOD_S = 0.4
"""With what a socket holds besides, less than a second is lost with this process."""
STALLED_S = 3.0
"""A disk that has taken nothing for this long is no record any more."""
MAX_QUEUED_BYTES = 32 << 20
"""About three minutes of a gateway in two networks [bytes]."""


class Files(Protocol):
    """What takes the records."""

    def append(self, records: list[bytes], now_s: float) -> None:
        """Add records.

        Raises:
            OSError: they did not get in.
        """

    def disk_free_share(self) -> float:
        """Share of the disk that is free.

        Raises:
            OSError: there is no disk.
        """


class RecordWriter:
    """A bounded queue and the thread that empties it. One thread may put records in; it needs no lock and never waits.

    Attributes:
        recorded: records that are in their files.
        disk_free_share: of the disk, as of the last write.
    """

    def __init__(self, files: Files, max_queued_bytes: int = MAX_QUEUED_BYTES) -> None:
        self._files = files
        self._max_queued_bytes = max_queued_bytes
        self._queue: deque[bytes] = deque()
        # Each is written by one thread only.
        self._put_bytes = self._taken_bytes = 0
        self._refused = self._lost = 0
        self._refusal = ""
        self._alive_s = time.monotonic()
        self.recorded = 0
        self.disk_free_share = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="records", daemon=True)
        self._thread.start()

    def put(self, record: bytes) -> None:
        """Take a record, or count it as lost when the queue is full."""
        if self._put_bytes - self._taken_bytes + len(record) > self._max_queued_bytes:
            self._refused += 1
        else:
            self._put_bytes += len(record)
            self._queue.append(record)

    @property
    def lost(self) -> int:
        """Records that did not get into their files."""
        return self._refused + self._lost

    @property
    def problem(self) -> str:
        """Why nothing is recorded now, in one line; empty while all is well."""
        if not self._thread.is_alive():
            return "the writer of the record has ended"
        if time.monotonic() - self._alive_s > STALLED_S:
            return "the disk of the record does not answer"
        return self._refusal

    def _run(self) -> None:
        while not self._closing.wait(WRITE_PERIOD_S):
            self._write()
        self._write()

    def _write(self) -> None:
        records = [self._queue.popleft() for _ in range(len(self._queue))]
        try:
            if records:
                self._files.append(records, time.monotonic())
                self.recorded += len(records)
            self.disk_free_share = self._files.disk_free_share()
            self._refusal = ""
        except OSError as error:
            self._lost += len(records)
            self._refusal = _line(error)
        self._taken_bytes += sum(map(len, records))
        self._alive_s = time.monotonic()

    def close(self, within_s: float = 2.0) -> None:
        """Write what is left and end."""
        self._closing.set()
        self._thread.join(within_s)


def _line(error: OSError) -> str:
    """An error in printable words: a name of a file may hold anything."""
    text = f"{error.filename}: {error.strerror}" if error.filename is not None else str(error.strerror or error)
    return "".join(character if character.isprintable() else "?" for character in text)
