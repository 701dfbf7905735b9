"""The bus oracle as a process of its own: it listens on the buses and prints what must not be, one JSON object a line.

    python -m tests.support.oracle_process --bus robots=xilgate:robots --bus navigation=xilgate:navigation --profile proving_ground

Standard input tells what happens to the gateway, one JSON object a line, `t_ns` of CLOCK_MONOTONIC: {"fault": "F1", "t_ns": ...},
{"end": "F3"}, {"request": "ARM"}, {"restart": true}; without `t_ns` it is now. At its end, or after --seconds, the exit code is 1 when
there was a violation and 0 when there was none; 3 when a bus does not open.
"""

import argparse
import heapq
import json
import os
import select
import sys
import time
from collections.abc import Iterator
from typing import Any

import can

from tests.support.bus_oracle import BusOracle
from tests.support.oracle_limits import ENVELOPES, MS
from tests.support.oracle_wire import Wire

HOLD_BACK_NS = 100 * MS
"""Frames wait this long, so that those of two buses and what standard input tells are judged in the order of their times."""
POLL_S = 0.005
JITTER_NS = 5 * MS


class Listener:
    """One bus; frames come with CLOCK_MONOTONIC times."""

    def __init__(self, network: str, bus_name: str) -> None:
        interface, _, channel = bus_name.partition(":")
        self.network = network
        self._bus = can.Bus(channel=channel, interface=interface, ignore_config=True)
        self._ahead_ns = time.time_ns() - time.monotonic_ns()
        self._offset_ns: int | None = None

    def frames(self) -> Iterator[tuple[int, int, bytes]]:
        """What has come: time [ns], identifier, payload."""
        while (message := self._bus.recv(timeout=0)) is not None:
            if not (message.is_error_frame or message.is_remote_frame):
                identifier = message.arbitration_id | (1 << 31 if message.is_extended_id else 0)
                yield self._monotonic_ns(round(message.timestamp * 1e9)), identifier, bytes(message.data)

    def _monotonic_ns(self, stamp_ns: int) -> int:
        """A time stamp in CLOCK_MONOTONIC; the kernel stamps frames with CLOCK_REALTIME, other interfaces with either."""
        if self._offset_ns is None:
            is_realtime = abs(stamp_ns - time.time_ns()) < abs(stamp_ns - time.monotonic_ns())
            self._offset_ns = self._ahead_ns if is_realtime else 0
        return stamp_ns - self._offset_ns

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


class Judge:
    """Puts what was heard and what was told into order and hands it to the oracle.

    Args:
        buses: bus name by network.
    """

    def __init__(self, oracle: BusOracle, buses: dict[str, str]) -> None:
        self._oracle = oracle
        self._listeners = [Listener(network, name) for network, name in buses.items()]
        wire = Wire()
        self._known = set(wire.by_id)
        self._own = {(message.network, message.arbitration_id) for message in wire.of_gateway()}
        self._networks_of = {message.arbitration_id: message.network for message in wire.by_name.values()}
        self._is_one_bus = len(set(buses.values())) < len(buses) or len(buses) == 1
        self._waiting: list[tuple[int, int, tuple[Any, ...]]] = []
        self._count = self._reported = self._answered = 0

    def tell(self, told: dict[str, Any]) -> None:
        """Take in what happens to the gateway."""
        self._put(int(told.get("t_ns", time.monotonic_ns())), ("told", told))

    def _put(self, t_ns: int, what: tuple[Any, ...]) -> None:
        self._count += 1
        heapq.heappush(self._waiting, (t_ns, self._count, what))

    def poll(self, until_ns: int) -> None:
        """Listen, and judge what is older than `until_ns`."""
        for listener in self._listeners:
            for t_ns, identifier, data in listener.frames():
                self._put(t_ns, ("frame", listener.network, identifier, data))
        while self._waiting and self._waiting[0][0] <= until_ns:
            t_ns, _, what = heapq.heappop(self._waiting)
            if what[0] == "told":
                self._mark(t_ns, what[1])
            else:
                self._observe(t_ns, *what[1:])
        self._report()

    def _observe(self, t_ns: int, network: str, identifier: int, data: bytes) -> None:
        if self._is_one_bus:
            network = self._networks_of.get(identifier, network)
        self._oracle.observe(t_ns, network, identifier, data, is_from_gateway=(network, identifier) in self._own)

    def _mark(self, t_ns: int, told: dict[str, Any]) -> None:
        if "fault" in told:
            self._oracle.mark_fault(t_ns, told["fault"])
        elif "end" in told:
            self._oracle.mark_end(told["end"])
        elif "request" in told:
            self._oracle.mark_request(t_ns, told["request"])
        elif "restart" in told:
            self._oracle.mark_restart()

    def _report(self) -> None:
        for violation in self._oracle.violations[self._reported :]:
            say({"violation": violation.rule, "t_ns": violation.t_ns, "detail": violation.detail})
        for answer in self._oracle.reactions[self._answered :]:
            say({"reaction": answer.fault, "latency_ms": answer.latency_ns / MS})
        self._reported, self._answered = len(self._oracle.violations), len(self._oracle.reactions)

    def finish(self) -> int:
        """Judge the rest; the exit code."""
        time.sleep(2 * POLL_S)
        now_ns = time.monotonic_ns()
        self.poll(now_ns)
        self._oracle.finish(now_ns)
        self._report()
        for listener in self._listeners:
            listener.close()
        return 1 if self._oracle.violations else 0


def say(what: dict[str, Any]) -> None:
    """One line on standard output."""
    print(json.dumps(what), flush=True)


def told_lines(pending: bytearray) -> Iterator[dict[str, Any] | None]:
    """What standard input has; None at its end."""
    while select.select([0], [], [], 0)[0]:
        chunk = os.read(0, 65536)
        if not chunk:
            yield None
            return
        pending += chunk
        while (end := pending.find(b"\n")) >= 0:
            line = bytes(pending[:end])
            del pending[: end + 1]
            if line.strip():
                yield json.loads(line)


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Independent judge of what the gateway sends.")
    parser.add_argument("--bus", action="append", required=True, metavar="NETWORK=INTERFACE:CHANNEL")
    parser.add_argument("--profile", choices=sorted(ENVELOPES), default="proving_ground")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--requests-untold", action="store_true", help="engagements need not be told on standard input")
    arguments = parser.parse_args()
    oracle = BusOracle(
        arguments.profile, jitter_ns=JITTER_NS, is_lossless=False, knows_requests=not arguments.requests_untold, is_virtual=False
    )
    try:
        judge = Judge(oracle, dict(bus.split("=", 1) for bus in arguments.bus))
    except (can.CanError, OSError, ValueError) as error:
        print(f"oracle: a bus does not open: {error}", file=sys.stderr)
        return 3
    say({"listening": arguments.bus})
    end_s, pending = time.monotonic() + arguments.seconds, bytearray()
    while time.monotonic() < end_s:
        for told in told_lines(pending):
            if told is None:
                return judge.finish()
            judge.tell(told)
        judge.poll(time.monotonic_ns() - HOLD_BACK_NS)
        time.sleep(POLL_S)
    return judge.finish()


if __name__ == "__main__":
    sys.exit(main())
