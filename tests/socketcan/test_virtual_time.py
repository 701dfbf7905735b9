"""Gateway, controller and emulator as processes on vcan, in virtual time: the same drive is the same frames at the same times.

The guest's clock stands still while anything computes and jumps over the time in which nothing does, so that the processes that drive in
real time elsewhere do everything at the same times again, however busy the machine is. What they decide by chance shows as a difference.
How long computing takes does not show here.
"""

import os
import subprocess
import sys
import time
from itertools import zip_longest
from pathlib import Path

import pytest

SUPPORT = Path(__file__).parents[1] / "support"
ROOT = SUPPORT.parents[1]
PACKAGES = ("dbc", "gateway", "controller", "vehicle_emulator", "visualiser", "xil")
SCENARIO = "iso3888-1"
DRIVE_LIMIT_S = 1_200
MIN_FRAMES = 20_000


def output(*command: str | Path, **environment: str) -> str:
    """What a command prints; where it fails, so does the test, with what it says of itself."""
    finished = subprocess.run(command, env=os.environ | environment, cwd=ROOT, capture_output=True, text=True, check=False)
    if finished.returncode:
        pytest.fail(f"{Path(command[0]).name} ended with {finished.returncode}:\n{finished.stdout}{finished.stderr}", pytrace=False)
    return finished.stdout.strip()


def drive(kernel: str, directory: Path) -> list[str]:
    """Boot, drive, halt: the lines of the record of both buses."""
    guest = {"VCAN_GUEST_KERNEL": kernel, "VCAN_GUEST_TIME": "virtual", "VCAN_GUEST_LIMIT_S": str(DRIVE_LIMIT_S)}
    buses = ["--bus", "socketcan:vcan0", "--navigation-bus", "socketcan:vcan1"]
    command = [sys.executable, "-m", "xil", "drive", SCENARIO, "--stage", "hil", *buses, "--out", directory]
    # A drive that writes byte code starts some milliseconds later than one that finds it, and then all differs.
    output(SUPPORT / "vcan_guest.sh", *command, PYTHONDONTWRITEBYTECODE="1", **guest)
    return (directory / "bus.log").read_text(encoding="ascii").splitlines()


def time_s(line: str) -> float:
    return float(line.split(maxsplit=1)[0].strip("()"))


@pytest.mark.long
@pytest.mark.timeout(2 * 3_600)
def test_two_drives_are_the_same_to_the_microsecond(tmp_path, figure):
    kernel = output(SUPPORT / "uml_kernel.sh")
    # Both drives find everything compiled.
    output(sys.executable, "-m", "compileall", "-q", *PACKAGES)
    output(sys.executable, "-m", "xil", "drive", SCENARIO, "--stage", "sil", "--out", tmp_path / "sil")
    begun_s = time.monotonic()
    first, second = (drive(kernel, tmp_path / name) for name in ("drive-1", "drive-2"))
    wall_s = time.monotonic() - begun_s
    differences = [(ours, theirs) for ours, theirs in zip_longest(first, second) if ours != theirs]
    figure("a drive, from the first frame to the last, virtual time", time_s(first[-1]) - time_s(first[0]), "s")
    figure("boot, drive and halt, mean of two, real time", wall_s / 2, "s")
    assert figure("frames compared: identifier, data, bus and time stamp in microseconds", len(first), "", f">= {MIN_FRAMES}")
    assert figure("frames that differ", len(differences), "", "= 0"), differences[:5]
