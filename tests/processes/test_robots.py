"""F12: when the gateway dies or hangs, the emulated robots stop the car by themselves, as the bus shows."""

import random
import signal
import tempfile
import time
from pathlib import Path

import can
import numpy as np
import pytest

from gateway.messages import Operation
from tests.support.oracle_wire import Wire
from tests.support.process_bench import ProcessBench, ended
from tests.support.processes import start_xilgate
from tests.support.quiet import Quiet

pytestmark = [pytest.mark.realtime, pytest.mark.long, pytest.mark.timeout(1_800)]

TRIALS = 30
ATTEMPTS = 4
RELEASE_MS = 140.0  # B3, F12: the robots' own timeout of 100 ms, and one status message
WATCHED_S = 0.5
HEARD_S = 0.05
"""Time in which the gateway is heard before anything happens to it [s]."""
WIRE = Wire()
COMMAND, STATUS = WIRE.by_name["GW_SafetyCommand"], WIRE.by_name["RC_SafetyStatus"]


class EmulatedCarBench(ProcessBench):
    """The emulated car with its robots in place of the stub; it stands."""

    def start_car(self) -> None:
        buses = ["--bus", self.buses["robots"], "--navigation-bus", self.buses["navigation"]]
        emulator = start_xilgate("emulator", *buses, "--plant", "bicycle", "--telemetry-port", str(self.base_port))
        self.opened.callback(ended, emulator)

    def roll(self, speed_mps: float) -> None:
        """It is there, and robots that have stopped it are told that all is well again."""
        self.ask(Operation.RESET)


@pytest.fixture(scope="module")
def rig():
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        rig = EmulatedCarBench(Path(directory))
        try:
            yield rig
        finally:
            rig.close()


def release_ms(rig: ProcessBench, number: signal.Signals) -> float | None:
    """Time from the last command on the bus to the robots' stop [ms]; None when they go on."""
    identifiers = [{"can_id": message.arbitration_id, "can_mask": 0x7FF} for message in (COMMAND, STATUS)]
    with can.Bus(interface="xilgate", channel=rig.channels["robots"], can_filters=identifiers) as bus:
        end_s, commanded_s = time.monotonic() + WATCHED_S, None
        time.sleep(HEARD_S)
        rig.signal_gateway(number)
        while time.monotonic() < end_s:
            message = bus.recv(0.01)
            if message is None or message.is_error_frame:
                continue
            if message.arbitration_id == COMMAND.arbitration_id:
                commanded_s = message.timestamp
            elif commanded_s is not None and STATUS.choice(bytes(message.data), "SystemState") != "Engaged":
                return (message.timestamp - commanded_s) * 1e3
    return None


def conclusive_ms(rig: ProcessBench, number: signal.Signals, dice: random.Random) -> float | None:
    disturbances = []
    for _ in range(ATTEMPTS):
        rig.engage()
        time.sleep(dice.uniform(0.0, 0.1))
        with Quiet() as quiet:
            latency_ms = release_ms(rig, number)
        rig.restart_gateway()
        if not quiet.disturbance:
            return latency_ms
        disturbances.append(quiet.disturbance)
    raise AssertionError(f"{ATTEMPTS} times inconclusive: {', '.join(disturbances)}")


@pytest.mark.req("F12")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_robots_stop_the_car_when_the_gateway_is_gone(rig, number, figure):
    dice = random.Random(number)
    times_ms = [conclusive_ms(rig, number, dice) for _ in range(TRIALS)]
    released_ms = [time_ms for time_ms in times_ms if time_ms is not None]
    name = f"{number.name} to the gateway"
    assert figure(f"{name}: trials without a stop by the robots, of {TRIALS}", TRIALS - len(released_ms), "", "= 0")
    figure(f"{name}: from the last command to the stop, median", float(np.median(released_ms)), "ms")
    assert figure(f"{name}: from the last command to the stop, longest", max(released_ms), "ms", f"<= {RELEASE_MS:g}")
