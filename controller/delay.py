"""Delay compensation: the state at the moment when a command that is given now will act.

Between the measurement and that moment the car does what earlier commands ask for, each input late by its own delay.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from controller.problem import Array, Model
from dbc.vehicle import Vehicle

TRANSPORT_DELAY_S = 0.010
"""From a command to the robots: one cycle of the gateway, which forwards the command, and the bus."""

_MOST_COMMANDS = 100
"""Commands that are kept while nothing is measured: four seconds of them."""

Advance = Callable[[Array, Array, float], Array]
"""(state, input, duration_s) to the state of the model after that time; see `solver.Solver.advance`."""


def actuation_delays_s(vehicle: Vehicle, model: Model) -> tuple[float, float]:
    """Time from a command to what the model takes for its effect [s], of steering and drive.

    A model with actuator lag leaves transport and the dead time of each robot. One without takes the lag of the steering robot
    for delay as well, and one delay for both inputs: a second-order lag delays a slow signal by 2 zeta / omega_0. For the
    Focus's robots: 10 + 20 ms, and 10 + 20 + 29 ms.
    """
    steering, accelerator = vehicle.robots.steering, vehicle.robots.accelerator
    if "delta_a" in model.states:
        return TRANSPORT_DELAY_S + steering.dead_time_s, TRANSPORT_DELAY_S + accelerator.dead_time_s
    lag_s = 2.0 * steering.damping_ratio / (2.0 * math.pi * steering.bandwidth_hz)
    return (TRANSPORT_DELAY_S + steering.dead_time_s + lag_s,) * 2


class DelayCompensator:
    """Remembers what was commanded, and integrates the model over it.

    Args:
        advance: the model's flow, for up to `longest_step_s` at a time.
        delays_s: from a command to its effect, of each input [s].
        longest_step_s: longest time that `advance` integrates accurately [s].
    """

    def __init__(self, advance: Advance, delays_s: Sequence[float], longest_step_s: float) -> None:
        self._advance = advance
        self._delays_ns = [round(delay_s * 1e9) for delay_s in delays_s]
        self._longest_step_ns = round(longest_step_s * 1e9)
        self._commanded: deque[tuple[int, Array]] = deque(maxlen=_MOST_COMMANDS)

    def restart(self, inputs: Array) -> None:
        """Someone else has driven until now; `inputs`, shape (n_inputs,), is what acts."""
        self._commanded.clear()
        self._commanded.append((-(1 << 62), inputs))

    def commanded(self, t_ns: int, inputs: Array) -> None:
        """Note that `inputs`, shape (n_inputs,), are commanded from `t_ns` on."""
        self._commanded.append((t_ns, inputs))

    @property
    def last_input(self) -> Array:
        """What was commanded last, shape (n_inputs,)."""
        return self._commanded[-1][1]

    def forget(self, t_ns: int) -> None:
        """Nobody will ask any more what acted before `t_ns`."""
        while len(self._commanded) > 1 and self._commanded[1][0] + max(self._delays_ns) <= t_ns:
            self._commanded.popleft()

    def predict(self, state: Array, t_ns: int, now_ns: int) -> Array:
        """State at the moment when a steering command given at `now_ns` acts, from the state that was measured at `t_ns`.

        The drive, where its delay is another, is slower by its lag than the difference.
        """
        return self.drive(state, t_ns, now_ns + self._delays_ns[0])

    def drive(self, state: Array, from_ns: int, until_ns: int) -> Array:
        """State at `until_ns`, from that at `from_ns`, under what was commanded."""
        slowest_mps = min(state[0], 0.0)
        changes = {start_ns + delay_ns for start_ns, _ in self._commanded for delay_ns in self._delays_ns}
        times_ns = [from_ns, *sorted(t_ns for t_ns in changes if from_ns < t_ns < until_ns), until_ns]
        for start_ns, end_ns in pairwise(times_ns):
            inputs = self._acting(start_ns)
            steps = max(0, math.ceil((end_ns - start_ns) / self._longest_step_ns))
            for _ in range(steps):
                state = self._advance(state, inputs, (end_ns - start_ns) / steps * 1e-9)
        after = np.array(state)
        # In the model a brake drives backwards; a car that brakes only stops.
        after[0] = max(after[0], slowest_mps)
        return after

    def _acting(self, t_ns: int) -> Array:
        """Of each input, what acts at `t_ns`: the newest command that is as old as the delay."""
        acting = np.array(self._commanded[0][1])
        for start_ns, inputs in self._commanded:
            for k, delay_ns in enumerate(self._delays_ns):
                if start_ns + delay_ns <= t_ns:
                    acting[k] = inputs[k]
        return acting
