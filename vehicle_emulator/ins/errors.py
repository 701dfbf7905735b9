"""Errors of a navigation solution, and what the instrument believes of them."""

import math
from random import Random
from typing import NamedTuple

from dbc.ins import GnssFix, InsParameters
from vehicle_emulator.ins.axes import Vector

_VERTICAL_SHARE = 1.5  # satellites are seen from one side only
_ACCURACY_LAG_S = 0.6
"""With which the stated accuracies follow the fix: 95 % in 1.8 s."""


class GaussMarkov:
    """Error that wanders with a correlation time, stationary from the start.

    Attributes:
        value: the present error.
    """

    def __init__(self, random: Random, sigma: float, correlation_s: float) -> None:
        self._random = random
        self._sigma = sigma
        self._correlation_s = correlation_s
        self._dt_s, self._kept, self._renewed = 0.0, 1.0, 0.0
        self.value = random.gauss(0.0, sigma)

    def step(self, dt_s: float) -> float:
        """The error after `dt_s`."""
        if dt_s != self._dt_s:
            self._dt_s, self._kept = dt_s, math.exp(-dt_s / self._correlation_s)
            self._renewed = math.sqrt(1.0 - self._kept * self._kept)
        self.value = self._kept * self.value + self._sigma * self._renewed * self._random.gauss(0.0, 1.0)
        return self.value

    def correct(self, sigma: float) -> None:
        """A new, independent error of this spread: the solution steps."""
        self._sigma = sigma
        self.value = self._random.gauss(0.0, sigma)

    def loosen(self, sigma: float) -> None:
        """Another spread from now on: the error wanders there without a step."""
        self._sigma = sigma


class Accuracy(NamedTuple):
    """What the instrument says of its errors: 1 sigma."""

    position_m: float
    height_m: float
    velocity_mps: float
    heading_rad: float
    tilt_rad: float


class Errors(NamedTuple):
    """What is added to the truth: position and velocity east, north, up; angles; rates and accelerations in the car's axes."""

    position_m: Vector
    velocity_mps: Vector
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rates_radps: Vector
    accelerations_mps2: Vector


class ErrorModel:
    """Errors that follow the fix: they wander around a fix, run away without one, and step when a better one comes.

    Args:
        random: the source of all errors.
        fix: of the start.
    """

    def __init__(self, parameters: InsParameters, random: Random, fix: GnssFix) -> None:
        p = self._p = parameters
        self._random = random
        self._fix = fix
        self._position = tuple(
            GaussMarkov(random, share * fix.position_sigma_m, p.position_correlation_s) for share in (1.0, 1.0, _VERTICAL_SHARE)
        )
        self._heading = GaussMarkov(random, p.heading_sigma_rad, p.heading_correlation_s)
        self._tilt = tuple(GaussMarkov(random, p.tilt_sigma_rad, p.heading_correlation_s) for _ in "rp")
        self._gyro_bias = tuple(GaussMarkov(random, p.gyro_bias_sigma_radps, p.bias_correlation_s) for _ in "xyz")
        self._accelerometer_bias = tuple(GaussMarkov(random, p.acceleration_bias_sigma_mps2, p.bias_correlation_s) for _ in "xyz")
        self._drift_mps2: Vector = (0.0, 0.0, 0.0)
        self._outage_s: float | None = None
        self._stated_m, self._stated_mps = fix.position_sigma_m, fix.velocity_sigma_mps

    def step(self, dt_s: float, fix: GnssFix | None, noise_factor: float) -> Errors:
        """The errors after `dt_s` with this fix, or none; `noise_factor` multiplies all that is white."""
        p, f = self._p, noise_factor
        if fix is None:
            self._run_away(dt_s)
        else:
            self._wander(dt_s, fix)
        outage_s = self._outage_s or 0.0
        x_m, y_m, z_m = (e.value + self._white(f * p.position_white_sigma_m) for e in self._position)
        east_mps, north_mps, up_mps = (a * outage_s + self._white(f * self._fix.velocity_sigma_mps) for a in self._drift_mps2)
        roll_rad, pitch_rad = (e.step(dt_s) + self._white(f * p.tilt_white_sigma_rad) for e in self._tilt)
        p_radps, q_radps, r_radps = (e.step(dt_s) + self._white(f * p.yaw_rate_sigma_radps) for e in self._gyro_bias)
        ax, ay, az = (e.step(dt_s) + self._white(f * p.acceleration_sigma_mps2) for e in self._accelerometer_bias)
        return Errors(
            position_m=(x_m, y_m, z_m),
            velocity_mps=(east_mps, north_mps, up_mps),
            roll_rad=roll_rad,
            pitch_rad=pitch_rad,
            yaw_rad=self._heading.value + self._white(f * p.heading_white_sigma_rad),
            rates_radps=(p_radps, q_radps, r_radps),
            accelerations_mps2=(ax, ay, az),
        )

    def accuracy(self) -> Accuracy:
        """What the instrument says of the present errors."""
        p, outage_s = self._p, self._outage_s or 0.0
        position_m = math.hypot(self._stated_m, 0.5 * p.drift_acceleration_sigma_mps2 * outage_s**2, p.position_white_sigma_m)
        return Accuracy(
            position_m=position_m,
            height_m=_VERTICAL_SHARE * position_m,
            velocity_mps=math.hypot(self._stated_mps, p.drift_acceleration_sigma_mps2 * outage_s),
            heading_rad=math.hypot(p.heading_sigma_rad, p.heading_white_sigma_rad, p.gyro_bias_sigma_radps * outage_s),
            tilt_rad=math.hypot(p.tilt_sigma_rad, p.tilt_white_sigma_rad),
        )

    def _white(self, sigma: float) -> float:
        return self._random.gauss(0.0, sigma)

    def _run_away(self, dt_s: float) -> None:
        """Without a fix the acceleration is off by a constant, and the heading turns with the bias of the gyroscope."""
        if self._outage_s is None:
            sigma = self._p.drift_acceleration_sigma_mps2
            self._drift_mps2 = (self._white(sigma), self._white(sigma), self._white(_VERTICAL_SHARE * sigma))
            self._outage_s = 0.0
        for error, drift in zip(self._position, self._drift_mps2, strict=True):
            error.value += drift * (self._outage_s + 0.5 * dt_s) * dt_s
        self._heading.value += self._gyro_bias[2].value * dt_s
        self._outage_s += dt_s

    def _wander(self, dt_s: float, fix: GnssFix) -> None:
        if fix is not self._fix or self._outage_s is not None:
            self._take(fix)
        for error in (*self._position, self._heading):
            error.step(dt_s)
        followed = 1.0 - math.exp(-dt_s / _ACCURACY_LAG_S)
        self._stated_m += followed * (fix.position_sigma_m - self._stated_m)
        self._stated_mps += followed * (fix.velocity_sigma_mps - self._stated_mps)

    def _take(self, fix: GnssFix) -> None:
        """Another fix: one that is better than what the instrument has is believed at once, and the solution steps."""
        accuracy = self.accuracy()
        known_m = self._fix.position_sigma_m if self._outage_s is None else accuracy.position_m
        is_better = fix.position_sigma_m < known_m
        for error, share in zip(self._position, (1.0, 1.0, _VERTICAL_SHARE), strict=True):
            (error.correct if is_better else error.loosen)(share * fix.position_sigma_m)
        self._stated_m, self._stated_mps = accuracy.position_m, accuracy.velocity_mps
        self._drift_mps2 = (0.0, 0.0, 0.0)
        self._outage_s = None
        self._fix = fix
