"""The steering wheel of plants that have no steering column of their own: an inertia with a position servo and a driver's hands.

While its torque suffices the servo is a linear second-order system of the bandwidth and the damping of the robot, and is solved
exactly. It makes up for everything that resists, the driver's torque included, up to its own limit; then whoever is stronger wins.
A wheel that nobody holds returns to the centre slowly.
"""

import math

from dbc.vehicle import Vehicle
from vehicle_emulator.actuators import second_order_transition
from vehicle_emulator.plants.interface import SteeringInputs

_INERTIA_KGM2 = 0.05
"""Assumption: steering wheel, robot and column, with the road wheels as they are seen from there."""
_DAMPING_NMS = 2.0
"""Assumption: 10 Nm turn a wheel without robot by almost 5 rad/s."""
_CENTRING_RADPS = 1.0
"""Assumption: rate at which a released wheel returns."""
_CENTRED_RAD = 0.05
"""Closer to the centre than this, the centring torque is proportional to the angle."""


class SteeringWheel:
    """The steering wheel and what turns it.

    Args:
        vehicle: bandwidth and damping ratio of its steering robot, and how far its wheel turns.
        period_s: time of a step.

    Attributes:
        angle_rad, rate_radps: left positive.
        robot_nm: torque of the robot over the last step.
    """

    def __init__(self, vehicle: Vehicle, period_s: float) -> None:
        robot = vehicle.robots.steering
        self._period_s = period_s
        self._limit_rad = vehicle.steering.ratio * vehicle.steering.road_wheel_limit_rad
        self._transition = second_order_transition(2.0 * math.pi * robot.bandwidth_hz, robot.damping_ratio, period_s)
        self.angle_rad = 0.0
        self.rate_radps = 0.0
        self.robot_nm = 0.0

    def step(self, inputs: SteeringInputs) -> None:
        """Turn for one period, the demand held."""
        period_s, rate_radps = self._period_s, self.rate_radps
        centring = min(max(self.angle_rad / _CENTRED_RAD, -1.0), 1.0)
        outside_nm = inputs.driver_torque_nm - _DAMPING_NMS * (rate_radps + _CENTRING_RADPS * centring)
        wanted_rad, wanted_radps = self._wanted(inputs)
        robot_nm = _INERTIA_KGM2 * (wanted_radps - rate_radps) / period_s - outside_nm
        limit_nm = inputs.torque_limit_nm
        self.robot_nm = min(max(robot_nm, -limit_nm), limit_nm)
        if self.robot_nm == robot_nm:
            self.angle_rad, self.rate_radps = wanted_rad, wanted_radps
        else:
            self.rate_radps += period_s * (self.robot_nm + outside_nm) / _INERTIA_KGM2
            self.angle_rad += 0.5 * period_s * (rate_radps + self.rate_radps)
        if abs(self.angle_rad) > self._limit_rad:
            self.angle_rad = math.copysign(self._limit_rad, self.angle_rad)
            self.rate_radps = 0.0

    def _wanted(self, inputs: SteeringInputs) -> tuple[float, float]:
        """Angle and rate at the end of the period with torque enough."""
        from_error, from_rate, rate_from_error, rate_from_rate = self._transition
        error_rad = self.angle_rad - inputs.demand_rad
        return (
            inputs.demand_rad + from_error * error_rad + from_rate * self.rate_radps,
            rate_from_error * error_rad + rate_from_rate * self.rate_radps,
        )
