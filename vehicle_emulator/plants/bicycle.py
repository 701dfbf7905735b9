"""The paper's bicycle as a car: equations (1) to (4) with the numbers of the vehicle file's `[model]`, made valid at standstill.

A plant for work on the controller: fast, and without mismatch between plant and model but for what stands below.

- The slip angles of equation (3) divide by the speed. Below 1 m/s they are computed as if the car moved this fast, and the steering
  counts in proportion to the speed, so that a slow car rolls about its centre of turn and a standing one does not turn.
- Brakes and rolling resistance are dry friction: they stop the car and hold it, on a slope as well.
- Body and wheels follow the road's slope; its grip does not count, because the model's tyres are linear.
"""

import math
from typing import NamedTuple

from dbc.vehicle import Vehicle
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.interface import GRAVITY_MPS2, PlantInputs, PlantState, Road, RoadPoint, Selector

_SLIP_SPEED_FLOOR_MPS = 1.0
"""The pole of the lateral motion, -140 m/s2 over the speed, stays far within the 2000 1/s that Heun's method with 1 ms is stable for."""
_SLIP_SPEED_SMOOTHING_MPS = 0.1
_STANDING_MPS = 0.02
"""A braked car that slides aside or turns slower than this stands still altogether."""

GEARS = {Selector.PARK: 0, Selector.REVERSE: -1, Selector.NEUTRAL: 0, Selector.DRIVE: 1}
"""Gear of a car with one gear in each direction."""


class _Pushes(NamedTuple):
    """What acts on the car over a step.

    Args:
        axle_n: what the wheels of each axle push with along their planes.
        along_n, aside_n: on the body, along its axes: slope, rolling resistance, a gust.
        direction: in which it drives or begins to drive; 0 for a car that friction holds.
    """

    steer_rad: float
    axle_n: float
    along_n: float
    aside_n: float
    direction: float


class BicyclePlant:
    """A car of equations (1) to (4).

    Full pedals are the vehicle file's `[pedals]` forces, without lag; the locked gearbox of P holds like a full brake.

    Args:
        pose: x [m], y [m] and yaw [rad] at the start.
        speed_mps: forward speed at the start.
        period_s: time of a step.
    """

    def __init__(
        self, vehicle: Vehicle, road: Road, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), speed_mps: float = 0.0,
        period_s: float = 1e-3,
    ) -> None:  # fmt: skip
        p = vehicle.model
        wheelbase_m = p.cog_to_front_m + p.cog_to_rear_m
        front_n, rear_n = (0.5 * p.mass_kg * GRAVITY_MPS2 * lever_m / wheelbase_m for lever_m in (p.cog_to_rear_m, p.cog_to_front_m))
        self._p = p
        self._pedals = vehicle.pedals
        self._ratio = vehicle.steering.ratio
        self._loads_n = (front_n, front_n, rear_n, rear_n)
        self._road = road
        self._period_s = period_s
        self._wheel = SteeringWheel(vehicle, period_s)
        x_m, y_m, yaw_rad = pose
        ground = road.at(x_m, y_m)
        roll_rad, pitch_rad = attitude(ground, yaw_rad)
        self._state = PlantState(
            x_m=x_m, y_m=y_m, z_m=ground.z_m, roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=yaw_rad, vx_mps=speed_mps,
            wheel_speeds_radps=(speed_mps / p.wheel_radius_m,) * 4, wheel_loads_n=self._loads_n,
        )  # fmt: skip

    @property
    def state(self) -> PlantState:
        """The state reached by the last step."""
        return self._state

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s`, the period, with the inputs held and return the state reached."""
        if dt_s != self._period_s:
            raise ValueError(f"step of {dt_s} s, made for {self._period_s} s")
        self._wheel.step(inputs.steering)
        pushes, state = self._pushes(inputs), self._state
        vx_mps, vy_mps, yaw_rate_radps = state.vx_mps, state.vy_mps, state.yaw_rate_radps
        a_x, a_y, a_yaw = self._derivative(vx_mps, vy_mps, yaw_rate_radps, pushes)
        b_x, b_y, b_yaw = self._derivative(vx_mps + dt_s * a_x, vy_mps + dt_s * a_y, yaw_rate_radps + dt_s * a_yaw, pushes)
        half_s = 0.5 * dt_s
        vx_mps, vy_mps = vx_mps + half_s * (a_x + b_x), vy_mps + half_s * (a_y + b_y)
        yaw_rate_radps += half_s * (a_yaw + b_yaw)
        if vx_mps * pushes.direction <= 0.0:  # friction stops a car, it does not turn it back
            vx_mps = 0.0
            if pushes.direction == 0.0 and max(abs(vy_mps), abs(yaw_rate_radps)) < _STANDING_MPS:
                vy_mps = yaw_rate_radps = 0.0
        self._state = self._moved(dt_s, vx_mps, vy_mps, yaw_rate_radps, GEARS[inputs.selector])
        return self._state

    def _pushes(self, inputs: PlantInputs) -> _Pushes:
        p, pedals, state, faults = self._p, self._pedals, self._state, inputs.faults
        weight_n = p.mass_kg * GRAVITY_MPS2
        drive_n = GEARS[inputs.selector] * inputs.accelerator_norm * faults.drive_norm * pedals.full_drive_force_n
        brake_n = inputs.brake_norm * faults.brake_norm * pedals.full_brake_force_n
        if inputs.selector is Selector.PARK:
            brake_n = max(brake_n, pedals.full_brake_force_n)
        downhill_n = weight_n * math.sin(state.pitch_rad)
        direction = math.copysign(1.0, state.vx_mps or drive_n + downhill_n)
        if state.vx_mps == 0.0 and abs(drive_n + downhill_n) <= brake_n + p.rolling_resistance_n:
            drive_n = brake_n = downhill_n = direction = 0.0
        return _Pushes(
            steer_rad=self._wheel.angle_rad / self._ratio,
            axle_n=0.5 * (drive_n - direction * brake_n),
            along_n=downhill_n - direction * p.rolling_resistance_n,
            aside_n=faults.push_n - weight_n * math.cos(state.pitch_rad) * math.sin(state.roll_rad),
            direction=direction,
        )

    def _derivative(self, vx_mps: float, vy_mps: float, yaw_rate_radps: float, pushes: _Pushes) -> tuple[float, float, float]:
        """Derivatives of the two velocities and of the yaw rate."""
        p, (steer_rad, axle_n, along_n, aside_n, _) = self._p, pushes
        speed_mps = abs(vx_mps)
        excess_mps = speed_mps - _SLIP_SPEED_FLOOR_MPS
        slip_mps = 0.5 * (speed_mps + _SLIP_SPEED_FLOOR_MPS + math.sqrt(excess_mps * excess_mps + _SLIP_SPEED_SMOOTHING_MPS**2))
        front_slip_rad = steer_rad * vx_mps / slip_mps - math.atan((vy_mps + yaw_rate_radps * p.cog_to_front_m) / slip_mps)
        rear_slip_rad = math.atan((yaw_rate_radps * p.cog_to_rear_m - vy_mps) / slip_mps)
        front_n, rear_n = p.front_cornering_stiffness_nprad * front_slip_rad, p.rear_cornering_stiffness_nprad * rear_slip_rad
        cosine, sine = math.cos(steer_rad), math.sin(steer_rad)
        forward_n = axle_n * cosine + axle_n - front_n * sine + along_n - p.air_drag_nps2pm2 * vx_mps * speed_mps
        front_leftward_n = front_n * cosine + axle_n * sine
        return (
            forward_n / p.mass_kg + yaw_rate_radps * vy_mps,
            (front_leftward_n + rear_n + aside_n) / p.mass_kg - yaw_rate_radps * vx_mps,
            (p.cog_to_front_m * front_leftward_n - p.cog_to_rear_m * rear_n) / p.yaw_inertia_kgm2,
        )

    def _moved(self, dt_s: float, vx_mps: float, vy_mps: float, yaw_rate_radps: float, gear: int) -> PlantState:
        """The state after a step that ends with these velocities."""
        before, wheel = self._state, self._wheel
        yaw_rad = before.yaw_rad + 0.5 * dt_s * (before.yaw_rate_radps + yaw_rate_radps)
        middle_rad = 0.5 * (before.yaw_rad + yaw_rad)
        mean_x_mps, mean_y_mps = 0.5 * (before.vx_mps + vx_mps), 0.5 * (before.vy_mps + vy_mps)
        mean_radps = 0.5 * (before.yaw_rate_radps + yaw_rate_radps)
        ahead_m, left_m = dt_s * mean_x_mps * math.cos(before.pitch_rad), dt_s * mean_y_mps * math.cos(before.roll_rad)
        cosine, sine = math.cos(middle_rad), math.sin(middle_rad)
        x_m, y_m = before.x_m + ahead_m * cosine - left_m * sine, before.y_m + ahead_m * sine + left_m * cosine
        ground = self._road.at(x_m, y_m)
        roll_rad, pitch_rad = attitude(ground, yaw_rad)
        wheel_radps = vx_mps / self._p.wheel_radius_m
        return PlantState(
            x_m, y_m, ground.z_m, roll_rad, pitch_rad, yaw_rad,
            vx_mps, vy_mps, 0.0,
            (roll_rad - before.roll_rad) / dt_s, (pitch_rad - before.pitch_rad) / dt_s, yaw_rate_radps,
            (vx_mps - before.vx_mps) / dt_s - mean_radps * mean_y_mps, (vy_mps - before.vy_mps) / dt_s + mean_radps * mean_x_mps, 0.0,
            wheel.angle_rad, wheel.rate_radps, wheel.robot_nm,
            (wheel_radps, wheel_radps, wheel_radps, wheel_radps), self._loads_n,
            0.0, gear,
        )  # fmt: skip


def attitude(ground: RoadPoint, yaw_rad: float) -> tuple[float, float]:
    """Roll and pitch of a car that lies flat on the road: z-y-x angles, nose-down and rolled to the right positive [rad]."""
    if ground.slope_x == ground.slope_y == 0.0:
        return 0.0, 0.0
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    pitch_rad = -math.atan(ground.slope_x * cosine + ground.slope_y * sine)
    return math.atan((ground.slope_y * cosine - ground.slope_x * sine) * math.cos(pitch_rad)), pitch_rad
