"""A process with a gateway that records: `python -m tests.support.recording_gateway DIRECTORY SECONDS PERIOD_S FORMAT...`.

Tells on its output the process id of its recorder, then for each tick its number, its time and whether it counts as recorded.
"""

import sys
import time
from pathlib import Path

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.vehicle import FOCUS
from gateway.journal import Glance, StepArguments
from gateway.limits import PROVING_GROUND
from gateway.record.session import gateway_session
from gateway.recorder import BusFormat, FileOptions, Recorder
from tests.support.drive import GatewayDrive


def session():
    return gateway_session(1, PROVING_GROUND, (ROBOTS_DBC, GNSS_IMU_DBC), FOCUS, {"name": "test"})


def step(drive: GatewayDrive, now_ns: int) -> StepArguments:
    """One tick of the stub car and the gateway at this time; what the gateway was given."""
    frames = drive.car.speak(now_ns)
    early, late = frames[: len(frames) // 2], frames[len(frames) // 2 :]
    arguments = StepArguments(now_ns, late, glances=[Glance(now_ns - 1_000_000, early)])
    drive.output = arguments.step(drive.core)
    drive.car.hear(drive.output.frames)
    return arguments


def main(directory: str, seconds: str, period_s: str, *formats: str) -> None:
    drive = GatewayDrive()
    options = FileOptions(Path(directory), "gateway", tuple(map(BusFormat, formats)))
    with Recorder(options, session(), drive.catalogue) as recorder:
        print(recorder.pid, flush=True)
        next_s = end_s = time.monotonic()
        end_s += float(seconds)
        tick = 0
        while next_s < end_s:
            next_s += float(period_s)
            time.sleep(max(0.0, next_s - time.monotonic()))
            now_ns = time.monotonic_ns()
            status = recorder.poll(now_ns)
            recorder.record(step(drive, now_ns), drive.output)
            print(tick, now_ns, int(status.is_recording), flush=True)
            tick += 1


if __name__ == "__main__":
    main(*sys.argv[1:])
