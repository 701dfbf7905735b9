"""A car that is an FMU: what Amesim, CarMaker and others export for co-simulation, FMI 2.0 or 3.0."""

import math
import os
from pathlib import Path
from typing import Self

from dbc.vehicle import Vehicle
from vehicle_emulator.plants.bicycle import GEARS
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.fmu_mapping import WHEEL_LOADS, WHEEL_SPEEDS, FmuMapping, MappingError, Variables, load_mapping
from vehicle_emulator.plants.fmu_slave import FmuFailed, FmuSlave, FmuUnusable
from vehicle_emulator.plants.interface import PlantInputs, PlantState, Road, RoadPoint, Wheels

PERIOD_S = 1e-3


class FmuPlant:
    """A car that is an FMU, one communication step at a time.

    Inputs are those of the last millisecond of a communication step, and outputs those of its end: what goes in comes out at most one
    communication step later.

    Args:
        path: of the FMU.
        vehicle: its steering ratio, and the robot that turns our own steering wheel where the FMU has none.
        road: what the FMU may be told of the road.
        pose: x [m], y [m] and yaw [rad] at the start.
        speed_mps: forward speed at the start.
        mapping: file that says which variable is what; else the TOML file beside the FMU, of the same name.

    Raises:
        ExtraMissing, FmuUnusable, MappingError, FmuFailed: it cannot be used; one line each.
    """

    def __init__(
        self,
        path: Path,
        vehicle: Vehicle,
        road: Road,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
        speed_mps: float = 0.0,
        *,
        mapping: Path | None = None,
    ) -> None:
        if not os.path.isfile(path):
            raise FmuUnusable(f"{path}: no such file")
        mapping_path = mapping or path.with_suffix(".toml")
        content = load_mapping(mapping_path)
        self._vehicle = vehicle
        self._road = road
        self._path = path
        self._step_ms = content.step_ms
        self._ms_in_step = 0
        self._wheel = SteeringWheel(vehicle, PERIOD_S)
        self._state = PlantState()
        self._slave = FmuSlave(path)
        try:
            variables = Variables(mapping_path, self._slave.variables)
            self._inputs = variables.channels("inputs", content.inputs)
            self._outputs = variables.channels("outputs", content.outputs)
            self._has_wheel = "steering_wheel_rad" in content.outputs
            self._begin = self._beginning(mapping_path, content, variables, pose, speed_mps)
            self.reset()
        except BaseException:
            self._slave.close()
            raise

    @property
    def state(self) -> PlantState:
        """The state reached by the last step."""
        return self._state

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s` (1 ms) with the inputs held and return the state reached.

        Raises:
            FmuFailed: the FMU returned an error, ended, or gave a number that is none.
        """
        if dt_s != PERIOD_S:
            raise ValueError(f"step of {dt_s} s, made for {PERIOD_S} s")
        self._wheel.step(inputs.steering)
        self._ms_in_step += 1
        if self._ms_in_step < self._step_ms:
            self._state = _gone_on(self._state, dt_s)
        else:
            self._ms_in_step = 0
            given = self._given(inputs, self._road.at(self._state.x_m, self._state.y_m))
            self._slave.set([c.reference for c in self._inputs], [c.factor * given[c.key] + c.offset for c in self._inputs])
            self._slave.step(self._step_ms * PERIOD_S)
            self._state = self._observed()
        return self._state

    def reset(self) -> None:
        """Go back to the start.

        Raises:
            FmuFailed: the FMU returned an error.
        """
        self._wheel = SteeringWheel(self._vehicle, PERIOD_S)
        self._ms_in_step = 0
        self._slave.start(*self._begin)
        self._state = self._observed()

    def close(self) -> None:
        """End the FMU and remove what was unpacked; happens by itself when nobody has the plant any more."""
        self._slave.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _beginning(
        self, path: Path, mapping: FmuMapping, variables: Variables, pose: tuple[float, float, float], speed_mps: float
    ) -> tuple[list[int], list[float]]:
        """References and values of what is set before the FMU initializes."""
        x_m, y_m, yaw_rad = pose
        wanted = {"x_m": x_m, "y_m": y_m, "z_m": self._road.at(x_m, y_m).z_m, "yaw_rad": yaw_rad, "speed_mps": speed_mps}
        for key in ("x_m", "y_m", "yaw_rad", "speed_mps"):
            if wanted[key] != 0.0 and key not in mapping.start:
                raise MappingError(f"{path}: start.{key}: missing; the car is to start with {wanted[key]:g}")
        channels = variables.channels("start", mapping.start)
        fixed = {variables.reference("parameters", name, name): value for name, value in mapping.parameters.items()}
        values = [channel.factor * wanted[channel.key] + channel.offset for channel in channels]
        return [*(channel.reference for channel in channels), *fixed], [*values, *fixed.values()]

    def _given(self, inputs: PlantInputs, ground: RoadPoint) -> dict[str, float]:
        """All that an FMU can be given, by its key."""
        steering, faults, wheel = inputs.steering, inputs.faults, self._wheel
        return {
            "steering_wheel_rad": wheel.angle_rad,
            "steering_wheel_rate_radps": wheel.rate_radps,
            "road_wheel_rad": wheel.angle_rad / self._vehicle.steering.ratio,
            "steering_demand_rad": steering.demand_rad,
            "steering_torque_limit_nm": steering.torque_limit_nm,
            "driver_torque_nm": steering.driver_torque_nm,
            "accelerator_norm": inputs.accelerator_norm,
            "brake_norm": inputs.brake_norm,
            "gear": float(GEARS[inputs.selector]),
            "drive_fault_norm": faults.drive_norm,
            "brake_fault_norm": faults.brake_norm,
            "push_n": faults.push_n,
            "road_z_m": ground.z_m,
            "road_slope_x": ground.slope_x,
            "road_slope_y": ground.slope_y,
            "road_friction": ground.friction,
        }

    def _observed(self) -> PlantState:
        channels = self._outputs
        read = self._slave.get([channel.reference for channel in channels])
        values = {c.key: c.factor * value + c.offset for c, value in zip(channels, read, strict=True)}
        if wrong := [key for key, value in values.items() if not math.isfinite(value)]:
            raise FmuFailed(f"{self._path}: {wrong[0]} = {values[wrong[0]]}: the FMU gives a number that is none")
        if not self._has_wheel:
            values |= {
                "steering_wheel_rad": self._wheel.angle_rad,
                "steering_wheel_rate_radps": self._wheel.rate_radps,
                "steering_robot_nm": self._wheel.robot_nm,
            }
        speeds_radps, loads_n = _popped(values, WHEEL_SPEEDS), _popped(values, WHEEL_LOADS)
        gear = round(values.pop("gear", 0.0))
        state = PlantState(wheel_speeds_radps=speeds_radps, wheel_loads_n=loads_n, gear=gear)
        return state._replace(**values)  # type: ignore[arg-type]  # what is left are fields of one number


def _popped(values: dict[str, float], keys: tuple[str, ...]) -> Wheels:
    """The numbers of the four wheels, taken out."""
    front_left, front_right, rear_left, rear_right = (values.pop(key, 0.0) for key in keys)
    return front_left, front_right, rear_left, rear_right


def _gone_on(state: PlantState, dt_s: float) -> PlantState:
    """A car that goes on at the velocities that it has."""
    yaw_rad = state.yaw_rad + dt_s * state.yaw_rate_radps
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return state._replace(
        x_m=state.x_m + dt_s * (state.vx_mps * cosine - state.vy_mps * sine),
        y_m=state.y_m + dt_s * (state.vx_mps * sine + state.vy_mps * cosine),
        yaw_rad=yaw_rad,
    )
