"""Steering robot (SR): from a command to a demand for the steering column, whose servo is the robot's.

    AnglePosition   follows AngleCommand at RateLimit; TorqueFeedForward is added to the torque
    AngleRate       the same: turns towards AngleCommand at the rate RateLimit
    Torque          applies TorqueFeedForward

Torque is limited to the least of TorqueLimit and its own limit, the angle to what it has learned of the car. In a stop it holds
the wheel where its demand was, while its torque fades out; then the wheel is free, and the tyres centre it. A frozen steering angle
would be right in a long bend and wrong in a lane change. Whenever it is released or overridden, it lets go at once.
"""

import math
from random import Random

from dbc.catalogue import Catalogue
from dbc.robots import SteeringRobot as SteeringRobotParameters
from vehicle_emulator.actuators import Backlash, DeadTime, MotionProfile, PositionSensor, quantised
from vehicle_emulator.driver import Driver
from vehicle_emulator.plants.interface import PlantState, SteeringInputs
from vehicle_emulator.robots.receiver import Values
from vehicle_emulator.robots.robot import FREE, Robot, View, limits_hit

_SATURATING_RAD = 100.0
"""An error that drives every servo into its torque limit, which then is the torque."""
_LIMIT_SHARE = 0.99
"""Share of the torque limit from which it counts as reached."""


class SteeringRobot(Robot):
    """Turns the steering wheel.

    Args:
        inertia_kgm2: of all that turns with the steering wheel; makes a torque feed-forward a shift of the demand.
    """

    def __init__(
        self, catalogue: Catalogue, parameters: SteeringRobotParameters, inertia_kgm2: float, period_s: float, random: Random
    ) -> None:
        super().__init__(catalogue, "SR", parameters, ("AnglePosition", "AngleRate", "Torque"), period_s)
        p = self._p = parameters
        self._stiffness_nmprad = inertia_kgm2 * (2.0 * math.pi * p.bandwidth_hz) ** 2
        self._dead_time = DeadTime(period_s, p.dead_time_s, p.dead_time_jitter_s, random)
        self._profile = MotionProfile(period_s, p.acceleration_limit_radps2)
        self._lash = Backlash(p.play_rad)
        self._sensor = PositionSensor(p.resolution_rad, p.noise_rad, random)
        self._end_rad = min(p.learned_range_rad, p.range_rad)
        self._hold_rad = 0.0
        self._feedback = PlantState()
        self._fading_from_nm = 0.0
        self._fading_since_ns: int | None = None
        self._stuck_at_rad: float | None = None
        self._values: Values = {}
        self._command_rad = self._rate_limit_radps = 0.0

    def step(self, view: View, feedback: PlantState, driver: Driver) -> SteeringInputs:
        """Decide and move for one period."""
        self._feedback = feedback
        error_rad = self._profile.position - feedback.steering_wheel_rad
        is_astray = abs(error_rad) > self._p.following_error_rad and self.mode != "Torque"
        self._update(view, is_astray, abs(driver.steering_torque_nm) > self._p.override_nm)
        is_at_end = False
        is_engaged = self.is_engaged
        if not is_engaged:
            demand_rad, limit_nm = (self._hold_rad, self._faded_nm(view.now_ns)) if self._stops(view) else (self._release(), 0.0)
        else:
            demand_rad, limit_nm, is_at_end = self._torque() if self.mode == "Torque" else self._position()
            self._fading_from_nm, self._fading_since_ns = limit_nm, None
        demand_rad, limit_nm = self._as_broken(demand_rad, limit_nm)
        if is_engaged:
            is_at_torque = 0.0 < _LIMIT_SHARE * limit_nm <= abs(feedback.steering_robot_nm)
            self.limits_hit = limits_hit(is_at_end, self._profile.is_at_rate_limit, is_at_torque)
        else:
            self.limits_hit = FREE
        return SteeringInputs(demand_rad, limit_nm, driver.steering_torque_nm)

    def _position(self) -> tuple[float, float, bool]:
        """Demand, torque limit, and whether the command is beyond the learned end."""
        p, values, slow = self._p, self.command.values, self.faults.slow_factor
        if values is not self._values:
            self._values = values
            self._command_rad = math.radians(values["AngleCommand"])
            self._rate_limit_radps = min(math.radians(values["RateLimit"]), p.rate_limit_radps)
        wanted_rad = self._command_rad + self.faults.offset
        clipped_rad = min(max(wanted_rad, -self._end_rad), self._end_rad)
        delayed_rad = quantised(self._dead_time.step(clipped_rad), p.resolution_rad)
        profile_rad = self._profile.step(delayed_rad, slow * self._rate_limit_radps, slow)
        before_rad, self._hold_rad = self._hold_rad, self._lash.step(profile_rad)
        # The column holds a demand for one period: it gets the mean.
        demand_rad = 0.5 * (before_rad + self._hold_rad) + values["TorqueFeedForward"] / self._stiffness_nmprad
        return demand_rad, min(values["TorqueLimit"], p.torque_limit_nm), clipped_rad != wanted_rad

    def _torque(self) -> tuple[float, float, bool]:
        self._release()
        torque_nm = self.command.values["TorqueFeedForward"]
        limit_nm = min(abs(torque_nm), self.command.values["TorqueLimit"], self._p.torque_limit_nm)
        return self._feedback.steering_wheel_rad + math.copysign(_SATURATING_RAD, torque_nm), limit_nm, False

    def _faded_nm(self, now_ns: int) -> float:
        if self._fading_since_ns is None:
            self._fading_since_ns = now_ns
        elapsed_s = (now_ns - self._fading_since_ns) * 1e-9
        return self._fading_from_nm * max(0.0, 1.0 - elapsed_s / self._p.ramp_out_s)

    def _release(self) -> float:
        """Follow the wheel, so that an engagement begins where it is."""
        angle_rad, rate_radps = self._feedback.steering_wheel_rad, self._feedback.steering_wheel_rate_radps
        self._dead_time.reset(angle_rad)
        self._profile.reset(angle_rad, rate_radps)
        self._lash.reset(angle_rad)
        self._hold_rad, self._fading_from_nm = angle_rad, 0.0
        return angle_rad

    def _as_broken(self, demand_rad: float, limit_nm: float) -> tuple[float, float]:
        if not self.faults.is_stuck:
            self._stuck_at_rad = None
        elif self._stuck_at_rad is None:
            self._stuck_at_rad = self._feedback.steering_wheel_rad
        if self.faults.drops_torque:
            return demand_rad, 0.0
        return (demand_rad, limit_nm) if self._stuck_at_rad is None else (self._stuck_at_rad, self._p.torque_limit_nm)

    @property
    def effort(self) -> float:
        """See `Robot`."""
        return abs(self._feedback.steering_robot_nm) / self._p.torque_limit_nm

    def status(self) -> dict[str, float]:
        """See `Robot`."""
        return self._common_status() | {
            "AngleActual": math.degrees(self._sensor.read(self._feedback.steering_wheel_rad)),
            "RateActual": math.degrees(self._feedback.steering_wheel_rate_radps),
            "TorqueActual": self._feedback.steering_robot_nm,
            "LimitAngle": self.limits_hit.is_position,
            "LimitTorque": self.limits_hit.is_force,
        }
