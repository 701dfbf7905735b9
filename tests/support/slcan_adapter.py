"""A CAN adapter that does not exist, under the kernel's real driver: one end of a pseudo-terminal speaks slcan as its firmware would.

The kernel's slcan driver sits on the other end and makes an interface with error states, counters, error frames and hot-unplug.
It shows frames to their sender as soon as it takes them, has no restart after bus-off, and takes frames in bus-off without
sending them. Needs the module slcan and the right to make interfaces.
"""

import contextlib
import fcntl
import os
import pty
import struct
import subprocess
import termios
import time

_N_SLCAN = 17
_SIOCGIFNAME = 0x8910


class SlcanAdapter:
    """Plugged in when made, its interface up.

    Attributes:
        interface: name that the kernel gave it.
    """

    def __init__(self) -> None:
        self._firmware, self._port = pty.openpty()
        mode = termios.tcgetattr(self._port)
        mode[0], mode[1], mode[3] = 0, 0, 0  # raw: no translation, no echo
        termios.tcsetattr(self._port, termios.TCSANOW, mode)
        os.set_blocking(self._firmware, False)
        try:
            fcntl.ioctl(self._port, termios.TIOCSETD, struct.pack("i", _N_SLCAN))
        except OSError:
            os.close(self._firmware)
            os.close(self._port)
            raise
        self.interface = fcntl.ioctl(self._port, _SIOCGIFNAME, bytes(16)).partition(b"\0")[0].decode()
        self._unread = b""
        self._is_gone = False
        subprocess.run(["ip", "link", "set", self.interface, "up"], check=True)

    def deliver(self, arbitration_id: int, data: bytes) -> None:
        """A frame comes in from the bus."""
        self._say(f"t{arbitration_id:03X}{len(data)}{data.hex().upper()}")

    def enter(self, state: str, rx_error_count: int, tx_error_count: int) -> None:
        """The controller enters a state: a(ctive), w(arning), p(assive) or b(us-off)."""
        self._say(f"s{state}{rx_error_count:03}{tx_error_count:03}")

    def report(self, errors: str) -> None:
        """Errors on the wire: a(cknowledge), b and B (bit), c (CRC), f(orm), s(tuff); o and O for lost frames."""
        self._say(f"e{len(errors)}{errors}")

    def sent(self) -> list[tuple[int, bytes]]:
        """Frames that the kernel has given out for the bus since the last call."""
        with contextlib.suppress(BlockingIOError):
            self._unread += os.read(self._firmware, 65536)
        *lines, self._unread = self._unread.split(b"\r")
        return [(int(line[1:4], 16), bytes.fromhex(line[5:].decode())) for line in lines if line[:1] == b"t"]

    def unplug(self) -> None:
        """Take it off; its interface goes. A second time changes nothing."""
        if self._is_gone:
            return
        self._is_gone = True
        os.close(self._firmware)
        os.close(self._port)
        deadline_s = time.monotonic() + 10.0
        while os.path.exists(f"/sys/class/net/{self.interface}"):
            assert time.monotonic() < deadline_s, f"{self.interface} does not go"
            time.sleep(0.005)

    def _say(self, line: str) -> None:
        os.write(self._firmware, line.encode("ascii") + b"\r")
