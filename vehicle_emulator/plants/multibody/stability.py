"""How fast the fastest motion of a car is, which decides on the step of an explicit integrator."""

from itertools import product

import casadi as ca
import numpy as np

from dbc.vehicle import Vehicle
from vehicle_emulator.plants.interface import Level, PlantInputs, Selector, SteeringInputs
from vehicle_emulator.plants.multibody.equations import build_functions
from vehicle_emulator.plants.multibody.layout import numbers
from vehicle_emulator.plants.multibody.parameters import car_parameters
from vehicle_emulator.plants.multibody.plant import MultibodyPlant

_SPEEDS_MPS = (0.0, 2.0, 20.0, 60.0, -5.0)
_PEDALS = ((0.7, 0.0), (0.0, 0.4), (0.0, 1.0))
"""Accelerator and brake."""
_STEERING_RAD = (0.0, 7.0)
_FRICTIONS = (1.0, 0.2)
_STEP_S, _STEPS = 0.001, 300


def largest_pole(vehicle: Vehicle) -> tuple[float, str]:
    """Largest eigenvalue [1/s] of the car's linearised equations over its operating range, and where it is.

    Each operating point is linearised after 0.3 s: rolling, reversing and at rest, driven, braked up to full pedal, straight and with
    the steering wheel turned by 400 degrees, on a dry road and on snow, and on the lift.
    """
    parameters = car_parameters(vehicle)
    derivatives = build_functions(parameters).derivatives
    x, u, p = derivatives.sx_in()
    jacobian = ca.Function("jacobian", [x, u, p], [ca.jacobian(derivatives(x, u, p)[0], x)])
    values, found = numbers(parameters), []
    for speed_mps, (accelerator, brake), steering_rad, friction in product(_SPEEDS_MPS, _PEDALS, _STEERING_RAD, _FRICTIONS):
        for is_lifted in (False, True)[: 2 if speed_mps == 0.0 and friction == 1.0 else 1]:
            plant = MultibodyPlant(vehicle, Level(friction), speed_mps=speed_mps, is_lifted=is_lifted)
            selector = Selector.DRIVE if speed_mps >= 0.0 else Selector.REVERSE
            inputs = PlantInputs(SteeringInputs(steering_rad, torque_limit_nm=60.0), accelerator, brake, selector)
            for _ in range(_STEPS):
                plant.step(_STEP_S, inputs)
            matrix = np.array(jacobian(np.array(plant.car.state), np.array(plant.car.inputs), values))
            where = f"{speed_mps:g} m/s, accelerator {accelerator:g}, brake {brake:g}, steering {steering_rad:g} rad, friction {friction:g}"
            found.append((float(abs(np.linalg.eigvals(matrix)).max()), "on the lift, " * is_lifted + where))
    return max(found)
