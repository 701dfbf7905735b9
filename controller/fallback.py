"""What the controller commands when a solve fails: the rest of the last good plan, for a while; and from where it solves again."""

from dataclasses import dataclass

import numpy as np

from controller.problem import Array, Layout
from controller.solver import WarmStart
from gateway.messages import CommandStatus

MAX_DEGRADED_CYCLES = 3
"""Cycles in a row that an old plan may stand in; after that the command says FAILED and the gateway stops the car."""


@dataclass(frozen=True)
class Plan:
    """A finite, converged plan.

    Args:
        t_ns: time from which the first input holds [ns].
        states: shape (N+1, n_states).
        inputs: shape (N, n_inputs).
    """

    t_ns: int
    states: Array
    inputs: Array

    def from_time(self, now_ns: int, period_ns: int) -> "Plan":
        """What is left of the plan at `now_ns`, its end held, in the same shape."""
        passed = max(0, round((now_ns - self.t_ns) / period_ns))
        left = [np.minimum(np.arange(len(rows)) + passed, len(rows) - 1) for rows in (self.states, self.inputs)]
        return Plan(now_ns, self.states[left[0]], self.inputs[left[1]])


class Fallback:
    """Decides cycle by cycle which plan to command, and what to say of it; keeps what the next solve begins from.

    A solver that failed begins again from the last good answer, not from where it went astray.

    Args:
        period_ns: time between two inputs of a plan [ns].
    """

    def __init__(self, period_ns: int, layout: Layout) -> None:
        self._period_ns = period_ns
        self._layout = layout
        self._good: Plan | None = None
        self._degraded_cycles = 0
        self._guess: tuple[int, WarmStart | None] = 0, None

    def accept(self, plan: Plan) -> tuple[CommandStatus, Plan]:
        """A good plan: command it."""
        self._good, self._degraded_cycles = plan, 0
        return CommandStatus.OK, plan

    def substitute(self, now_ns: int, nothing_planned: Plan) -> tuple[CommandStatus, Plan]:
        """No good plan in this cycle: the last one, shifted; `nothing_planned` when there never was one."""
        self._degraded_cycles += 1
        if self._good is None:
            return CommandStatus.FAILED, nothing_planned
        status = CommandStatus.DEGRADED if self._degraded_cycles <= MAX_DEGRADED_CYCLES else CommandStatus.FAILED
        return status, self._good.from_time(now_ns, self._period_ns)

    def prime(self, now_ns: int, guess: WarmStart | None) -> None:
        """Note what a solver that has converged at `now_ns` would begin from one period later."""
        self._guess = now_ns + self._period_ns, guess

    def guess(self, now_ns: int) -> WarmStart | None:
        """What to begin from at `now_ns`; None when the last answer is older than a plan may be."""
        t_ns, guess = self._guess
        missed = max(0, round((now_ns - t_ns) / self._period_ns))
        return guess if guess is None or missed == 0 else _shifted(guess, self._layout, missed) if missed <= MAX_DEGRADED_CYCLES else None


def _shifted(guess: WarmStart, layout: Layout, samples: int) -> WarmStart:
    """The guess some samples later; the last stage is repeated."""
    stage, n_states = layout.n_states + layout.n_inputs, layout.n_states
    gaps, corridor = guess.lam_g[: layout.n_gaps], guess.lam_g[layout.n_gaps :]

    def later(values: Array, size: int) -> Array:
        return np.concatenate((values[samples * size :], *[values[-size:]] * samples))

    return WarmStart(
        later(guess.w, stage), later(guess.lam_w, stage), np.concatenate((later(gaps, n_states), later(corridor, 1)))
    )
