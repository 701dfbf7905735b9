"""A small closed loop of the controller's own: where the bench's instances come from.

The car in it is on purpose not the controller's model: other mass, inertia and stiffness, tyres that saturate, actuators with
dead time and lag, noise on what is measured.
"""

import math
from collections import deque

import numpy as np

from controller.bench.scenarios import Scenario
from controller.integrator import rk4_step
from controller.nmpc import Nmpc, NmpcOutput
from controller.problem import Array
from dbc.vehicle import Vehicle
from gateway.messages import PLAN_PERIOD_NS, Mode, VehicleState

_STEP_NS = 1_000_000
_STEP_S = _STEP_NS * 1e-9
_STATE_AGE_NS = 5_000_000
_TRANSPORT_NS = 10_000_000
_DRIVE_LAG_S = 0.2  # accelerator robot and engine


class BenchCar:
    """A single-track car with saturating tyres and slow actuators, 1 kHz."""

    def __init__(self, vehicle: Vehicle, state: Array) -> None:
        car, robot = vehicle.model, vehicle.robots.steering
        self._mass, self._inertia = 1.08 * car.mass_kg, 1.10 * car.yaw_inertia_kgm2
        self._front, self._rear = car.cog_to_front_m, car.cog_to_rear_m
        self._stiffness = (0.88 * car.front_cornering_stiffness_nprad, 0.95 * car.rear_cornering_stiffness_nprad)
        load = 0.95 * self._mass * 9.81 / (self._front + self._rear)
        self._grip = (load * self._rear, load * self._front)
        self._full_force = 0.93 * car.max_wheel_torque_nm / car.wheel_radius_m
        self._resistance, self._drag = 1.3 * car.rolling_resistance_n, car.air_drag_nps2pm2
        self._omega0, self._damping = 2.0 * math.pi * robot.bandwidth_hz, robot.damping_ratio
        self._pending = deque([(0.0, 0.0)] * ((round(robot.dead_time_s * 1e9) + _TRANSPORT_NS) // _STEP_NS))
        # v_x, v_y, omega, X, Y, psi, delta, its rate, drive
        self.state = np.concatenate((state, np.zeros(3)))

    def step(self, steer_rad: float, drive_norm: float) -> None:
        """Drive on by one millisecond."""
        self._pending.append((steer_rad, drive_norm))
        self.state = rk4_step(self._derivative, self.state, self._pending.popleft(), _STEP_S)

    def _derivative(self, z: Array, command: tuple[float, float]) -> Array:
        v_x, v_y, omega, _, _, psi, delta, rate, drive = z.tolist()
        v_slip = max(v_x, 1.0)
        slips = (delta - math.atan((omega * self._front + v_y) / v_slip), math.atan((omega * self._rear - v_y) / v_slip))
        front, rear = (g * math.tanh(c * a / g) for g, c, a in zip(self._grip, self._stiffness, slips, strict=True))
        rolling = math.tanh(v_x / 0.05)
        force = self._full_force * (drive if drive > 0.0 else drive * rolling)
        force -= self._resistance * rolling + self._drag * v_x * abs(v_x)
        return np.array((
            (force - front * math.sin(delta)) / self._mass + omega * v_y,
            (front * math.cos(delta) + rear) / self._mass - omega * v_x,
            (self._front * front * math.cos(delta) - self._rear * rear) / self._inertia,
            v_x * math.cos(psi) - v_y * math.sin(psi),
            v_x * math.sin(psi) + v_y * math.cos(psi),
            omega,
            rate,
            self._omega0**2 * (command[0] - delta) - 2.0 * self._damping * self._omega0 * rate,
            (command[1] - drive) / _DRIVE_LAG_S,
        ))  # fmt: skip


def drive(nmpc: Nmpc, vehicle: Vehicle, scenario: Scenario, seed: int, noise: float = 1.0) -> tuple[list[NmpcOutput], Array]:
    """Drive a scenario in virtual time.

    Args:
        noise: factor on the noise of the navigation system.

    Returns:
        The controller's output of each cycle, and the car's state at each, shape (cycles, 9).
    """
    rng = np.random.default_rng(seed)
    car = BenchCar(vehicle, scenario.start())
    ins = vehicle.ins
    sigma = noise * np.array(
        (ins.velocity_sigma_mps, ins.velocity_sigma_mps, ins.yaw_rate_sigma_radps,
         ins.position_white_sigma_m, ins.position_white_sigma_m, ins.heading_white_sigma_rad, 0.0, 0.0, 0.0)
    )  # fmt: skip
    outputs: list[NmpcOutput] = []
    states: list[Array] = []
    steer_rad = drive_norm = 0.0
    for cycle in range(round(scenario.duration_s * 1e9) // PLAN_PERIOD_NS):
        now_ns = cycle * PLAN_PERIOD_NS
        for _ in range((PLAN_PERIOD_NS - _STATE_AGE_NS) // _STEP_NS if cycle else 0):
            car.step(steer_rad, drive_norm)
        z = car.state + sigma * rng.standard_normal(9)
        for _ in range(_STATE_AGE_NS // _STEP_NS if cycle else 0):
            car.step(steer_rad, drive_norm)
        mode = Mode.ENGAGED if cycle else Mode.READY
        measured = VehicleState(
            boot_id=1, seq=4 * cycle, t_ns=now_ns - (_STATE_AGE_NS if cycle else 0), mode=mode, is_valid=True, x_m=z[3], y_m=z[4],
            yaw_rad=math.remainder(z[5], 2.0 * math.pi), vx_mps=z[0], vy_mps=z[1], yaw_rate_radps=z[2], ax_mps2=0.0,
            steer_rad=z[6], drive_norm=z[8],
        )  # fmt: skip
        outputs.append(nmpc.step(measured, now_ns))
        states.append(car.state)
        steer_rad, drive_norm = outputs[-1].command.steer_rad, outputs[-1].command.drive_norm
    return outputs, np.array(states)
