"""A run-time directory of the test's own, and a hub that serves in a thread."""

import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from vehicle_emulator.bus.hub import Hub, HubOptions

FAST = HubOptions(bitrate_bps=1_000_000, tcp_port=0)


@pytest.fixture(autouse=True)
def runtime_directory(monkeypatch):
    # Not tmp_path: a socket name has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        yield Path(directory)


@contextmanager
def serving(channel: str, options: HubOptions = FAST):
    """A hub whose turns run in a thread, closed at the end."""
    stop = threading.Event()
    with Hub(channel, options) as hub:

        def turns():
            while not stop.is_set():
                hub.turn(0.02)

        thread = threading.Thread(target=turns)
        thread.start()
        try:
            yield hub
        finally:
            stop.set()
            thread.join()


@pytest.fixture
def hub():
    with serving("bus0") as served:
        yield served


@pytest.fixture(params=["bus0", "tcp"])
def channel(request, hub):
    """The hub's channel, by its name and by its port."""
    return f"tcp://127.0.0.1:{hub.tcp_port}" if request.param == "tcp" else request.param
