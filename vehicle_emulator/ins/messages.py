"""A navigation solution as signals of the DBC: units, axes and signs of the instrument.

The instrument's car axes are forward, right, down (OxTS output frame), its level axes those turned back by roll and pitch (OxTS
horizontal frame), heading and track count clockwise from north. Conventions as in the maker's public NCOM decoder (NComRxC.c): its
accelerations are those of the IMU, gravity included, also in level axes, where gravity shows in the down axis alone; in the ISO 8855
messages gravity is taken out. Neither there nor here does the turning of the earth matter: 0.005 m/s2 at 130 km/h, half a bit.
"""

import math
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta

from vehicle_emulator.ins.axes import ORIGIN_ALTITUDE_M, Vector, car_of, latitude_longitude_deg, level_of, turned
from vehicle_emulator.ins.solution import Solution, Status
from vehicle_emulator.plants.interface import GRAVITY_MPS2

Signals = dict[str, float]

GPS_EPOCH = datetime(1980, 1, 6)
UTC_OFFSET_S = -18
"""UTC minus GPS time since 2017."""

_MS = timedelta(milliseconds=1)
_SLOW_MPS = 0.2
"""Below this speed neither track nor curvature means anything; the manual's bound of the distance with hold."""
_NO_UMAC = 255


def wrap_degrees(angle_deg: float) -> float:
    """The same direction in [-180, 180) [deg]."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _compass_deg(angle_rad: float) -> float:
    """A direction given counter-clockwise from east, clockwise from north, in whole hundredths of a degree from 0 to 359.99."""
    return round(100.0 * (90.0 - math.degrees(angle_rad))) % 36_000 / 100.0


def _degrees(v: Vector) -> Vector:
    return math.degrees(v[0]), math.degrees(v[1]), math.degrees(v[2])


def _right_down(v: Vector) -> Vector:
    """Forward, left, up as forward, right, down."""
    return v[0], -v[1], -v[2]


def _level(s: Solution, car: Vector) -> Vector:
    return level_of(car, s.motion.roll_rad, s.motion.pitch_rad)


def _level_velocity(s: Solution) -> Vector:
    return turned(s.motion.velocity_mps, -s.motion.yaw_rad)


def _level_acceleration(s: Solution) -> Vector:
    """Against the ground."""
    forward, left, up = _level(s, s.motion.specific_force_mps2)
    return forward, left, up - GRAVITY_MPS2


def _named(names: str, values: Sequence[float]) -> Signals:
    return dict(zip(names.split(), values, strict=True))


def _date_time(s: Solution) -> Signals:
    date = GPS_EPOCH + s.valid_ms * _MS
    century, year = divmod(date.year, 100)
    return {
        "TimeYear": year,
        "TimeCentury": 100 * century,
        "TimeMonth": date.month,
        "TimeDay": date.day,
        "TimeHSecond": 0.01 * (date.microsecond // 10_000),
        "TimeSecond": date.second,
        "TimeMinute": date.minute,
        "TimeHour": date.hour,
    }


def _velocity(s: Solution) -> Signals:
    east_mps, north_mps, up_mps = s.motion.velocity_mps
    return {"VelNorth": north_mps, "VelEast": east_mps, "VelDown": -up_mps, "Speed2D": math.hypot(east_mps, north_mps)}


def _velocity_level(s: Solution) -> Signals:
    forward_mps, left_mps, _ = _level_velocity(s)
    return {"VelForward": forward_mps, "VelLateral": -left_mps}


def _acceleration_level(s: Solution) -> Signals:
    forward_mps2, right_mps2, down_mps2 = _right_down(_level(s, s.motion.specific_force_mps2))
    right_turn_radps = -_level(s, s.motion.rates_radps)[2]
    slip_mps2 = right_mps2 - _level_velocity(s)[0] * right_turn_radps
    return {"AccelForward": forward_mps2, "AccelLateral": right_mps2, "AccelDown": down_mps2, "AccelSlip": slip_mps2}


def _heading_pitch_roll(s: Solution) -> Signals:
    return {
        "AngleHeading": _compass_deg(s.motion.yaw_rad),
        "AnglePitch": -math.degrees(s.motion.pitch_rad),
        "AngleRoll": wrap_degrees(math.degrees(s.motion.roll_rad)),
    }


def _track_slip_curvature(s: Solution) -> Signals:
    (east_mps, north_mps, _), yaw_rad = s.motion.velocity_mps, s.motion.yaw_rad
    speed_mps = math.hypot(east_mps, north_mps)
    if speed_mps < _SLOW_MPS:
        return {"AngleTrack": _compass_deg(yaw_rad), "AngleSlip": 0.0, "Curvature": 0.0}
    track_rad = math.atan2(north_mps, east_mps)
    return {
        "AngleTrack": _compass_deg(track_rad),
        "AngleSlip": wrap_degrees(math.degrees(yaw_rad - track_rad)),
        "Curvature": -_level(s, s.motion.rates_radps)[2] / speed_mps,
    }


def _velocity_yaw_local(s: Solution) -> Signals:
    x_mps, y_mps, _ = s.motion.velocity_mps
    return {
        "VelLocalX": x_mps,
        "VelLocalY": y_mps,
        "AngleLocalYaw": wrap_degrees(math.degrees(s.motion.yaw_rad)),
        "AngleLocalTrack": math.degrees(math.atan2(y_mps, x_mps)),
    }


def _iso_orientation(s: Solution) -> Signals:
    return {
        "IsoYawAngle": wrap_degrees(math.degrees(s.motion.yaw_rad)),
        "IsoPitchAngle": math.degrees(s.motion.pitch_rad),
        "IsoRollAngle": wrap_degrees(math.degrees(s.motion.roll_rad)),
    }


def _iso_names(frame: str, quantity: str) -> str:
    axes = ("Roll", "Pitch", "Yaw") if quantity.startswith("Angular") else ("Longitudinal", "Lateral", "Vertical")
    return " ".join(f"Iso{frame}{axis}{quantity.removeprefix('Angular')}" for axis in axes)


def _iso(frame: str, quantity: str, values: Callable[[Solution], Vector]) -> tuple[str, Callable[[Solution], Signals]]:
    names = _iso_names(frame, quantity)
    return f"Iso{frame}{quantity}", lambda s: _named(names, values(s))


_VELOCITY = "IsoEfsEastVelocity IsoEfsNorthVelocity IsoEfsVerticalVelocity"
_ACCELERATION = "IsoEfsEastAcceleration IsoEfsNorthAcceleration IsoEfsVerticalAcceleration"

_ISO = dict(
    (
        _iso("Vs", "Velocity", lambda s: car_of(_level_velocity(s), s.motion.roll_rad, s.motion.pitch_rad)),
        _iso("Vs", "Acceleration", lambda s: car_of(_level_acceleration(s), s.motion.roll_rad, s.motion.pitch_rad)),
        _iso("Vs", "AngularVelocity", lambda s: _degrees(s.motion.rates_radps)),
        _iso("Vs", "AngularAcceleration", lambda s: _degrees(s.motion.angular_accelerations_radps2)),
        _iso("Is", "Velocity", _level_velocity),
        _iso("Is", "Acceleration", _level_acceleration),
        _iso("Is", "AngularVelocity", lambda s: _degrees(_level(s, s.motion.rates_radps))),
        _iso("Is", "AngularAcceleration", lambda s: _degrees(_level(s, s.motion.angular_accelerations_radps2))),
    )
)

NAVIGATION: dict[str, Callable[[Solution], Signals]] = {
    "DateTime": _date_time,
    "LatitudeLongitude": lambda s: _named("PosLat PosLon", latitude_longitude_deg(*s.motion.position_m[:2])),
    "Altitude": lambda s: {"Altitude": ORIGIN_ALTITUDE_M + s.motion.position_m[2]},
    "Velocity": _velocity,
    "VelocityLevel": _velocity_level,
    "AccelVehicle": lambda s: _named("AccelX AccelY AccelZ", _right_down(s.motion.specific_force_mps2)),
    "AccelLevel": _acceleration_level,
    "HeadingPitchRoll": _heading_pitch_roll,
    "RateVehicle": lambda s: _named("AngRateX AngRateY AngRateZ", _degrees(_right_down(s.motion.rates_radps))),
    "RateLevel": lambda s: _named("AngRateForward AngRateLateral AngRateDown", _degrees(_right_down(_level(s, s.motion.rates_radps)))),
    "TrackSlipCurvature": _track_slip_curvature,
    "Distance": lambda s: {"DistanceWithHold": s.held_distance_m, "Distance": s.distance_m},
    "PosLocal": lambda s: {"PosLocalX": s.motion.position_m[0], "PosLocalY": s.motion.position_m[1]},
    "VelYawLocal": _velocity_yaw_local,
    "AngAccelVehicle": lambda s: _named("AngAccelX AngAccelY AngAccelZ", _degrees(_right_down(s.motion.angular_accelerations_radps2))),
    "AngAccelLevel": lambda s: _named(
        "AngAccelForward AngAccelLateral AngAccelDown", _degrees(_right_down(_level(s, s.motion.angular_accelerations_radps2)))
    ),
    "PosLocalNE": lambda s: {"PosLocalNorth": s.motion.position_m[1], "PosLocalEast": s.motion.position_m[0]},
    "MilliTime": lambda s: {"MilliTime": s.valid_ms, "UtcOffset": UTC_OFFSET_S},
    "IsoOrientation": _iso_orientation,
    **_ISO,
    "IsoEfsVelocity": lambda s: _named(_VELOCITY, s.motion.velocity_mps),
    "IsoEfsAcceleration": lambda s: _named(_ACCELERATION, turned(_level_acceleration(s), s.motion.yaw_rad)),
}
"""How each message about the motion is filled."""


def _gnss_status(s: Status) -> Signals:
    return {"GpsMinutes": s.valid_ms // 60_000, "NumSats": s.satellites, "PosMode": s.mode, "VelMode": s.mode, "OriMode": s.mode}


def _position_accuracy(s: Status) -> Signals:
    a = s.accuracy
    return {"PosAccNorth": a.position_m, "PosAccEast": a.position_m, "PosAccDown": a.height_m, "PosAccAge": 0, "UmacStatus": _NO_UMAC}


def _velocity_accuracy(s: Status) -> Signals:
    sigma_mps = s.accuracy.velocity_mps
    return {"VelAccNorth": sigma_mps, "VelAccEast": sigma_mps, "VelAccDown": sigma_mps, "VelAccAge": 0, "BlendMethod": s.blend_method}


def _orientation_accuracy(s: Status) -> Signals:
    tilt_deg = math.degrees(s.accuracy.tilt_rad)
    return {"OriAccHeading": math.degrees(s.accuracy.heading_rad), "OriAccPitch": tilt_deg, "OriAccRoll": tilt_deg, "OriAccAge": 0}


def _can_status(s: Status) -> Signals:
    return {"InsCanTxCount": s.transmitted % 65_536, "InsCanTxOk": 100, "InsCanRxOk": 100}


STATUS: dict[str, Callable[[Status], Signals]] = {
    "NcomStatus00": _gnss_status,
    "NcomStatus03": _position_accuracy,
    "NcomStatus04": _velocity_accuracy,
    "NcomStatus05": _orientation_accuracy,
    "NcomStatus78": _can_status,
}
"""How each status channel is filled; the instrument sends one per cycle, in turn."""

STATUS_MESSAGES = tuple(STATUS)
"""The NCOM channels that the instrument knows."""
MESSAGES = (*STATUS, *NAVIGATION)
"""Names of the messages that the instrument can fill; it sends those that have a cycle time in the DBC."""
CORE_MESSAGES = (
    *("NcomStatus00", "NcomStatus03", "NcomStatus04", "NcomStatus05", "DateTime", "LatitudeLongitude", "Altitude", "Velocity"),
    *("VelocityLevel", "AccelLevel", "HeadingPitchRoll", "RateVehicle", "PosLocal", "VelYawLocal", "MilliTime"),
)
"""Those that a DBC must have."""
