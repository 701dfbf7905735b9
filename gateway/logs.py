"""Log records go through a bounded queue to a thread of their own: whoever logs waits neither for a file nor for a lock."""

import faulthandler
import json
import logging
import os
import sys
import threading
import time
from collections import deque
from typing import Self, TextIO

QUEUE_LENGTH = 1024
_POLL_S = 0.05
_CLOSE_TIMEOUT_S = 2.0
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
# Of syslog(3), as sd-daemon(3) wants them at the beginning of a line.
_SYSLOG_LEVELS = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))


def escaped(text: str) -> str:
    """The text with what is not printable as Python would write it: nobody's text makes lines of its own, or commands a terminal."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class PlainFormatter(logging.Formatter):
    """For people; see `escaped`."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(name)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name of the standard library
        """The line of a record."""
        record.message = escaped(record.message)
        return super().formatMessage(record)


class JsonFormatter(logging.Formatter):
    """One JSON object per line: `ts` (UTC), `level`, `process`, `logger`, `message`, and what the caller gave as `extra`.

    Args:
        process: name of the process.
        has_level_prefix: whether a line begins with its level as sd-daemon(3) has it, which journald takes away.
    """

    def __init__(self, process: str, has_level_prefix: bool = False) -> None:
        super().__init__()
        self._process = process
        self._has_level_prefix = has_level_prefix

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        line = {
            "ts": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {key: value for key, value in vars(record).items() if key not in _STANDARD}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        prefix = f"<{next(level for threshold, level in _SYSLOG_LEVELS if record.levelno >= threshold)}>" if self._has_level_prefix else ""
        return prefix + json.dumps(line, default=str)


class LogThread(logging.Handler):
    """Takes records from every thread and writes them on one of its own; a context manager that sets up logging for the process.

    No lock is taken when a record is handed over: a thread of low priority that holds one would keep the control thread waiting.

    Attributes:
        dropped: records lost because the writing did not keep up, or was refused.
    """

    def __init__(self, formatter: logging.Formatter, stream: TextIO = sys.stderr) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self.dropped = 0
        self._stream = stream
        self._records: deque[logging.LogRecord] = deque()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)

    def createLock(self) -> None:  # noqa: N802 - the name of the standard library
        """None: `emit` needs none."""
        self.lock = None

    def emit(self, record: logging.LogRecord) -> None:
        """Hand a record over."""
        if len(self._records) >= QUEUE_LENGTH:
            self.dropped += 1
        else:
            self._records.append(record)

    def _run(self) -> None:
        while not self._closing.wait(_POLL_S):
            self._write()
        self._write()

    def _write(self) -> None:
        lines = []
        while self._records:
            lines.append(self.format(self._records.popleft()) + "\n")
        if not lines:
            return
        try:
            self._stream.write("".join(lines))
            self._stream.flush()
        except OSError:  # a full disk, or a reader that has gone: neither may be for good
            self.dropped += len(lines)

    def __enter__(self) -> Self:
        root = logging.getLogger()
        root.setLevel(logging.INFO)
        root.addHandler(self)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger().removeHandler(self)
        self._closing.set()
        self._thread.join(_CLOSE_TIMEOUT_S)


def log_crashes(formatter: logging.Formatter, stream: TextIO = sys.stderr) -> None:
    """Have errors that nobody catches told in this format as well, and tell where every thread is when the watchdog ends the process."""

    def write(error: BaseException, where: str) -> None:
        record = logging.makeLogRecord({"name": "xilgate", "levelno": logging.CRITICAL, "levelname": "CRITICAL"})
        record.msg, record.exc_info = f"{where} ended by an error: {error!r}", (type(error), error, error.__traceback__)
        stream.write(formatter.format(record) + "\n")
        stream.flush()

    def of_thread(arguments: threading.ExceptHookArgs) -> None:
        if arguments.exc_value is not None and arguments.thread is not None:
            write(arguments.exc_value, f"thread {arguments.thread.name}")

    sys.excepthook = lambda _, error, __: write(error, "process")
    threading.excepthook = of_thread
    faulthandler.enable(stream)


def is_journal(stream: TextIO) -> bool:
    """Whether systemd has connected a stream to the journal."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    found = os.fstat(stream.fileno())
    return (device, inode) == (str(found.st_dev), str(found.st_ino))
