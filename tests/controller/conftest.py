"""What the controller's tests share: one compiled library, kept in the user's cache, and solvers on it."""

import numpy as np
import pytest

from controller.build import build
from controller.compiled import CompiledBackEnd
from controller.planning.planner import Planner, PlannerOptions
from controller.planning.reference import ReferencePath
from controller.problem import Horizon, OcpOptions
from controller.solver import SqpSolver
from dbc.vehicle import load_vehicle


@pytest.fixture(scope="session")
def vehicle():
    return load_vehicle()


@pytest.fixture(scope="session")
def library(vehicle):
    return build(vehicle.model, OcpOptions(), print).library


@pytest.fixture
def solver(library):
    return SqpSolver("casadi-c", OcpOptions(), lambda buffers: CompiledBackEnd(library, buffers))


@pytest.fixture(scope="session")
def wavy_path():
    """A road with bends, driven at 60 km/h, 2 m of room to the left and 1.5 m to the right."""
    x_m = np.arange(0.0, 300.0, 0.5)
    y_m = 5.0 * np.sin(x_m / 40.0)
    yaw_rad = np.arctan2(np.gradient(y_m), np.gradient(x_m))
    return ReferencePath(x_m, y_m, yaw_rad, np.full(600, 60 / 3.6), np.full(600, 2.0), np.full(600, 1.5))


@pytest.fixture
def problem(vehicle, wavy_path) -> tuple[np.ndarray, np.ndarray, Horizon]:
    """An ordinary problem: state, previous input, horizon."""
    state = np.array((16.0, 0.05, 0.02, 51.0, 5.0 * np.sin(51 / 40) + 0.3, 0.05))
    return state, np.array((0.01, 0.1)), Planner(wavy_path, vehicle.model, OcpOptions(), PlannerOptions()).horizon(state, 0.0)
