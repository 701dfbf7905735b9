"""Body and suspension: six degrees of freedom of the sprung body, four of the wheels on slanted axes.

Wheel i is a point mass at r_i = r_i0 + q_i d_i in the body frame, with a constant axis d_i = (s, 2 h_rc / t, 1) to the left and
(s, -2 h_rc / t, 1) to the right. The axis is the whole kinematics of the suspension: a lateral force has the share 2 h_rc / t along
it and so passes by the spring, which is what a roll centre at height h_rc means, and s does the same for lengthwise forces.

With V and w the velocity and the rates of the body, F_i and M_i what the road does to wheel i, and Q_i what acts along d_i:

    a_i = J_i nu' + b_i + q_i'' d_i,  J_i = [1, -[r_i]x],  nu' = (V', w'),  b_i = w x V + w x (w x r_i) + 2 w x d_i q_i'
    m_i d_i . (a_i - g) = Q_i                                                                                 (each wheel)
    m_s (V' + w x V - g) + sum m_i (a_i - g) = F                                                              (whole car)
    I w' + w x I w + sum r_i x m_i (a_i - g) + d/dt sum H_i = M                                               (whole car)

H_i is the angular momentum of the spinning wheel. The first line gives q_i''; put into the others it leaves

    (M_s + sum m_i J_i' P_i J_i) nu' = ...,  P_i = 1 - d_i d_i' / d_i . d_i,

symmetric and positive definite: factored as L D L' without pivots. Source: Newton and Euler; no further model enters.
"""

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca

from dbc.multibody import Axle, Masses, MultibodyParameters
from vehicle_emulator.plants.interface import GRAVITY_MPS2
from vehicle_emulator.plants.multibody.layout import SX, State

LEFT_RIGHT = (1.0, -1.0, 1.0, -1.0)
"""Side of each wheel, along y."""


class Design(NamedTuple):
    """The car as it stands on a level road, in the body frame.

    Args:
        reference_m, height_m: centre of gravity of the whole car, and its height over the road.
        hubs_m, axes: r_i0 and d_i.
        loads_n: on the road.
    """

    sprung_kg: SX
    reference_m: SX
    height_m: SX
    hubs_m: list[SX]
    axes: list[SX]
    loads_n: list[SX]


class Drives(NamedTuple):
    """What acts on the car: along the axis of each wheel (Q_i), and in sum: F without weight, M less d/dt sum H_i, and g.

    All in the body frame.
    """

    wheels_n: list[SX]
    force_n: SX
    moment_nm: SX
    gravity_mps2: SX


def axles(p: MultibodyParameters) -> tuple[Axle, Axle, Axle, Axle]:
    """The axle of each wheel."""
    return p.front, p.front, p.rear, p.rear


def design(p: MultibodyParameters) -> Design:
    """Where everything is in the design position."""
    masses, wheelbase_m = p.masses, p.masses.cog_to_front_m + p.masses.cog_to_rear_m
    shares = (masses.cog_to_rear_m,) * 2 + (masses.cog_to_front_m,) * 2
    loads_n = [0.5 * masses.mass_kg * GRAVITY_MPS2 * share / wheelbase_m for share in shares]
    along_m = (masses.cog_to_front_m,) * 2 + (-masses.cog_to_rear_m,) * 2
    hubs_m = [
        ca.vertcat(x_m, 0.5 * side * axle.track_m, p.tyre.radius_m - load_n / p.tyre.stiffness_npm - masses.cog_height_m)
        for x_m, side, axle, load_n in zip(along_m, LEFT_RIGHT, axles(p), loads_n, strict=True)
    ]  # from the centre of gravity of the whole car, of which the sprung one balances the wheels
    sprung_kg = masses.mass_kg - 2.0 * (p.front.wheel_kg + p.rear.wheel_kg)
    reference_m = sum(axle.wheel_kg * hub_m for axle, hub_m in zip(axles(p), hubs_m, strict=True)) / sprung_kg
    return Design(
        sprung_kg,
        reference_m,
        masses.cog_height_m,
        [hub_m + reference_m for hub_m in hubs_m],
        [ca.vertcat(a.hub_slope, side * 2.0 * a.roll_centre_m / a.track_m, 1.0) for a, side in zip(axles(p), LEFT_RIGHT, strict=True)],
        loads_n,
    )


def hub_m(at: Design, x: State, i: int) -> SX:
    """r_i, where the hub of a wheel is."""
    return at.hubs_m[i] + x.travel_m[i] * at.axes[i]


def rotation(quaternion: SX) -> SX:
    """Matrix from the body to the local frame, shape (3, 3); a rotation whatever the length of the quaternion."""
    scalar, vector = quaternion[0], quaternion[1:]
    double = 2.0 / ca.sumsqr(quaternion)
    return ca.DM.eye(3) + double * (scalar * ca.skew(vector) + ca.skew(vector) @ ca.skew(vector))


def attitude_rate(quaternion: SX, rates_radps: SX) -> SX:
    """Derivative of the quaternion: half its product with (0, w)."""
    scalar, vector = quaternion[0], quaternion[1:]
    return 0.5 * ca.vertcat(-ca.dot(vector, rates_radps), scalar * rates_radps + ca.cross(vector, rates_radps))


def struts_n(p: MultibodyParameters, at: Design, x: State) -> list[SX]:
    """Force that spring, anti-roll bar, damper and stops push each wheel down with, along its axis."""
    forces_n = []
    for i, axle in enumerate(axles(p)):
        inwards_m, inwards_mps, other_m = x.travel_m[i], x.travel_mps[i], x.travel_m[i ^ 1]
        preload_n = at.loads_n[i] - axle.wheel_kg * GRAVITY_MPS2
        springs_n = axle.spring_npm * inwards_m + 0.5 * axle.anti_roll_npm * (inwards_m - other_m)
        damper_n = axle.bump_nspm * ca.fmax(inwards_mps, 0.0) + axle.rebound_nspm * ca.fmin(inwards_mps, 0.0)
        bumped_m, drooped_m = ca.fmax(inwards_m - axle.bump_travel_m, 0.0), ca.fmin(inwards_m + axle.droop_travel_m, 0.0)
        forces_n.append(preload_n + springs_n + damper_n + axle.stop_npm2 * (bumped_m**2 - drooped_m**2))
    return forces_n


def inertia(masses: Masses) -> SX:
    """Moments of inertia of the sprung body; its axes are principal axes."""
    return ca.diag(ca.vertcat(masses.sprung_roll_inertia_kgm2, masses.sprung_pitch_inertia_kgm2, masses.sprung_yaw_inertia_kgm2))


def accelerations(p: MultibodyParameters, at: Design, x: State, hubs_m: Sequence[SX], drives: Drives) -> tuple[SX, list[tuple[SX, SX]]]:
    """nu' of the body, shape (6,), and for each wheel (u, v) with q'' = u + v . nu'; a car on the lift has nu' = 0.

    Args:
        hubs_m: r_i.
    """
    rates_radps, gravity, tensor = x.rates_radps, drives.gravity_mps2, inertia(p.masses)
    spinning = ca.cross(rates_radps, x.velocity_mps)
    matrix = ca.diagcat(at.sprung_kg * ca.DM.eye(3), tensor)
    right = ca.vertcat(
        drives.force_n - at.sprung_kg * (spinning - gravity),
        drives.moment_nm - ca.cross(rates_radps, tensor @ rates_radps),
    )
    wheels = []
    for i, (axle, hub_m, axis) in enumerate(zip(axles(p), hubs_m, at.axes, strict=True)):
        jacobian = ca.horzcat(ca.DM.eye(3), -ca.skew(hub_m))
        bias = spinning + ca.cross(rates_radps, ca.cross(rates_radps, hub_m) + 2.0 * x.travel_mps[i] * axis) - gravity
        squared = ca.dot(axis, axis)
        across = jacobian - axis @ ((axis.T @ jacobian) / squared)
        push_n = drives.wheels_n[i] / squared
        matrix += axle.wheel_kg * (jacobian.T @ across)
        right -= axle.wheel_kg * (across.T @ bias) + push_n * (jacobian.T @ axis)
        wheels.append((push_n / axle.wheel_kg - ca.dot(axis, bias) / squared, -(jacobian.T @ axis) / squared))
    diagonal, factor, order = ca.ldl(matrix, False)
    return ca.ldl_solve(right, diagonal, factor, order), wheels
