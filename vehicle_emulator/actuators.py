"""Motion of one driving robot: dead time, second-order lag, rate limit, end stops."""

import math
from collections import deque


class Servo:
    """A position servo, stepped at a fixed period.

    Semi-implicit Euler: with the bandwidths of driving robots (10 Hz, 63 rad/s) and 1 ms it is stable by a factor of 30.

    Args:
        period_s: time of one step [s]; the dead time is rounded to whole steps.
        rate_limit: largest rate of the position [1/s times the unit of the position].
        low, high: end stops.

    Attributes:
        position, rate: where it is and how fast it moves.
        is_at_end_stop, is_at_rate_limit: whether a limit shaped the last step.
    """

    def __init__(
        self,
        period_s: float,
        *,
        bandwidth_hz: float,
        damping_ratio: float,
        dead_time_s: float,
        rate_limit: float,
        low: float,
        high: float,
    ) -> None:
        self._period_s = period_s
        self._pole_radps = 2.0 * math.pi * bandwidth_hz
        self._damping_ratio = damping_ratio
        self._rate_limit = rate_limit
        self._low, self._high = low, high
        self._demands: deque[float] = deque([0.0] * round(dead_time_s / period_s))
        self.position = 0.0
        self.rate = 0.0
        self.is_at_end_stop = False
        self.is_at_rate_limit = False

    def step(self, demand: float, rate_limit: float = math.inf) -> float:
        """Move for one period towards the demand of one dead time ago; the lower of the two rate limits holds."""
        self._demands.append(demand)
        error = self._demands.popleft() - self.position
        rate = self.rate + self._period_s * self._pole_radps * (self._pole_radps * error - 2.0 * self._damping_ratio * self.rate)
        limit = min(rate_limit, self._rate_limit)
        self.rate = min(max(rate, -limit), limit)
        self.is_at_rate_limit = self.rate != rate
        position = self.position + self._period_s * self.rate
        self.position = min(max(position, self._low), self._high)
        self.is_at_end_stop = self.position != position
        if self.is_at_end_stop:
            self.rate = 0.0
        return self.position
