"""The emulator as a process: the car in real time on a CAN bus, its ground truth on telemetry."""

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from dbc import catalogue as dbc_catalogue
from dbc.frame import CanFrame
from dbc.link import CanLink
from dbc.realtime import EMULATOR_PRIORITY, become_realtime
from dbc.vehicle import FOCUS, load_vehicle
from gateway.telemetry import DEFAULT_BASE_PORT, Publisher, Source, WorldSample
from vehicle_emulator.emulator import STEP_NS, Emulator, GroundTruth, StartPose

_STEPS_PER_WORLD_SAMPLE = 20
"""50 Hz."""
MAX_CATCH_UP_NS = 50_000_000
"""After a longer stall of the machine the car stands still for the time lost, instead of racing after it."""


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What a run of the emulator needs.

    Args:
        bus_name: as `dbc.link` wants it, for example "socketcan:vcan0".
        vehicle: vehicle file; None for the car that comes with the project.
        dbc: DBC files of robots and navigation system.
    """

    bus_name: str
    vehicle: Path | None = None
    dbc: tuple[Path, ...] = (dbc_catalogue.ROBOTS_DBC, dbc_catalogue.GNSS_IMU_DBC)
    start: StartPose = field(default_factory=StartPose)
    seed: int = 0
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
    return WorldSample(
        t_ns=t_ns,
        seq=seq,
        x_m=truth.x_m,
        y_m=truth.y_m,
        yaw_rad=truth.yaw_rad,
        vx_mps=truth.vx_mps,
        vy_mps=truth.vy_mps,
        yaw_rate_radps=truth.yaw_rate_radps,
        ax_mps2=truth.ax_mps2,
        ay_mps2=truth.ay_mps2,
        sr_angle_rad=truth.sr_angle_rad,
        ar_position_norm=truth.ar_position_norm,
        br_position_norm=truth.br_position_norm,
        robots_engaged=truth.are_robots_engaged,
    )


def run(options: EmulatorOptions, stop: threading.Event) -> None:
    """Emulate the car until `stop` is set.

    Raises:
        CatalogueError, VehicleError, LinkError, TelemetryError: the set-up does not work; one line says why.
    """
    vehicle = load_vehicle(options.vehicle or FOCUS)
    catalogue = dbc_catalogue.load(options.dbc)
    with CanLink(options.bus_name) as link, Publisher(Source.EMULATOR, options.telemetry_base_port) as publisher:
        start_ns = time.monotonic_ns()
        emulator = Emulator(vehicle, catalogue, options.start, options.seed, start_ns)
        become_realtime(EMULATOR_PRIORITY)
        _drive(emulator, StepClock(start_ns), link, publisher, stop)


def _drive(emulator: Emulator, clock: StepClock, link: CanLink, publisher: Publisher, stop: threading.Event) -> None:
    steps = 0
    arrived: list[CanFrame] = []
    while not stop.wait(STEP_NS * 1e-9):
        arrived += link.receive()
        for step_ns in clock.due(time.monotonic_ns()):
            link.send(emulator.step(step_ns, arrived))
            arrived = []
            if steps % _STEPS_PER_WORLD_SAMPLE == 0:
                publisher.post(world_sample(emulator.truth(), step_ns, steps // _STEPS_PER_WORLD_SAMPLE))
            steps += 1
