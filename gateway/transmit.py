"""The last line before the bus: what the gateway may send at all. A second, small programme that trusts nothing of the core.

It knows the mode and the DBC, reads the frames as the robots will, and drops what does not belong there. It changes nothing: a frame
passes as it is, or not at all. Dropping is safe, because robots that hear no command stop the car.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from dbc.catalogue import Catalogue, CatalogueError, DecodeError, MessageSpec
from dbc.frame import CanFrame
from gateway.messages import Mode

RATE_CYCLES = 10
MAX_FRAMES = 12
"""Of one message at most 12 frames in any 10 of its periods: 1.2 times its rate, as in opendbc, and room for a late frame."""

DIAGNOSTIC_IDS = frozenset({0x7DF, *range(0x7E0, 0x7F0)})
"""Requests and answers of diagnosis (ISO 15765-4): the gateway never sends them, whatever a DBC says."""

_REQUESTS: Mapping[Mode, frozenset[str]] = {
    Mode.STANDBY: frozenset({"None", "Disarm"}),
    Mode.READY: frozenset({"Arm"}),
    Mode.ENGAGED: frozenset({"Engage"}),
    Mode.COMFORT_STOP: frozenset({"Engage"}),
    Mode.SAFE_STOP: frozenset({"Engage"}),
    Mode.FAULT: frozenset({"None", "Disarm"}),
}
"""What the robot controller may be asked for in each mode; in a mode that is not here nothing is sent."""
_MAY_MOVE = frozenset({Mode.ENGAGED, Mode.COMFORT_STOP, Mode.SAFE_STOP})
_NEUTRAL_MODES, _POSITION_MODES = ("Off", "Standby"), ("AnglePosition", "Position")
_POSITIONS, _EFFORTS = ("AngleCommand", "PositionCommand"), ("TorqueFeedForward", "ForceCommand")
"""Demands of a robot command: the gateway moves robots by position, never by torque or force."""


class TransmitGate:
    """Admits frames of one node.

    Args:
        node: the sender whose messages in the DBC are the allow-list.

    Attributes:
        rejected: dropped frames by cause.

    Raises:
        CatalogueError: the DBC wants the gateway to send a diagnostic message.
    """

    def __init__(self, catalogue: Catalogue, node: str = "GW") -> None:
        self._catalogue = catalogue
        self._allowed: dict[int, MessageSpec] = {spec.arbitration_id: spec for spec in catalogue.by_name.values() if spec.sender == node}
        for spec in self._allowed.values():
            if spec.arbitration_id in DIAGNOSTIC_IDS:
                raise CatalogueError(f"message {spec.name} (id 0x{spec.arbitration_id:X}): 0x7DF and 0x7E0 to 0x7EF are for diagnosis")
        self._request_names = {raw: name for name, raw in catalogue.enumeration("GW_SafetyCommand", "SystemRequest").items()}
        commands = [spec.name for spec in self._allowed.values() if "Enable" in catalogue.signals(spec.name)]
        self._mode_names = {name: {raw: mode for mode, raw in catalogue.enumeration(name, "Mode").items()} for name in commands}
        self._times_ns: dict[int, deque[int]] = {arbitration_id: deque(maxlen=MAX_FRAMES) for arbitration_id in self._allowed}
        self.rejected: Counter[str] = Counter()

    def admit(self, now_ns: int, mode: Mode, frames: Sequence[CanFrame]) -> list[CanFrame]:
        """Those of `frames` that may be sent now, in `mode`."""
        admitted = []
        for frame in frames:
            if (cause := self._reject_cause(now_ns, mode, frame)) is None:
                self._times_ns[frame.arbitration_id].append(now_ns)
                admitted.append(frame)
            else:
                self.rejected[cause] += 1
        return admitted

    def _reject_cause(self, now_ns: int, mode: Mode, frame: CanFrame) -> str | None:
        if mode not in _REQUESTS:
            return "silent"
        spec = self._allowed.get(frame.arbitration_id)
        if spec is None:
            return "not in the allow-list"
        if len(frame.data) != spec.length_bytes:
            return "length"
        times_ns = self._times_ns[frame.arbitration_id]
        if len(times_ns) == MAX_FRAMES and now_ns - times_ns[0] < RATE_CYCLES * spec.cycle_time_ns:
            return "rate"
        try:
            values = self._catalogue.decode(spec, frame)
        except DecodeError:
            return "range"
        if "SystemRequest" in values and self._request_names.get(int(values["SystemRequest"])) not in _REQUESTS[mode]:
            return "request"
        if spec.name in self._mode_names:
            return self._reject_motion(mode in _MAY_MOVE, self._mode_names[spec.name].get(int(values["Mode"])), values)
        return None

    def _reject_motion(self, may_move: bool, robot_mode: str | None, values: Mapping[str, float]) -> str | None:
        if robot_mode not in _NEUTRAL_MODES + _POSITION_MODES or any(values[name] for name in _EFFORTS if name in values):
            return "robot mode"
        is_still = not values["Enable"] and not any(values[name] for name in _POSITIONS if name in values)
        return None if may_move or (robot_mode in _NEUTRAL_MODES and is_still) else "not neutral"
