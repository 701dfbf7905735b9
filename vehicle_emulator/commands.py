"""The emulator's own reading of the gateway's command frames."""

from collections.abc import Mapping

from dbc.catalogue import Catalogue, DecodeError
from dbc.e2e import E2EReceiver
from dbc.frame import CanFrame


class CommandReceiver:
    """Newest good content of one message; a frame that fails length, range or end-to-end protection never arrived.

    Attributes:
        values: signals of the last good frame, in the units of the DBC; zero before the first.
        rejected: frames that did not count.
    """

    def __init__(self, catalogue: Catalogue, name: str) -> None:
        self._catalogue = catalogue
        self._spec = catalogue.by_name[name]
        self._e2e = None if self._spec.e2e_data_id is None else E2EReceiver(self._spec.e2e_data_id)
        self._last_good_ns: int | None = None
        self.arbitration_id = self._spec.arbitration_id
        self.values: Mapping[str, float] = dict.fromkeys(catalogue.signals(name), 0.0)
        self.rejected = 0

    def receive(self, now_ns: int, frame: CanFrame) -> None:
        """Judge a frame that arrived now."""
        is_length_good = len(frame.data) == self._spec.length_bytes
        if not is_length_good or not (self._e2e is None or self._e2e.check(frame.data).is_usable):
            self.rejected += 1
            return
        try:
            self.values = self._catalogue.decode(self._spec, frame)
            self._last_good_ns = now_ns
        except DecodeError:
            self.rejected += 1

    def is_fresh(self, now_ns: int) -> bool:
        """Whether the last good frame is no older than the timeout in the DBC."""
        return self._last_good_ns is not None and now_ns - self._last_good_ns <= self._spec.timeout_ns
