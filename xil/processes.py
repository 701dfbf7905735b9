"""Child processes that cannot outlive their runner.

Each child is one `xilgate` command in a process group of its own, so that Ctrl-C reaches the runner alone, which then ends
the children in order. Should the runner die without a word, the kernel kills them (PR_SET_PDEATHSIG, set by the child).
"""

import ctypes
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

PARENT_VARIABLE = "XILGATE_PARENT_PID"
_PR_SET_PDEATHSIG = 1
_TERMINATE_S = 3.0


def die_with_parent() -> None:
    """Called by a child at its start: die when the runner that started it dies."""
    expected = os.environ.pop(PARENT_VARIABLE, None)
    if expected is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(expected):  # it died before prctl took hold
        sys.exit(0)


@dataclass(frozen=True, slots=True)
class Death:
    """A child that ended by itself.

    Args:
        last_words: the last line it wrote to its log, for people.
    """

    name: str
    exit_code: int
    last_words: str


class Processes:
    """The children of one run, in the order in which they were started; they end in the reverse order."""

    def __init__(self, log_directory: Path) -> None:
        self._log_directory = log_directory
        self._children: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, arguments: list[str]) -> None:
        """Start `xilgate ARGUMENTS` as child `name`; its output goes to NAME.log."""
        with self._log_path(name).open("wb") as log:
            self._children[name] = subprocess.Popen(
                [sys.executable, "-m", "xil", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=os.environ | {PARENT_VARIABLE: str(os.getpid()), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )

    def pid(self, name: str) -> int:
        """Process id of a child."""
        return self._children[name].pid

    def deaths(self) -> list[Death]:
        """Children that have ended, though nobody asked them to."""
        return [
            Death(name, child.returncode, self._last_words(name)) for name, child in self._children.items() if child.poll() is not None
        ]

    def end_one(self, name: str) -> None:
        """Make one child end; it is not reported as a death any more."""
        child = self._children.pop(name, None)
        if child is not None:
            child.kill()
            child.wait()

    def end(self) -> None:
        """Ask every child to end, then make it."""
        for child in reversed(self._children.values()):
            if child.poll() is None:
                child.terminate()
        deadline = time.monotonic() + _TERMINATE_S
        for child in reversed(self._children.values()):
            try:
                child.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()

    def _log_path(self, name: str) -> Path:
        return self._log_directory / f"{name}.log"

    def _last_words(self, name: str) -> str:
        lines = self._log_path(name).read_text(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("xilgate: ") if lines else "no message"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.end()
