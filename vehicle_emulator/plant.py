"""Plane motion of a four-wheel car with load transfer and saturating tyres, from standstill to 130 km/h.

ISO 8855 axes: x forward, y left, yaw and road-wheel angle positive to the left; the reference point is the centre of gravity.

Integrator: semi-implicit Euler with 1 ms, one evaluation of the forces per step. What is stiff is solved implicitly: the
relaxation of the tyres (pole -v/sigma, 90 1/s at 130 km/h) and the forces that oppose motion, which act as dry friction and stop
the car instead of reversing it. The rest has no pole beyond 100 1/s, against a stability limit of 2000 1/s, and the loads follow
the accelerations of the step before. A higher order would gain nothing, because the inputs are held over the step.
"""

import math
from typing import NamedTuple, Protocol

from dbc.vehicle import PlantParameters

GRAVITY_MPS2 = 9.81
AIR_DENSITY_KGPM3 = 1.2

_STANDSTILL_MPS = 1e-5
"""Below this speed dry friction fades to zero: a push that it can hold makes the car creep at less than this, 0.1 mm in 10 s."""
_LENGTHWISE_GRIP_SHARE = 0.95
"""Anti-lock and traction control, idealised: a wheel uses at most this share of its grip lengthwise and keeps 31 % for cornering."""
_CARCASS_DAMPING_RATIO = 0.3
"""Assumption. A tyre without slip is a spring; below about 5 m/s the slip alone would leave the car rocking for seconds."""
_MAX_RELAXED_SLIP = 1.0
"""Far beyond the peak of the tyre; bounds what a sideways slide winds up."""


class PlantInputs(NamedTuple):
    """What acts on the car: road-wheel angle [rad], left positive, and the two pedals, 0 to 1."""

    road_wheel_rad: float
    accelerator_norm: float
    brake_norm: float


class PlantState(NamedTuple):
    """Motion of the centre of gravity: local frame x east and y north, velocities and accelerations along the car's axes.

    `yaw_rad` is not wrapped.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    ay_mps2: float


class Plant(Protocol):
    """A car that moves; other plants plug in here."""

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s` with the inputs held and return the state reached."""
        ...


class _Wheel:
    """One tyre on the road: its direction, its load, and the lateral force that builds up over the relaxation length.

    Front wheels steer as Ackermann drew them: at low speed all four roll about one centre.

    Args:
        x_m, y_m: place of the contact patch from the centre of gravity.
        drive_share, brake_share: this wheel's share of the car's drive and brake force.
    """

    __slots__ = (
        "_ackermann", "_load_per_ax_kg", "_load_per_ay_kg", "_p", "_static_load_n", "brake_share", "drive_share", "is_front", "slip",
        "x_m", "y_m",
    )

    def __init__(self, p: PlantParameters, is_front: bool, is_left: bool) -> None:
        wheelbase_m = p.cog_to_front_m + p.cog_to_rear_m
        track_m = p.track_front_m if is_front else p.track_rear_m
        roll_share = p.roll_stiffness_front_share if is_front else 1.0 - p.roll_stiffness_front_share
        lever_m = p.cog_to_rear_m if is_front else p.cog_to_front_m
        self._p = p
        self.is_front = is_front
        self.x_m = p.cog_to_front_m if is_front else -p.cog_to_rear_m
        self.y_m = 0.5 * track_m if is_left else -0.5 * track_m
        self.drive_share = 0.5 if is_front else 0.0
        self.brake_share = 0.5 * (p.brake_front_share if is_front else 1.0 - p.brake_front_share)
        self.slip = 0.0
        self._ackermann = self.y_m / wheelbase_m
        self._static_load_n = 0.5 * p.mass_kg * GRAVITY_MPS2 * lever_m / wheelbase_m
        self._load_per_ax_kg = math.copysign(0.5 * p.mass_kg * p.cog_height_m / wheelbase_m, -self.x_m)
        self._load_per_ay_kg = math.copysign(p.mass_kg * p.cog_height_m * roll_share / track_m, -self.y_m)

    def direction(self, steer_cosine: float, steer_sine: float) -> tuple[float, float]:
        """Cosine and sine of the wheel's own angle, from those of the road-wheel angle on the car's centre line."""
        if not self.is_front:
            return 1.0, 0.0
        cosine = steer_cosine - self._ackermann * steer_sine
        length = math.hypot(cosine, steer_sine)
        return cosine / length, steer_sine / length

    def load_n(self, ax_mps2: float, ay_mps2: float) -> float:
        """Vertical load under steady accelerations; a wheel can lift, not pull."""
        return max(0.0, self._static_load_n + self._load_per_ax_kg * ax_mps2 + self._load_per_ay_kg * ay_mps2)

    def grip_n(self, load_n: float) -> float:
        """Largest force that the tyre can transmit in any direction; falls short of proportional to the load."""
        p = self._p
        return max(1.0, p.friction * load_n * (1.0 - p.tyre_load_sensitivity * (load_n / p.tyre_nominal_load_n - 1.0)))

    def lateral_n(self, dt_s: float, *, load_n: float, grip_n: float, lengthwise_n: float, along_mps: float, across_mps: float) -> float:
        """Lateral force after `dt_s` at the given velocity of the contact patch along and across the wheel.

        Magic Formula (Pacejka, Tire and Vehicle Dynamics) without curvature and shifts on the relaxed slip, within the
        friction ellipse that the lengthwise force leaves.
        """
        p = self._p
        relaxed = (self.slip - dt_s / p.relaxation_length_m * across_mps) / (1.0 + dt_s / p.relaxation_length_m * abs(along_mps))
        self.slip = min(max(relaxed, -_MAX_RELAXED_SLIP), _MAX_RELAXED_SLIP)
        stiffness_b = p.tyre_cornering_stiffness_per_load / (p.tyre_shape_c * p.friction)
        pure_n = grip_n * math.sin(p.tyre_shape_c * math.atan(stiffness_b * self.slip))
        pole_radps = math.sqrt(p.tyre_cornering_stiffness_per_load * GRAVITY_MPS2 / p.relaxation_length_m)
        missing_damping = max(0.0, 2.0 * _CARCASS_DAMPING_RATIO * pole_radps - abs(along_mps) / p.relaxation_length_m)
        damping_n = missing_damping * load_n / GRAVITY_MPS2 * across_mps
        share_left = math.sqrt(max(0.0, 1.0 - (lengthwise_n / grip_n) ** 2))
        return share_left * min(max(pure_n - damping_n, -grip_n), grip_n)


class FourWheelPlant:
    """A front-driven car on a road that climbs evenly in the direction in which the car points.

    Args:
        parameters: numbers of the car.
        pose: x [m], y [m] and yaw [rad] at the start.
        speed_mps: forward speed at the start.
        grade: rise over run of the road; the loads of the wheels stay those of a level one.
    """

    def __init__(
        self, parameters: PlantParameters, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), speed_mps: float = 0.0, grade: float = 0.0
    ) -> None:
        self._p = parameters
        self._downhill_n = parameters.mass_kg * GRAVITY_MPS2 * math.sin(math.atan(grade))
        self._state = PlantState(*pose, speed_mps, 0.0, 0.0, 0.0, 0.0)
        self._wheels = tuple(_Wheel(parameters, is_front, is_left) for is_front in (True, False) for is_left in (True, False))
        self._drive_n = 0.0
        self._brake_n = 0.0
        self._front_lateral_n = 0.0

    @property
    def state(self) -> PlantState:
        """The state reached by the last step."""
        return self._state

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s` (1 ms; 2 ms at most) with the inputs held and return the state reached."""
        p, before = self._p, self._state
        self._drive_n += (p.full_drive_force_n * inputs.accelerator_norm - self._drive_n) * -math.expm1(-dt_s / p.drive_lag_s)
        self._brake_n += (p.full_brake_force_n * inputs.brake_norm - self._brake_n) * -math.expm1(-dt_s / p.brake_lag_s)
        engine_drag_n = p.drag_torque_force_n * (1.0 - inputs.accelerator_norm)
        push_n, resist_n, lateral_n, yaw_moment_nm = self._forces(dt_s, inputs.road_wheel_rad, engine_drag_n)
        push_n -= 0.5 * AIR_DENSITY_KGPM3 * p.drag_area_m2 * before.vx_mps * abs(before.vx_mps) + self._downhill_n
        floor_mps = max(abs(before.vx_mps), _STANDSTILL_MPS)
        vx_mps = (before.vx_mps + dt_s * (push_n / p.mass_kg + before.yaw_rate_radps * before.vy_mps)) / (
            1.0 + dt_s * resist_n / (p.mass_kg * floor_mps)
        )
        vy_mps = before.vy_mps + dt_s * (lateral_n / p.mass_kg - before.yaw_rate_radps * vx_mps)
        yaw_rate_radps = before.yaw_rate_radps + dt_s * yaw_moment_nm / p.yaw_inertia_kgm2
        yaw_rad = before.yaw_rad + 0.5 * dt_s * (before.yaw_rate_radps + yaw_rate_radps)
        middle_rad = 0.5 * (before.yaw_rad + yaw_rad)
        ahead_m, left_m = 0.5 * dt_s * (before.vx_mps + vx_mps), 0.5 * dt_s * (before.vy_mps + vy_mps)
        self._state = PlantState(
            x_m=before.x_m + ahead_m * math.cos(middle_rad) - left_m * math.sin(middle_rad),
            y_m=before.y_m + ahead_m * math.sin(middle_rad) + left_m * math.cos(middle_rad),
            yaw_rad=yaw_rad,
            vx_mps=vx_mps,
            vy_mps=vy_mps,
            yaw_rate_radps=yaw_rate_radps,
            ax_mps2=(vx_mps - before.vx_mps) / dt_s - before.yaw_rate_radps * before.vy_mps,
            ay_mps2=lateral_n / p.mass_kg,
        )
        return self._state

    def _forces(self, dt_s: float, road_wheel_rad: float, engine_drag_n: float) -> tuple[float, float, float, float]:
        """Push, dry resistance to it, lateral force [N] and yaw moment [Nm] of the four tyres, in the car's axes."""
        p, state = self._p, self._state
        direction = state.vx_mps / max(abs(state.vx_mps), _STANDSTILL_MPS)
        steer_rad = road_wheel_rad - p.front_compliance_radpn * self._front_lateral_n
        steer_cosine, steer_sine = math.cos(steer_rad), math.sin(steer_rad)
        push_n = resist_n = across_n = yaw_moment_nm = front_lateral_n = 0.0
        for wheel in self._wheels:
            cosine, sine = wheel.direction(steer_cosine, steer_sine)
            forward_mps = state.vx_mps - state.yaw_rate_radps * wheel.y_m
            leftward_mps = state.vy_mps + state.yaw_rate_radps * wheel.x_m
            load_n = wheel.load_n(state.ax_mps2, state.ay_mps2)
            grip_n = wheel.grip_n(load_n)
            most_n = _LENGTHWISE_GRIP_SHARE * grip_n
            drive_n = min(wheel.drive_share * self._drive_n, most_n)
            drag_n = p.rolling_resistance_coefficient * load_n + wheel.drive_share * engine_drag_n + wheel.brake_share * self._brake_n
            drag_n = min(drag_n, most_n)
            along_n = drive_n - drag_n * direction
            lateral_n = wheel.lateral_n(
                dt_s,
                load_n=load_n,
                grip_n=grip_n,
                lengthwise_n=along_n,
                along_mps=cosine * forward_mps + sine * leftward_mps,
                across_mps=cosine * leftward_mps - sine * forward_mps,
            )
            wheel_across_n = sine * along_n + cosine * lateral_n
            push_n += cosine * drive_n - sine * lateral_n
            resist_n += cosine * drag_n
            across_n += wheel_across_n
            yaw_moment_nm += wheel.x_m * wheel_across_n - wheel.y_m * (cosine * along_n - sine * lateral_n)
            if wheel.is_front:
                front_lateral_n += lateral_n
        self._front_lateral_n = front_lateral_n
        return push_n, resist_n, across_n, yaw_moment_nm
