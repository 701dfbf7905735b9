"""Command frames as a robot judges them: length, end-to-end protection, range, and whether they may come now.

A frame that fails anything never arrived: it is counted, and the age of the last good one goes on.
"""

from collections import Counter
from collections.abc import Callable, Mapping

from dbc.catalogue import Catalogue, DecodeError
from dbc.e2e import E2EReceiver, E2EStatus
from dbc.frame import CanFrame
from vehicle_emulator.robots.states import Dtc

Values = Mapping[str, float]


class CommandReceiver:
    """Newest good content of one message.

    Args:
        accepts: whether these values may come now; a frame with others does not count.

    Attributes:
        values: signals of the last good frame, in the units of the DBC; zero before the first.
        rejected: frames that did not count, by cause.
        trouble: why the newest frame did not count, or None when it did.
    """

    def __init__(self, catalogue: Catalogue, name: str, accepts: Callable[[Values], bool]) -> None:
        self._catalogue = catalogue
        self._spec = catalogue.by_name[name]
        self._e2e = None if self._spec.e2e_data_id is None else E2EReceiver(self._spec.e2e_data_id)
        self._accepts = accepts
        self._fresh_until_ns = -1
        self.arbitration_id = self._spec.arbitration_id
        self.values: Values = dict.fromkeys(catalogue.signals(name), 0.0)
        self.rejected: Counter[Dtc] = Counter()
        self.trouble: Dtc | None = None

    def receive(self, now_ns: int, frame: CanFrame) -> bool:
        """Judge a frame that arrived now; whether it counts."""
        self.trouble = self._judge(frame)
        if self.trouble is None:
            self._fresh_until_ns = now_ns + self._spec.timeout_ns
            return True
        self.rejected[self.trouble] += 1
        return False

    def is_fresh(self, now_ns: int) -> bool:
        """Whether the last good frame is no older than the timeout in the DBC."""
        return now_ns <= self._fresh_until_ns

    def is_overdue(self, now_ns: int) -> bool:
        """Whether there have been good frames, and are none any more."""
        return 0 <= self._fresh_until_ns < now_ns

    def _judge(self, frame: CanFrame) -> Dtc | None:
        if len(frame.data) != self._spec.length_bytes:
            return Dtc.COMMAND_OUT_OF_RANGE
        if self._e2e is not None and not (status := self._e2e.check(frame.data)).is_usable:
            return Dtc.COMMAND_CRC if status is E2EStatus.WRONG_CRC else Dtc.COMMAND_COUNTER
        try:
            values = self._catalogue.decode(self._spec, frame)
        except DecodeError:
            return Dtc.COMMAND_OUT_OF_RANGE
        if not self._accepts(values):
            return Dtc.COMMAND_OUT_OF_RANGE
        self.values = values
        return None
