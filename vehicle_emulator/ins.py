"""GNSS-aided inertial navigation system: true motion in, one noisy and late navigation solution out, as OxTS instruments send it.

All messages of one cycle are views of one solution, as in the instrument: a wrong heading also turns the velocity in the car's axes.
Instrument conventions: car axes forward, right, down; heading clockwise from north. Local frame: x east, y north, yaw
counter-clockwise from x. Reference point: the centre of gravity. Time of validity counts from a fixed date, so that runs repeat.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from random import Random

from dbc.catalogue import Catalogue
from dbc.vehicle import InsParameters
from vehicle_emulator.plant import GRAVITY_MPS2, PlantState

STATUS_MESSAGES = ("NcomStatus00", "NcomStatus03", "NcomStatus04", "NcomStatus05")
"""The NCOM channels, of which the instrument sends one per cycle in turn."""

_GPS_EPOCH = datetime(1980, 1, 6)
_START = datetime(2026, 1, 5, 8, 0, 0)
"""GPS time at which every run starts."""
_UTC_OFFSET_S = -18
"""UTC minus GPS time since 2017."""
_ORIGIN_LATITUDE_RAD = math.radians(50.88)
_ORIGIN_LONGITUDE_RAD = math.radians(6.29)
_ALTITUDE_M = 120.0
"""Origin of the local frame: an arbitrary point near the proving ground of Aldenhoven."""
_EQUATORIAL_RADIUS_M = 6_378_137.0  # WGS 84
_ECCENTRICITY_SQUARED = 6.694379990e-3  # WGS 84
_VERTICAL_SIGMA_SHARE = 1.5  # satellites are seen from one side only

_MS = timedelta(milliseconds=1)
_NS_PER_MS = 1_000_000


@dataclass(frozen=True, slots=True)
class Solution:
    """What the instrument believes at `valid_ms`, milliseconds of GPS time; ISO 8855 axes, local frame."""

    valid_ms: int
    x_m: float
    y_m: float
    yaw_rad: float
    v_east_mps: float
    v_north_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    ay_mps2: float


class GaussMarkov:
    """Error that wanders with a correlation time, stationary from the start."""

    def __init__(self, random: Random, sigma: float, correlation_s: float) -> None:
        self._random = random
        self._sigma = sigma
        self._correlation_s = correlation_s
        self._value = random.gauss(0.0, sigma)

    def step(self, dt_s: float) -> float:
        """The error after `dt_s`."""
        kept = math.exp(-dt_s / self._correlation_s)
        self._value = kept * self._value + self._sigma * math.sqrt(1.0 - kept * kept) * self._random.gauss(0.0, 1.0)
        return self._value


class NavigationSystem:
    """The instrument.

    Args:
        period_ns: time between two calls of `observe` [ns]; the latency is rounded up to whole periods.
        start_ns: monotonic time at which the run starts [ns].
        state: true motion at the start.
    """

    def __init__(
        self, parameters: InsParameters, catalogue: Catalogue, random: Random, *, period_ns: int, start_ns: int, state: PlantState
    ) -> None:
        p = parameters
        self._p = p
        self._random = random
        self._start_ns = start_ns
        latency_steps = math.ceil(p.latency_s * 1e9 / period_ns)
        self._latency_ns = latency_steps * period_ns
        self._delayed = deque([state] * (latency_steps + 1), maxlen=latency_steps + 1)
        self._errors = tuple(GaussMarkov(random, p.position_sigma_m, p.position_correlation_s) for _ in "xy")
        self._heading_error = GaussMarkov(random, p.heading_sigma_rad, p.heading_correlation_s)
        self._solved_ns = start_ns
        self._solution: Solution | None = None
        self._gnss_mode = catalogue.enumeration("NcomStatus00", "PosMode")["RTKInteger"]
        self._blend_method = catalogue.enumeration("NcomStatus04", "BlendMethod")["RealTime"]

    def observe(self, state: PlantState) -> None:
        """Take the true motion of one more period."""
        self._delayed.append(state)

    def message(self, name: str, now_ns: int) -> dict[str, float]:
        """Signals of one of `MESSAGES` sent at `now_ns`, in the units of the DBC."""
        return _MESSAGES[name](self, self.solution(now_ns))

    def solution(self, now_ns: int) -> Solution:
        """The navigation solution that is sent at `now_ns`; the same for all messages of a cycle."""
        if self._solution is None or now_ns != self._solved_ns:
            self._solution = self._solve(now_ns)
            self._solved_ns = now_ns
        return self._solution

    def _solve(self, now_ns: int) -> Solution:
        p, truth, gauss = self._p, self._delayed[0], self._random.gauss
        dt_s = (now_ns - self._solved_ns) * 1e-9
        cosine, sine = math.cos(truth.yaw_rad), math.sin(truth.yaw_rad)
        x_error_m, y_error_m = (error.step(dt_s) + gauss(0.0, p.position_white_sigma_m) for error in self._errors)
        return Solution(
            valid_ms=(_START - _GPS_EPOCH) // _MS + (now_ns - self._latency_ns - self._start_ns) // _NS_PER_MS,
            x_m=truth.x_m + x_error_m,
            y_m=truth.y_m + y_error_m,
            yaw_rad=truth.yaw_rad + self._heading_error.step(dt_s) + gauss(0.0, p.heading_white_sigma_rad),
            v_east_mps=cosine * truth.vx_mps - sine * truth.vy_mps + gauss(0.0, p.velocity_sigma_mps),
            v_north_mps=sine * truth.vx_mps + cosine * truth.vy_mps + gauss(0.0, p.velocity_sigma_mps),
            yaw_rate_radps=truth.yaw_rate_radps + gauss(0.0, p.yaw_rate_sigma_radps),
            ax_mps2=truth.ax_mps2 + gauss(0.0, p.acceleration_sigma_mps2),
            ay_mps2=truth.ay_mps2 + gauss(0.0, p.acceleration_sigma_mps2),
        )

    def _gnss_status(self, solution: Solution) -> dict[str, float]:
        mode = self._gnss_mode
        return {"GpsMinutes": solution.valid_ms // 60_000, "NumSats": 14, "PosMode": mode, "VelMode": mode, "OriMode": mode}

    def _position_accuracy(self, _: Solution) -> dict[str, float]:
        sigma_m = math.hypot(self._p.position_sigma_m, self._p.position_white_sigma_m)
        down_m = _VERTICAL_SIGMA_SHARE * sigma_m
        return {"PosAccNorth": sigma_m, "PosAccEast": sigma_m, "PosAccDown": down_m, "PosAccAge": 0, "UmacStatus": 255}

    def _velocity_accuracy(self, _: Solution) -> dict[str, float]:
        sigma_mps = self._p.velocity_sigma_mps
        return {"VelAccNorth": sigma_mps, "VelAccEast": sigma_mps, "VelAccDown": sigma_mps, "BlendMethod": self._blend_method}

    def _orientation_accuracy(self, _: Solution) -> dict[str, float]:
        return {"OriAccHeading": math.degrees(math.hypot(self._p.heading_sigma_rad, self._p.heading_white_sigma_rad))}


def wrap_degrees(angle_deg: float) -> float:
    """The same direction in [-180, 180) [deg]."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _date_time(s: Solution) -> dict[str, float]:
    date = _GPS_EPOCH + s.valid_ms * _MS
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


def _latitude_longitude(s: Solution) -> dict[str, float]:
    """Flat-earth approximation at the origin with the radii of curvature of the ellipsoid."""
    flattening = 1.0 - _ECCENTRICITY_SQUARED * math.sin(_ORIGIN_LATITUDE_RAD) ** 2
    normal_m = _EQUATORIAL_RADIUS_M / math.sqrt(flattening)
    meridian_m = normal_m * (1.0 - _ECCENTRICITY_SQUARED) / flattening
    return {
        "PosLat": math.degrees(_ORIGIN_LATITUDE_RAD + s.y_m / (meridian_m + _ALTITUDE_M)),
        "PosLon": math.degrees(_ORIGIN_LONGITUDE_RAD + s.x_m / ((normal_m + _ALTITUDE_M) * math.cos(_ORIGIN_LATITUDE_RAD))),
    }


def _velocity_level(s: Solution) -> dict[str, float]:
    cosine, sine = math.cos(s.yaw_rad), math.sin(s.yaw_rad)
    return {
        "VelForward": cosine * s.v_east_mps + sine * s.v_north_mps,
        "VelLateral": sine * s.v_east_mps - cosine * s.v_north_mps,
    }


def _velocity_yaw_local(s: Solution) -> dict[str, float]:
    return {
        "VelLocalX": s.v_east_mps,
        "VelLocalY": s.v_north_mps,
        "AngleLocalYaw": wrap_degrees(math.degrees(s.yaw_rad)),
        "AngleLocalTrack": math.degrees(math.atan2(s.v_north_mps, s.v_east_mps)),
    }


_MESSAGES: dict[str, Callable[[NavigationSystem, Solution], dict[str, float]]] = {
    "NcomStatus00": NavigationSystem._gnss_status,
    "NcomStatus03": NavigationSystem._position_accuracy,
    "NcomStatus04": NavigationSystem._velocity_accuracy,
    "NcomStatus05": NavigationSystem._orientation_accuracy,
    "DateTime": lambda _, s: _date_time(s),
    "LatitudeLongitude": lambda _, s: _latitude_longitude(s),
    "Altitude": lambda _, s: {"Altitude": _ALTITUDE_M},
    "Velocity": lambda _, s: {
        "VelNorth": s.v_north_mps, "VelEast": s.v_east_mps, "Speed2D": math.hypot(s.v_east_mps, s.v_north_mps)
    },
    "VelocityLevel": lambda _, s: _velocity_level(s),
    "AccelVehicle": lambda _, s: {"AccelX": s.ax_mps2, "AccelY": -s.ay_mps2, "AccelZ": -GRAVITY_MPS2},
    "HeadingPitchRoll": lambda _, s: {"AngleHeading": (90.0 - math.degrees(s.yaw_rad)) % 360.0},
    "RateVehicle": lambda _, s: {"AngRateZ": -math.degrees(s.yaw_rate_radps)},
    "PosLocal": lambda _, s: {"PosLocalX": s.x_m, "PosLocalY": s.y_m},
    "VelYawLocal": lambda _, s: _velocity_yaw_local(s),
    "MilliTime": lambda _, s: {"MilliTime": s.valid_ms, "UtcOffset": _UTC_OFFSET_S},
}
MESSAGES = tuple(_MESSAGES)
"""Names of the messages that the instrument sends."""
