"""The heart of the emulator: one millisecond of the car, from the gateway's frames to the frames of all that answers it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from random import Random

from dbc.catalogue import Catalogue, CatalogueError
from dbc.e2e import E2EProtector
from dbc.errors import UserMistake
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle
from vehicle_emulator import car_bus, ins
from vehicle_emulator.car_bus import CarBus
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.effects import ActiveFaults, Disturbance
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.spec import FaultSpec
from vehicle_emulator.ins import NavigationSystem
from vehicle_emulator.lift import Car
from vehicle_emulator.plants import make_plant
from vehicle_emulator.plants.interface import PlantInputs, PlantState, Progress, Road, RoadPoint, silent
from vehicle_emulator.road import RoadDescription, make_road
from vehicle_emulator.robots import system
from vehicle_emulator.robots.supervisor import RELEASED, STOPS, SystemState
from vehicle_emulator.robots.system import RobotSystem
from vehicle_emulator.safety_driver import SafetyDriver

STEP_NS = 1_000_000
"""Time that one step advances the car [ns]."""
STEP_S = STEP_NS * 1e-9
DEFAULT_PLANT = "multibody"
_GATEWAY = "GW"
_ACTIVE = (SystemState.ENGAGED, *STOPS)


@dataclass(frozen=True, slots=True)
class StartPose:
    """Where the car starts: local frame, x east and y north, yaw counter-clockwise from x, and its forward speed."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    speed_mps: float = 0.0


@dataclass(frozen=True, slots=True)
class EmulatorSetup:
    """What is emulated.

    Args:
        plant: one of `plants.CHOICES`.
        is_lifted: whether the car begins on the lift, see `vehicle_emulator.lift`.
        faults: that are there from the start.
        seed: of everything that is random.
    """

    vehicle: Vehicle
    start: StartPose = field(default_factory=StartPose)
    road: RoadDescription = field(default_factory=RoadDescription)
    plant: str = DEFAULT_PLANT
    is_lifted: bool = False
    faults: tuple[FaultSpec, ...] = ()
    seed: int = 0


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """What is really so, at the centre of gravity, ISO 8855 axes; the steering angle is that of the steering wheel."""

    state: PlantState
    sr_angle_rad: float
    ar_position_norm: float
    br_position_norm: float
    are_robots_engaged: bool
    is_lifted: bool = False


class PlantLost(UserMistake):
    """The emulated car left the realm of numbers; one line that says whose it is."""


class Emulator:
    """The car on its buses: every message of the DBC that the gateway does not send.

    Deterministic: the same setup and frames give the same bytes. Until the robots are engaged for the first time, a virtual safety
    driver holds the start speed, or the standing car; afterwards he only holds a slow car while the robots are not active.

    Args:
        start_ns: monotonic time of the start [ns]; the first step is due one `STEP_NS` later.
        progress: told in one line each what takes time.

    Raises:
        UserMistake: the DBC lacks a message that the emulator needs, or has one that it cannot fill; the plant or a fault is not known.
        SetupFailure: the plant cannot be built on this machine.

    Attributes:
        car: on its road or on the lift.
        faults: what is injected.
        inputs: what acts on the car since the last step.
        disturbances: transmissions that the buses are to destroy, as of the last step.
    """

    def __init__(self, setup: EmulatorSetup, catalogue: Catalogue, start_ns: int, progress: Progress = silent) -> None:
        _check(catalogue)
        vehicle, start = setup.vehicle, setup.start
        self._name = vehicle.name
        self._road = _SlipperyRoad(make_road(setup.road))
        pose = (start.x_m, start.y_m, start.yaw_rad)
        plant = make_plant(setup.plant, vehicle, self._road, pose, speed_mps=start.speed_mps, progress=progress)
        self.car = Car(plant, is_lifted=setup.is_lifted)
        self._robots = RobotSystem(vehicle, catalogue, STEP_S, Random(f"{setup.seed} robots"))
        self._driver = SafetyDriver(start.speed_mps)
        self._ins = NavigationSystem(
            vehicle.ins, catalogue, Random(setup.seed), period_ns=STEP_NS, start_ns=start_ns, state=self.car.state
        )  # fmt: skip
        self._car_bus = CarBus(catalogue)
        self._senders = {name: _Sender(catalogue, name) for name in _OWN_MESSAGES if name in catalogue.by_name}
        self._timetable = _Timetable({name: catalogue.by_name[name].cycle_time_ns for name in _CYCLIC_MESSAGES}, start_ns)
        self.faults = FaultEngine(setup.faults, setup.seed, start_ns, catalogue)
        self._active: ActiveFaults | None = None
        self.inputs = PlantInputs()
        self.disturbances: tuple[Disturbance, ...] = ()

    def step(self, now_ns: int, frames: Sequence[CanFrame]) -> list[CanFrame]:
        """Advance the car by `STEP_NS` to `now_ns`, with the frames that have arrived; the frames that are due now."""
        robots, before = self._robots, self.car.state
        faults = self.faults.update(now_ns, Situation(before, robots.is_engaged))
        if faults is not self._active:
            self._suffer(faults)
        is_active = robots.supervisor.state in _ACTIVE
        driver = faults.driven_by(self._driver.step(STEP_S, before, was_engaged=robots.was_engaged, are_robots_active=is_active))
        heard = self.faults.incoming(now_ns, list(frames))
        inputs = robots.step(now_ns, heard, before, driver)
        self.inputs = inputs if faults.plant == inputs.faults else inputs._replace(faults=faults.plant)
        self._ins.observe(self._checked(self.car.step(STEP_S, self.inputs)))
        return self.faults.outgoing(now_ns, [self._senders[name].frame(now_ns, values) for name, values in self._due(now_ns)])

    def _suffer(self, faults: ActiveFaults) -> None:
        """Hand what is wrong from now on to those whom it concerns."""
        self._active = faults
        self._road.factor, self._ins.faults, self.disturbances = faults.friction, faults.ins, faults.disturbances
        self._robots.faults.update(faults.robots)

    def _checked(self, state: PlantState) -> PlantState:
        """The state, if it is one: numbers of a vehicle file can be allowed each, and still be no car together."""
        if not math.isfinite(state.x_m + state.y_m + state.vx_mps + state.yaw_rate_radps):
            raise PlantLost(f"vehicle {self._name}: the emulated car has no finite state any more; its numbers do not make a car")
        return state

    def truth(self) -> GroundTruth:
        """The state reached by the last step."""
        state = self.car.state
        engaged, lifted = self._robots.is_engaged, self.car.is_lifted
        return GroundTruth(state, state.steering_wheel_rad, *self._robots.pedals, are_robots_engaged=engaged, is_lifted=lifted)

    def robot_actions(self) -> list[str]:
        """What the robots do or may do now, in words; nothing when they are neutral: released, with their pedals at rest."""
        state, pedals = self._robots.supervisor.state, self._robots.pedals
        conditions = (
            (state not in RELEASED, f"the robot system is in {state}"),
            (pedals.accelerator_norm > 0.0, f"the accelerator robot is at {100.0 * pedals.accelerator_norm:.0f} %"),
            (pedals.brake_norm > 0.0, f"the brake robot is at {100.0 * pedals.brake_norm:.0f} %"),
        )
        return [action for is_true, action in conditions if is_true]

    def _due(self, now_ns: int) -> list[tuple[str, Mapping[str, float]]]:
        """Messages to send now, with their signals in the units of the DBC."""
        messages: list[tuple[str, Mapping[str, float]]] = []
        if cyclic := self._timetable.due(now_ns):
            robots = [name for name in cyclic if name in system.STATUS_MESSAGES and not self._robots.is_silent(name)]
            messages += [(name, self._robots.status(name)) for name in robots]
            messages += [(name, self._car_bus.message(name, self.car.state, self.inputs)) for name in cyclic if name in car_bus.MESSAGES]
        messages += [(name, self._ins.message(name, now_ns)) for name in self._ins.due(now_ns)]
        return messages


class _SlipperyRoad:
    """A road whose grip a fault may take."""

    def __init__(self, road: Road) -> None:
        self._road = road
        self.factor = 1.0

    def at(self, x_m: float, y_m: float) -> RoadPoint:
        """See `Road`."""
        point = self._road.at(x_m, y_m)
        return point if self.factor == 1.0 else point._replace(friction=self.factor * point.friction)


class _Timetable:
    """When cyclic messages are due: first one cycle after the start; what a stall has made late is skipped, not sent in a burst.

    Args:
        cycles_ns: of each message [ns].
    """

    def __init__(self, cycles_ns: Mapping[str, int], start_ns: int) -> None:
        self._cycles_ns = cycles_ns
        self._due_ns = {name: start_ns + cycle_ns for name, cycle_ns in cycles_ns.items()}
        self._next_ns = min(self._due_ns.values())

    def due(self, now_ns: int) -> list[str]:
        """The messages to be sent."""
        if now_ns < self._next_ns:
            return []
        names = [name for name, due_ns in self._due_ns.items() if due_ns <= now_ns]
        for name in names:
            cycle_ns = self._cycles_ns[name]
            self._due_ns[name] += cycle_ns * (1 + (now_ns - self._due_ns[name]) // cycle_ns)
        self._next_ns = min(self._due_ns.values())
        return names


class _Sender:
    """Makes the frames of one message."""

    def __init__(self, catalogue: Catalogue, name: str) -> None:
        spec = catalogue.by_name[name]
        self._name = name
        self._arbitration_id = spec.arbitration_id
        self._catalogue = catalogue
        self._protector = None if spec.e2e_data_id is None else E2EProtector(spec.e2e_data_id)

    def frame(self, now_ns: int, values: Mapping[str, float]) -> CanFrame:
        """The frame with these values, moved into the range of the DBC where an instrument would saturate."""
        payload = self._catalogue.encode(self._name, values, saturates=True)
        return CanFrame(self._arbitration_id, self._protector.protect(payload) if self._protector else payload, now_ns)


_CYCLIC_MESSAGES = (*system.STATUS_MESSAGES, *car_bus.MESSAGES)
_NEEDED_MESSAGES = (*_CYCLIC_MESSAGES, *ins.CORE_MESSAGES)
_OWN_MESSAGES = (*_CYCLIC_MESSAGES, *ins.MESSAGES)


def _check(catalogue: Catalogue) -> None:
    catalogue.require((*_NEEDED_MESSAGES, *system.COMMAND_MESSAGES), "emulator")
    files = ", ".join(catalogue.sha256)
    others = {name for name, spec in catalogue.by_name.items() if spec.sender != _GATEWAY}
    if unknown := sorted(others - set(_OWN_MESSAGES)):
        raise CatalogueError(f"{files}: message {', '.join(unknown)}, which the emulator cannot fill")
    if silent := sorted(name for name in _NEEDED_MESSAGES if catalogue.by_name[name].cycle_time_ns <= 0):
        raise CatalogueError(f"{files}: message {', '.join(silent)}: no GenMsgCycleTime")
