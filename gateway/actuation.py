"""From a road-wheel angle and a drive demand to three robots, within the limits."""

import math
from collections import Counter

from dbc.vehicle import Vehicle
from gateway.limits import Demand, LimitProfile, clamp, limit_rate, steer_bound_rad

BRAKE_RELEASED_NORM = 0.02
"""Brake-pedal position below which the accelerator may move."""

NEUTRAL = Demand(0.0, 0.0, 0.0)


class Actuation:
    """Limits demands and splits them; holds the last one, because rates are limited against it.

    Attributes:
        demand: what the robots are asked for now.
        limited: ticks in which a limit changed the demand, by limit.
    """

    def __init__(self, vehicle: Vehicle, profile: LimitProfile, tick_ns: int) -> None:
        self._vehicle = vehicle
        self._profile = profile
        self._tick_s = tick_ns * 1e-9
        self._wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
        self._brake_gain = vehicle.pedals.full_brake_force_n / vehicle.pedals.full_drive_force_n
        self._drive_norm = 0.0
        self.demand = NEUTRAL
        self.limited: Counter[str] = Counter()

    @property
    def steer_rad(self) -> float:
        """Road-wheel angle that is demanded [rad]."""
        return self.demand.steering_wheel_rad / self._vehicle.steering.ratio

    def drive_norm(self, accelerator_norm: float, brake_norm: float) -> float:
        """Drive demand that two pedal positions stand for; the inverse of the split."""
        return accelerator_norm - brake_norm * self._brake_gain

    def release(self) -> None:
        """Ask for nothing."""
        self.demand, self._drive_norm = NEUTRAL, 0.0

    def start_from(self, measured: Demand) -> None:
        """Take over from where the robots are, so that an engagement has no bump."""
        self.demand = measured
        self._drive_norm = self.drive_norm(measured.accelerator_norm, measured.brake_norm)

    def hold_still(self) -> None:
        """Keep a standing car standing."""
        self.demand = Demand(self.demand.steering_wheel_rad, 0.0, self._profile.standstill_brake_norm)
        self._drive_norm = self.drive_norm(0.0, self._profile.standstill_brake_norm)

    def decelerate(self, steer_rad: float, deceleration_mps2: float, vx_mps: float, brake_norm: float) -> None:
        """Steer and slow down; `brake_norm` is the measured pedal."""
        force_n = self._vehicle.model.mass_kg * deceleration_mps2
        self.follow(steer_rad, -force_n / self._vehicle.pedals.full_drive_force_n, vx_mps, brake_norm)

    def follow(self, steer_rad: float, drive_norm: float, vx_mps: float, brake_norm: float) -> None:
        """Follow a command as far as the limits let it; `brake_norm` is the measured pedal."""
        steering_wheel_rad = self._limit_steering(steer_rad, vx_mps)
        self._limit_drive(drive_norm)
        if self._drive_norm < 0.0:
            self.demand = Demand(steering_wheel_rad, 0.0, -self._drive_norm / self._brake_gain)
        else:
            # Interlock: the accelerator waits until the brake pedal has really come back.
            is_brake_released = brake_norm < BRAKE_RELEASED_NORM
            self.demand = Demand(steering_wheel_rad, self._drive_norm if is_brake_released else 0.0, 0.0)

    def _limit_steering(self, steer_rad: float, vx_mps: float) -> float:
        bound_rad = steer_bound_rad(self._profile, self._wheelbase_m, self._vehicle.steering.road_wheel_limit_rad, vx_mps)
        bounded_rad = clamp(steer_rad, -bound_rad, bound_rad)
        self._count("steering angle", steer_rad, bounded_rad)
        wanted_rad = bounded_rad * self._vehicle.steering.ratio
        step_rad = self._profile.steering_wheel_rate_radps * self._tick_s
        limited_rad = limit_rate(wanted_rad, self.demand.steering_wheel_rad, step_rad, step_rad)
        self._count("steering rate", wanted_rad, limited_rad)
        return limited_rad

    def _limit_drive(self, drive_norm: float) -> None:
        wanted_norm = clamp(drive_norm, -self._brake_gain, 1.0)
        self._count("drive", drive_norm, wanted_norm)
        rise, fall = self._profile.drive_rate_per_s * self._tick_s, self._profile.brake_rate_per_s * self._tick_s
        self._drive_norm = limit_rate(wanted_norm, self._drive_norm, rise, fall)
        self._count("drive rate", wanted_norm, self._drive_norm)

    def _count(self, name: str, asked: float, given: float) -> None:
        if not math.isclose(asked, given, abs_tol=1e-9):
            self.limited[name] += 1
