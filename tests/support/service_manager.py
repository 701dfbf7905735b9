"""Stands in for systemd: a socket that hears what a service tells."""

import socket
import time


class ServiceManager:
    """Listens at `path`; `environment` is what a service is started with."""

    def __init__(self, path):
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self.environment = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "1000000"}
        self.heard = []  # (arrival [s], text)

    def hear(self, for_s=0.0):
        """What has been told, after listening for some time."""
        end_s = time.monotonic() + for_s
        while (left_s := end_s - time.monotonic()) > 0.0 or for_s == 0.0:
            self._socket.settimeout(max(left_s, 0.001))
            try:
                self.heard.append((time.monotonic(), self._socket.recv(4096).decode()))
            except TimeoutError:
                break
        return self.texts

    @property
    def texts(self):
        return [text for _, text in self.heard]

    def has_heard(self, beginning, times=1):
        return sum(text.startswith(beginning) for text in self.hear()) >= times

    def close(self):
        self._socket.close()
