"""Judgement on every frame received, and on those that are missing.

A frame counts only when the DBC knows it, its length and ranges fit, and its end-to-end protection holds. All else is
counted by cause and ignored: bad data and no data are the same thing, so that one freshness check per message covers both.
"""

from collections import Counter
from collections.abc import Iterable, Sequence

from dbc.catalogue import Catalogue, DecodeError, MessageSpec
from dbc.e2e import E2EReceiver
from dbc.frame import CanFrame


class Supervisor:
    """Accepts or rejects frames and watches the age of the messages it is told to need.

    Args:
        needed: names of the messages whose absence matters and whose content is decoded; others are ignored.

    Attributes:
        received: frames seen.
        rejected: count by cause.
    """

    def __init__(self, catalogue: Catalogue, needed: Iterable[str]) -> None:
        self._catalogue = catalogue
        self._needed: dict[int, MessageSpec] = {
            catalogue.by_name[name].arbitration_id: catalogue.by_name[name] for name in needed
        }
        self._receivers = {
            arbitration_id: E2EReceiver(spec.e2e_data_id)
            for arbitration_id, spec in self._needed.items()
            if spec.e2e_data_id is not None
        }
        self._last_good_ns: dict[str, int] = {}
        self.received = 0
        self.rejected: Counter[str] = Counter()

    def observe(self, frames: Sequence[CanFrame]) -> dict[str, dict[str, float]]:
        """Newest good signal values of each needed message among `frames`, in the units of the DBC."""
        values: dict[str, dict[str, float]] = {}
        self.received += len(frames)
        for frame in frames:
            spec = self._needed.get(frame.arbitration_id)
            if spec is None:
                if frame.arbitration_id not in self._catalogue.by_id:
                    self.rejected["unknown id"] += 1
                continue
            cause = self._reject_cause(spec, frame)
            if cause is None:
                try:
                    values[spec.name] = self._catalogue.decode(spec, frame)
                    self._last_good_ns[spec.name] = frame.t_ns
                    continue
                except DecodeError:
                    cause = "range"
            self.rejected[f"{spec.name}: {cause}"] += 1
        return values

    def _reject_cause(self, spec: MessageSpec, frame: CanFrame) -> str | None:
        if len(frame.data) != spec.length_bytes:
            return "length"
        receiver = self._receivers.get(frame.arbitration_id)
        if receiver is not None and not (status := receiver.check(frame.data)).is_usable:
            return status.value
        return None

    def arrival_ns(self, name: str) -> int:
        """Time at which the newest good frame of a needed message arrived [ns].

        Raises:
            KeyError: there has been none.
        """
        return self._last_good_ns[name]

    def missing(self, now_ns: int) -> list[str]:
        """Needed messages without a good frame for longer than their timeout in the DBC."""
        return [
            spec.name
            for spec in self._needed.values()
            if now_ns - self._last_good_ns.get(spec.name, now_ns - spec.timeout_ns - 1) > spec.timeout_ns
        ]
