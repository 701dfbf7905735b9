"""One rig of real processes for the tests of a module."""

import tempfile
from pathlib import Path

import pytest

from tests.support.process_bench import ProcessBench


@pytest.fixture(scope="module")
def bench():
    # Not tmp_path: a socket name has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        rig = ProcessBench(Path(directory))
        try:
            yield rig
        finally:
            rig.close()
