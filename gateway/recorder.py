"""The recorder: a process of its own that keeps what the gateway received and sent, and the gateway's end of it.

The gateway hands over one packet for each tick and never waits; what does not fit is counted as lost. The recorder lives as long as the
gateway: the end of the gateway, however it came, is the end of the socket between them, and then the files are completed. So it
ignores the signals that end the gateway: systemd sends them to both, and its watchdog's SIGABRT as well. Twice a second it reports what
it has recorded and how full its disk is.
"""

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import msgspec

from dbc.catalogue import Catalogue
from dbc.errors import SetupFailure
from gateway.journal import MAX_RECORD_BYTES, GatewaySession, StepArguments, pack_step, pack_value
from gateway.record.files import BusFormat, FileOptions, RecordFiles
from gateway.record.writer import RecordWriter

if TYPE_CHECKING:
    from gateway.core import StepOutput

__all__ = ["BusFormat", "FileOptions", "Recorder", "RecorderStatus"]

POLL_S = 0.1
"""A recorder that woke for every tick would cost the gateway a context switch each time."""
REPORT_PERIOD_S = 0.5
MAX_REPORT_AGE_NS = 2_000_000_000
"""A recorder that has not reported for longer is none."""
_SEND_BUFFER_BYTES = 4 << 20
_POLL_PERIOD_NS = 100_000_000
"""Reports come twice a second: to look for one in every tick would cost more than to record it."""
_MAX_REPORTS_PER_POLL = 16
_MAX_REPORT_BYTES = 8192
_START_S = 20.0
_CLOSE_S = 2.0
_NICE = 5


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """What is known of the recorder.

    Args:
        is_recording: it reports, and its disk takes what it is given.
        disk_free_share: of the disk that it writes to.
        recorded: ticks that are in their files.
        lost: ticks that are not, wherever they were lost.
        problem: why nothing is recorded, in one printable line; empty while all is well.
    """

    is_recording: bool
    disk_free_share: float
    recorded: int
    lost: int
    problem: str


class _Report(msgspec.Struct, frozen=True, array_like=True):
    recorded: int
    lost: int
    disk_free_share: float
    problem: str


class _Task(msgspec.Struct, frozen=True, array_like=True):
    """What a recorder is told at its start."""

    options: FileOptions
    session: bytes
    networks: dict[int, str]
    wall_offset_ns: int


class Recorder:
    """The gateway's end. Belongs before real-time priority, locked memory and affinity: a child inherits them.

    Raises:
        SetupFailure: there is such a record already, or no process to be had.
    """

    def __init__(self, options: FileOptions, session: GatewaySession, catalogue: Catalogue) -> None:
        options.refuse_existing()
        self._seq = 0
        self._lost = 0
        self._report = _Report(0, 0, 0.0, "")
        self._report_ns = self._polled_ns = 0
        self._has_ended = False
        networks = {arbitration_id: spec.network for arbitration_id, spec in catalogue.by_id.items()}
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._socket.setblocking(False)
            _enlarge(self._socket)
            self._process = _start(theirs, _Task(options, pack_value(session), networks, session.wall_offset_ns))
        self._await_first_report()
        self._status = self._look(time.monotonic_ns())

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    def record(self, arguments: StepArguments, output: "StepOutput") -> None:
        """Hand a tick over, or count it as lost; never waits."""
        packet = pack_step(self._seq, arguments, output)
        self._seq += 1
        try:
            if len(packet) > MAX_RECORD_BYTES:
                self._lost += 1
            else:
                self._socket.send(packet)
        except OSError:
            self._lost += 1

    def poll(self, now_ns: int) -> RecorderStatus:
        """What is known of the recorder, as of a tenth of a second ago at most; never waits."""
        if now_ns - self._polled_ns >= _POLL_PERIOD_NS:
            self._polled_ns = now_ns
            self._status = self._look(now_ns)
        return self._status

    def _look(self, now_ns: int) -> RecorderStatus:
        """Take in what the recorder has reported."""
        for _ in range(_MAX_REPORTS_PER_POLL):
            if not self._take_report(now_ns):
                break
        report, problem = self._report, self._report.problem
        if self._has_ended:
            problem = "the recorder has ended"
        elif now_ns - self._report_ns > MAX_REPORT_AGE_NS:
            problem = "the recorder does not report"
        return RecorderStatus(not problem, report.disk_free_share, report.recorded, report.lost + self._lost, problem)

    def _take_report(self, now_ns: int) -> bool:
        """Take in one report, if there is one."""
        try:
            packet = self._socket.recv(_MAX_REPORT_BYTES)
        except BlockingIOError:
            return False
        except ConnectionError:
            packet = b""
        if not packet:
            self._has_ended = True
            return False
        self._report, self._report_ns = msgspec.msgpack.decode(packet, type=_Report), now_ns
        return True

    def _await_first_report(self) -> None:
        """Wait until there is somebody to take what is recorded: a record whose beginning is lost cannot be run again."""
        readable, _, _ = select.select([self._socket], [], [], _START_S)
        if not (readable and self._take_report(time.monotonic_ns())):
            self.close()
            raise SetupFailure("the recorder does not come up")

    def close(self) -> None:
        """End the record; returns when its files are complete, or after two seconds."""
        self._socket.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _enlarge(end: socket.socket) -> None:
    """Ask for room for many ticks: by privilege for what is wanted, else for what the machine grants (about 100 ticks)."""
    so_sndbufforce = 32  # asm-generic/socket.h; Python has no name for it
    try:
        end.setsockopt(socket.SOL_SOCKET, so_sndbufforce, _SEND_BUFFER_BYTES)
    except PermissionError:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)


def _start(theirs: socket.socket, task: _Task) -> subprocess.Popen[bytes]:
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "gateway.recorder", str(theirs.fileno())],
            stdin=subprocess.PIPE, pass_fds=[theirs.fileno()], start_new_session=True,
        )  # fmt: skip
        if process.stdin is not None:
            with process.stdin as pipe:
                pipe.write(msgspec.msgpack.encode(task, enc_hook=str))
    except OSError as error:
        raise SetupFailure(f"the recorder does not start: {error.strerror or error}") from error
    return process


def serve(end: socket.socket, writer: RecordWriter) -> None:
    """Take packets until the other end has gone, and report."""
    end.setblocking(False)
    reported_s = 0.0
    while _drain(end, writer):
        now_s = time.monotonic()
        if now_s - reported_s >= REPORT_PERIOD_S:
            reported_s = now_s
            report = _Report(writer.recorded, writer.lost, writer.disk_free_share, writer.problem)
            with contextlib.suppress(OSError):  # a gateway that stands still does not read either
                end.send(msgspec.msgpack.encode(report))
        time.sleep(POLL_S)


def _drain(end: socket.socket, writer: RecordWriter) -> bool:
    """Take what has arrived; whether more can come."""
    was_reset = False
    while True:
        try:
            packet = end.recv(MAX_RECORD_BYTES)
        except BlockingIOError:
            return True
        except ConnectionResetError:
            if was_reset:
                return False
            # The gateway died with reports unread: the kernel says so once, ahead of the packets that are still there.
            was_reset = True
            continue
        if not packet:
            return False
        writer.put(packet)


def main() -> None:
    """The process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGABRT):
        signal.signal(number, signal.SIG_IGN)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(_NICE)
    task = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=_Task, dec_hook=lambda kind, value: kind(value))
    writer = RecordWriter(RecordFiles(task.options, task.session, task.networks, task.wall_offset_ns))
    with socket.socket(fileno=int(sys.argv[1])) as end:
        serve(end, writer)
    writer.close()


if __name__ == "__main__":
    main()
