"""The satellite receiver of the navigation system: what kind of fix it has."""

from collections.abc import Mapping
from enum import StrEnum


class GnssMode(StrEnum):
    """Kinds of fix, as the value table of the DBC names them."""

    NONE = "None"
    BLANKED = "Blanked"
    SEARCH = "Search"
    SPS = "SPS"
    DIFFERENTIAL = "Differential"
    RTK_FLOAT = "RTKFloat"
    RTK_INTEGER = "RTKInteger"


GNSS_MODES = tuple(mode.value for mode in GnssMode)
"""What `InsFaults.gnss_mode` may say."""

SATELLITES: Mapping[GnssMode, int] = {
    GnssMode.NONE: 0,
    GnssMode.BLANKED: 0,
    GnssMode.SEARCH: 3,
    GnssMode.SPS: 7,
    GnssMode.DIFFERENTIAL: 9,
    GnssMode.RTK_FLOAT: 11,
    GnssMode.RTK_INTEGER: 14,
}
"""How many the receiver tracks; assumption."""

_LADDER = (GnssMode.SEARCH, GnssMode.SPS, GnssMode.DIFFERENTIAL, GnssMode.RTK_FLOAT, GnssMode.RTK_INTEGER)
_CORRECTIONS_S = 1.0
"""Time on the rungs between search and RTK float: a base station sends its corrections once a second."""
_NS_PER_S = 1_000_000_000


class Receiver:
    """Loses a fix at once and finds it again rung by rung.

    Args:
        search_s: time in search before there is a fix.
        ambiguity_s: time in RTK float before the integers are resolved.
        now_ns: when it starts, with the best fix.

    Attributes:
        mode: the present kind of fix.
    """

    def __init__(self, search_s: float, ambiguity_s: float, now_ns: int) -> None:
        self._dwell_ns = {
            GnssMode.SEARCH: round(search_s * _NS_PER_S),
            GnssMode.SPS: round(_CORRECTIONS_S * _NS_PER_S),
            GnssMode.DIFFERENTIAL: round(_CORRECTIONS_S * _NS_PER_S),
            GnssMode.RTK_FLOAT: round(ambiguity_s * _NS_PER_S),
        }
        self.mode = GnssMode.RTK_INTEGER
        self._since_ns = now_ns

    def update(self, now_ns: int, sky: GnssMode) -> GnssMode:
        """The kind of fix at `now_ns`, where reception allows no better than `sky`."""
        if _rung(sky) <= _rung(self.mode):
            self._enter(sky, now_ns)
        elif now_ns - self._since_ns >= self._dwell_ns.get(self.mode, 0):
            self._enter(_LADDER[_rung(self.mode) + 1], now_ns)
        return self.mode

    def _enter(self, mode: GnssMode, now_ns: int) -> None:
        if mode is not self.mode:
            self.mode = mode
            self._since_ns = now_ns


def _rung(mode: GnssMode) -> int:
    """Place on the ladder; -1 without satellites."""
    return _LADDER.index(mode) if mode in _LADDER else -1
