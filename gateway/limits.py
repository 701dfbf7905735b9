"""Limits on what the gateway lets through to the robots: frozen data, each number with its source, and their arithmetic.

What a demand that a dead gateway leaves standing can do (the derivation of the fault-tolerant times, 250 ms lateral and 500 ms
longitudinal): with the largest lateral acceleration a held for t the car is a t^2 / 2 beside its path; when the acceleration grows from
straight ahead with the jerk j, j t^3 / 6. With the largest acceleration held for 500 ms it is faster by 0.5 a.

| profile        | a, lateral | held 250 ms | from straight | held 500 ms | a, drive | held 500 ms |
|----------------|------------|-------------|---------------|-------------|----------|-------------|
| nominal        |  3 m/s2    | 0.09 m      | 0.013 m       | 0.38 m      | 2.0 m/s2 | 1.0 m/s     |
| proving_ground |  9 m/s2    | 0.28 m      | 0.23 m        | 1.13 m      | 3.3 m/s2 | 1.7 m/s     |
| bench          |  1 m/s2    | 0.03 m      | 0.005 m       | 0.13 m      | 1.0 m/s2 | 0.5 m/s     |

The 9 m/s2 are what tyres on dry asphalt give; the kinematic bound of proving_ground is above them, because a car that understeers or
counter-steers needs angles that no tyre can follow. From straight they are there after 45 ms.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from dbc.vehicle import Vehicle


@dataclass(frozen=True, slots=True)
class StopGrade:
    """How firmly the gateway stops the car by itself."""

    deceleration_mps2: float
    jerk_mps3: float


COMFORT_STOP = StopGrade(deceleration_mps2=1.0, jerk_mps3=0.3)
"""Comfortable minimal risk manoeuvre of Autoware."""
EMERGENCY_STOP = StopGrade(deceleration_mps2=2.5, jerk_mps3=1.5)
"""Emergency minimal risk manoeuvre of Autoware; UN R157 allows 4.0 m/s2 at most."""


@dataclass(frozen=True, slots=True)
class LimitProfile:
    """What the robots may be asked for. Lateral is v^2 tan(road-wheel angle) / wheelbase, longitudinal the force of a pedal over the mass.

    Args:
        steering_wheel_limit_rad: largest steering-wheel angle to each side [rad]; the end stop of the car applies too.
        steering_wheel_rate_radps: largest rate of the steering-wheel angle [rad/s].
        lateral_acceleration_mps2, lateral_jerk_mps3: largest kinematic lateral acceleration, and its rate at the present speed.
        acceleration_mps2, deceleration_mps2: largest of accelerator and brake.
        drive_jerk_mps3: largest rate at which the accelerator is pressed; it may be released at once.
        brake_jerk_mps3: largest rate at which the brake is pressed or released.
        comfort_stop, safe_stop: the two grades of a stop.
        max_speed_mps: largest speed at which the gateway drives.
        standstill_brake_norm: brake pedal that holds the car after a stop, share of the stroke.
        are_wheels_on_the_road: whether their speed is that of the car; on a lift nothing tells a virtual car from a fault.
    """

    name: str
    steering_wheel_limit_rad: float
    steering_wheel_rate_radps: float
    lateral_acceleration_mps2: float
    lateral_jerk_mps3: float
    acceleration_mps2: float
    deceleration_mps2: float
    drive_jerk_mps3: float
    brake_jerk_mps3: float
    comfort_stop: StopGrade
    safe_stop: StopGrade
    max_speed_mps: float
    standstill_brake_norm: float
    are_wheels_on_the_road: bool = True


NOMINAL = LimitProfile(
    name="nominal",
    steering_wheel_limit_rad=18.85,  # three turns, the range of a steering robot: the end stop of the car acts first
    steering_wheel_rate_radps=13.9,  # as proving_ground, for parking; at speed the lateral jerk is what limits
    lateral_acceleration_mps2=3.0,  # ISO 11270, as in opendbc
    lateral_jerk_mps3=5.0,  # ISO 11270; opendbc takes 3.6 of them
    acceleration_mps2=2.0,  # adaptive cruise control in opendbc, from ISO 15622
    deceleration_mps2=3.5,  # the same
    drive_jerk_mps3=10.0,  # assumption: full acceleration in 0.2 s, hardly slower than the engine (0.2 s)
    brake_jerk_mps3=20.0,  # assumption: full deceleration in 0.18 s, braking must not wait for the limiter
    comfort_stop=COMFORT_STOP,
    safe_stop=EMERGENCY_STOP,
    max_speed_mps=36.0,  # 130 km/h, as UN R157
    standstill_brake_norm=0.3,  # holds a 30 % slope with full_brake_force_n of 1 g
)

PROVING_GROUND = LimitProfile(
    name="proving_ground",
    steering_wheel_limit_rad=18.85,  # as nominal
    steering_wheel_rate_radps=13.9,  # 800 deg/s: a preview driver needs 290 deg/s in ISO 3888-1 at 80 km/h, a sine with dwell 1190
    lateral_acceleration_mps2=15.0,  # 9 m/s2 at the tyres plus understeer and counter-steering; catches gross errors only
    lateral_jerk_mps3=200.0,  # from one end of the range above to the other in 0.15 s; ISO 3888-1 at 80 km/h needs 57, mean over 250 ms
    acceleration_mps2=3.3,  # full accelerator of the cars of dbc/: 3.2 and 2.9 m/s2
    deceleration_mps2=10.0,  # full brake: 1 g
    drive_jerk_mps3=20.0,  # six strokes a second, as fast as the accelerator robot of the Focus (19.4 m/s3)
    brake_jerk_mps3=64.0,  # 1 g in 0.15 s: braking must not wait for the limiter
    comfort_stop=COMFORT_STOP,
    safe_stop=EMERGENCY_STOP,
    max_speed_mps=36.0,  # as nominal
    standstill_brake_norm=0.3,  # as nominal
)

BENCH = LimitProfile(
    name="bench",
    steering_wheel_limit_rad=1.57,  # a quarter of a turn: hands and tools are near
    steering_wheel_rate_radps=1.75,  # 100 deg/s: can be watched
    lateral_acceleration_mps2=1.0,  # assumption: what a car in a bend of a yard has
    lateral_jerk_mps3=2.0,  # assumption
    acceleration_mps2=1.0,  # assumption: wheels without load run away faster than the road lets them
    deceleration_mps2=3.5,  # as nominal: it has to hold the car
    drive_jerk_mps3=2.0,  # assumption: half a second to full demand
    brake_jerk_mps3=20.0,  # as nominal
    comfort_stop=COMFORT_STOP,
    safe_stop=EMERGENCY_STOP,
    max_speed_mps=8.4,  # 30 km/h
    standstill_brake_norm=0.3,  # as nominal
    are_wheels_on_the_road=False,
)

LIFTED = replace(PROVING_GROUND, name="lifted", are_wheels_on_the_road=False)
"""What a virtual car drives on the proving ground while the real one hangs on a lift."""

PROFILES: Mapping[str, LimitProfile] = {profile.name: profile for profile in (NOMINAL, PROVING_GROUND, LIFTED, BENCH)}
"""By name; one is chosen at the start of the gateway and stays."""


@dataclass(frozen=True, slots=True)
class Resolution:
    """Smallest steps of the demands on the bus; by default those of dbc/robots.dbc.

    A demand that lies on them stays what it is when it is encoded, so that no rounding exceeds a limit.
    """

    steering_wheel_rad: float = math.radians(0.05)
    accelerator_norm: float = 1e-4
    brake_norm: float = 1e-4



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


STILL_MPS = 1.0
"""Below this speed no lateral limit applies: it allows every angle there is."""

_ROUNDING = 1e-9
"""Part of a step by which a product of floats may be off its multiple."""


def coarsest(vehicle: Vehicle, profile: LimitProfile, tick_s: float) -> Resolution:
    """The largest steps with which demands can move in every tick of that length [s] without exceeding a rate."""
    wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
    curvature_per_mps2 = 1.0 / profile.max_speed_mps**2
    slope = 1.0 + (profile.lateral_acceleration_mps2 * wheelbase_m * curvature_per_mps2) ** 2  # of the tangent, where it is steepest
    at_speed_rad = profile.lateral_jerk_mps3 * tick_s * wheelbase_m * curvature_per_mps2 / slope * vehicle.steering.ratio
    force_per_s = vehicle.model.mass_kg * tick_s
    return Resolution(
        min(profile.steering_wheel_rate_radps * tick_s, at_speed_rad),
        profile.drive_jerk_mps3 * force_per_s / vehicle.pedals.full_drive_force_n,
        profile.brake_jerk_mps3 * force_per_s / vehicle.pedals.full_brake_force_n,
    )


def clamp(value: float, low: float, high: float) -> float:
    """`value` moved into [low, high]."""
    return min(max(value, low), high)


def steps_up(value: float, step: float) -> int:
    """Smallest number of steps that is not below `value`."""
    return math.ceil(value / step - _ROUNDING)


def steps_down(value: float, step: float) -> int:
    """Largest number of steps that is not above `value`."""
    return math.floor(value / step + _ROUNDING)


def steps_within(value: float, low: float, high: float, step: float) -> int:
    """The number of steps that is nearest to `value` and does not leave [low, high], which must be wider than a step."""
    return min(max(round(value / step), steps_up(low, step)), steps_down(high, step))


def lateral_acceleration_mps2(road_wheel_rad: float, wheelbase_m: float, vx_mps: float) -> float:
    """Kinematic lateral acceleration of a road-wheel angle [m/s2]."""
    return vx_mps * vx_mps * math.tan(road_wheel_rad) / wheelbase_m


def road_wheel_rad(lateral_acceleration_mps2: float, wheelbase_m: float, vx_mps: float) -> float:
    """Road-wheel angle of a kinematic lateral acceleration [rad]; the speed must not be 0."""
    return math.atan(lateral_acceleration_mps2 * wheelbase_m / (vx_mps * vx_mps))
