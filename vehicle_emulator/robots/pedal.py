"""Accelerator robot (AR) and brake robot (BR): from a command to a pedal position and a force.

    Position               follows PositionCommand at RateLimit
    PositionForceLimited   the same
    Force                  presses with ForceCommand

The pedal's spring decides how far the least of ForceLimit and the robot's own limit can press it. Released, a robot retracts as fast
as it can. In a stop AR retracts and BR presses with its stop force, also at standstill. The driver's foot can press deeper.
"""

from random import Random

from dbc.catalogue import Catalogue
from dbc.robots import PedalRobot as PedalRobotParameters
from vehicle_emulator.actuators import DeadTime, MotionProfile, PedalSpring, PositionSensor, Servo, quantised
from vehicle_emulator.robots.receiver import Values
from vehicle_emulator.robots.robot import Robot, View, limits_hit

_RESTING_NORM = 1e-4
"""A pedal that comes back and is as close as this to its rest is there."""
_FRICTION_PER_S = 0.05
"""Speed at which the pedal's friction is all there."""


class PedalRobot(Robot):
    """Presses one pedal; positions are shares of the learned stroke.

    Args:
        node: "AR" or "BR".
        stop_force_n: force in a stop; 0 retracts.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        node: str,
        parameters: PedalRobotParameters,
        *,
        period_s: float,
        random: Random,
        stop_force_n: float = 0.0,
    ) -> None:
        super().__init__(catalogue, node, parameters, ("Position", "PositionForceLimited", "Force"), period_s)
        p = self._p = parameters
        self._period_s = period_s
        self._spring = PedalSpring(p.preload_n, p.full_stroke_n, p.friction_n)
        self._stop_norm = self._spring.position_norm(stop_force_n)
        self._strongest_norm = self._spring.position_norm(p.force_limit_n)
        self._dead_time = DeadTime(period_s, p.dead_time_s, p.dead_time_jitter_s, random)
        self._profile = MotionProfile(period_s, p.acceleration_limit_per_s2)
        self._servo = Servo(period_s, p.bandwidth_hz, p.damping_ratio)
        self._sensor = PositionSensor(p.resolution_norm, p.noise_norm, random)
        self._foot_norm = 0.0
        self._was_stuck = False
        self._values: Values = {}
        self._rate_limit_per_s, self._reachable_norm = p.rate_limit_per_s, self._strongest_norm

    @property
    def position_norm(self) -> float:
        """Where the robot is; 0 is retracted."""
        return self._servo.position

    def demand_norm(self, view: View) -> float:
        """Position wanted by the newest command or by a stop, before all limits; as of the last step."""
        if self._stops(view):
            return self._stop_norm
        if not self.is_engaged:
            return 0.0
        values = self.command.values
        if self.mode == "Force":
            return self._spring.position_norm(values["ForceCommand"])
        return 0.01 * values["PositionCommand"]

    def decide(self, view: View, foot_norm: float) -> None:
        """Decide on the state, before any robot moves."""
        self._foot_norm = foot_norm
        position_norm = self._servo.position
        is_astray = abs(self._profile.position - position_norm) > self._p.following_error_norm
        self._update(view, is_astray, foot_norm - position_norm > self._p.override_norm)

    def move(self, view: View, demand_norm: float) -> float:
        """Move for one period and return where the pedal is."""
        p, faults, is_following = self._p, self.faults, self.is_engaged
        if is_following:
            rate_limit_per_s, reachable_norm = self._commanded_limits()
            demand_norm += faults.offset
        else:
            rate_limit_per_s, reachable_norm = p.rate_limit_per_s, self._strongest_norm
        clipped_norm = min(max(demand_norm, 0.0), 1.0)
        delayed_norm = quantised(self._dead_time.step(min(clipped_norm, reachable_norm)), p.resolution_norm)
        if self._was_stuck and not faults.is_stuck:
            self._profile.reset(self._servo.position)
        before_norm, self._was_stuck = self._profile.position, faults.is_stuck
        target_norm = self._profile.step(delayed_norm, faults.slow_factor * rate_limit_per_s, faults.slow_factor)
        if faults.is_stuck:
            self._servo.reset(self._servo.position)
        elif target_norm or self._servo.position:
            self._drive(*((0.0, 0.0) if self.has_let_go else (target_norm, (target_norm - before_norm) / self._period_s)))
        is_at_rate = is_following and self._profile.is_at_rate_limit
        self.limits_hit = limits_hit(clipped_norm != demand_norm, is_at_rate, clipped_norm > reachable_norm)
        return max(self._servo.position, self._foot_norm)

    def _commanded_limits(self) -> tuple[float, float]:
        """Largest speed, and how far the force reaches, by the command and by its own limits."""
        p, values = self._p, self.command.values
        if values is not self._values:
            self._values = values
            self._rate_limit_per_s = min(1e-3 * values["RateLimit"] / p.stroke_m, p.rate_limit_per_s)
            self._reachable_norm = self._spring.position_norm(min(values["ForceLimit"], p.force_limit_n))
        return self._rate_limit_per_s, self._reachable_norm

    def _drive(self, target_norm: float, target_rate_per_s: float) -> None:
        position_norm = self._servo.step(target_norm, target_rate_per_s, self.faults.slow_factor)
        self._servo.stop_at(0.0, 1.0)
        if max(target_norm, position_norm) < _RESTING_NORM:
            self._servo.reset(0.0)

    @property
    def _force_n(self) -> float:
        """What its load cell measures: nothing when the foot has taken the pedal away, or without torque."""
        if self._foot_norm > self.position_norm or self.has_let_go:
            return 0.0
        return self._spring.force_n(self.position_norm, min(max(self._servo.rate / _FRICTION_PER_S, -1.0), 1.0))

    @property
    def effort(self) -> float:
        """See `Robot`."""
        return self._force_n / self._p.force_limit_n

    def status(self) -> dict[str, float]:
        """See `Robot`."""
        measured_norm = min(max(self._sensor.read(self.position_norm), 0.0), 1.0)
        return self._common_status() | {
            "PositionActual": 100.0 * measured_norm,
            "PositionStroke": 1e3 * self._p.stroke_m * measured_norm,
            "ForceActual": self._force_n,
            "LimitPosition": self.limits_hit.is_position,
            "LimitForce": self.limits_hit.is_force,
        }
