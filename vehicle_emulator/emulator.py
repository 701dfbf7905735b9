"""The heart of the emulator: one millisecond of the car, from the gateway's frames to the frames of robots and navigation system."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

from dbc.catalogue import Catalogue, CatalogueError
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle
from vehicle_emulator import ins, robot_system
from vehicle_emulator.ins import NavigationSystem
from vehicle_emulator.plant import AIR_DENSITY_KGPM3, GRAVITY_MPS2, FourWheelPlant, Plant, PlantInputs
from vehicle_emulator.robot_system import RobotPositions, RobotSystem

STEP_NS = 1_000_000
"""Time that one step advances the car [ns]."""
_GATEWAY = "GW"
_DRIVER_BRAKE_NORM = 0.3
"""Brake pedal that holds a standing car on a slope of 30 %."""
_DRIVER_GAIN_PER_S = 1.0
"""Acceleration that the safety driver asks for per m/s of speed error."""


@dataclass(frozen=True, slots=True)
class StartPose:
    """Where the car starts: local frame, x east and y north, yaw counter-clockwise from x, forward speed, and how the road climbs.

    Args:
        grade: rise over run, in the direction in which the car points.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    speed_mps: float = 0.0
    grade: float = 0.0


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """What is really so, at the centre of gravity, ISO 8855 axes; the steering angle is that of the steering wheel."""

    x_m: float
    y_m: float
    yaw_rad: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    ay_mps2: float
    sr_angle_rad: float
    ar_position_norm: float
    br_position_norm: float
    are_robots_engaged: bool


class Emulator:
    """The car on its bus: every message of the DBC that the gateway does not send.

    Deterministic: the same seed, start and frames give the same bytes.

    Until the robots are engaged for the first time, a virtual safety driver holds the start speed with the accelerator, or the
    standing car with the brake, and steers straight ahead; afterwards nobody touches pedals or wheel but the robots. The dead-man
    switch is always pressed.

    Args:
        seed: of the noise of the navigation system.
        start_ns: monotonic time of the start [ns]; the first step is due one `STEP_NS` later.

    Raises:
        CatalogueError: the DBC lacks a message that the emulator needs, or has one that it cannot fill.
    """

    def __init__(self, vehicle: Vehicle, catalogue: Catalogue, start: StartPose, seed: int, start_ns: int) -> None:
        _check(catalogue)
        self._vehicle = vehicle
        self._catalogue = catalogue
        self._start = start
        self._robots = RobotSystem(vehicle, catalogue, STEP_NS * 1e-9)
        plant = FourWheelPlant(vehicle.plant, (start.x_m, start.y_m, start.yaw_rad), start.speed_mps, start.grade)
        self._plant: Plant = plant
        self._state = plant.state
        self._ins = NavigationSystem(vehicle.ins, catalogue, Random(seed), period_ns=STEP_NS, start_ns=start_ns, state=self._state)
        self._outputs = sorted((_Output(catalogue, name, start_ns) for name in _OWN_MESSAGES), key=lambda output: output.arbitration_id)

    def step(self, now_ns: int, frames: Sequence[CanFrame]) -> list[CanFrame]:
        """Advance the car by `STEP_NS` to `now_ns`, with the frames that have arrived; the frames that are due now."""
        robots = self._robots.step(now_ns, frames, self._state.vx_mps)
        self._state = self._plant.step(STEP_NS * 1e-9, self._inputs(robots))
        self._ins.observe(self._state)
        return [output.frame(now_ns, self._values(output.name, now_ns)) for output in self._outputs if output.is_due(now_ns)]

    def truth(self) -> GroundTruth:
        """The state reached by the last step."""
        return GroundTruth(*self._state, *self._robots.positions, are_robots_engaged=self._robots.is_engaged)

    def _inputs(self, robots: RobotPositions) -> PlantInputs:
        limit_rad = self._vehicle.steering.road_wheel_limit_rad
        road_wheel_rad = min(max(robots.steering_wheel_rad / self._vehicle.steering.ratio, -limit_rad), limit_rad)
        if self._robots.was_engaged:
            return PlantInputs(road_wheel_rad, robots.accelerator_norm, robots.brake_norm)
        if self._start.speed_mps > 0.0:
            return PlantInputs(road_wheel_rad, self._driver_norm(), robots.brake_norm)
        return PlantInputs(road_wheel_rad, robots.accelerator_norm, max(robots.brake_norm, _DRIVER_BRAKE_NORM))

    def _driver_norm(self) -> float:
        """Accelerator of the safety driver: what the resistances need, and a correction of the speed."""
        p, vx_mps = self._vehicle.plant, self._state.vx_mps
        rolling_n = p.rolling_resistance_coefficient * p.mass_kg * GRAVITY_MPS2
        air_n = 0.5 * AIR_DENSITY_KGPM3 * p.drag_area_m2 * vx_mps * vx_mps
        correction_n = p.mass_kg * _DRIVER_GAIN_PER_S * (self._start.speed_mps - vx_mps)
        climb_n = p.mass_kg * GRAVITY_MPS2 * math.sin(math.atan(self._start.grade))
        wanted_n = rolling_n + air_n + climb_n + p.drag_torque_force_n + correction_n
        return min(max(wanted_n / (p.full_drive_force_n + p.drag_torque_force_n), 0.0), 1.0)

    def _values(self, name: str, now_ns: int) -> dict[str, float]:
        return self._robots.status(name) if name in robot_system.STATUS_MESSAGES else self._ins.message(name, now_ns)


class _Output:
    """One cyclic message: when it is due and how its frame is made."""

    def __init__(self, catalogue: Catalogue, name: str, start_ns: int) -> None:
        spec = catalogue.by_name[name]
        self.name = name
        self.arbitration_id = spec.arbitration_id
        self._catalogue = catalogue
        self._cycle_ns = spec.cycle_time_ns
        self._due_ns = start_ns + _first_ns(name, spec.cycle_time_ns)
        self._bounds = {signal: catalogue.bounds(name, signal) for signal in catalogue.signals(name)}
        self._protector = None if spec.e2e_data_id is None else E2EProtector(spec.e2e_data_id)

    def is_due(self, now_ns: int) -> bool:
        """Whether the message is to be sent; what a stall has made late is skipped, not sent in a burst."""
        if now_ns < self._due_ns:
            return False
        self._due_ns += self._cycle_ns * (1 + (now_ns - self._due_ns) // self._cycle_ns)
        return True

    def frame(self, now_ns: int, values: dict[str, float]) -> CanFrame:
        """The frame with these values, moved into the range of the DBC where an instrument would saturate."""
        bounds = self._bounds
        payload = self._catalogue.encode(self.name, {s: min(max(v, bounds[s][0]), bounds[s][1]) for s, v in values.items()})
        return CanFrame(self.arbitration_id, self._protector.protect(payload) if self._protector else payload, now_ns)


_OWN_MESSAGES = robot_system.STATUS_MESSAGES + ins.MESSAGES


def _first_ns(name: str, cycle_ns: int) -> int:
    """Time from the start to the first frame: one cycle, but the status channels of the navigation system take turns."""
    turns = ins.STATUS_MESSAGES
    return (turns.index(name) + 1) * cycle_ns // len(turns) if name in turns else cycle_ns


def _check(catalogue: Catalogue) -> None:
    catalogue.require(_OWN_MESSAGES + robot_system.COMMAND_MESSAGES, "emulator")
    files = ", ".join(catalogue.sha256)
    others = {name for name, spec in catalogue.by_name.items() if spec.sender != _GATEWAY}
    if unknown := sorted(others - set(_OWN_MESSAGES)):
        raise CatalogueError(f"{files}: message {', '.join(unknown)}, which the emulator cannot fill")
    if silent := sorted(name for name in _OWN_MESSAGES if catalogue.by_name[name].cycle_time_ns <= 0):
        raise CatalogueError(f"{files}: message {', '.join(silent)}: no GenMsgCycleTime")
