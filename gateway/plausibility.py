"""Do the measurements contradict each other, or what the gateway asked for?

Every frame may be fresh, whole and within its ranges, and its content still wrong: frozen, off, or of somebody else. So each signal
that steers the car is held against another one that knows the same thing, for as long as honest ones may disagree.
"""

import math
from collections import deque
from typing import NamedTuple

from dbc.vehicle import Vehicle
from gateway.causes import Cause, Finding
from gateway.codec import Measurement
from gateway.limits import Demand, clamp

SPEED_LIMIT_MPS = 2.0
"""Difference of the speeds of wheels and navigation, as in opendbc. In undisturbed drives 0.8 m/s."""
SPEED_HOLD_NS = 100_000_000
"""Wheels that slip for a moment are no fault of a sensor."""
BRAKE_SLIP = 0.3
"""By this share of the car's speed wheels may be slower while an anti-lock brake works: it keeps the slip below a quarter."""
SLOWING_MPS = 0.0625
"""Loss of speed in the window below that excuses such wheels: ice gives 0.1 m/s, and a speed that is frozen none."""
SPEED_JUMP_MPS = 2.5
"""Change of speed in the window below that no car makes: at 1 g, and with frames lost, it is 1.9 m/s."""

MOTION_WINDOW_MS = 100
"""Over this time position and heading are held against speed and yaw rate: ten measurements of the navigation system."""
MOTION_HOLD_NS = 30_000_000
"""A lost frame makes a difference for one cycle, two for two: 36 m/s are 0.36 m a cycle."""
POSITION_LIMITS_M = (0.2, 0.5)
"""Half of the way that the car makes in the window, so that a position that stands still is found, within these: the usable position
modes are good to 0.2 m, and a lane of 3.5 m leaves a car of 1.8 m 0.85 m on each side. In undisturbed drives 0.02 m."""
YAW_RATE_LIMIT_RADPS = 0.1
"""At 20 m/s a path that is 2 m/s2 off; a jump of the heading by 0.01 rad. In undisturbed drives 0.02 rad/s."""

STEERING_RATE_SHARE = 1.25
"""Of the fastest rate of the steering robot: faster is no motion. Twice the rate that profiles allow, for two frames in one cycle."""
STEERING_STEP_NS = (10_000_000, 30_000_000)
"""Time that a step of the angle took: a cycle of its message, or three when two were lost. An angle that did not change stood still."""
FOLLOWING_NS = 100_000_000
"""Time in which the robot has followed every demand, besides its dead time: three times its lag, and a step of the plan."""
FOLLOWING_LIMIT_RAD = 0.05
"""Steering-wheel angle beside everything demanded in that time: ten times what undisturbed drives show, six times the robot's lash."""
FOLLOWING_HOLD_NS = 50_000_000

PEDAL_LIMIT_NORM = 0.05
"""A foot that is deeper than the robot by so much of the stroke wants to be: the robots judge by the same figure."""
PEDAL_HOLD_NS = 100_000_000
"""As Dataspeed: an override has a level and a time."""
PEDAL_WINDOW_NS = 300_000_000
"""A pedal that is no deeper than the robot was asked for within this time is no foot, whatever the robot says of itself: a status
that stands still while the robot brakes must not hand a moving car to nobody. The slowest stroke of the robots takes 0.2 s."""

_NS_PER_S = 1e9


class _Held:
    """A contradiction that counts once it has lasted."""

    def __init__(self, hold_ns: int) -> None:
        self._hold_ns = hold_ns
        self._since_ns: int | None = None

    def update(self, now_ns: int, is_there: bool) -> bool:
        """Whether it has been there for its time, without a break."""
        if not is_there:
            self.reset()
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        return now_ns - self._since_ns >= self._hold_ns

    def reset(self) -> None:
        """It is not there."""
        self._since_ns = None


class _Recent:
    """Values of the last while, with both of its ends."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._times_ns: deque[int] = deque()
        self._values: deque[float] = deque()

    def add(self, now_ns: int, value: float) -> None:
        """Remember a value, and forget those that are too old."""
        self._times_ns.append(now_ns)
        self._values.append(value)
        while now_ns - self._times_ns[0] > self._window_ns:
            self._times_ns.popleft()
            self._values.popleft()

    @property
    def smallest(self) -> float:
        """Of these values."""
        return min(self._values)

    @property
    def largest(self) -> float:
        """Of these values."""
        return max(self._values)


class _Point(NamedTuple):
    """A measurement, and what of the way to it speed and yaw rate do not explain, in sum since the trail began."""

    time_ms: int
    x_m: float
    y_m: float
    yaw_rad: float
    vx_mps: float
    unexplained_x_m: float = 0.0
    unexplained_y_m: float = 0.0
    unexplained_yaw_rad: float = 0.0


class _Motion:
    """Position and heading against what speed and yaw rate make of them, over the last `MOTION_WINDOW_MS` of navigation time."""

    def __init__(self) -> None:
        self._trail: deque[_Point] = deque()

    def update(self, m: Measurement) -> None:
        """Take in a measurement; nothing is new without a new time of validity."""
        elapsed_ms = m.navigation_time_ms - self._trail[-1].time_ms if self._trail else math.inf
        if elapsed_ms in range(1, MOTION_WINDOW_MS + 1):
            self._trail.append(_next_point(self._trail[-1], m, elapsed_ms * 1e-3))
            while m.navigation_time_ms - self._trail[1].time_ms >= MOTION_WINDOW_MS:
                self._trail.popleft()
        elif elapsed_ms:
            self._trail = deque([_Point(m.navigation_time_ms, m.x_m, m.y_m, m.yaw_rad, m.vx_mps)])

    @property
    def position_error_m(self) -> float:
        """How far the position has moved otherwise than the speed says."""
        first, last = self._trail[0], self._trail[-1]
        return math.hypot(last.unexplained_x_m - first.unexplained_x_m, last.unexplained_y_m - first.unexplained_y_m)

    @property
    def yaw_rate_error_radps(self) -> float:
        """How much faster the heading has turned than the yaw rate says, mean over the window."""
        return (self._trail[-1].unexplained_yaw_rad - self._trail[0].unexplained_yaw_rad) / (MOTION_WINDOW_MS * 1e-3)

    @property
    def speed_change_mps(self) -> float:
        """By how much the car has become faster."""
        return self._trail[-1].vx_mps - self._trail[0].vx_mps


def _next_point(before: _Point, m: Measurement, elapsed_s: float) -> _Point:
    cosine, sine = math.cos(m.yaw_rad), math.sin(m.yaw_rad)
    return _Point(
        m.navigation_time_ms,
        m.x_m,
        m.y_m,
        m.yaw_rad,
        m.vx_mps,
        before.unexplained_x_m + m.x_m - before.x_m - (m.vx_mps * cosine - m.vy_mps * sine) * elapsed_s,
        before.unexplained_y_m + m.y_m - before.y_m - (m.vx_mps * sine + m.vy_mps * cosine) * elapsed_s,
        before.unexplained_yaw_rad + math.remainder(m.yaw_rad - before.yaw_rad, math.tau) - m.yaw_rate_radps * elapsed_s,
    )


class Plausibility:
    """Compares what is measured.

    Args:
        is_on_lift: the wheels turn without the road; their speed then says nothing about the car's.
    """

    def __init__(self, vehicle: Vehicle, *, is_on_lift: bool = False) -> None:
        robot = vehicle.robots.steering
        self._is_on_lift = is_on_lift
        self._wheel_radius_m = vehicle.model.wheel_radius_m
        self._steering_limit_radps = STEERING_RATE_SHARE * robot.rate_limit_radps
        self._motion = _Motion()
        self._steered: tuple[int, float] | None = None
        self._asked_rad = _Recent(FOLLOWING_NS + round(robot.dead_time_s * _NS_PER_S))
        self._asked_brake_norm, self._asked_accelerator_norm = _Recent(PEDAL_WINDOW_NS), _Recent(PEDAL_WINDOW_NS)
        self._speed, self._jump = _Held(SPEED_HOLD_NS), _Held(MOTION_HOLD_NS)
        self._position, self._yaw_rate = _Held(MOTION_HOLD_NS), _Held(MOTION_HOLD_NS)
        self._following = _Held(FOLLOWING_HOLD_NS)
        self._brake, self._accelerator = _Held(PEDAL_HOLD_NS), _Held(PEDAL_HOLD_NS)

    def update(self, now_ns: int, measurement: Measurement, demand: Demand, is_driving: bool) -> list[Finding]:
        """What is contradictory now.

        Args:
            demand: what the robots were asked for last.
            is_driving: whether they are to follow it.
        """
        self._asked_rad.add(now_ns, demand.steering_wheel_rad)
        self._asked_brake_norm.add(now_ns, demand.brake_norm)
        self._asked_accelerator_norm.add(now_ns, demand.accelerator_norm)
        found = self._judge_steering_rate(now_ns, measurement)
        if measurement.navigation_time_ms >= 0:
            found += self._judge_navigation(now_ns, measurement)
        if is_driving:
            found += self._judge_following(now_ns, measurement)
            found += self._judge_pedals(now_ns, measurement)
        else:
            for held in (self._following, self._brake, self._accelerator):
                held.reset()
        return found

    def _judge_navigation(self, now_ns: int, m: Measurement) -> list[Finding]:
        self._motion.update(m)
        wheels_mps = m.vx_mps if self._is_on_lift else m.wheels_radps * self._wheel_radius_m
        position_limit_m = clamp(0.5 * abs(m.vx_mps) * MOTION_WINDOW_MS * 1e-3, *POSITION_LIMITS_M)
        checks = (
            (self._speed, Cause.SPEED_IMPLAUSIBLE, "wheels", wheels_mps - m.vx_mps, self._speed_limit_mps(m, wheels_mps)),
            (self._jump, Cause.SPEED_IMPLAUSIBLE, "navigation", self._motion.speed_change_mps, SPEED_JUMP_MPS),
            (self._position, Cause.POSITION_IMPLAUSIBLE, "navigation", self._motion.position_error_m, position_limit_m),
            (self._yaw_rate, Cause.YAW_RATE_IMPLAUSIBLE, "navigation", self._motion.yaw_rate_error_radps, YAW_RATE_LIMIT_RADPS),
        )
        return [
            Finding(cause, abs(error), limit, source)
            for held, cause, source, error, limit in checks
            if held.update(now_ns, abs(error) > limit)
        ]

    def _speed_limit_mps(self, m: Measurement, wheels_mps: float) -> float:
        """How far wheels and navigation may be apart: further when brakes hold the wheels of a car that slows down."""
        is_braking = max(m.brake_norm, m.brake_pedal_norm) > PEDAL_LIMIT_NORM and wheels_mps < m.vx_mps
        if is_braking and self._motion.speed_change_mps < -SLOWING_MPS:
            return max(SPEED_LIMIT_MPS, BRAKE_SLIP * m.vx_mps)
        return SPEED_LIMIT_MPS

    def _judge_steering_rate(self, now_ns: int, m: Measurement) -> list[Finding]:
        before_ns, before_rad = (now_ns, m.steering_wheel_rad) if self._steered is None else self._steered
        if m.steering_wheel_rad == before_rad:
            self._steered = (before_ns, before_rad)
            return []
        self._steered = (now_ns, m.steering_wheel_rad)
        elapsed_s = clamp(now_ns - before_ns, *STEERING_STEP_NS) / _NS_PER_S
        rate_radps = abs(m.steering_wheel_rad - before_rad) / elapsed_s
        if rate_radps <= self._steering_limit_radps:
            return []
        return [Finding(Cause.STEERING_IMPLAUSIBLE, rate_radps, self._steering_limit_radps, "SR")]

    def _judge_following(self, now_ns: int, m: Measurement) -> list[Finding]:
        error_rad = max(m.steering_wheel_rad - self._asked_rad.largest, self._asked_rad.smallest - m.steering_wheel_rad)
        if not self._following.update(now_ns, error_rad > FOLLOWING_LIMIT_RAD):
            return []
        return [Finding(Cause.STEERING_NOT_FOLLOWING, error_rad, FOLLOWING_LIMIT_RAD, "SR")]

    def _judge_pedals(self, now_ns: int, m: Measurement) -> list[Finding]:
        brake_norm = max(m.brake_norm, self._asked_brake_norm.largest)
        accelerator_norm = max(m.accelerator_norm, self._asked_accelerator_norm.largest)
        feet = (
            (self._brake, Cause.DRIVER_BRAKES, m.brake_pedal_norm - brake_norm),
            (self._accelerator, Cause.DRIVER_ACCELERATES, m.accelerator_pedal_norm - accelerator_norm),
        )
        return [
            Finding(cause, deeper_norm, PEDAL_LIMIT_NORM, "CAR_Powertrain")
            for held, cause, deeper_norm in feet
            if held.update(now_ns, deeper_norm > PEDAL_LIMIT_NORM)
        ]
