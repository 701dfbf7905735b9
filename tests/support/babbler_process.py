"""A node that sends without end, on a bus of its own choice.

    python -m tests.support.babbler_process xilgate:robots

Standard input: {"rate_hz": 300, "identifier": 1}; null for as fast as the bus takes it, 0 for nothing. The answer {"since_ns": ...} is the
time of the first such frame.
"""

import contextlib
import random
import sys
import time

import can

from dbc.realtime import take_priority
from tests.support.lines import Told, say

PRIORITY = 40
ROOM_S = 0.005


def main() -> None:
    """Live until standard input ends."""
    told, rate_hz, identifier, dice = Told(), 0.0, 0, random.Random(1)
    take_priority(PRIORITY)
    with can.Bus(interface="xilgate", channel=sys.argv[1].partition(":")[2], receive_own_messages=False) as bus:
        say(running=True)
        while not told.is_over:
            changes = list(told)
            for change in changes:
                rate_hz, identifier = change["rate_hz"], change.get("identifier", 0)
            now_ns = time.monotonic_ns()
            if rate_hz != 0:
                with contextlib.suppress(can.CanError):
                    bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=dice.randbytes(8)), timeout=ROOM_S)
            for _ in changes:
                say(since_ns=now_ns)
            if rate_hz is not None:
                time.sleep(1.0 / rate_hz if rate_hz else ROOM_S)


if __name__ == "__main__":
    main()
