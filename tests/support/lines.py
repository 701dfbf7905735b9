"""A helper process that is told things and tells things, one JSON object a line."""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

TIMEOUT_S = 20.0


def say(**what: Any) -> None:
    """One line on standard output; a reader that has gone is no trouble."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(what), flush=True)


class Told:
    """What standard input has, without waiting for it."""

    def __init__(self) -> None:
        self._pending = b""
        self.is_over = False

    def __iter__(self) -> Iterator[dict[str, Any]]:
        while not self.is_over and select.select([0], [], [], 0)[0]:
            chunk = os.read(0, 65536)
            self.is_over = not chunk
            *lines, self._pending = (self._pending + chunk).split(b"\n")
            yield from map(json.loads, lines)


class Helper:
    """A process that runs a module of the tests.

    Attributes:
        said: all that it has told, oldest first.
        pid: of the process.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self.said: list[dict[str, Any]] = []
        self._news = threading.Condition()
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"tests.support.{module}", *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.pid = self._process.pid
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with self._news:
                self.said.append(json.loads(line))
                self._news.notify_all()

    def tell(self, **what: Any) -> None:
        """Say something and do not wait."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()

    def ask(self, **what: Any) -> int:
        """Say something and wait for the time from which on it is so [ns]."""
        begin = len(self.said)
        self.tell(**what)
        return int(self.wait_for(lambda line: "since_ns" in line, begin)["since_ns"])

    def wait_for(self, is_it: Callable[[dict[str, Any]], bool], begin: int = 0, timeout_s: float = TIMEOUT_S) -> dict[str, Any]:
        """The first line of that kind, from a place in `said` on."""
        found = self.look_for(is_it, begin, timeout_s)
        assert found is not None, f"{self._process.args}: not said within {timeout_s} s; last words {self.said[-3:]}"
        return found

    def look_for(self, is_it: Callable[[dict[str, Any]], bool], begin: int, timeout_s: float) -> dict[str, Any] | None:
        """The same; None when there is none in time, or the process has ended."""
        deadline_s = time.monotonic() + timeout_s
        with self._news:
            while True:
                for line in self.said[begin:]:
                    if is_it(line):
                        return line
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0 or not self._reader.is_alive():
                    return None
                self._news.wait(min(left_s, 0.5))

    def signal(self, number: signal.Signals) -> int:
        """Send a signal; the time just before it [ns]."""
        t_ns = time.monotonic_ns()
        self._process.send_signal(number)
        return t_ns

    def close(self) -> int:
        """Let it end; its exit code."""
        with contextlib.suppress(BrokenPipeError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGCONT)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._reader.join(10)
        return self._process.wait()
