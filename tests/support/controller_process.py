"""A stub controller as a process of its own: answers every fourth state with a plan of constant demands, in real time.

    python -m tests.support.controller_process CONTROL_DIRECTORY

Standard input changes it, one JSON object a line: `steer_rad`, `drive_norm`, `status`, `skip` (commands that it does not send),
`bad` (what is wrong with its commands, of `BAD`; null for nothing). The answer {"since_ns": ...} is the time at which the first such
command is sent, or not sent. It says {"mode": ..., "t_ns": ...} when the states tell another one.
"""

import random
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from dbc.realtime import CONTROLLER_PRIORITY, become_realtime
from gateway.channel import Channel, control_path
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, VehicleState
from tests.support.lines import Told, say

PERIOD_NS = 40_000_000

BAD: dict[str, Callable[[ControlCommand], ControlCommand]] = {
    "not a number": lambda c: replace(c, steer_rad=float("nan")),
    "infinite": lambda c: replace(c, plan_drive_norm=(*c.plan_drive_norm[:-1], float("inf"))),
    "out of range": lambda c: replace(c, steer_rad=3.0),
    "answers an old state": lambda c: replace(c, state_seq=max(c.state_seq - 100, 0)),
    "repeated": lambda c: replace(c, seq=1),
    "from the future": lambda c: replace(c, t_ns=c.t_ns + 10_000_000_000),
}


class ControllerProcess:
    """Sends a plan every 40 ms while there are states."""

    def __init__(self, directory: Path) -> None:
        control = control_path(directory)
        self._channel = Channel(control.controller_socket, control.gateway_socket, control.key())
        self._boot_id = random.SystemRandom().randrange(1, 1 << 31)
        self._seq = 0
        self._settings = {"steer_rad": 0.0, "drive_norm": 0.0, "status": "OK", "skip": 0, "bad": None}
        self._state: VehicleState | None = None
        self._mode = ""

    def run(self) -> None:
        """Live until standard input ends."""
        told, deadline_ns = Told(), time.monotonic_ns()
        say(running=True)
        while not told.is_over:
            deadline_ns = max(deadline_ns + PERIOD_NS, time.monotonic_ns() - PERIOD_NS)
            time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
            changes = list(told)
            for change in changes:
                self._settings |= change
            now_ns = time.monotonic_ns()
            self._answer(now_ns)
            for _ in changes:
                say(since_ns=now_ns)

    def _answer(self, now_ns: int) -> None:
        state = self._state = self._channel.newest(VehicleState) or self._state
        if state is None:
            return
        if state.mode.name != self._mode:
            self._mode = state.mode.name
            say(mode=self._mode, t_ns=now_ns)
        self._seq += 1
        if self._settings["skip"]:
            self._settings["skip"] -= 1
            return
        steer_rad, drive_norm = self._settings["steer_rad"], self._settings["drive_norm"]
        command = ControlCommand(
            boot_id=self._boot_id, seq=self._seq, state_seq=state.seq, t_ns=now_ns, status=CommandStatus[self._settings["status"]],
            solve_time_ns=0, lateral_error_m=0.0, heading_error_rad=0.0, steer_rad=steer_rad, drive_norm=drive_norm,
            plan_steer_rad=(steer_rad,) * HORIZON_STEPS, plan_drive_norm=(drive_norm,) * HORIZON_STEPS,
        )  # fmt: skip
        bad = self._settings["bad"]
        self._channel.send(BAD[bad](command) if bad else command)


if __name__ == "__main__":
    process = ControllerProcess(Path(sys.argv[1]))
    become_realtime(CONTROLLER_PRIORITY)
    process.run()
