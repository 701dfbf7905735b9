"""What the model has to know of the car at the moment when the next command acts.

Measured are the six states of the car and its road-wheel angle. The drive is not: the engine is slower than the pedal, so its
state follows from what was commanded. The disturbance shows in the speed; delay is compensated by prediction.
"""

from collections.abc import Sequence

import numpy as np

from controller.delay import Advance, DelayCompensator
from controller.disturbance import DisturbanceObserver, DisturbanceOptions, equivalent_drive
from controller.problem import N_CAR_STATES, SINGLE_TRACK, Array, OcpOptions
from dbc.vehicle import ModelParameters

_LONGEST_GAP_NS = 1_000_000_000
"""Across a longer time without a measurement nothing is learnt."""


class StateEstimator:
    """State of one car as one model has it.

    In all that it hands out, the disturbance is part of the drive: t_r, and its lag state where the model has one, are what the
    model needs for the acceleration that the car has.

    Args:
        advance: the model's flow; see `solver.Solver.advance`.
        ocp: model and sample time.
        delays_s: from a command to its effect, of each input [s].
        disturbance: numbers of the observer; None takes the model for true and the speed as measured.

    Attributes:
        input_shift: from a command to an input of the model, shape (2,): the drive that the disturbance amounts to.

    Raises:
        ValueError: the model is not one of a car with commanded steering and drive.
    """

    def __init__(
        self, advance: Advance, car: ModelParameters, ocp: OcpOptions, delays_s: Sequence[float], disturbance: DisturbanceOptions | None
    ) -> None:
        model = ocp.model
        if model.states[:N_CAR_STATES] != SINGLE_TRACK.states or model.inputs != SINGLE_TRACK.inputs:
            raise ValueError(f"model {model.name}: its states begin with those of a car, its inputs are steering and drive")
        self._advance = advance
        self._car = car
        self._n_states = model.n_states
        self._compensator = DelayCompensator(self._advance_disturbed, delays_s, ocp.sample_time_s)
        self._observer = DisturbanceObserver(disturbance) if disturbance is not None else None
        self._state = np.zeros(self._n_states)
        self._t_ns = 0
        self.input_shift: Array = np.zeros(2)

    @property
    def disturbance_mps2(self) -> float:
        """Acceleration that the model does not explain [m/s2]."""
        return 0.0 if self._observer is None else self._observer.disturbance_mps2

    @property
    def previous_input(self) -> Array:
        """The model's input that was commanded last, shape (2,)."""
        return self._compensator.last_input + self.input_shift

    def commanded(self, t_ns: int, inputs: Array) -> None:
        """Note that `inputs`, shape (2,), are commanded from `t_ns` on."""
        self._compensator.commanded(t_ns, inputs)

    def restart(self, measured: Array, acting: Array, t_ns: int) -> None:
        """Someone else has driven until now; `acting` is what acts. Otherwise as `observe`."""
        if self._observer is not None:
            self._observer.forget()
            self.input_shift = np.zeros(2)
        self.hold(measured, acting, t_ns)

    def hold(self, measured: Array, acting: Array, t_ns: int) -> None:
        """The car has been held where it is, with `acting`; what disturbs it is still there. Otherwise as `observe`."""
        self._compensator.restart(acting)
        self._begin(measured, acting, t_ns)

    def observe(self, measured: Array, acting: Array, t_ns: int) -> None:
        """Take one measurement of a car that does what was commanded.

        Args:
            measured: states of the car, shape (6,).
            acting: road-wheel angle [rad] and drive that the robots report, shape (2,).
            t_ns: when that was so.
        """
        elapsed_ns = t_ns - self._t_ns
        if not 0 <= elapsed_ns <= _LONGEST_GAP_NS:
            self._begin(measured, acting, t_ns)
        elif elapsed_ns > 0:
            self._correct(measured, float(acting[0]), t_ns)

    def predict(self, now_ns: int) -> Array:
        """State of the model when a command given at `now_ns` acts, shape (n_states,)."""
        return self._compensator.predict(self._state, self._t_ns, now_ns)

    def _begin(self, measured: Array, acting: Array, t_ns: int) -> None:
        if self._observer is not None:
            self._observer.restart(float(measured[0]))
        self._state = np.concatenate((measured, acting + self.input_shift))[: self._n_states]
        self._t_ns = t_ns

    def _correct(self, measured: Array, steer_rad: float, t_ns: int) -> None:
        before = self.input_shift
        predicted = self._compensator.drive(self._state, self._t_ns, t_ns)
        state = np.concatenate((measured, (steer_rad, predicted[-1])))
        if self._observer is not None:
            commanded = float(self._compensator.last_input[1])
            self._observer.update(float(predicted[0]), float(measured[0]), (t_ns - self._t_ns) * 1e-9, commanded)
            self.input_shift = np.array((0.0, equivalent_drive(self.disturbance_mps2, self._car)))
            state[0] = self._observer.speed_mps
        state[N_CAR_STATES:] += self.input_shift - before
        self._state, self._t_ns = state[: self._n_states], t_ns
        self._compensator.forget(t_ns)

    def _advance_disturbed(self, state: Array, inputs: Array, duration_s: float) -> Array:
        return self._advance(state, inputs + self.input_shift, duration_s)
