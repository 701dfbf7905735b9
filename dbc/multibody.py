"""The part of the vehicle file that describes the emulated car as bodies, springs, tyres, brakes and steering.

Front and rear are axles of two equal wheels. "Wheel rate" is a stiffness felt at the wheel, along its travel.
Ranges hold every road car, and shut out what would fly apart in a step of 1 ms.
"""

from typing import Annotated

from pydantic import Field

from dbc.section import NotNegative, Positive, Section, Share, between


class Masses(Section):
    """The whole car as it is driven, and the moments of inertia of its sprung body about that body's centre of gravity."""

    mass_kg: Annotated[float, between(100, 60000)]
    cog_to_front_m: Annotated[float, between(0.2, 10)]
    cog_to_rear_m: Annotated[float, between(0.2, 10)]
    cog_height_m: Annotated[float, between(0.05, 3)]
    sprung_roll_inertia_kgm2: Annotated[float, between(10, 1e6)]
    sprung_pitch_inertia_kgm2: Annotated[float, between(10, 1e6)]
    sprung_yaw_inertia_kgm2: Annotated[float, between(10, 1e6)]


class Axle(Section):
    """One axle.

    Args:
        wheel_kg, wheel_inertia_kgm2: unsprung mass of one wheel, and its moment of inertia about its own axis.
        spring_npm, anti_roll_npm: wheel rates; that of the anti-roll bar is what it adds in pure roll.
        bump_nspm, rebound_nspm: damping at the wheel, inwards and outwards.
        bump_travel_m, droop_travel_m, stop_npm2: free travel from the design position to the stops, and their force per squared way in.
        roll_centre_m: height over the road.
        hub_slope: forward travel of the hub per upward travel; carries the force of the drive shafts.
        braking_slope: the same of the contact patch of a locked wheel; positive in front and negative in the rear is anti-dive.
        toe_per_travel_radpm: how the wheels toe out when they go up; positive in front and negative in the rear is understeer.
        toe_per_force_radpn: how a wheel gives way to its lateral force.
        bearing_nms: drag of bearing and shaft.
    """

    track_m: Annotated[float, between(0.5, 4)]
    wheel_kg: Annotated[float, between(1, 500)]
    wheel_inertia_kgm2: Annotated[float, between(0.05, 100)]
    spring_npm: Annotated[float, between(1000, 1e6)]
    anti_roll_npm: NotNegative
    bump_nspm: NotNegative
    rebound_nspm: NotNegative
    bump_travel_m: Positive
    droop_travel_m: Positive
    stop_npm2: Positive
    roll_centre_m: float
    hub_slope: float
    braking_slope: float
    toe_per_travel_radpm: float
    toe_per_force_radpn: float
    bearing_nms: NotNegative


class MagicFormula(Section):
    """Coefficients of the PAC2002 Magic Formula, by their names in a tyre property file; symmetric, without camber.

    Args:
        nominal_load_n: FNOMIN times LFZO.
        p_ky1: positive here; negative in files with the sign of ISO slip angle against force.
    """

    nominal_load_n: Positive
    p_cx1: Annotated[float, Field(ge=1.0, lt=2.0)]
    p_dx1: Positive
    p_dx2: float
    p_ex1: float
    p_ex2: float
    p_ex3: float
    p_kx1: Positive
    p_kx2: float
    p_kx3: float
    p_cy1: Annotated[float, Field(ge=1.0, lt=2.0)]
    p_dy1: Positive
    p_dy2: float
    p_ey1: float
    p_ey2: float
    p_ky1: Positive
    p_ky2: Positive
    r_bx1: float
    r_bx2: float
    r_cx1: float
    r_ex1: float
    r_by1: float
    r_by2: float
    r_cy1: float
    r_ey1: float
    q_bz1: NotNegative
    q_bz2: float
    q_cz1: NotNegative
    q_dz1: float
    q_dz2: float
    q_ez1: float
    q_ez2: float


class Tyre(Section):
    """One tyre.

    Args:
        radius_m: without load.
        stiffness_npm, damping_nspm: vertical.
        friction: factor on the friction of the Magic Formula, LMUX and LMUY.
        relaxation_x_m, relaxation_y_m: relaxation lengths; at standstill the tyre is a spring of slip stiffness over relaxation length.
        standstill_damping_nspm: damping of that spring at nominal load; fades out up to `standstill_mps`.
        rolling_resistance: moment over load and radius.
    """

    radius_m: Annotated[float, between(0.1, 1)]
    stiffness_npm: Annotated[float, between(20000, 5e6)]
    damping_nspm: NotNegative
    friction: Positive
    relaxation_x_m: Positive
    relaxation_y_m: Positive
    standstill_damping_nspm: NotNegative
    standstill_mps: Positive
    rolling_resistance: NotNegative
    formula: MagicFormula


class Brakes(Section):
    """Hydraulic brakes.

    Args:
        full_pedal_bar: pressure at full pedal.
        front_nm_per_bar, rear_nm_per_bar: torque of one wheel per pressure.
        lag_s: from the pedal to the pressure.
        has_abs: whether pressure is let off where a wheel slips more than `abs_slip`; none is left at `abs_slip_full`.
        abs_mps: the system is off below this speed and wholly on at twice this speed.
        park_lock_nm: what the locked gearbox holds at each driven wheel.
    """

    full_pedal_bar: Positive
    front_nm_per_bar: Positive
    rear_nm_per_bar: Positive
    lag_s: Positive
    has_abs: bool
    abs_slip: Positive
    abs_slip_full: Positive
    abs_mps: Positive
    park_lock_nm: NotNegative


class SteeringColumn(Section):
    """All that turns with the steering wheel, as seen there.

    Args:
        inertia_kgm2: steering wheel, robot, column and front wheels.
        friction_nm: dry friction.
        ackermann_share: 1 when both front wheels point at one centre of turn, 0 when they are parallel.
        mechanical_trail_m: of the steering axis on the road.
        assist_share: share of the tyres' aligning moment that the power steering takes.
        stop_nmprad2: torque of the end stop per squared way into it.
    """

    inertia_kgm2: Annotated[float, between(0.005, 5)]
    friction_nm: NotNegative
    ackermann_share: Share
    mechanical_trail_m: float
    assist_share: Share
    stop_nmprad2: Positive


class MultibodyParameters(Section):
    """The emulated car; on purpose not the controller's model.

    Args:
        drag_area_m2: drag coefficient times frontal area.
        front_drive_share: share of the drive torque on the front axle: 1 front-driven, 0 rear-driven.
    """

    drag_area_m2: Annotated[float, between(0.0, 30.0)]
    front_drive_share: Share
    masses: Masses
    front: Axle
    rear: Axle
    tyre: Tyre
    brakes: Brakes
    steering: SteeringColumn
