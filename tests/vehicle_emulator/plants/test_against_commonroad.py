"""Our car of fifteen degrees of freedom against one that nobody here wrote: the multi-body car of commonroad-vehicle-models.

Both get the numbers of the library's Ford Escort and the same road-wheel angles, and roll without drive, as the library's car does at
acceleration 0. What the library has and our car has not is put into numbers that ours has, each computed from the library's own:

- its tyre: no load dependence of friction and stiffness, no relaxation, no rolling resistance, no moment about the normal;
- camber: roll tilts its wheels, which push inwards then, the rear ones more. As the library has it, a slip angle in proportion to the
  roll angle, which is a steering of the wheels with their travel. (Beside it there is a step with the sign of the camber, alike at all
  wheels; it moves the lateral velocity, which is therefore not compared.)
- its yaw equation has the forces of the tyres about the centre of gravity of the body, and no inertia of the axles' masses: the tyres
  share the lateral force as if those masses were at that centre, but the load as they really are. That is so much more slip in front
  and less in the rear, which is a compliance of the wheels.
"""

import math

import numpy as np
import pytest

from dbc.vehicle import load_vehicle
from vehicle_emulator.plants.interface import Level, PlantInputs, Selector, SteeringInputs
from vehicle_emulator.plants.multibody.plant import MultibodyPlant

pytest.importorskip("vehiclemodels", reason="commonroad-vehicle-models is not installed")

from vehicle_emulator.plants.commonroad import CommonroadPlant, load_car

GRAVITY_MPS2 = 9.81
STEP_S = 1e-3
STIFF_NPM2, FAR_M, FAR_N, SHORT_M = 1e6, 1.0, 1e9, 0.05
"""Stops of the suspension out of reach, a load so large that no load matters beside it, and a relaxation length that is almost none."""


def escort(vehicle):
    """A vehicle with the library's numbers."""
    car = load_car().numbers
    wheelbase_m = car.a + car.b
    front_n = GRAVITY_MPS2 * (car.m_s * car.b / wheelbase_m + car.m_uf)
    rear_n = GRAVITY_MPS2 * (car.m_s * car.a / wheelbase_m + car.m_ur)
    behind_m = (car.m_ur * car.b - car.m_uf * car.a) / car.m
    hub_m = car.R_w - 0.5 * np.array((front_n, rear_n)) / car.K_zt
    multibody = vehicle.multibody
    masses = {
        "mass_kg": car.m,
        "cog_to_front_m": car.a + behind_m,
        "cog_to_rear_m": car.b - behind_m,
        "cog_height_m": float(car.m_s * car.h_s + car.m_uf * hub_m[0] + car.m_ur * hub_m[1]) / car.m,
        "sprung_roll_inertia_kgm2": car.I_Phi_s,
        "sprung_pitch_inertia_kgm2": car.I_y_s,
        "sprung_yaw_inertia_kgm2": car.I_z - car.m_uf * (car.a**2 + 0.25 * car.T_f**2) - car.m_ur * (car.b**2 + 0.25 * car.T_r**2),
    }
    tyre = {
        "radius_m": car.R_w, "stiffness_npm": car.K_zt, "damping_nspm": 0.0, "friction": 1.0, "relaxation_x_m": SHORT_M,
        "relaxation_y_m": SHORT_M, "standstill_damping_nspm": 0.0, "rolling_resistance": 0.0,
        "formula": multibody.tyre.formula.model_copy(update=formula(car.tire)),
    }  # fmt: skip
    front = axle(car, car.m_uf, car.T_f, (car.K_sf, car.K_sdf, car.K_tsf), car.D_f, front_n, car.b / wheelbase_m)
    rear = axle(car, car.m_ur, car.T_r, (car.K_sr, car.K_sdr, car.K_tsr), car.D_r, rear_n, car.a / wheelbase_m)
    steering = {"ackermann_share": 0.0, "mechanical_trail_m": 0.0, "friction_nm": 0.0}
    return replaced(
        vehicle,
        multibody=replaced(
            multibody,
            drag_area_m2=0.0,
            masses=replaced(multibody.masses, **masses),
            front=replaced(multibody.front, **front),
            rear=replaced(multibody.rear, **rear),
            tyre=replaced(multibody.tyre, **tyre),
            steering=replaced(multibody.steering, **steering),
        ),
        powertrain=replaced(vehicle.powertrain, driveline=replaced(vehicle.powertrain.driveline, drag_nm=0.0, drag_nms=0.0)),
    )


def replaced(section, **fields):
    assert set(fields) <= set(type(section).model_fields)
    return section.model_copy(update=fields)


def formula(tyre):
    """The library's Magic Formula, without load dependence and moment about the normal."""
    same = {key: getattr(tyre, key) for key in ("p_cx1", "p_dx1", "p_ex1", "p_kx1", "p_cy1", "p_dy1", "p_ey1")}
    same |= {key: getattr(tyre, key) for key in ("r_bx1", "r_bx2", "r_cx1", "r_ex1", "r_by1", "r_by2", "r_cy1", "r_ey1")}
    none = ("p_dx2", "p_ex2", "p_ex3", "p_kx2", "p_kx3", "p_dy2", "p_ey2", "q_dz1", "q_dz2")
    # p_ky2 = 2 and no load make the cornering stiffness p_ky1 times the load.
    return same | dict.fromkeys(none, 0.0) | {"p_ky1": -tyre.p_ky1, "p_ky2": 2.0, "nominal_load_n": FAR_N}


def axle(car, mass_kg, track_m, springs, camber_radpm, load_n, lateral_share):
    """One axle with the library's numbers.

    Args:
        springs: of the library: stiffness, damping, and that of the anti-roll bar per angle with its sign.
        lateral_share: its share of the lateral force in the library's yaw equation.
    """
    spring_npm, damping_nspm, anti_roll_nmprad = springs
    tyre, arm_m = car.tire, 0.5 * track_m
    slip_per_camber = tyre.p_hy3 + tyre.p_vy3 / tyre.p_ky1
    slip_per_travel_radpm = slip_per_camber * (1.0 + camber_radpm * arm_m) / arm_m
    load_share, stiffness_nprad = load_n / (GRAVITY_MPS2 * car.m), -tyre.p_ky1 * 0.5 * load_n
    return {
        "track_m": track_m, "wheel_kg": 0.5 * mass_kg, "wheel_inertia_kgm2": car.I_y_w, "spring_npm": spring_npm,
        "anti_roll_npm": -2.0 * anti_roll_nmprad / track_m**2, "bump_nspm": damping_nspm, "rebound_nspm": damping_nspm,
        "bump_travel_m": FAR_M, "droop_travel_m": FAR_M, "stop_npm2": STIFF_NPM2, "roll_centre_m": 0.0, "hub_slope": 0.0,
        "braking_slope": 0.0, "bearing_nms": 0.0,
        "toe_per_travel_radpm": -slip_per_travel_radpm,
        "toe_per_force_radpn": (lateral_share / load_share - 1.0) / stiffness_nprad,
    }  # fmt: skip


def at_once(vehicle):
    """The same with a steering robot that is where it is to be at the end of every step."""
    steering = vehicle.robots.steering.model_copy(update={"bandwidth_hz": 1e4, "damping_ratio": 1.0})
    return vehicle.model_copy(update={"robots": vehicle.robots.model_copy(update={"steering": steering})})


def drives(road_wheel_rad, speed_mps, seconds=5.0, ramp_from_s=1.0, ramp_s=0.3):
    """The two cars over the same steering: that of our car, whose robot follows a ramp; arrays by the field of the state."""
    vehicle, ours, theirs = escort(load_vehicle()), [], []
    ratio = vehicle.steering.ratio
    own, other = MultibodyPlant(vehicle, Level(), speed_mps=speed_mps), CommonroadPlant(at_once(vehicle), Level(), speed_mps=speed_mps)
    for k in range(1, round(seconds / STEP_S) + 1):
        done = (k * STEP_S - ramp_from_s) / ramp_s
        demand = SteeringInputs(road_wheel_rad * ratio * min(max(done, 0.0), 1.0), 60.0)
        ours.append(own.step(STEP_S, PlantInputs(demand, selector=Selector.NEUTRAL)))
        same = SteeringInputs(ours[-1].steering_wheel_rad, 1e9)
        theirs.append(other.step(STEP_S, PlantInputs(same, selector=Selector.NEUTRAL)))
    return ours, theirs


def series(states, field):
    return np.array([getattr(state, field) for state in states])


@pytest.mark.parametrize(("road_wheel_rad", "speed_mps"), [(0.01, 20.0), (0.03, 20.0), (0.05, 20.0), (0.02, 30.0), (-0.03, 20.0)])
def test_a_ramp_of_the_steering_is_answered_as_by_the_car_of_the_library(road_wheel_rad, speed_mps):
    ours, theirs = drives(road_wheel_rad, speed_mps)
    assert series(ours, "steering_wheel_rad") == pytest.approx(series(theirs, "steering_wheel_rad"), abs=1e-9)
    own_radps, other_radps = series(ours, "yaw_rate_radps"), series(theirs, "yaw_rate_radps")
    assert math.copysign(1.0, other_radps[-1]) == math.copysign(1.0, road_wheel_rad)
    nrmse = float(np.sqrt(np.mean((own_radps - other_radps) ** 2) / np.mean(other_radps**2)))
    assert nrmse <= 0.05
    assert math.copysign(1.0, theirs[-1].roll_rad) == math.copysign(1.0, road_wheel_rad)
    assert ours[-1].roll_rad == pytest.approx(theirs[-1].roll_rad, rel=0.08)
    assert math.dist((ours[-1].x_m, ours[-1].y_m), (theirs[-1].x_m, theirs[-1].y_m)) <= 1.0
