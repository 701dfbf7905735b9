"""Delay compensation: the state at the moment when a command that is given now will act.

Between the measurement and that moment the car does what earlier commands ask for, late by the delay of the actuators.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from controller.problem import Array
from dbc.vehicle import Vehicle

TRANSPORT_DELAY_S = 0.010
"""From a command to the robots: one cycle of the gateway, which forwards the command, and the bus."""

Advance = Callable[[Array, Array, float], Array]
"""(state, input, duration_s) to the state of the model after that time; see `solver.Solver.advance`."""


def actuation_delay_s(vehicle: Vehicle) -> float:
    """Time from a steering command to the road wheels [s]: transport, dead time of the robot, and its lag.

    A second-order lag delays a slow signal by 2 zeta / omega_0. For the Focus's robots: 10 + 20 + 29 ms.
    """
    robot = vehicle.robots.steering
    return TRANSPORT_DELAY_S + robot.dead_time_s + 2.0 * robot.damping_ratio / (2.0 * math.pi * robot.bandwidth_hz)


class DelayCompensator:
    """Remembers what was commanded, and integrates the model over it.

    Args:
        advance: the model's flow, for up to `longest_step_s` at a time.
        delay_s: from a command to its effect [s].
        longest_step_s: longest time that `advance` integrates accurately [s].
    """

    def __init__(self, advance: Advance, delay_s: float, longest_step_s: float) -> None:
        self._advance = advance
        self._delay_ns = round(delay_s * 1e9)
        self._longest_step_ns = round(longest_step_s * 1e9)
        self._commanded: deque[tuple[int, Array]] = deque()

    def restart(self, inputs: Array) -> None:
        """Someone else has driven until now; `inputs`, shape (2,), is what acts."""
        self._commanded.clear()
        self._commanded.append((-(1 << 62), inputs))

    def commanded(self, t_ns: int, inputs: Array) -> None:
        """Note that `inputs`, shape (2,), are commanded from `t_ns` on."""
        self._commanded.append((t_ns, inputs))

    @property
    def last_input(self) -> Array:
        """What was commanded last, shape (2,)."""
        return self._commanded[-1][1]

    def predict(self, state: Array, t_ns: int, now_ns: int) -> Array:
        """State at the moment when a command given at `now_ns` acts, from the state that was measured at `t_ns`."""
        until_ns, slowest_mps = now_ns + self._delay_ns, state[0]
        while len(self._commanded) > 1 and self._commanded[1][0] + self._delay_ns <= t_ns:
            self._commanded.popleft()
        starts = [start_ns + self._delay_ns for start_ns, _ in self._commanded]
        for (_, inputs), start_ns, end_ns in zip(self._commanded, starts, [*starts[1:], until_ns], strict=True):
            state = self._drive(state, inputs, min(end_ns, until_ns) - max(start_ns, t_ns))
        # In the model a brake drives backwards; a car that brakes only stops.
        state[0] = max(state[0], min(slowest_mps, 0.0))
        return state

    def _drive(self, state: Array, inputs: Array, duration_ns: int) -> Array:
        steps = max(0, math.ceil(duration_ns / self._longest_step_ns))
        for _ in range(steps):
            state = self._advance(state, inputs, duration_ns / steps * 1e-9)
        return np.array(state)
