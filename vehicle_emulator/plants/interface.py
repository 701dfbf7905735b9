"""What every emulated car takes and gives, one millisecond at a time.

ISO 8855 axes: x forward, y left, z up; angles and steering to the left, roll to the right and pitch nose-down positive (right-handed
about x and y). The reference point is the centre of gravity of the whole car in its design position.
"""

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple, Protocol, runtime_checkable

GRAVITY_MPS2 = 9.81

Progress = Callable[[str], None]
"""Told in one line each what takes time."""
Wheels = tuple[float, float, float, float]
"""One number for each wheel: front left, front right, rear left, rear right."""


class Selector(StrEnum):
    """Position of the gear lever."""

    PARK = "P"
    REVERSE = "R"
    NEUTRAL = "N"
    DRIVE = "D"


class PlantFaults(NamedTuple):
    """What is wrong with the car itself, or pushes it; neutral by default.

    Args:
        drive_norm, brake_norm: share of drive and of brake torque that is left.
        push_n: force on the centre of gravity along the car's y axis, for example a gust [N].
    """

    drive_norm: float = 1.0
    brake_norm: float = 1.0
    push_n: float = 0.0


class SteeringInputs(NamedTuple):
    """What turns the steering wheel; the robot is a position servo of bandwidth and damping as the vehicle file says.

    Args:
        demand_rad: steering-wheel angle that the robot is to take now.
        torque_limit_nm: largest torque of the robot; 0 when it lets go.
        driver_torque_nm: torque of the driver's hands.
    """

    demand_rad: float = 0.0
    torque_limit_nm: float = 0.0
    driver_torque_nm: float = 0.0


class PlantInputs(NamedTuple):
    """What acts on the car, held over a step; pedals are shares of their stroke, 0 to 1."""

    steering: SteeringInputs = SteeringInputs()
    accelerator_norm: float = 0.0
    brake_norm: float = 0.0
    selector: Selector = Selector.DRIVE
    faults: PlantFaults = PlantFaults()


class PlantState(NamedTuple):
    """Motion of the car and what its sensors could measure; what a simple plant does not know stays at its default.

    Args:
        x_m, y_m, z_m: reference point in the local frame, x east, y north, z up; z is 0 for a car at rest on a level road at 0.
        roll_rad, pitch_rad, yaw_rad: intrinsic z-y-x angles; yaw is not wrapped.
        vx_mps, vy_mps, vz_mps: velocity of the reference point along the car's axes.
        roll_rate_radps, pitch_rate_radps, yaw_rate_radps: angular velocity about the car's axes.
        ax_mps2, ay_mps2, az_mps2: acceleration of the reference point against the ground, along the car's axes; without gravity.
        steering_wheel_rad, steering_wheel_rate_radps: left positive.
        steering_robot_nm: torque that the steering robot applies.
        wheel_speeds_radps, wheel_loads_n: forward rotation positive.
        gear: 1 upwards, 0 neutral or park, -1 reverse.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    vz_mps: float = 0.0
    roll_rate_radps: float = 0.0
    pitch_rate_radps: float = 0.0
    yaw_rate_radps: float = 0.0
    ax_mps2: float = 0.0
    ay_mps2: float = 0.0
    az_mps2: float = 0.0
    steering_wheel_rad: float = 0.0
    steering_wheel_rate_radps: float = 0.0
    steering_robot_nm: float = 0.0
    wheel_speeds_radps: Wheels = (0.0, 0.0, 0.0, 0.0)
    wheel_loads_n: Wheels = (0.0, 0.0, 0.0, 0.0)
    engine_speed_radps: float = 0.0
    gear: int = 0


class Plant(Protocol):
    """A car that moves."""

    @property
    def state(self) -> PlantState:
        """The state reached by the last step."""
        ...

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s` (1 ms) with the inputs held and return the state reached."""
        ...


@runtime_checkable
class LiftablePlant(Plant, Protocol):
    """A car that can hang on a lift, and be the virtual car of one that does; see `vehicle_emulator.lift`."""

    def on_the_lift(self) -> Plant:
        """The same car at rest with its wheels in the air, where it started."""
        ...

    def impose_steering(self, angle_rad: float, rate_radps: float) -> None:
        """Set angle and rate of the steering wheel; the next step starts from them."""
        ...


def silent(_: str) -> None:
    """A progress that tells nobody."""


class RoadPoint(NamedTuple):
    """The road under one point: height, its derivatives along x and y, and the factor on the grip of the tyre's own road."""

    z_m: float
    slope_x: float
    slope_y: float
    friction: float


class Road(Protocol):
    """A road: a height that is continuous with its slope, and a friction map. No steps: a wheel that meets one flies."""

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        """The road at a place of the local frame."""
        ...


class Level:
    """A level road at height 0.

    Args:
        friction: factor on the grip.
    """

    def __init__(self, friction: float = 1.0) -> None:
        self._point = RoadPoint(0.0, 0.0, 0.0, friction)

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        """See `Road`."""
        return self._point
