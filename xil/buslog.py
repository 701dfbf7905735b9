"""The bus record: every frame of a run in candump's log format, which candump, canplayer, python-can and many others read."""

import threading
from pathlib import Path
from typing import IO, Self

import can

from dbc.frame import CanFrame

_NS_PER_S = 1_000_000_000
_NS_PER_US = 1_000


class BusLog:
    """Writes frames with a time stamp each."""

    def __init__(self, path: Path, channel: str) -> None:
        self._file: IO[str] = path.open("w", encoding="ascii")
        self._channel = channel
        self.frames = 0

    def write(self, frame: CanFrame) -> None:
        """Append one frame; its `t_ns` is the time stamp."""
        seconds, rest_ns = divmod(frame.t_ns, _NS_PER_S)
        data = frame.data.hex().upper()
        self._file.write(f"({seconds}.{rest_ns // _NS_PER_US:06d}) {self._channel} {frame.arbitration_id:03X}#{data}\n")
        self.frames += 1

    def close(self) -> None:
        """Write out what is buffered."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class BusListener:
    """Records a bus from a thread of its own, with the time stamps of the bus, until closed."""

    def __init__(self, bus_name: str, path: Path) -> None:
        interface, _, channel = bus_name.partition(":")
        self._bus = can.Bus(interface=interface, channel=channel)
        self._log = BusLog(path, channel)
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bus log", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._is_closing.is_set():
            try:
                message = self._bus.recv(timeout=0.2)
            except (can.CanError, OSError):
                return  # the bus has gone; whoever runs it says so
            if message is not None and not (message.is_error_frame or message.is_remote_frame):
                self._log.write(CanFrame(message.arbitration_id, bytes(message.data), round(message.timestamp * _NS_PER_S)))

    @property
    def frames(self) -> int:
        """Frames recorded so far."""
        return self._log.frames

    def close(self) -> None:
        """Leave the bus and close the file."""
        self._is_closing.set()
        self._thread.join(timeout=2.0)
        self._bus.shutdown()
        self._log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
