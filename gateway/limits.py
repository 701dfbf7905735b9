"""Limits on what the gateway lets through to the robots: frozen data, each number with its source, and their application."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LimitProfile:
    """What the robots may be asked for.

    Args:
        steering_wheel_rate_radps: largest rate of the steering-wheel demand [rad/s].
        kinematic_lateral_acceleration_mps2: bound on v^2 * tan(road-wheel angle) / wheelbase [m/s2].
        drive_rate_per_s: largest rate at which drive_norm may rise [1/s]; it may fall at `brake_rate_per_s`.
        stop_deceleration_mps2, stop_jerk_mps3: safe stop.
        standstill_brake_norm: brake pedal that holds the car after a stop, share of the stroke.
    """

    name: str
    steering_wheel_rate_radps: float
    kinematic_lateral_acceleration_mps2: float
    drive_rate_per_s: float
    brake_rate_per_s: float
    stop_deceleration_mps2: float
    stop_jerk_mps3: float
    standstill_brake_norm: float


PROVING_GROUND = LimitProfile(
    name="proving_ground",
    steering_wheel_rate_radps=13.9,  # 800 deg/s: a preview driver needs 290 deg/s in ISO 3888-1 at 80 km/h, a sine with dwell 1190
    kinematic_lateral_acceleration_mps2=15.0,  # 9 m/s2 at the tyres plus understeer and counter-steering; catches gross errors only
    drive_rate_per_s=5.0,  # half of what the accelerator robot can do
    brake_rate_per_s=20.0,  # braking must not wait for the limiter
    stop_deceleration_mps2=2.5,  # emergency minimal risk manoeuvre of Autoware
    stop_jerk_mps3=1.5,  # the same
    standstill_brake_norm=0.3,  # holds a 30 % slope with full_brake_force_n of 1 g
)


@dataclass(frozen=True, slots=True)
class Demand:
    """What the robots are asked for.

    Args:
        steering_wheel_rad: steering-wheel angle [rad], left positive.
        accelerator_norm, brake_norm: pedal positions, 0 to 1; never both above 0.
    """

    steering_wheel_rad: float
    accelerator_norm: float
    brake_norm: float


def clamp(value: float, low: float, high: float) -> float:
    """`value` moved into [low, high]."""
    return min(max(value, low), high)


def steer_bound_rad(profile: LimitProfile, wheelbase_m: float, mechanical_limit_rad: float, vx_mps: float) -> float:
    """Largest road-wheel angle at a speed [rad]: the mechanical limit, or the kinematic lateral acceleration."""
    speed_squared = vx_mps * vx_mps
    if speed_squared < 1.0:
        return mechanical_limit_rad
    return min(mechanical_limit_rad, math.atan(profile.kinematic_lateral_acceleration_mps2 * wheelbase_m / speed_squared))


def limit_rate(value: float, previous: float, rise: float, fall: float) -> float:
    """`value`, at most `rise` above and `fall` below `previous`."""
    return clamp(value, previous - fall, previous + rise)
