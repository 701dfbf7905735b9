"""Axes and places: from the car's axes to level ones, to the local frame, and to the ellipsoid.

The car's axes are forward, left, up (ISO 8855 vehicle system); the level ones are those turned back by roll and pitch (ISO 8855
intermediate system); the local frame is east, north, up.
"""

import math

Vector = tuple[float, float, float]

ORIGIN_LATITUDE_RAD = math.radians(50.88)
ORIGIN_LONGITUDE_RAD = math.radians(6.29)
ORIGIN_ALTITUDE_M = 120.0
"""Origin of the local frame: an arbitrary point near the proving ground of Aldenhoven."""

_EQUATORIAL_RADIUS_M = 6_378_137.0  # WGS 84
_ECCENTRICITY_SQUARED = 6.694379990e-3  # WGS 84
_FLATTENING = 1.0 - _ECCENTRICITY_SQUARED * math.sin(ORIGIN_LATITUDE_RAD) ** 2
_NORMAL_M = _EQUATORIAL_RADIUS_M / math.sqrt(_FLATTENING)
_MERIDIAN_M = _NORMAL_M * (1.0 - _ECCENTRICITY_SQUARED) / _FLATTENING
_NORTH_M_PER_RAD = _MERIDIAN_M + ORIGIN_ALTITUDE_M
_EAST_M_PER_RAD = (_NORMAL_M + ORIGIN_ALTITUDE_M) * math.cos(ORIGIN_LATITUDE_RAD)


def add(a: Vector, b: Vector) -> Vector:
    """The sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def level_of(car: Vector, roll_rad: float, pitch_rad: float) -> Vector:
    """A vector given in the car's axes, in level axes."""
    (x, y, z), sine_r, cosine_r = car, math.sin(roll_rad), math.cos(roll_rad)
    sine_p, cosine_p = math.sin(pitch_rad), math.cos(pitch_rad)
    up = sine_r * y + cosine_r * z
    return cosine_p * x + sine_p * up, cosine_r * y - sine_r * z, cosine_p * up - sine_p * x


def car_of(level: Vector, roll_rad: float, pitch_rad: float) -> Vector:
    """A vector given in level axes, in the car's axes."""
    (x, y, z), sine_r, cosine_r = level, math.sin(roll_rad), math.cos(roll_rad)
    sine_p, cosine_p = math.sin(pitch_rad), math.cos(pitch_rad)
    up = sine_p * x + cosine_p * z
    return cosine_p * x - sine_p * z, cosine_r * y + sine_r * up, cosine_r * up - sine_r * y


def turned(v: Vector, yaw_rad: float) -> Vector:
    """A vector turned by `yaw_rad` about the vertical: from level axes to the local frame."""
    sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
    return cosine * v[0] - sine * v[1], sine * v[0] + cosine * v[1], v[2]


def latitude_longitude_deg(x_m: float, y_m: float) -> tuple[float, float]:
    """Geodetic place of a point of the local frame.

    As the instrument does it for local coordinates: straight from metres to angles with the radii of curvature at the origin. A
    plane that touches the ellipsoid there differs by x y tan(latitude) / R: 2 cm at 300 m east and north.
    """
    return math.degrees(ORIGIN_LATITUDE_RAD + y_m / _NORTH_M_PER_RAD), math.degrees(ORIGIN_LONGITUDE_RAD + x_m / _EAST_M_PER_RAD)
