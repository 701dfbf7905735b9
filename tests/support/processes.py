"""Runs the command line as its user would, and looks after its processes."""

import functools
import itertools
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

BLOCK, SPACING = 200, 10
"""Ports of one process of tests; ports for one call, more than a run of all sources has."""


@functools.cache
def _ports() -> tuple[range, socket.socket]:
    """A block of ports of this process alone: the kernel keeps the socket's name, and nobody else's, until the process ends."""
    # Below the ports that Linux gives to outgoing connections.
    for first in range(12_000, 32_000, BLOCK):
        reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            reservation.bind(f"\0xilgate test ports {first}")
        except OSError:
            reservation.close()
            continue
        return range(first, first + BLOCK, SPACING), reservation
    raise RuntimeError("no free ports")


_turns = itertools.count()


def free_base_port() -> int:
    """First of ten neighbouring loopback ports that are free now and that no other process of tests is given."""
    bases, _ = _ports()
    for _ in bases:
        base = bases[next(_turns) % len(bases)]
        try:
            for port in range(base, base + SPACING):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return base
    raise RuntimeError("no free ports")


def xilgate(*arguments: str, **options) -> subprocess.CompletedProcess:
    """Run a command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "xil", *arguments], capture_output=True, text=True, timeout=180, check=False, **options
    )


def start_xilgate(*arguments: str) -> subprocess.Popen:
    """Start a command; its output is read with `communicate`."""
    return subprocess.Popen(
        [sys.executable, "-m", "xil", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def children(pid: int) -> dict[str, int]:
    """Running children of a runner, by the xilgate command that each runs."""
    found = {}
    for task in Path("/proc").iterdir():
        if task.name.isdigit():
            try:
                stat = (task / "stat").read_text()
                command = (task / "cmdline").read_bytes().decode().split("\0")
            except OSError:
                continue
            if int(stat.rpartition(")")[2].split()[1]) == pid and "xil" in command:
                found[command[command.index("xil") + 1]] = int(task.name)
    return found


def is_running(pid: int) -> bool:
    """Whether a process exists and is more than an entry that nobody has collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition, timeout_s: float, what: str) -> None:
    """Poll a condition; fail with `what` when it does not come true."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"timed out: {what}"
        time.sleep(0.02)


def end(process: subprocess.Popen) -> None:
    """Make sure that a test leaves nothing behind."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
