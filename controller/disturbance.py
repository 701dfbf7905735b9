"""Longitudinal disturbance: the acceleration that the model does not explain, from slope, mass and the engine that is not as modelled.

Luenberger observer on the measured speed v with two states, speed and disturbance d [m/s2], which is taken for constant:

    e = v - v_predicted         v_predicted: the model's speed at this measurement, from the estimate at the one before, with d
    v <- v_predicted + l_1 e    l_1 = 1 - p^2
    d <- d + l_2 e / T          l_2 = (1 - p)^2,   p = exp(-T / time constant): both poles in the same place

To a controller, d is an equivalent drive: the model with t_r + d M R / T_max instead of t_r accelerates by d more. Optimised in
that sum, speed tracking is offset-free, and the generated code knows nothing of d.

Source: U. Maeder, F. Borrelli, M. Morari, Linear offset-free model predictive control, Automatica 45 (2009).
"""

import math
from dataclasses import dataclass

from dbc.vehicle import ModelParameters

_SATURATED_NORM = 0.999


@dataclass(frozen=True)
class DisturbanceOptions:
    """Numbers of the observer.

    Args:
        time_constant_s: of the double pole [s]. With the noise of the navigation system, 0.014 m/s, d then has 0.003 m/s2 of noise.
        largest_error_mps: of the predicted speed [m/s]; with a larger one something else has happened, and the observer begins anew.
        largest_mps2: bound on d; a slope of 25 %.
        slowest_mps: speed below which nothing is learnt and the speed is taken as measured unless the car is driven: it may stand,
            which the model cannot. Driven and standing, as on a slope that is steeper than known, it has to learn, or it stands there.
        leak_s: time constant with which a push (d above 0) is forgotten there [s]: believed where there is none, it would make
            the controller brake a car that is to start, for ever.
    """

    time_constant_s: float = 0.6
    largest_error_mps: float = 1.0
    largest_mps2: float = 2.5
    slowest_mps: float = 1.0
    leak_s: float = 3.0


def equivalent_drive(disturbance_mps2: float, car: ModelParameters) -> float:
    """The t_r that accelerates the model by this much; equation (4) of the paper, both axles."""
    return disturbance_mps2 * car.mass_kg * car.wheel_radius_m / car.max_wheel_torque_nm


class DisturbanceObserver:
    """Estimates speed and disturbance.

    Attributes:
        speed_mps: filtered speed.
        disturbance_mps2: what acts on the car besides what the model knows, forward positive.
    """

    def __init__(self, options: DisturbanceOptions) -> None:
        self._options = options
        self.speed_mps = 0.0
        self.disturbance_mps2 = 0.0

    def restart(self, measured_mps: float) -> None:
        """The speed is what is measured, d stays."""
        self.speed_mps = measured_mps

    def forget(self) -> None:
        """Someone else has driven, maybe to another slope, or held the car against the engine: d is not known."""
        self.disturbance_mps2 = 0.0

    def update(self, predicted_mps: float, measured_mps: float, elapsed_s: float, drive_norm: float) -> None:
        """Take one measurement.

        Args:
            predicted_mps: speed of the model now, `elapsed_s` (above 0) after it was `speed_mps`.
            drive_norm: what is commanded, -1 to 1. At a bound it may not do what the model thinks: d stays as it is.
        """
        options = self._options
        error_mps = measured_mps - predicted_mps
        if measured_mps < options.slowest_mps and drive_norm <= 0.0:
            self.restart(measured_mps)
            self.disturbance_mps2 *= math.exp(-elapsed_s / options.leak_s) if self.disturbance_mps2 > 0.0 else 1.0
            return
        if abs(error_mps) > options.largest_error_mps:
            self.restart(measured_mps)
            return
        pole = math.exp(-elapsed_s / options.time_constant_s)
        self.speed_mps = predicted_mps + (1.0 - pole**2) * error_mps
        if abs(drive_norm) < _SATURATED_NORM:
            estimate_mps2 = self.disturbance_mps2 + (1.0 - pole) ** 2 / elapsed_s * error_mps
            self.disturbance_mps2 = min(max(estimate_mps2, -options.largest_mps2), options.largest_mps2)
