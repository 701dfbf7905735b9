"""The operator of a run: arms and engages as soon as the gateway grants it, ends the run when it is over. Pure; fed with telemetry."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from gateway.messages import Mode, Operation
from gateway.telemetry import StateSample

STANDSTILL_MPS = 0.1
"""Below the speed that the verdict calls standing, so that a run that is over has also ended well."""
SETTLE_S = 0.5
"""How long the car must stand at the end before the run is over."""
PATIENCE_S = 8.0
"""How long it must stand before that: what is in its way may move on, as a pedestrian who walks across does."""
MIN_DISTANCE_M = 2.0
"""A car that has not moved this far since it was engaged has not driven yet."""
READY_TIMEOUT_S = 20.0
ASK_PERIOD_S = 0.1
"""How often he asks for what was refused [s]."""


_FIRST_STEPS = {Mode.SILENT.name: Operation.ARM, Mode.STANDBY.name: Operation.ARM, Mode.READY.name: Operation.ENGAGE}
"""What he asks for before the car is engaged, by the mode of the gateway."""


class Ending(Enum):
    """How a run ended."""

    COMPLETED = "the car stands for good"
    STOPPED = "the gateway ended the drive"
    TIME_LIMIT = "time limit reached"
    NEVER_READY = "the gateway never granted the engagement"


@dataclass(frozen=True, slots=True)
class Advice:
    """What the operator does now: a request to the gateway, or the end of the run."""

    operation: Operation | None = None
    ending: Ending | None = None


class Operator:
    """Watches the state and decides.

    Args:
        time_limit_s: longest drive after engagement [s].
        is_at_end: whether a place (x, y) [m] is one where the drive may end.

    Attributes:
        has_engaged: whether the car was ever engaged.
        distance_m: way driven since the engagement [m].
    """

    def __init__(self, time_limit_s: float, is_at_end: Callable[[float, float], bool]) -> None:
        self._time_limit_s = time_limit_s
        self._is_at_end = is_at_end
        self._start_ns: int | None = None
        self._engaged_ns = 0
        self._asked: tuple[Operation, int] | None = None
        self._standing_since_ns: int | None = None
        self._last_position_m = (0.0, 0.0)
        self.has_engaged = False
        self.distance_m = 0.0

    def advise(self, state: StateSample) -> Advice:
        """Decide on the newest state."""
        now_ns = state.t_ns
        if self._start_ns is None:
            self._start_ns = now_ns
        if not self.has_engaged:
            return self._before_engagement(now_ns, state)
        self._follow(state)
        if state.mode != Mode.ENGAGED.name:
            return Advice(ending=Ending.STOPPED) if self._has_stood(SETTLE_S, now_ns, state) or self._is_late(now_ns) else Advice()
        if self.distance_m > MIN_DISTANCE_M and self._is_over(now_ns, state):
            return Advice(Operation.DISENGAGE, Ending.COMPLETED)
        if self._is_late(now_ns):
            return Advice(Operation.DISENGAGE, Ending.TIME_LIMIT)
        return Advice()

    def _before_engagement(self, now_ns: int, state: StateSample) -> Advice:
        asks_for = _FIRST_STEPS.get(state.mode)
        if asks_for is None:  # a short engagement may fall between two samples
            self.has_engaged, self._engaged_ns = True, now_ns
            self._last_position_m = (state.x_m, state.y_m)
            return Advice()
        if now_ns - (self._start_ns or now_ns) > READY_TIMEOUT_S * 1e9:
            return Advice(ending=Ending.NEVER_READY)
        if self._asked is not None and self._asked[0] is asks_for and now_ns - self._asked[1] < ASK_PERIOD_S * 1e9:
            return Advice()
        self._asked = asks_for, now_ns
        return Advice(asks_for)

    def _follow(self, state: StateSample) -> None:
        self.distance_m += math.dist(self._last_position_m, (state.x_m, state.y_m))
        self._last_position_m = (state.x_m, state.y_m)
        is_standing = abs(state.vx_mps) < STANDSTILL_MPS
        if not is_standing:
            self._standing_since_ns = None
        elif self._standing_since_ns is None:
            self._standing_since_ns = state.t_ns

    def _is_over(self, now_ns: int, state: StateSample) -> bool:
        is_there = self._has_stood(SETTLE_S, now_ns, state) and self._is_at_end(state.x_m, state.y_m)
        return is_there or self._has_stood(PATIENCE_S, now_ns, state)

    def _has_stood(self, duration_s: float, now_ns: int, state: StateSample) -> bool:
        """Whether the car has stood so long; a state that is not valid says nothing about standing."""
        return state.is_valid and self._standing_since_ns is not None and now_ns - self._standing_since_ns > duration_s * 1e9

    def _is_late(self, now_ns: int) -> bool:
        return now_ns - self._engaged_ns > self._time_limit_s * 1e9
