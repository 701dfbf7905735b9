"""Tyre: Magic Formula with load dependence and combined slip, relaxation, valid at standstill.

Forces: PAC2002, the Magic Formula of the ADAMS/Tire help and of Pacejka, Tire and Vehicle Dynamics, chapter 4, without camber and
without the shifts of plysteer and conicity, so that left and right are mirror images. Signs: a positive slip gives a positive force,
slip_x = -V_sx / |V_x| and slip_y = -V_sy / |V_x| when they do not change.

Relaxation and standstill, the same book, chapters 7 and 8: slips are states,

    sigma slip' + (|V_x| + |V_s| s^4) slip = -V_s,    s^2 = slip_x^2 + slip_y^2,

so that a standing tyre is a spring of stiffness K / sigma. The term in s^4 is ours: nothing within the grip of the tyre, it bounds
what a tyre winds up that slides without rolling. The spring is damped by the slip velocity entering the formula beside the slip, with
a factor that fades out with speed; whatever the damper wants, the formula limits to what the road can hold.
"""

import math
from typing import NamedTuple

import casadi as ca

from dbc.multibody import MagicFormula, Tyre
from vehicle_emulator.plants.multibody.layout import SX

_MAX_OVERLOAD = 1.5
"""Loads beyond 2.5 times the nominal one have the coefficients of that load."""
_LEAST_FRICTION = 0.01
_MAX_DEFLECTION = 0.5
"""Share of the radius; a tyre does not get thinner."""
_MAX_SLIDING = 4.0
"""Bound of s^4: without it the tyre of a car that tumbles is stiff."""


class Contact(NamedTuple):
    """Where and how a tyre touches the road; vectors in the body frame.

    Args:
        forward, left, normal: axes of the contact patch.
        radius_m: height of the hub over the road, not more than that of a free tyre.
        rolling_mps: V_x, speed of the hub along `forward`.
        slide_x_mps, slide_y_mps: V_sx, V_sy, velocity of the tread on the road.
    """

    forward: SX
    left: SX
    normal: SX
    radius_m: SX
    load_n: SX
    rolling_mps: SX
    slide_x_mps: SX
    slide_y_mps: SX


class Forces(NamedTuple):
    """Force of the road on the tyre along the axes of its contact patch, and its moment about the normal."""

    x_n: SX
    y_n: SX
    aligning_nm: SX


def contact(
    p: Tyre, *, axle: SX, normal: SX, height_m: SX, hub_mps: SX, rates_radps: SX, spin_radps: SX, load_share: SX
) -> Contact:  # fmt: skip
    """The contact of a wheel with the plane of the road under it.

    Args:
        axle: unit vector along the wheel's axis, to the left; `normal`: that of the road.
        height_m: distance of the hub from the plane.
        hub_mps: velocity of the hub.
        load_share: 0 for a car on the lift.
    """
    across = ca.cross(axle, normal)
    forward = across / ca.sqrt(ca.dot(across, across) + 1e-9)
    left = ca.cross(normal, forward)
    deflection_m = ca.fmin(ca.fmax(p.radius_m - height_m, 0.0), _MAX_DEFLECTION * p.radius_m)
    radius_m = p.radius_m - deflection_m
    push_n = p.stiffness_npm * deflection_m - p.damping_nspm * ca.dot(normal, hub_mps)
    load_n = load_share * ca.fmax(push_n, 0.0) * (deflection_m > 0.0)
    rolling_mps = ca.dot(forward, hub_mps)
    # The belt rolls on a radius between the free and the loaded one; spin is against the ground, so that V_sx has no pitch rate.
    slide_x_mps = rolling_mps - (p.radius_m - deflection_m / 3.0) * spin_radps
    slide_y_mps = ca.dot(left, hub_mps - radius_m * ca.cross(rates_radps, normal))
    return Contact(forward, left, normal, radius_m, load_n, rolling_mps, slide_x_mps, slide_y_mps)


def forces(p: Tyre, at: Contact, friction: SX, slip_x: SX, slip_y: SX) -> Forces:
    """Forces of the relaxed slips, with the damping of a standing tyre.

    Args:
        friction: of the road, a factor on that of the tyre.
    """
    f = p.formula
    overload = ca.fmin(at.load_n / f.nominal_load_n - 1.0, _MAX_OVERLOAD)
    grip = p.friction * ca.fmax(friction, _LEAST_FRICTION)
    stiffness_x, stiffness_y = _stiffness_x(f, overload), _stiffness_y(f, at.load_n)
    standing = 0.5 * (1.0 + ca.cos(math.pi * ca.fmin(ca.fabs(at.rolling_mps) / p.standstill_mps, 1.0)))
    damping_sPm = standing * p.standstill_damping_nspm / f.nominal_load_n
    slip_x -= damping_sPm / stiffness_x * at.slide_x_mps
    slip_y -= damping_sPm / stiffness_y * at.slide_y_mps
    peak_x = grip * (f.p_dx1 + f.p_dx2 * overload)
    peak_y = grip * (f.p_dy1 + f.p_dy2 * overload)
    curvature_x = ca.fmin(f.p_ex1 + f.p_ex2 * overload + f.p_ex3 * overload**2, 1.0)
    curvature_y = f.p_ey1 + f.p_ey2 * overload
    x_n = at.load_n * _magic(slip_x, stiffness_x, f.p_cx1, peak_x, curvature_x)
    y_n = at.load_n * _magic(slip_y, stiffness_y, f.p_cy1, peak_y, curvature_y)
    x_n *= _weight(slip_y, f.r_bx1 / ca.sqrt(1.0 + (f.r_bx2 * slip_x) ** 2), f.r_cx1, f.r_ex1)
    y_n *= _weight(slip_x, f.r_by1 / ca.sqrt(1.0 + (f.r_by2 * slip_y) ** 2), f.r_cy1, f.r_ey1)
    return Forces(x_n, y_n, -_trail_m(p, at.load_n, overload, slip_y) * y_n)


def slip_rates(p: Tyre, at: Contact, slip_x: SX, slip_y: SX, toe_rad: SX) -> tuple[SX, SX]:
    """Derivatives of the two slips.

    Args:
        toe_rad: small angle by which the wheel points to the left of its axis, from the elasticity of its suspension.
    """
    slide_y_mps = at.slide_y_mps - toe_rad * at.rolling_mps
    sliding = ca.fmin((slip_x**2 + slip_y**2) ** 2, _MAX_SLIDING)
    transport_mps = ca.fabs(at.rolling_mps) + ca.sqrt(at.slide_x_mps**2 + slide_y_mps**2 + 1e-12) * sliding
    return (
        -(at.slide_x_mps + transport_mps * slip_x) / p.relaxation_x_m,
        -(slide_y_mps + transport_mps * slip_y) / p.relaxation_y_m,
    )


def _stiffness_x(f: MagicFormula, overload: SX) -> SX:
    """K_x / F_z."""
    return (f.p_kx1 + f.p_kx2 * overload) * ca.exp(f.p_kx3 * overload)


def _stiffness_y(f: MagicFormula, load_n: SX) -> SX:
    """K_y / F_z; sin(2 atan(x)) is 2 x / (1 + x^2), which needs no load to divide by."""
    return 2.0 * f.p_ky1 / f.p_ky2 / (1.0 + (load_n / (f.p_ky2 * f.nominal_load_n)) ** 2)


def _magic(slip: SX, stiffness: SX, shape: SX, peak: SX, curvature: SX) -> SX:
    """Force over load: D sin(C atan(B s - E (B s - atan(B s)))), with B = K / (C D)."""
    scaled = stiffness / (shape * peak) * slip
    return peak * ca.sin(shape * ca.atan(scaled - curvature * (scaled - ca.atan(scaled))))


def _weight(slip: SX, factor: SX, shape: SX, curvature: SX) -> SX:
    """What the slip in the other direction leaves of a force, G_xa and G_yk.

    The factor B is r_b1 cos(atan(r_b2 own slip)), and cos(atan(x)) is 1 / sqrt(1 + x^2). A locked wheel is beyond the slips that the
    formula was fitted to; there it must not turn the force round.
    """
    scaled = factor * slip
    return ca.fmax(ca.cos(shape * ca.atan(scaled - curvature * (scaled - ca.atan(scaled)))), 0.0)


def _trail_m(p: Tyre, load_n: SX, overload: SX, slip_y: SX) -> SX:
    """Pneumatic trail: D cos(C atan(B s - E (B s - atan(B s))))."""
    f = p.formula
    peak_m = load_n / f.nominal_load_n * p.radius_m * (f.q_dz1 + f.q_dz2 * overload)
    scaled = (f.q_bz1 + f.q_bz2 * overload) * slip_y
    curvature = f.q_ez1 + f.q_ez2 * overload
    return peak_m * ca.cos(f.q_cz1 * ca.atan(scaled - curvature * (scaled - ca.atan(scaled))))
