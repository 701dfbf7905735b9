"""What stands where in the vectors of the compiled car: one table for each vector, and the parameters.

A table is a tuple of named fields that holds the size of each field; `slices` gives the same tuple filled with places,
`symbols.symbols` with CasADi symbols. Vectors are in the car's body frame, origin at the sprung centre of gravity, unless they say
otherwise; wheels stand in the order front left, front right, rear left, rear right.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel

SX = Any
"""`casadi.SX`; CasADi has no types."""


class State(NamedTuple):
    """What is integrated.

    Args:
        position_m: of the sprung centre of gravity in the local frame.
        attitude: quaternion from the body to the local frame, scalar first.
        velocity_mps, rates_radps: of the body.
        travel_m, travel_mps: of the wheels relative to the body, along their slanted axes, upward positive; 0 in the design position.
        spin_radps: of the wheels about their own axes, against the ground, not against the car.
        steering_rad, steering_radps: of the steering wheel.
        column_bristle, brake_bristle: friction over its limit, -1 to 1.
        resistance_nm: what the steering robot believes that turns the wheel besides itself.
        slip_x, slip_y: slip that the tyres have relaxed to; sign of the force that it gives.
        brake_bar: pressure.
        engine_radps, engine_nm: see `powertrain`.
    """

    position_m: Any
    attitude: Any
    velocity_mps: Any
    rates_radps: Any
    travel_m: Any
    travel_mps: Any
    spin_radps: Any
    steering_rad: Any
    steering_radps: Any
    column_bristle: Any
    resistance_nm: Any
    slip_x: Any
    slip_y: Any
    brake_bristle: Any
    brake_bar: Any
    engine_radps: Any
    engine_nm: Any


class Inputs(NamedTuple):
    """What is held over a step.

    Args:
        demand_rad, torque_limit_nm, driver_nm: steering robot and driver's hands.
        accelerator, brake: pedals, 0 to 1.
        ratio: engine speed over speed of the driven wheels, negative in reverse; 0 in neutral.
        clutch, lockup: closed share of clutch or gear, and of the converter's lock-up clutch.
        park: 1 when the gearbox is locked.
        drive_share, brake_share, push_n: see `interface.PlantFaults`.
        lift: 1 on the lift, 0 on the road.
        road: for each wheel the plane z = c + a x + b y of the road under it, c, a and b, and the factor on grip.
    """

    demand_rad: Any
    torque_limit_nm: Any
    driver_nm: Any
    accelerator: Any
    brake: Any
    ratio: Any
    clutch: Any
    lockup: Any
    park: Any
    drive_share: Any
    brake_share: Any
    push_n: Any
    lift: Any
    road: Any


class Motion(NamedTuple):
    """What follows from the state alone; of the reference point of `interface.PlantState`.

    Args:
        wheels_radps: speeds of the wheels as sensors on the car measure them.
        hubs_x_m, hubs_y_m: where the road is looked up.
    """

    position_m: Any
    angles_rad: Any
    velocity_mps: Any
    rates_radps: Any
    steering_rad: Any
    steering_radps: Any
    wheels_radps: Any
    engine_radps: Any
    hubs_x_m: Any
    hubs_y_m: Any


class Felt(NamedTuple):
    """What comes with the derivative of the state: acceleration of the reference point, wheel loads, torque of the steering robot."""

    acceleration_mps2: Any
    loads_n: Any
    robot_nm: Any


STATE = State(
    position_m=3, attitude=4, velocity_mps=3, rates_radps=3, travel_m=4, travel_mps=4, spin_radps=4, steering_rad=1, steering_radps=1,
    column_bristle=1, resistance_nm=1, slip_x=4, slip_y=4, brake_bristle=4, brake_bar=1, engine_radps=1, engine_nm=1,
)  # fmt: skip
INPUTS = Inputs(
    demand_rad=1, torque_limit_nm=1, driver_nm=1, accelerator=1, brake=1, ratio=1, clutch=1, lockup=1, park=1, drive_share=1,
    brake_share=1, push_n=1, lift=1, road=16,
)  # fmt: skip
MOTION = Motion(
    position_m=3, angles_rad=3, velocity_mps=3, rates_radps=3, steering_rad=1, steering_radps=1, wheels_radps=4, engine_radps=1,
    hubs_x_m=4, hubs_y_m=4,
)  # fmt: skip
FELT = Felt(acceleration_mps2=3, loads_n=4, robot_nm=1)

Table = TypeVar("Table", State, Inputs, Motion, Felt)


def slices(sizes: Table) -> Table:
    """Where each field stands in the vector."""
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    return type(sizes)(*(slice(end - size, end) for size, end in zip(sizes, ends, strict=True)))


def numbers(section: BaseModel) -> list[float]:
    """All numbers of a section of the vehicle file and of those in it, in their order; truth is 1."""
    return [float(number) for _, values in leaves(section) for number in values]


def leaves(section: BaseModel, prefix: str = "") -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Name and values of every entry of a section and of those in it."""
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value if isinstance(value, tuple) else (value,)
