"""The multi-body car of commonroad-vehicle-models as a plant: a model that nobody here wrote, to check our own against.

29 states, the Ford Escort of the library (Althoff and Würsching, CommonRoad: Vehicle Models, 2020). On a level road only; without engine,
gearbox, reverse and gusts: pedals are accelerations. Below 1 m/s it is not a model of a car: there the pedals move it, its wheels are made
to roll, and a car that is not driven stands. One step of 1 ms, RK4 in Python, takes about 0.3 ms.

Its frame has y to the right and z down. Seen in a mirror it is ours: y, yaw and steering keep their signs, left and right change places,
roll and pitch their signs.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from dbc.errors import UserMistake
from dbc.vehicle import Vehicle
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.extras import optional
from vehicle_emulator.plants.interface import PlantInputs, PlantState, Road, Selector, Wheels

_EXTRA = "commonroad"
_ROLLING_MPS = 1.0
_STANDING_MPS = 0.1
"""Speed below which the library itself goes over to a kinematic model."""
_LEVEL = 1e-6
X, Y, STEER, VX, YAW, YAW_RATE, ROLL, ROLL_RATE, PITCH, PITCH_RATE, VY, Z, VZ = range(13)
"""Places of the states of the body."""
_SPINS = slice(23, 27)
_PLACE = (X, Y, YAW)
_LEVEL_VELOCITIES = (VX, VY, YAW_RATE, 15, 20)
"""Of the body, and across of both axles."""
_AXLES = ((13, 16), (18, 21))
"""Places of roll angle and height of front and rear axle."""

Derivative = Callable[[list[float]], list[float]]


class NotOnThisRoad(UserMistake):
    """The car of commonroad-vehicle-models was to drive where it cannot."""


class Car(NamedTuple):
    """What the library gives.

    Args:
        derivative: of the state (list of 29, inputs of 2, parameters); may change the list that it is given.
        numbers: of the Ford Escort, as a tree of names.
        start: state from x, y, steering angle, speed, yaw, yaw rate and sideslip angle.
    """

    derivative: Callable[[list[float], list[float], Any], list[float]]
    numbers: Any
    start: Callable[[list[float], Any], list[float]]


def load_car() -> Car:
    """The multi-body Ford Escort of the library; its limits of the steering rate are taken away, ours is that of the robot.

    Raises:
        ExtraMissing: the library is not installed.
    """
    numbers = optional("vehiclemodels.parameters_vehicle1", _EXTRA).parameters_vehicle1()
    numbers.steering.v_min, numbers.steering.v_max = -math.inf, math.inf
    return Car(
        optional("vehiclemodels.vehicle_dynamics_mb", _EXTRA).vehicle_dynamics_mb,
        numbers,
        optional("vehiclemodels.init_mb", _EXTRA).init_mb,
    )


class CommonroadPlant:
    """The multi-body car of commonroad-vehicle-models.

    Args:
        vehicle: its steering ratio and the robot that turns the wheel, and the forces of full pedals; all else is the library's.
        road: has to be level where the car starts.
        pose: x [m], y [m] and yaw [rad] at the start.
        speed_mps: forward speed at the start.
        period_s: time of a step.

    Raises:
        ExtraMissing: the library is not installed.
        NotOnThisRoad: the road climbs.
    """

    def __init__(
        self, vehicle: Vehicle, road: Road, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), speed_mps: float = 0.0,
        period_s: float = 1e-3,
    ) -> None:  # fmt: skip
        x_m, y_m, yaw_rad = pose
        ground = road.at(x_m, y_m)
        if max(abs(ground.slope_x), abs(ground.slope_y)) > _LEVEL or ground.friction != 1.0:
            raise NotOnThisRoad("plant commonroad: a road with a slope or another grip; allowed: a level one of grip 1")
        self._car = load_car()
        self._vehicle = vehicle
        self._period_s = period_s
        self._wheel = SteeringWheel(vehicle, period_s)
        self._x = [float(v) for v in self._car.start([x_m, y_m, 0.0, speed_mps, yaw_rad, 0.0, 0.0], self._car.numbers)]
        self._z_m = ground.z_m
        self._state = self._observed(self._x, 1)

    @property
    def state(self) -> PlantState:
        """The state reached by the last step."""
        return self._state

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s`, the period, with the inputs held and return the state reached."""
        if dt_s != self._period_s:
            raise ValueError(f"step of {dt_s} s, made for {self._period_s} s")
        self._wheel.step(inputs.steering)
        steer_rad = self._wheel.angle_rad / self._vehicle.steering.ratio
        controls = [(steer_rad - self._x[STEER]) / dt_s, self._acceleration_mps2(inputs)]
        before = self._x
        self._x = runge_kutta(lambda x: self._car.derivative(x, controls, self._car.numbers), self._x, dt_s)
        self._x[STEER] = steer_rad
        self._mend(before, controls[1])
        self._state = self._observed(before, 1 if inputs.selector is Selector.DRIVE else 0)
        return self._state

    def _acceleration_mps2(self, inputs: PlantInputs) -> float:
        """What the pedals want; the library knows one of both at a time."""
        pedals, faults = self._vehicle.pedals, inputs.faults
        brake_n = inputs.brake_norm * faults.brake_norm * pedals.full_brake_force_n
        drive_n = inputs.accelerator_norm * faults.drive_norm * pedals.full_drive_force_n if inputs.selector is Selector.DRIVE else 0.0
        return (drive_n - brake_n) / float(self._car.numbers.m)

    def _mend(self, before: list[float], acceleration_mps2: float) -> None:
        """Keep a slow car a car: the pedals move it, not its slips, its wheels roll, and without drive it comes to stand."""
        x = self._x
        if x[VX] >= _ROLLING_MPS:
            return
        x[VX] = max(before[VX] + acceleration_mps2 * self._period_s, 0.0)
        x[_SPINS] = [x[VX] / self._car.numbers.R_w] * 4
        if x[VX] < _STANDING_MPS and acceleration_mps2 <= 0.0:
            for place in _LEVEL_VELOCITIES:
                x[place] = 0.0
            for place in _PLACE:
                x[place] = before[place]
            x[_SPINS] = [0.0] * 4

    def _observed(self, before: list[float], gear: int) -> PlantState:
        """The state in our frame.

        Args:
            before: the library's state one step earlier.
        """
        x, wheel = self._x, self._wheel
        ax_mps2, ay_mps2, az_mps2 = ((x[place] - before[place]) / self._period_s for place in (VX, VY, VZ))
        left_front, right_front, left_rear, right_rear = x[_SPINS]
        return PlantState(
            x_m=x[X], y_m=x[Y], z_m=self._z_m - x[Z], roll_rad=-x[ROLL], pitch_rad=-x[PITCH], yaw_rad=x[YAW],
            vx_mps=x[VX], vy_mps=x[VY], vz_mps=-x[VZ],
            roll_rate_radps=-x[ROLL_RATE], pitch_rate_radps=-x[PITCH_RATE], yaw_rate_radps=x[YAW_RATE],
            ax_mps2=ax_mps2 - x[YAW_RATE] * x[VY], ay_mps2=ay_mps2 + x[YAW_RATE] * x[VX], az_mps2=-az_mps2,
            steering_wheel_rad=wheel.angle_rad, steering_wheel_rate_radps=wheel.rate_radps, steering_robot_nm=wheel.robot_nm,
            wheel_speeds_radps=(right_front, left_front, right_rear, left_rear), wheel_loads_n=self._loads_n(), gear=gear,
        )  # fmt: skip

    def _loads_n(self) -> Wheels:
        p, loads_n = self._car.numbers, []
        for (roll, height), track_m in zip(_AXLES, (p.T_f, p.T_r), strict=True):
            middle_m, aside_m = self._x[height] + p.R_w * (math.cos(self._x[roll]) - 1.0), 0.5 * track_m * math.sin(self._x[roll])
            loads_n += [p.K_zt * (middle_m + aside_m), p.K_zt * (middle_m - aside_m)]
        front_left, front_right, rear_left, rear_right = loads_n
        return front_left, front_right, rear_left, rear_right


def runge_kutta(derivative: Derivative, x: list[float], dt_s: float) -> list[float]:
    """One step of the classical Runge-Kutta method."""

    def beyond(rate: list[float], step_s: float) -> list[float]:
        return [a + step_s * b for a, b in zip(x, rate, strict=True)]

    k1 = derivative(list(x))
    k2 = derivative(beyond(k1, 0.5 * dt_s))
    k3 = derivative(beyond(k2, 0.5 * dt_s))
    k4 = derivative(beyond(k3, dt_s))
    return beyond([(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)], dt_s)
