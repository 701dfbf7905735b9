"""An emulated bus of the test's own, served in a thread."""

import tempfile
import threading

import pytest

from vehicle_emulator.bus.hub import Hub


class ServedChannel:
    """A hub whose turns run in a thread until it is stopped; it can be started again."""

    def __init__(self, channel):
        self.channel = channel
        self.start()

    def start(self):
        self.hub = Hub(self.channel)
        self.stopping = threading.Event()
        self.thread = threading.Thread(target=self._turns)
        self.thread.start()

    def _turns(self):
        while not self.stopping.is_set():
            self.hub.turn(0.02)

    def stop(self):
        if not self.thread.is_alive():
            return
        self.stopping.set()
        self.thread.join()
        self.hub.close()


@pytest.fixture
def served(monkeypatch):
    # Not tmp_path: a socket name has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        channel = ServedChannel("bus0")
        yield channel
        channel.stop()
