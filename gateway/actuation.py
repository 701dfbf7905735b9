"""From a road-wheel angle and a drive demand to three robots, within the limits.

Demands are whole numbers of the steps that the bus has, and every rate is judged against the last one: what is on the bus is within the
limits to the last bit, however long the drive. Bounds give way to rates: a demand outside a bound that has become narrower comes back as
fast as the rate allows.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from dbc.vehicle import Vehicle
from gateway.limits import (
    STILL_MPS,
    Demand,
    LimitProfile,
    Resolution,
    clamp,
    lateral_acceleration_mps2,
    road_wheel_rad,
    steps_down,
    steps_up,
    steps_within,
)
from gateway.messages import PLAN_PERIOD_NS

BRAKE_RELEASED_NORM = 0.02
"""Brake-pedal position below which the accelerator may move."""

NEUTRAL = Demand(0.0, 0.0, 0.0)

STEERING_ANGLE, STEERING_RATE = "steering angle", "steering rate"
LATERAL_ACCELERATION, LATERAL_JERK = "lateral acceleration", "lateral jerk"
ACCELERATION, DECELERATION = "acceleration", "deceleration"
DRIVE_JERK, BRAKE_JERK = "drive jerk", "brake jerk"

UNITS: Mapping[str, str] = {
    STEERING_ANGLE: "rad",
    LATERAL_ACCELERATION: "m/s2",
    STEERING_RATE: "rad/s",
    LATERAL_JERK: "m/s3",
    ACCELERATION: "m/s2",
    DECELERATION: "m/s2",
    DRIVE_JERK: "m/s3",
    BRAKE_JERK: "m/s3",
}
"""Every limit, and the unit of its activations; angle and rate are those of the steering wheel."""

_RATES = (STEERING_RATE, LATERAL_JERK, DRIVE_JERK, BRAKE_JERK)


@dataclass(frozen=True, slots=True)
class Activation:
    """That a limit has changed a demand; numbers in the unit of the limit.

    Args:
        tick: of the driven ones, counted from 1.
        asked, limit, given: what came in, what is allowed, what went out.
    """

    tick: int
    asked: float
    limit: float
    given: float


class Actuation:
    """Limits demands and splits them; holds the last one, because rates are limited against it.

    Every time a limit acts is counted. A plan is a staircase, and a rate makes a ramp of each of its steps; that a demand is held back
    means more: a bound acts, or a rate has acted for as long as a step of the plan lasts.

    Attributes:
        demand: what the robots are asked for now.
        held_back: limits that hold the demand back now.
        engaged_ticks: ticks in which demands were limited.
        held_back_ticks: those of them in which a demand was held back; a controller with more than 1 % of them does not know its limits.
        limited: ticks in which each limit acted, see `UNITS`.
        last_limited: the newest activation of each limit.
    """

    def __init__(self, vehicle: Vehicle, profile: LimitProfile, tick_ns: int, resolution: Resolution) -> None:
        self._vehicle = vehicle
        self._profile = profile
        self._tick_ns = tick_ns
        self._tick_s = tick_ns * 1e-9
        self._resolution = resolution
        self._wheelbase_m = vehicle.model.cog_to_front_m + vehicle.model.cog_to_rear_m
        self._full_drive_mps2 = vehicle.pedals.full_drive_force_n / vehicle.model.mass_kg
        self._full_brake_mps2 = vehicle.pedals.full_brake_force_n / vehicle.model.mass_kg
        self._drive_step_mps2 = resolution.accelerator_norm * self._full_drive_mps2
        self._brake_step_mps2 = resolution.brake_norm * self._full_brake_mps2
        self._behind: Counter[str] = Counter()
        self.demand = NEUTRAL
        self.held_back: set[str] = set()
        self.engaged_ticks = 0
        self.held_back_ticks = 0
        self.limited: Counter[str] = Counter()
        self.last_limited: dict[str, Activation] = {}

    @property
    def steer_rad(self) -> float:
        """Road-wheel angle that is demanded [rad]."""
        return self.demand.steering_wheel_rad / self._vehicle.steering.ratio

    @property
    def acceleration_mps2(self) -> float:
        """What the pedals are asked for [m/s2]; negative brakes."""
        return self._acceleration_mps2(self.demand.accelerator_norm, self.demand.brake_norm)

    def drive_norm(self, accelerator_norm: float, brake_norm: float) -> float:
        """Drive demand that two pedal positions stand for; the inverse of the split."""
        return accelerator_norm - brake_norm * self._full_brake_mps2 / self._full_drive_mps2

    def pass_time(self, elapsed_ns: int) -> None:
        """Tell how long the last demand has stood [ns], for the rates; of more than a tick a tick counts, until told otherwise."""
        self._tick_s = clamp(elapsed_ns, self._tick_ns / 10, self._tick_ns) * 1e-9

    def release(self) -> None:
        """Ask for nothing."""
        self.demand = NEUTRAL
        self._behind.clear()

    def start_from(self, measured: Demand) -> None:
        """Take over from where the robots are, so that an engagement has no bump."""
        step_rad = self._resolution.steering_wheel_rad
        acceleration_mps2 = self._acceleration_mps2(measured.accelerator_norm, measured.brake_norm)
        pedals = self._split(acceleration_mps2, -self._full_brake_mps2, self._full_drive_mps2)
        self.demand = Demand(round(measured.steering_wheel_rad / step_rad) * step_rad, *pedals)
        self._behind.clear()

    def hold_still(self) -> None:
        """Keep a standing car standing, with the steering wheel where it is."""
        self._begin_tick()
        self._end_tick(self.demand.steering_wheel_rad, -self._profile.standstill_brake_norm * self._full_brake_mps2)

    def decelerate(self, steer_rad: float, deceleration_mps2: float, vx_mps: float, brake_norm: float) -> None:
        """Steer and slow down; `brake_norm` is the measured pedal."""
        self.follow(steer_rad, -deceleration_mps2 / self._full_drive_mps2, vx_mps, brake_norm)

    def follow(self, steer_rad: float, drive_norm: float, vx_mps: float, brake_norm: float) -> None:
        """Follow a command as far as the limits let it; `brake_norm` is the measured pedal."""
        self._begin_tick()
        steps = self._limit_steering(steer_rad * self._vehicle.steering.ratio, abs(vx_mps))
        acceleration_mps2 = drive_norm * self._full_drive_mps2
        if brake_norm >= BRAKE_RELEASED_NORM:
            acceleration_mps2 = min(acceleration_mps2, 0.0)  # interlock: the accelerator waits until the brake pedal has really come back
        self._end_tick(steps * self._resolution.steering_wheel_rad, acceleration_mps2)

    def _begin_tick(self) -> None:
        self.engaged_ticks += 1
        self.held_back.clear()

    def _end_tick(self, steering_wheel_rad: float, acceleration_mps2: float) -> None:
        self.demand = Demand(steering_wheel_rad, *self._limit_pedals(acceleration_mps2))
        self.held_back_ticks += bool(self.held_back)

    def _limit_steering(self, asked_rad: float, speed_mps: float) -> int:
        """Steering-wheel angle in steps of the bus."""
        step_rad = self._resolution.steering_wheel_rad
        before, target = round(self.demand.steering_wheel_rad / step_rad), self._bound_steering(asked_rad, speed_mps)
        limit_radps = self._profile.steering_wheel_rate_radps
        reach = limit_radps * self._tick_s / step_rad
        reached = _approach(before, target, before - reach, before + reach)
        per_s = step_rad / self._tick_s
        self._note(STEERING_RATE, (target - before) * per_s, limit_radps, (reached - before) * per_s)
        return self._limit_lateral_jerk(before, reached, speed_mps) if speed_mps >= STILL_MPS else reached

    def _bound_steering(self, asked_rad: float, speed_mps: float) -> int:
        """The nearest angle that is allowed when time does not count, in steps of the bus."""
        profile, ratio = self._profile, self._vehicle.steering.ratio
        end_rad = min(profile.steering_wheel_limit_rad, self._vehicle.steering.road_wheel_limit_rad * ratio)
        bounded_rad = clamp(asked_rad, -end_rad, end_rad)
        self._note(STEERING_ANGLE, asked_rad, end_rad, bounded_rad)
        if speed_mps >= STILL_MPS:
            limit_mps2, asked_mps2 = profile.lateral_acceleration_mps2, self._lateral_mps2(bounded_rad, speed_mps)
            given_mps2 = clamp(asked_mps2, -limit_mps2, limit_mps2)
            self._note(LATERAL_ACCELERATION, asked_mps2, limit_mps2, given_mps2)
            end_rad = min(end_rad, road_wheel_rad(limit_mps2, self._wheelbase_m, speed_mps) * ratio)
        return steps_within(bounded_rad, -end_rad, end_rad, self._resolution.steering_wheel_rad)

    def _limit_lateral_jerk(self, before: int, target: int, speed_mps: float) -> int:
        limit_mps3, step_rad = self._profile.lateral_jerk_mps3, self._resolution.steering_wheel_rad
        before_mps2, reach_mps2 = self._lateral_mps2(before * step_rad, speed_mps), limit_mps3 * self._tick_s
        low, high = (
            road_wheel_rad(bound_mps2, self._wheelbase_m, speed_mps) * self._vehicle.steering.ratio / step_rad
            for bound_mps2 in (before_mps2 - reach_mps2, before_mps2 + reach_mps2)
        )
        reached = _approach(before, target, low, high)
        asked_mps2, given_mps2 = (self._lateral_mps2(steps * step_rad, speed_mps) for steps in (target, reached))
        self._note(LATERAL_JERK, (asked_mps2 - before_mps2) / self._tick_s, limit_mps3, (given_mps2 - before_mps2) / self._tick_s)
        return reached

    def _lateral_mps2(self, steering_wheel_rad: float, speed_mps: float) -> float:
        return lateral_acceleration_mps2(steering_wheel_rad / self._vehicle.steering.ratio, self._wheelbase_m, speed_mps)

    def _limit_pedals(self, asked_mps2: float) -> tuple[float, float]:
        """Accelerator and brake pedal."""
        before_mps2, target_mps2 = self.acceleration_mps2, self._bound_acceleration(asked_mps2)
        drive_mps2, brake_mps2 = self._profile.drive_jerk_mps3 * self._tick_s, self._profile.brake_jerk_mps3 * self._tick_s
        low_mps2 = min(before_mps2, 0.0) - brake_mps2
        high_mps2 = min(before_mps2 + brake_mps2, 0.0) if before_mps2 < 0.0 else before_mps2 + drive_mps2
        for name, bound_mps2, reached_mps2 in (
            (DRIVE_JERK, high_mps2, min(target_mps2, high_mps2)),
            (BRAKE_JERK, low_mps2, max(target_mps2, low_mps2)),
        ):
            self._note(name, *((value_mps2 - before_mps2) / self._tick_s for value_mps2 in (target_mps2, bound_mps2, reached_mps2)))
        return self._split(clamp(target_mps2, low_mps2, high_mps2), low_mps2, high_mps2)

    def _bound_acceleration(self, asked_mps2: float) -> float:
        """The nearest acceleration that is allowed when time does not count, on steps of the bus."""
        top_mps2 = min(self._profile.acceleration_mps2, self._full_drive_mps2)
        bottom_mps2 = -min(self._profile.deceleration_mps2, self._full_brake_mps2)
        driven_mps2 = min(asked_mps2, top_mps2)
        self._note(ACCELERATION, asked_mps2, top_mps2, driven_mps2)
        bounded_mps2 = max(driven_mps2, bottom_mps2)
        self._note(DECELERATION, driven_mps2, bottom_mps2, bounded_mps2)
        return self._acceleration_mps2(*self._split(bounded_mps2, bottom_mps2, top_mps2))

    def _acceleration_mps2(self, accelerator_norm: float, brake_norm: float) -> float:
        return accelerator_norm * self._full_drive_mps2 - brake_norm * self._full_brake_mps2

    def _split(self, acceleration_mps2: float, low_mps2: float, high_mps2: float) -> tuple[float, float]:
        """Accelerator or brake for an acceleration, on steps of the bus within [low, high]."""
        drive_mps2, lowest_mps2, highest_mps2 = (max(value, 0.0) for value in (acceleration_mps2, low_mps2, high_mps2))
        brake_mps2, weakest_mps2, firmest_mps2 = (max(-value, 0.0) for value in (acceleration_mps2, high_mps2, low_mps2))
        return (
            steps_within(drive_mps2, lowest_mps2, highest_mps2, self._drive_step_mps2) * self._resolution.accelerator_norm,
            steps_within(brake_mps2, weakest_mps2, firmest_mps2, self._brake_step_mps2) * self._resolution.brake_norm,
        )

    def _note(self, name: str, asked: float, limit: float, given: float) -> None:
        """Keep account of a limit in this tick."""
        if asked == given:
            self._behind[name] = 0
            return
        self._behind[name] += 1
        self.limited[name] += 1
        self.last_limited[name] = Activation(self.engaged_ticks, asked, limit, given)
        if name not in _RATES or self._behind[name] * self._tick_ns >= PLAN_PERIOD_NS:
            self.held_back.add(name)


def _approach(before: int, target: int, low: float, high: float) -> int:
    """As far from `before` to `target` as [low, high] allows, in steps of the bus; one step is always allowed."""
    return min(max(target, min(steps_up(low, 1.0), before - 1)), max(steps_down(high, 1.0), before + 1))
