"""Steering: one degree of freedom, the angle theta of the steering wheel, with all that turns with it.

    J theta'' = T_robot + T_driver - T_friction - T_stop + (1 - assist) T_road / i + T_gyro
    T_robot = clip(J (w_0^2 (demand - theta) - 2 zeta w_0 theta') - T_believed, +- limit)
    T_believed' = w_r (J theta'' - T_robot - T_believed)

Alone, theta follows the demand as w_0^2 / (s^2 + 2 zeta w_0 s + w_0^2). T_believed is a disturbance observer, which stands for the
integral action of the robot's position loop: what resists for longer than 1 / w_r costs no accuracy, and nothing winds up while the
robot is at its limit or has let go. T_road is the moment of the front tyres about their steering
axes. T_gyro is what a spinning wheel does to its steering when the body turns, the counterpart of what it does to the body when it is
steered. Left is positive.
"""

import math

import casadi as ca

from dbc.multibody import SteeringColumn
from vehicle_emulator.plants.multibody.bristle import Bristle
from vehicle_emulator.plants.multibody.layout import SX

COLUMN_BRISTLE = Bristle(way=0.01, way_s=0.02, damping_s=0.005)
"""Assumption: the column gives way by 0.6 degrees before it slips."""


def wheel_direction(angle_rad: SX, ackermann: SX) -> tuple[SX, SX, SX]:
    """Cosine, sine and derivative by `angle_rad` of a front wheel's angle.

    Args:
        angle_rad: on the car's centre line.
        ackermann: y / wheelbase of the wheel, times the share of Ackermann's law; the centre of turn is where he put it.
    """
    cosine, sine = ca.cos(angle_rad) - ackermann * ca.sin(angle_rad), ca.sin(angle_rad)
    squared = cosine * cosine + sine * sine
    length = ca.sqrt(squared)
    return cosine / length, sine / length, 1.0 / squared


def robot_nm(
    p: SteeringColumn, *, bandwidth_hz: SX, damping_ratio: SX, error_rad: SX, rate_radps: SX, resistance_nm: SX, limit_nm: SX
) -> SX:  # fmt: skip
    """Torque of the robot's position servo."""
    pole_radps = 2.0 * math.pi * bandwidth_hz
    wanted_nm = p.inertia_kgm2 * (pole_radps**2 * error_rad - 2.0 * damping_ratio * pole_radps * rate_radps) - resistance_nm
    return ca.fmin(ca.fmax(wanted_nm, -limit_nm), limit_nm)


def resistance_rate(bandwidth_hz: SX, others_nm: SX, resistance_nm: SX) -> SX:
    """Derivative of what the robot believes that turns the wheel besides itself [Nm/s]; `others_nm` is what really does."""
    return 2.0 * math.pi * bandwidth_hz * (others_nm - resistance_nm)


def stop_nm(p: SteeringColumn, angle_rad: SX, limit_rad: SX) -> SX:
    """Torque of the end stops against the steering wheel."""
    beyond_rad = angle_rad - ca.fmin(ca.fmax(angle_rad, -limit_rad), limit_rad)
    return p.stop_nmprad2 * beyond_rad * ca.fabs(beyond_rad)
