"""All numbers that the compiled car takes, gathered from the vehicle file."""

from dbc.multibody import MultibodyParameters
from dbc.powertrain import PowertrainParameters
from dbc.section import Section
from dbc.vehicle import Vehicle


class CarParameters(Section):
    """Numbers of one car; see the sections of the vehicle file of the same names."""

    multibody: MultibodyParameters
    powertrain: PowertrainParameters
    steering_ratio: float
    road_wheel_limit_rad: float
    servo_bandwidth_hz: float
    servo_damping_ratio: float
    servo_resistance_hz: float


def car_parameters(vehicle: Vehicle) -> CarParameters:
    """The numbers of a vehicle file that shape the emulated car."""
    return CarParameters(
        multibody=vehicle.multibody,
        powertrain=vehicle.powertrain,
        steering_ratio=vehicle.steering.ratio,
        road_wheel_limit_rad=vehicle.steering.road_wheel_limit_rad,
        servo_bandwidth_hz=vehicle.robots.steering.bandwidth_hz,
        servo_damping_ratio=vehicle.robots.steering.damping_ratio,
        servo_resistance_hz=vehicle.robots.steering.resistance_hz,
    )
