"""The stub car as a process of its own, on real buses in real time.

    python -m tests.support.car_process robots=xilgate:robots navigation=xilgate:navigation

Standard input changes it, one JSON object a line: attributes of `StubCar`, `lose_norm` (share of its frames that are lost), `late_ms`
(how late they come). The answer {"since_ns": ...} is the time from which on the frames are so.
"""

import contextlib
import random
import sys
import time
from typing import Any

import can

from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.realtime import become_realtime
from tests.support.lines import Told, say
from tests.support.robots import TICK_NS, StubCar

PRIORITY = 52
TIMEOUT_NS = 100_000_000
"""After this time without a command the robots let go."""
SETS = ("silent", "corrupt", "override_of")


class CarProcess:
    """A stub car with its buses, by network."""

    def __init__(self, buses: dict[str, str]) -> None:
        self._catalogue = load()
        self._car = StubCar(self._catalogue, vx_mps=0.0, vy_mps=0.0, yaw_rate_radps=0.0, is_following=True)
        self._buses = {network: can.Bus(interface="xilgate", channel=name.partition(":")[2]) for network, name in buses.items()}
        self._own = {spec.arbitration_id for spec in self._catalogue.by_name.values() if spec.sender == "GW"}
        self._random = random.Random(1)
        self._lose_norm, self._late_ns = 0.0, 0
        self._late: list[tuple[int, CanFrame]] = []
        self._commanded_ns = 0

    def run(self) -> None:
        """Live until standard input ends."""
        told, deadline_ns = Told(), time.monotonic_ns()
        say(running=True)
        while not told.is_over:
            deadline_ns = max(deadline_ns + TICK_NS, time.monotonic_ns() - 5 * TICK_NS)
            time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
            changes = list(told)
            for change in changes:
                self._change(change)
            self._hear()
            now_ns = time.monotonic_ns()
            self._speak(now_ns)
            for _ in changes:
                say(since_ns=now_ns)

    def _change(self, change: dict[str, Any]) -> None:
        self._lose_norm = change.pop("lose_norm", self._lose_norm)
        self._late_ns = round(change.pop("late_ms", self._late_ns * 1e-6) * 1e6)
        for name, value in change.items():
            setattr(self._car, name, set(value) if name in SETS else value)

    def _hear(self) -> None:
        with contextlib.suppress(can.CanError):
            while (message := self._buses["robots"].recv(timeout=0)) is not None:
                if message.arbitration_id in self._own and not message.is_error_frame:
                    self._car.hear([CanFrame(message.arbitration_id, bytes(message.data), 0)])
                    self._commanded_ns = time.monotonic_ns()
        if time.monotonic_ns() - self._commanded_ns > TIMEOUT_NS:
            self._car.let_go()

    def _speak(self, now_ns: int) -> None:
        frames = [frame for frame in self._car.speak(now_ns) if self._random.random() >= self._lose_norm]
        self._late += [(now_ns + self._late_ns, frame) for frame in frames]
        for _, frame in (entry for entry in self._late if entry[0] <= now_ns):
            network = self._catalogue.by_id[frame.arbitration_id].network
            with contextlib.suppress(can.CanError):  # a bus that takes no more
                self._buses[network].send(can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False, data=frame.data))
        self._late = [entry for entry in self._late if entry[0] > now_ns]


if __name__ == "__main__":
    process = CarProcess(dict(argument.split("=", 1) for argument in sys.argv[1:]))
    become_realtime(PRIORITY)
    process.run()
