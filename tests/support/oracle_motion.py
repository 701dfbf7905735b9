"""What the gateway asks of the car, judged by the bus oracle: angles, pedals and stops against envelope and speed."""

import math
from collections import deque

from tests.support.oracle_limits import (
    COMFORT_STOP_JERK_MPS3,
    COMFORT_STOP_MPS2,
    MESSAGE_RATE_RATIO,
    MS,
    PLAN_TAIL_NS,
    SAFE_STOP_JERK_MPS3,
    SAFE_STOP_MPS2,
    STANDING_MPS,
    STANDSTILL_BRAKE_PERCENT,
    Car,
    Envelope,
)
from tests.support.oracle_reactions import Violate

STEER, DRIVE, BRAKE = "SR_Command", "AR_Command", "BR_Command"
_TICK_NS = 10 * MS
_DEMAND_WINDOW_NS = 250 * MS  # panda's real-time window
_SPEED_WINDOW_NS = 120 * MS  # age of a speed that the gateway may still rely on
_TAIL_MARGIN_NS = 200 * MS  # for the limits to follow the end of a plan
_SAFE_STOP_BUILT_UP_NS = 2_500 * MS  # 2.5 m/s2 at 1.5 m/s3 takes 1.7 s
_COMFORT_TOLERANCE_MPS2 = 0.02
_STEER_LSB_DEG, _PEDAL_LSB_PERCENT, _ACCELERATION_LSB_MPS2 = 0.05, 0.01, 0.01


class CarSeen:
    """What the car says of its motion.

    Attributes:
        felt_deceleration_mps2: newest.
    """

    def __init__(self) -> None:
        self._speeds: deque[tuple[int, float]] = deque()
        self._wheel_speeds: deque[tuple[int, float]] = deque()
        self.felt_deceleration_mps2 = 0.0

    def note_speed(self, t_ns: int, speed_mps: float) -> None:
        """Take in a speed of the navigation system."""
        _remember(self._speeds, t_ns, abs(speed_mps))

    def note_wheels(self, t_ns: int, speed_mps: float) -> None:
        """Take in a speed of the wheels."""
        _remember(self._wheel_speeds, t_ns, abs(speed_mps))

    @property
    def slowest_mps(self) -> float:
        """The smallest speed that the gateway may have relied on."""
        return min((speed for _, speed in self._speeds), default=0.0)

    @property
    def slowest_wheels_mps(self) -> float:
        """The same by the wheels."""
        return min((speed for _, speed in self._wheel_speeds), default=0.0)

    @property
    def fastest_mps(self) -> float:
        """The largest one."""
        return max((speed for _, speed in self._speeds), default=0.0)


def _remember(speeds: deque[tuple[int, float]], t_ns: int, speed_mps: float) -> None:
    speeds.append((t_ns, speed_mps))
    while speeds[0][0] < t_ns - _SPEED_WINDOW_NS and len(speeds) > 1:
        speeds.popleft()


class MotionJudge:
    """Judges the demands of one gateway while it moves the car.

    Args:
        jitter_ns: how far the times of two frames may be off [ns].
    """

    def __init__(self, limits: Envelope, car: Car, seen: CarSeen, jitter_ns: int, violate: Violate) -> None:
        self._limits, self._car, self._seen, self._jitter_ns, self._violate = limits, car, seen, jitter_ns, violate
        self._is_stop = False
        self._entered_ns = 0
        self._entry_deceleration_mps2 = 0.0
        self._angles: deque[tuple[int, float]] = deque()
        self._pedals_ns: int | None = None
        self._drive_percent = self._brake_percent = 0.0
        self._acceleration_mps2 = self._deceleration_mps2 = 0.0
        self._told, self._told_ns = "", 0

    def enter(self, t_ns: int, authority: str) -> None:
        """The gateway claims another authority."""
        self._is_stop, self._entered_ns = authority == "Stop", t_ns
        if self._is_stop:
            # A car that brakes already goes on braking; it feels a little more than the pedal is asked for.
            self._entry_deceleration_mps2 = max(self._deceleration_mps2, self._seen.felt_deceleration_mps2 + _ACCELERATION_LSB_MPS2)

    def release(self, name: str) -> None:
        """A robot is asked for nothing: what comes next begins anew."""
        if name == STEER:
            self._angles.clear()
        elif name == DRIVE:
            self._drive_percent = 0.0
        else:
            self._brake_percent, self._pedals_ns, self._acceleration_mps2, self._deceleration_mps2 = 0.0, None, 0.0, 0.0

    def demand(self, t_ns: int, name: str, value: float) -> None:
        """A robot is asked for an angle [deg] or a position [%]; the brake is the last of a tick."""
        if name == STEER:
            self._judge_angle(t_ns, value)
        elif name == DRIVE:
            self._drive_percent = value
        else:
            self._brake_percent = value
            self._judge_pedals(t_ns)

    def _elapsed_s(self, t_ns: int, since_ns: int) -> float:
        """Longest time that may lie between two frames."""
        return max(t_ns - since_ns + self._jitter_ns, MS) * 1e-9

    def _lateral_mps2(self, angle_deg: float, speed_mps: float) -> float:
        return speed_mps * speed_mps * math.tan(math.radians(angle_deg) / self._car.steering_ratio) / self._car.wheelbase_m

    # ---- steering

    def _judge_angle(self, t_ns: int, angle_deg: float) -> None:
        if abs(angle_deg) > self._limits.steering_wheel_limit_deg + _STEER_LSB_DEG:
            self._violate(t_ns, "steering angle", f"{angle_deg:.2f} deg")
        if self._angles:
            self._judge_rate(t_ns, angle_deg)
            self._judge_lateral(t_ns, angle_deg)
            self._judge_tail(t_ns, angle_deg)
        self._angles.append((t_ns, angle_deg))
        while self._angles[0][0] < t_ns - _DEMAND_WINDOW_NS:
            self._angles.popleft()

    def _judge_rate(self, t_ns: int, angle_deg: float) -> None:
        """From frame to frame, and over 250 ms of real time, so that more frames than there should be do not turn the wheel faster."""
        rate_dps = self._limits.steering_wheel_rate_dps
        for rule, (since_ns, since_deg), ratio in (
            ("steering rate", self._angles[-1], 1.0),
            ("steering window", self._angles[0], MESSAGE_RATE_RATIO),
        ):
            elapsed_s = self._elapsed_s(t_ns, since_ns)
            if abs(angle_deg - since_deg) > ratio * rate_dps * elapsed_s + _STEER_LSB_DEG:
                self._violate(t_ns, rule, f"{angle_deg - since_deg:.1f} deg in {elapsed_s * 1e3:.0f} ms")

    def _judge_lateral(self, t_ns: int, angle_deg: float) -> None:
        before_ns, before_deg = self._angles[-1]
        # Of navigation and wheels one may be wrong; the faster counts.
        speed_mps = max(self._seen.slowest_mps, self._seen.slowest_wheels_mps if self._limits.is_on_the_road else 0.0)
        now_mps2, was_mps2, lsb_mps2 = (self._lateral_mps2(angle, speed_mps) for angle in (angle_deg, before_deg, _STEER_LSB_DEG))
        # A demand that comes back from outside is no violation: the car was handed over like this, or has become faster.
        if abs(now_mps2) > self._limits.lateral_acceleration_mps2 + lsb_mps2 and abs(now_mps2) >= abs(was_mps2):
            self._violate(t_ns, "lateral acceleration", f"{now_mps2:.2f} m/s2")
        elapsed_s = self._elapsed_s(t_ns, before_ns)
        if abs(now_mps2 - was_mps2) > self._limits.lateral_jerk_mps3 * elapsed_s + lsb_mps2:
            self._violate(t_ns, "lateral jerk", f"{(now_mps2 - was_mps2) / elapsed_s:.2f} m/s3")

    def _judge_tail(self, t_ns: int, angle_deg: float) -> None:
        """After the end of any plan the angle is held, unless the limits hold it back, which loosen as the car becomes slower.

        In a comfort stop the controller goes on steering.
        """
        before_ns, before_deg = self._angles[-1]
        is_free = abs(self._lateral_mps2(angle_deg, self._seen.fastest_mps)) < 0.9 * self._limits.lateral_acceleration_mps2
        is_over = self._is_stop and self._told != "ComfortStop" and before_ns - self._entered_ns > PLAN_TAIL_NS + _TAIL_MARGIN_NS
        if is_over and is_free and abs(angle_deg - before_deg) > _STEER_LSB_DEG:
            self._violate(t_ns, "steering tail", f"{angle_deg - before_deg:.2f} deg in one frame after the end of any plan")

    # ---- pedals

    def _judge_pedals(self, t_ns: int) -> None:
        car, limits = self._car, self._limits
        for name, percent in (("accelerator", self._drive_percent), ("brake", self._brake_percent)):
            if not 0.0 <= percent <= 100.0:
                self._violate(t_ns, "pedal range", f"{name} {percent:g} %")
        if self._drive_percent > 0.0 and self._brake_percent > 0.0:
            self._violate(t_ns, "both pedals", f"{self._drive_percent:g} % and {self._brake_percent:g} %")
        lsb_mps2 = 1e-2 * _PEDAL_LSB_PERCENT * car.full_brake_force_n / car.mass_kg
        acceleration_mps2 = 1e-2 * self._drive_percent * car.full_drive_force_n / car.mass_kg
        deceleration_mps2 = 1e-2 * self._brake_percent * car.full_brake_force_n / car.mass_kg
        if acceleration_mps2 > limits.acceleration_mps2 + lsb_mps2:
            self._violate(t_ns, "acceleration", f"{acceleration_mps2:.2f} m/s2")
        if deceleration_mps2 > limits.deceleration_mps2 + lsb_mps2 and deceleration_mps2 > self._deceleration_mps2:
            self._violate(t_ns, "deceleration", f"{deceleration_mps2:.2f} m/s2")
        if self._pedals_ns is not None:
            elapsed_s = self._elapsed_s(t_ns, self._pedals_ns)
            for rule, change_mps2, limit_mps3 in (
                ("drive jerk", acceleration_mps2 - self._acceleration_mps2, limits.drive_jerk_mps3),
                ("brake jerk", abs(deceleration_mps2 - self._deceleration_mps2), limits.brake_jerk_mps3),
            ):
                if change_mps2 > limit_mps3 * elapsed_s + lsb_mps2:
                    self._violate(t_ns, rule, f"{change_mps2 / elapsed_s:.1f} m/s3")
            if self._is_stop:
                self._judge_stop(t_ns, deceleration_mps2, lsb_mps2)
        self._pedals_ns, self._acceleration_mps2, self._deceleration_mps2 = t_ns, acceleration_mps2, deceleration_mps2

    # ---- stops

    def _judge_stop(self, t_ns: int, deceleration_mps2: float, lsb_mps2: float) -> None:
        """The minimal risk manoeuvre: no accelerator, deceleration built up at a limited jerk, reached and held."""
        if self._drive_percent > 0.0:
            self._violate(t_ns, "stop accelerates", f"{self._drive_percent:g} %")
        if self._seen.slowest_mps < STANDING_MPS:
            if self._brake_percent > STANDSTILL_BRAKE_PERCENT and deceleration_mps2 >= self._deceleration_mps2:
                self._violate(t_ns, "standstill brake", f"{self._brake_percent:g} %")
            return
        entry_mps2, elapsed_s = self._entry_deceleration_mps2, self._stopping_s(t_ns)
        if deceleration_mps2 > max(SAFE_STOP_MPS2, entry_mps2) + lsb_mps2:
            self._violate(t_ns, "stop deceleration", f"{deceleration_mps2:.2f} m/s2")
        if deceleration_mps2 > entry_mps2 + SAFE_STOP_JERK_MPS3 * elapsed_s + lsb_mps2:
            self._violate(t_ns, "stop jerk", f"{deceleration_mps2:.2f} m/s2 after {elapsed_s:.2f} s")
        floor_mps2 = min(COMFORT_STOP_MPS2, COMFORT_STOP_JERK_MPS3 * (elapsed_s - 0.1))
        if deceleration_mps2 < 0.9 * floor_mps2 - lsb_mps2:
            self._violate(t_ns, "stop too weak", f"{deceleration_mps2:.2f} m/s2 after {elapsed_s:.2f} s")

    def _stopping_s(self, t_ns: int) -> float:
        return (t_ns - self._entered_ns + self._jitter_ns + _TICK_NS) * 1e-9

    def tell(self, t_ns: int, mode: str) -> None:
        """The gateway says which mode it is in: the stop must be of that grade."""
        if mode != self._told:
            self._told, self._told_ns = mode, t_ns
        if mode == "SafeStop" and t_ns - self._told_ns > _SAFE_STOP_BUILT_UP_NS and self._seen.slowest_mps > 1.0:
            if self._deceleration_mps2 < 0.9 * min(SAFE_STOP_MPS2, self._limits.deceleration_mps2):
                self._violate(t_ns, "stop too weak", f"{self._deceleration_mps2:.2f} m/s2 in {mode}")
        elif mode == "ComfortStop" and self._seen.slowest_mps > STANDING_MPS:
            entry_mps2 = self._entry_deceleration_mps2
            allowed_mps2 = min(max(entry_mps2, COMFORT_STOP_MPS2), entry_mps2 + COMFORT_STOP_JERK_MPS3 * self._stopping_s(t_ns))
            if self._deceleration_mps2 > allowed_mps2 + _COMFORT_TOLERANCE_MPS2:
                self._violate(t_ns, "comfort stop", f"{self._deceleration_mps2:.2f} m/s2, allowed {allowed_mps2:.2f}")
