"""What a service tells systemd, by sd_notify(3): one datagram each, without any library."""

import os
import socket
from collections.abc import Mapping

PAUSE_S = 30.0
"""Longest time in which a gateway may close its files and begin anew [s]."""


class Notifier:
    """Tells the service manager how the process is; nothing happens where there is none.

    Args:
        environment: of the process; `NOTIFY_SOCKET` names the manager's socket, `WATCHDOG_USEC` says that it watches.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # A leading @ stands for the zero byte of an abstract socket.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._is_watched = "WATCHDOG_USEC" in environment
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._last_status = ""

    def ready(self, watchdog_s: float) -> None:
        """The process works; from now on it is to be restarted when it is silent for longer than `watchdog_s` [s]."""
        self._send("READY=1" + self._patience(watchdog_s))

    def alive(self) -> None:
        """The process makes progress."""
        if self._is_watched:
            self._send("WATCHDOG=1")

    def pausing(self) -> None:
        """The control loop has ended; what follows, an end or another beginning, takes its time."""
        if self._is_watched:
            self._send(self._patience(PAUSE_S).strip())

    def _patience(self, watchdog_s: float) -> str:
        return f"\nWATCHDOG_USEC={round(watchdog_s * 1e6)}\nWATCHDOG=1" if self._is_watched else ""

    def status(self, text: str) -> None:
        """What the process does, in one line for people; sent when it changes."""
        if text != self._last_status:
            self._last_status = text
            self._send(f"STATUS={text}")

    def reloading(self, now_ns: int) -> None:
        """The process begins to take its configuration anew, at the monotonic time `now_ns`; `ready` ends it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={now_ns // 1_000}")

    def stopping(self) -> None:
        """The process begins to end."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:
            return  # a manager that is gone or busy is no reason to stop controlling a car

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
