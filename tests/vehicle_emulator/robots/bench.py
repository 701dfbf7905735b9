"""The robots, a gateway stub, a steering wheel (without a car by default), and a millisecond clock; the gateway sends every 10 ms."""

from collections.abc import Callable
from random import Random

from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle, load_vehicle
from tests.vehicle_emulator.gateway_stub import GatewayStub
from vehicle_emulator.driver import Driver
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.interface import Level, PlantInputs, PlantState, SteeringInputs
from vehicle_emulator.plants.multibody.plant import MultibodyPlant
from vehicle_emulator.robots.system import NODES, RobotSystem

CATALOGUE = load()
VEHICLE = load_vehicle()
STEP_NS = 1_000_000
TIMEOUT_MS = CATALOGUE.by_name["SR_Command"].timeout_ns // STEP_NS
SYSTEM_STATES = {raw: name for name, raw in CATALOGUE.enumeration("RC_SafetyStatus", "SystemState").items()}
STOP_SOURCES = {raw: name for name, raw in CATALOGUE.enumeration("RC_SafetyStatus", "StopSource").items()}
ROBOT_STATES = {raw: name for name, raw in CATALOGUE.enumeration("SR_Status", "State").items()}
DTC = CATALOGUE.enumeration("RC_FaultReport", "Dtc")


def ideal(vehicle: Vehicle = VEHICLE) -> Vehicle:
    """The same robots without jitter, play, noise and coarse resolution, so that an analytic model describes them."""
    fine = {"dead_time_jitter_s": 0.0}
    steering = vehicle.robots.steering.model_copy(update={**fine, "play_rad": 0.0, "noise_rad": 0.0, "resolution_rad": 1e-9})
    pedals = {**fine, "noise_norm": 0.0, "resolution_norm": 1e-9}
    robots = vehicle.robots.model_copy(
        update={
            "steering": steering,
            "accelerator": vehicle.robots.accelerator.model_copy(update=pedals),
            "brake": vehicle.robots.brake.model_copy(update=pedals),
        }
    )
    return vehicle.model_copy(update={"robots": robots})


class LiftedWheel:
    """The steering wheel of the multibody car with its wheels in the air."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._plant = MultibodyPlant(vehicle, Level(), is_lifted=True)
        self.step(SteeringInputs())

    def step(self, inputs: SteeringInputs) -> None:
        state = self._plant.step(1e-3, PlantInputs(steering=inputs))
        self.angle_rad, self.rate_radps, self.robot_nm = (
            state.steering_wheel_rad, state.steering_wheel_rate_radps, state.steering_robot_nm
        )  # fmt: skip


class Bench:
    """See the module; `speed_mps`, `sideways_mps` and `driver` may be set between steps."""

    def __init__(self, vehicle: Vehicle = VEHICLE, seed: int = 1, wheel: LiftedWheel | None = None) -> None:
        self.system = RobotSystem(vehicle, CATALOGUE, 1e-3, Random(seed))
        self.gateway = GatewayStub(CATALOGUE, lambda: self.system.watchdog_question)
        self.wheel = wheel or SteeringWheel(vehicle, 1e-3)
        self.ms = 0
        self.speed_mps = 20.0
        self.sideways_mps = 0.0
        self.driver = Driver()
        self.inputs = PlantInputs()

    @property
    def feedback(self) -> PlantState:
        return PlantState(
            vx_mps=self.speed_mps,
            vy_mps=self.sideways_mps,
            steering_wheel_rad=self.wheel.angle_rad,
            steering_wheel_rate_radps=self.wheel.rate_radps,
            steering_robot_nm=self.wheel.robot_nm,
        )

    def step(self, frames: list[CanFrame] | None = None) -> PlantInputs:
        self.ms += 1
        self.inputs = self.system.step(self.ms * STEP_NS, frames or [], self.feedback, self.driver)
        self.wheel.step(self.inputs.steering)
        return self.inputs

    def send(self, milliseconds: int, make_frames: Callable[[], list[CanFrame]]) -> None:
        for _ in range(milliseconds):
            self.step(make_frames() if self.ms % 10 == 0 else None)

    def run(self, milliseconds: int, request: str = "Engage", **demands: float) -> "Bench":
        self.send(milliseconds, lambda: self.gateway.frames(request, **demands))
        return self

    def engage(self) -> "Bench":
        self.run(50, "Disarm").run(50, "Arm").run(50, "Engage")
        assert self.state == "Engaged"
        assert {self.robot_state(node) for node in NODES} == {"Engaged"}
        return self

    def silence(self, milliseconds: int) -> "Bench":
        for _ in range(milliseconds):
            self.step()
        return self

    def status(self, message: str) -> dict[str, float]:
        """What arrives on the bus: through the packing of the DBC."""
        spec = CATALOGUE.by_name[message]
        bounds = {signal: CATALOGUE.bounds(message, signal) for signal in CATALOGUE.signals(message)}
        values = {s: min(max(v, bounds[s][0]), bounds[s][1]) for s, v in self.system.status(message).items()}
        return CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, CATALOGUE.encode(message, values), 0))

    @property
    def state(self) -> str:
        return SYSTEM_STATES[int(self.status("RC_SafetyStatus")["SystemState"])]

    @property
    def stop_source(self) -> str:
        return STOP_SOURCES[int(self.status("RC_SafetyStatus")["StopSource"])]

    def robot_state(self, node: str) -> str:
        return ROBOT_STATES[int(self.status(f"{node}_Status")["State"])]


def command_of(bench: Bench, node: str, **values: float | str) -> list[CanFrame]:
    """Good commands that ask every robot for something; those of one robot changed."""
    gateway = bench.gateway
    steering = {"angle_deg": 60.0} | (values if node == "SR" else {})
    pedals = {name: {"percent": percent} | (values if node == name else {}) for name, percent in (("AR", 0.0), ("BR", 40.0))}
    return [gateway.safety("Engage"), gateway.steering(**steering), *(gateway.pedal(name, **pedals[name]) for name in ("AR", "BR"))]
