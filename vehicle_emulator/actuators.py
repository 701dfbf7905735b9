"""Stages of a driving robot's actuator chain; each one works alone, at a fixed period.

    command -> DeadTime -> quantised -> MotionProfile -> Backlash -> Servo -> PositionSensor

`PedalSpring` is what a pedal robot pushes against. Positions are in any one unit.
"""

import cmath
import math
from collections import deque
from random import Random

_ROUNDING = 1e-12
"""A trajectory as close as this is where it should be."""


class DeadTime:
    """Time from a command to its effect: bus cycle and control loop of the robot, which do not keep step with each other.

    Every change of the demand draws a dead time of its own, evenly spread over `dead_time_s` +- `jitter_s`; none overtakes another.

    Args:
        period_s: time of one step [s]; dead times are rounded to whole steps.
    """

    def __init__(self, period_s: float, dead_time_s: float, jitter_s: float, random: Random) -> None:
        self._shortest = round(max(0.0, dead_time_s - jitter_s) / period_s)
        self._longest = round((dead_time_s + jitter_s) / period_s)
        self._random = random
        self._pending: deque[tuple[int, float]] = deque()
        self._now = 0
        self._newest = 0.0
        self._output = 0.0

    def reset(self, value: float) -> None:
        """Forget what is under way and give `value`."""
        self._pending.clear()
        self._newest = self._output = value

    def step(self, demand: float) -> float:
        """The demand of one dead time ago."""
        if demand != self._newest:
            due = self._now + self._random.randint(self._shortest, self._longest)
            self._pending.append((max(due, self._pending[-1][0]) if self._pending else due, demand))
            self._newest = demand
        while self._pending and self._pending[0][0] <= self._now:
            self._output = self._pending.popleft()[1]
        self._now += 1
        return self._output


def quantised(value: float, resolution: float) -> float:
    """The nearest whole multiple of `resolution`."""
    return round(value / resolution) * resolution


class MotionProfile:
    """Trajectory generator: follows a demand as fast as rate and acceleration limits allow and stops at it without overshoot.

    Exact in discrete time: every step has a constant acceleration within the limit, and a demand that stands still is reached, not
    passed. A demand that jumps to where it cannot stop any more is overrun, as inertia will have it.

    Args:
        acceleration_limit: largest change of the rate over time.

    Attributes:
        position, rate: the trajectory.
        is_at_rate_limit: whether the rate limit shaped the last step.
    """

    def __init__(self, period_s: float, acceleration_limit: float) -> None:
        self._period_s = period_s
        self._acceleration_limit = acceleration_limit
        self.position = 0.0
        self.rate = 0.0
        self.is_at_rate_limit = False

    def reset(self, position: float, rate: float = 0.0) -> None:
        """Go on from here."""
        self.position, self.rate = position, rate
        self.is_at_rate_limit = False

    def step(self, demand: float, rate_limit: float, share: float = 1.0) -> float:
        """Move for one period, at a constant acceleration.

        Args:
            rate_limit: largest rate now; a trajectory that is faster brakes.
            share: of the acceleration limit that is left.
        """
        change = share * self._acceleration_limit * self._period_s
        distance, before = demand - self.position, self.rate
        if abs(distance) <= _ROUNDING and abs(before) <= change:
            self.position, self.rate, self.is_at_rate_limit = demand, 0.0, False
            return demand
        length = distance / self._period_s - 0.5 * before
        stoppable = self._stoppable_rate(abs(length), change)
        wanted = math.copysign(min(stoppable, rate_limit), length)
        self.rate = min(max(wanted, before - change), before + change)
        self.is_at_rate_limit = stoppable > rate_limit and abs(self.rate) >= rate_limit
        self.position += 0.5 * (before + self.rate) * self._period_s
        return self.position

    @staticmethod
    def _stoppable_rate(length: float, change: float) -> float:
        """Largest rate for the end of this step from which steps of `change` come to rest at the demand.

        In n steps, this one included, of which each but this one loses `change`, a rate r covers n r - n (n - 1) / 2 change.

        Args:
            length: what is left to cover over the period, without what the rate before this step covers anyway.
        """
        steps = max(1, math.ceil(0.5 * (math.sqrt(1.0 + 8.0 * length / change) - 1.0)))
        return length / steps + 0.5 * (steps - 1) * change


class Backlash:
    """Play between what drives and what is driven: the driven side moves when the play is used up.

    Args:
        play: from one end of the play to the other.
    """

    def __init__(self, play: float) -> None:
        self._half = 0.5 * play
        self._position = 0.0

    def reset(self, position: float) -> None:
        """The driven side is here, with the driving side in the middle of the play."""
        self._position = position

    def step(self, driving: float) -> float:
        """Where the driven side is."""
        self._position = min(max(self._position, driving - self._half), driving + self._half)
        return self._position


class Servo:
    """A second-order position servo, x'' = omega^2 (demand - x) - 2 zeta omega x', solved exactly.

    Attributes:
        position, rate: where it is and how fast it moves.
    """

    def __init__(self, period_s: float, bandwidth_hz: float, damping_ratio: float) -> None:
        self._period_s = period_s
        self._bandwidth_hz = bandwidth_hz
        self._damping_ratio = damping_ratio
        self._share = math.nan
        self.position = 0.0
        self.rate = 0.0

    def reset(self, position: float) -> None:
        """Stand here."""
        self.position, self.rate = position, 0.0

    def step(self, demand: float, demand_rate: float = 0.0, share: float = 1.0) -> float:
        """Move for one period.

        Args:
            demand: at the end of the period.
            demand_rate: how fast it has moved in the period; 0 for one that was held.
            share: of the bandwidth that is left.
        """
        if share != self._share:
            self._share = share
            pole_radps = 2.0 * math.pi * share * self._bandwidth_hz
            self._lag_s = 2.0 * self._damping_ratio / pole_radps
            self._transition = second_order_transition(pole_radps, self._damping_ratio, self._period_s)
        error_error, error_rate, rate_error, rate_rate = self._transition
        following = demand - self._lag_s * demand_rate  # where it would be at the end, had the demand always moved so
        error, rate = self.position - following + self._period_s * demand_rate, self.rate - demand_rate
        self.position = following + error_error * error + error_rate * rate
        self.rate = demand_rate + rate_error * error + rate_rate * rate
        return self.position

    def stop_at(self, low: float, high: float) -> bool:
        """Stay within end stops; whether one was hit."""
        if low <= self.position <= high:
            return False
        self.reset(min(max(self.position, low), high))
        return True


class PedalSpring:
    """Force that a pedal puts up: spring with preload, and friction against the motion.

    Args:
        preload_n: at the beginning of the stroke.
        full_stroke_n: at its end; without friction, as is the preload.
    """

    def __init__(self, preload_n: float, full_stroke_n: float, friction_n: float) -> None:
        self._preload_n = preload_n
        self._rise_n = full_stroke_n - preload_n
        self._friction_n = friction_n

    def force_n(self, position_norm: float, direction: float) -> float:
        """Force at a position; `direction` is 1 while it is pressed, -1 while it comes back. A pedal at rest is not touched."""
        if position_norm <= 0.0:
            return 0.0
        return max(0.0, self._preload_n + self._rise_n * position_norm + direction * self._friction_n)

    def position_norm(self, force_n: float) -> float:
        """How far a force presses the pedal."""
        return min(max((force_n - self._preload_n - self._friction_n) / self._rise_n, 0.0), 1.0)


class PositionSensor:
    """Reads a position with noise and resolution."""

    def __init__(self, resolution: float, noise_sigma: float, random: Random) -> None:
        self._resolution = resolution
        self._noise_sigma = noise_sigma
        self._random = random

    def read(self, position: float) -> float:
        """What the sensor says."""
        return quantised(position + self._random.gauss(0.0, self._noise_sigma), self._resolution)


def second_order_transition(pole_radps: float, damping_ratio: float, period_s: float) -> tuple[float, float, float, float]:
    """Matrix exponential of e'' + 2 zeta omega e' + omega^2 e = 0 over a period, row by row: what e and e' become."""
    decay_radps = damping_ratio * pole_radps
    spread_radps = cmath.sqrt(decay_radps**2 - pole_radps**2)
    even = cmath.cosh(spread_radps * period_s).real
    odd_s = (cmath.sinh(spread_radps * period_s) / spread_radps).real if spread_radps else period_s
    decay = math.exp(-decay_radps * period_s)
    return (
        decay * (even + decay_radps * odd_s),
        decay * odd_s,
        -decay * pole_radps**2 * odd_s,
        decay * (even - decay_radps * odd_s),
    )
