"""Floods a gateway with junk: over Zenoh on the keys of telemetry, or on its control sockets.

    python -m tests.support.flood_process GATEWAY_PORT CONTROL_DIRECTORY

Standard input: {"kind": "telemetry"}, "sockets", "stalled" (subscribes to everything and stops reading: the process stops itself), or null
for nothing. The answer {"since_ns": ...} is the time at which it begins.
"""

import contextlib
import os
import random
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import zenoh

from tests.support.lines import Told, say

RATE_HZ = 10_000
BURST = 100
BIG_BYTES = 1_000_000
KEYS = ("state", "status", "command", "plan", "world", "objects", "faults", "parameters", "scene")


def session_to(port: int) -> zenoh.Session:
    """A client of that publisher, and of nobody else."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


class Flood:
    """What is sent, 100 messages at a time."""

    def __init__(self, port: int, directory: Path) -> None:
        self._dice = random.Random(1)
        self._session = session_to(port)
        self._sockets = [str(directory / name) for name in ("gateway.sock", "operator.sock")]
        self._sender = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sender.setblocking(False)
        self._big = self._dice.randbytes(BIG_BYTES)
        self.kinds: dict[str, Callable[[], None]] = {"telemetry": self._telemetry, "sockets": self._to_sockets, "stalled": self._stall}

    def _telemetry(self) -> None:
        for k in range(BURST):
            key = f"xilgate/{self._dice.choice(KEYS)}"
            payload = self._big if k == 0 and self._dice.random() < 0.2 else self._dice.randbytes(self._dice.randrange(200))
            self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def _to_sockets(self) -> None:
        for _ in range(BURST):
            with contextlib.suppress(OSError):  # refused, or full
                self._sender.sendto(self._dice.randbytes(self._dice.randrange(1, 1000)), self._dice.choice(self._sockets))

    def _stall(self) -> None:
        self._subscriber = self._session.declare_subscriber("xilgate/**", lambda sample: None)
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGSTOP)


def main() -> None:
    """Live until standard input ends."""
    told, kind, flood = Told(), None, Flood(int(sys.argv[1]), Path(sys.argv[2]))
    say(running=True)
    while not told.is_over:
        begin_s = time.monotonic()
        for change in told:
            kind = change["kind"]
            say(since_ns=time.monotonic_ns())
        if kind is not None:
            flood.kinds[kind]()
        time.sleep(max(BURST / RATE_HZ - (time.monotonic() - begin_s), 0.0))


if __name__ == "__main__":
    main()
