"""The bus record: every frame of a run, of all its buses, in candump's log format, which candump, canplayer, python-can and others read."""

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Self

import can

from dbc.frame import CanFrame
from dbc.frame_length import INTERMISSION_BITS
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.frame import BusFrame

_NS_PER_S = 1_000_000_000
_NS_PER_US = 1_000
_POLL_S = 0.02
"""A listener that waited for every frame would wake two thousand times a second, and cost whoever sends as much again."""


class BusLog:
    """Writes frames, each with its time stamp and the channel of its bus; several threads may write.

    Attributes:
        frames: frames written so far.
    """

    def __init__(self, path: Path) -> None:
        self._file: IO[str] = path.open("w", encoding="ascii")
        self._lock = threading.Lock()
        self.frames = 0

    def write(self, channel: str, frame: CanFrame) -> None:
        """Append one frame; its `t_ns` is the time stamp."""
        seconds, rest_ns = divmod(frame.t_ns, _NS_PER_S)
        line = f"({seconds}.{rest_ns // _NS_PER_US:06d}) {channel} {frame.arbitration_id:03X}#{frame.data.hex().upper()}\n"
        with self._lock:
            self._file.write(line)
            self.frames += 1

    def flush(self) -> None:
        """Give what is buffered to the system, so that it outlives this process."""
        with self._lock:
            self._file.flush()

    def close(self) -> None:
        """Write out what is buffered."""
        with self._lock:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class BusListener:
    """Records buses, each from a thread of its own, with the time stamps of the bus, until closed.

    Args:
        bus_names: `INTERFACE:CHANNEL` of each; one that is named twice is recorded once.

    Attributes:
        problem: why the record ends early, in one line; empty while it goes on.
    """

    def __init__(self, bus_names: Iterable[str], path: Path) -> None:
        self._is_closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self.problem = ""
        with contextlib.ExitStack() as opening:
            self._log = BusLog(path)
            opening.callback(self._close_log)
            for interface, _, channel in (name.partition(":") for name in dict.fromkeys(bus_names)):
                bus = opening.enter_context(can.Bus(interface=interface, channel=channel))
                self._threads.append(threading.Thread(target=self._record, args=(bus, channel), name=f"bus log {channel}", daemon=True))
            self._opened = opening.pop_all()
        for thread in self._threads:
            thread.start()

    def _record(self, bus: can.BusABC, channel: str) -> None:
        while not self._is_closing.is_set() and not self.problem:
            try:
                message = bus.recv(timeout=0)
            except (can.CanError, OSError):
                return  # the bus has gone; whoever runs it says so
            try:
                self._keep(channel, message)
            except OSError as error:
                self.problem = f"the bus record ends early: {error.strerror or error}"

    def _keep(self, channel: str, message: can.Message | None) -> None:
        if message is None:
            self._log.flush()
            time.sleep(_POLL_S)
        elif not (message.is_error_frame or message.is_remote_frame):
            self._log.write(channel, CanFrame(message.arbitration_id, bytes(message.data), round(message.timestamp * _NS_PER_S)))

    def _close_log(self) -> None:
        try:
            self._log.close()
        except OSError as error:
            self.problem = self.problem or f"the bus record ends early: {error.strerror or error}"

    @property
    def frames(self) -> int:
        """Frames recorded so far."""
        return self._log.frames

    def close(self) -> None:
        """Leave the buses and close the file."""
        self._is_closing.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def recorded_load(path: Path, bitrate_bps: Mapping[str, int]) -> dict[str, float]:
    """Share of the time from the first frame of a record to the last in which the buses were busy, error frames apart.

    Args:
        bitrate_bps: of each channel to look at [bit/s].

    Returns:
        By channel; nothing of a record that has no duration.
    """
    bits, times_s = Counter[str](), []
    for time_stamp, channel, content in (line.split() for line in path.read_text(encoding="ascii").splitlines()):
        arbitration_id, _, data = content.partition("#")
        payload = bytes.fromhex(data)
        nominal_bits, _ = frame_bits(BusFrame(int(arbitration_id, 16), payload, 0, len(payload)))
        bits[channel] += nominal_bits + INTERMISSION_BITS
        times_s.append(float(time_stamp.strip("()")))
    duration_s = max(times_s, default=0.0) - min(times_s, default=0.0)
    return {channel: bits[channel] / (rate_bps * duration_s) for channel, rate_bps in bitrate_bps.items()} if duration_s else {}
