"""F14: with another monotonic clock, as a container or a host that has run for days has, everything is as ever."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OFFSET_S = 10_000_000


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.req("F14")
def test_faults_are_found_as_quickly_after_a_hundred_days():
    namespace = ["unshare", *([] if os.geteuid() == 0 else ["--map-root-user"]), "--time", "--fork", f"--monotonic={OFFSET_S}"]
    told = subprocess.run([*namespace, "cat", "/proc/self/timens_offsets"], capture_output=True, text=True, check=True).stdout
    assert str(OFFSET_S) in told
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "tests/processes/test_faults.py"]
    finished = subprocess.run([*namespace, *tests], capture_output=True, text=True, timeout=250, check=False, cwd=ROOT)
    assert finished.returncode == 0, finished.stdout
    assert "1 passed" in finished.stdout
