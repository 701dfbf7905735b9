"""The emulator as a process: the car in real time on its CAN buses, its ground truth on telemetry."""

import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dbc import catalogue as dbc_catalogue
from dbc.frame import CanFrame
from dbc.link import BusSet
from dbc.realtime import EMULATOR_PRIORITY, become_realtime
from dbc.vehicle import FOCUS, load_vehicle
from gateway.telemetry import DEFAULT_BASE_PORT, FaultSample, Publisher, Source, WorldSample
from vehicle_emulator.emulator import DEFAULT_PLANT, STEP_NS, STEP_S, Emulator, EmulatorSetup, GroundTruth, StartPose
from vehicle_emulator.faults.engine import FaultEvent
from vehicle_emulator.faults.operations import fault_operations
from vehicle_emulator.faults.spec import load_faults
from vehicle_emulator.lift import lift_operations
from vehicle_emulator.road import RoadDescription, load_road
from vehicle_emulator.service import SERVICE, EmulatorService

_STEPS_PER_WORLD_SAMPLE = 20
"""50 Hz."""
MAX_CATCH_UP_NS = 50_000_000
"""After a longer stall of the machine the car stands still for the time lost, instead of racing after it."""

_PUBLISHED = (
    *("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps", "ax_mps2", "ay_mps2"),
    *("engine_speed_radps", "gear"),
)
"""Fields of the car's state that are published as they are."""

log = logging.getLogger("xilgate.emulator")


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What a run of the emulator needs.

    Args:
        buses: bus of every network as `dbc.link` wants it, for example "socketcan:vcan0".
        vehicle: vehicle file; None for the car that comes with the project.
        dbc: DBC files of robots and navigation system.
        mapping: names that the site gives to messages and signals, see `dbc.mapping`; None where they are ours.
        road: road file, as `vehicle_emulator.road` has it; None for a level one.
        plant: one of `plants.CHOICES`.
        is_lifted: whether the car begins on the lift.
        faults: file with the faults to inject, as `vehicle_emulator.faults` has them; None for none.
    """

    buses: Mapping[str, str]
    vehicle: Path | None = None
    dbc: tuple[Path, ...] = (dbc_catalogue.ROBOTS_DBC, dbc_catalogue.GNSS_IMU_DBC)
    mapping: Path | None = None
    start: StartPose = field(default_factory=StartPose)
    road: Path | None = None
    plant: str = DEFAULT_PLANT
    is_lifted: bool = False
    seed: int = 0
    faults: Path | None = None
    telemetry_base_port: int = DEFAULT_BASE_PORT


class StepClock:
    """Which steps are due: a fixed grid of absolute times, caught up with after a short stall, skipped after a long one.

    Attributes:
        skipped: steps that were never made.
    """

    def __init__(self, start_ns: int) -> None:
        self._next_ns = start_ns + STEP_NS
        self.skipped = 0

    def due(self, now_ns: int) -> range:
        """Times of the steps to make now, oldest first [ns]."""
        if now_ns - self._next_ns > MAX_CATCH_UP_NS:
            lost = (now_ns - self._next_ns) // STEP_NS
            self.skipped += lost
            self._next_ns += lost * STEP_NS
        steps = range(self._next_ns, now_ns + 1, STEP_NS)
        self._next_ns += len(steps) * STEP_NS
        return steps


def world_sample(truth: GroundTruth, t_ns: int, seq: int) -> WorldSample:
    """The ground truth as telemetry publishes it."""
    state = truth.state
    return WorldSample(
        t_ns=t_ns,
        seq=seq,
        **{name: getattr(state, name) for name in _PUBLISHED},
        wheel_speeds_radps=list(state.wheel_speeds_radps),
        sr_angle_rad=truth.sr_angle_rad,
        ar_position_norm=truth.ar_position_norm,
        br_position_norm=truth.br_position_norm,
        robots_engaged=truth.are_robots_engaged,
        is_lifted=truth.is_lifted,
    )


def fault_sample(event: FaultEvent, seq: int) -> FaultSample:
    """Beginning or end of a fault as telemetry publishes it."""
    return FaultSample(t_ns=event.t_ns, seq=seq, name=event.name, what=event.what, event=event.event, hits=event.hits)


def run(options: EmulatorOptions, stop: threading.Event) -> None:
    """Emulate the car until `stop` is set.

    Raises:
        UserMistake, SetupFailure: the set-up does not work; one line says why.
    """
    catalogue = dbc_catalogue.load(options.dbc, options.mapping)
    setup = EmulatorSetup(
        vehicle=load_vehicle(options.vehicle or FOCUS),
        start=options.start,
        road=load_road(options.road) if options.road is not None else RoadDescription(),
        plant=options.plant,
        is_lifted=options.is_lifted,
        faults=load_faults(options.faults) if options.faults is not None else (),
        seed=options.seed,
    )
    # Made once before anything is joined, because the first of its kind is compiled: a bus would fill up meanwhile.
    Emulator(setup, catalogue, 0, log.info)
    with BusSet(options.buses, catalogue) as buses, Publisher(Source.EMULATOR, options.telemetry_base_port) as publisher:
        start_ns = time.monotonic_ns()
        emulator = Emulator(setup, catalogue, start_ns)
        lift = lift_operations(emulator.car, lambda: emulator.inputs, emulator.robot_actions)
        service = EmulatorService(fault_operations(emulator.faults, catalogue) | lift)
        publisher.serve(SERVICE, service.answer)
        become_realtime(EMULATOR_PRIORITY)
        _drive(emulator, StepClock(start_ns), buses, publisher, service, stop)


def _drive(  # noqa: PLR0917 - what a drive takes
    emulator: Emulator, clock: StepClock, buses: BusSet, publisher: Publisher, service: EmulatorService, stop: threading.Event
) -> None:
    steps, events = 0, 0
    arrived: list[CanFrame] = []
    while not stop.is_set():
        time.sleep(STEP_S)  # a third cheaper than a wait for the event, a thousand times a second
        arrived += buses.receive()
        for step_ns in clock.due(time.monotonic_ns()):
            service.run_due(step_ns)
            buses.send(emulator.step(step_ns, arrived))
            arrived = []
            for arbitration_id, transmissions in emulator.disturbances:
                buses.disturb(arbitration_id, transmissions)
            for event in emulator.faults.take_events():
                log.info("fault %s %s: %s", event.name, event.event, event.what)
                publisher.post(fault_sample(event, events))
                events += 1
            if steps % _STEPS_PER_WORLD_SAMPLE == 0:
                publisher.post(world_sample(emulator.truth(), step_ns, steps // _STEPS_PER_WORLD_SAMPLE))
            steps += 1
