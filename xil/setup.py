"""All that a run is made of, worked out before anything starts, so that a mistake costs no driving."""

from dataclasses import dataclass
from pathlib import Path

from dbc.build import Build
from dbc.catalogue import Catalogue
from dbc.vehicle import Vehicle
from gateway.limits import LIFTED, PROVING_GROUND, LimitProfile
from vehicle_emulator.emulator import DEFAULT_PLANT, EmulatorSetup, StartPose
from xil.bus import BusChoice
from xil.scenario import Scenario, Stage


@dataclass(frozen=True)
class RunSetup:
    """One run.

    Args:
        build: the compiled controller, or None for the uncompiled solver.
        bus: the buses of a real-time stage, None in lockstep.
        view_port: port of the virtual world's page, or None.
        directory: where the run leaves its files.
        plant, is_lifted: of the emulated car, see `vehicle_emulator.emulator.EmulatorSetup`.
        mapping_path: names of the site for ours, see `dbc.mapping`; None where they are ours.
    """

    scenario: Scenario
    stage: Stage
    vehicle: Vehicle
    catalogue: Catalogue
    solver: str
    build: Build | None
    bus: BusChoice | None
    seed: int
    directory: Path
    dbc_paths: tuple[Path, ...]
    vehicle_path: Path
    view_port: int | None
    telemetry_base_port: int
    plant: str = DEFAULT_PLANT
    is_lifted: bool = False
    mapping_path: Path | None = None

    @property
    def emulator(self) -> EmulatorSetup:
        """What the emulator emulates."""
        pose = self.scenario.start_pose
        return EmulatorSetup(
            vehicle=self.vehicle,
            start=StartPose(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps),
            road=self.scenario.road_surface(),
            plant=self.plant,
            is_lifted=self.is_lifted,
            faults=self.scenario.faults,
            seed=self.seed,
        )

    @property
    def profile(self) -> LimitProfile:
        """What the gateway lets through."""
        return LIFTED if self.is_lifted else PROVING_GROUND

    @property
    def bus_log(self) -> Path:
        """The bus record."""
        return self.directory / "bus.log"

    @property
    def scenario_copy(self) -> Path:
        """The scenario, as it was when the run began."""
        return self.directory / "scenario.toml"

    @property
    def road_file(self) -> Path:
        """The surface of the road, as the emulator reads it."""
        return self.directory / "road.toml"

    @property
    def configuration(self) -> Path:
        """The effective configuration."""
        return self.directory / "configuration.json"

    @property
    def reference_csv(self) -> Path:
        """The path that the controller follows."""
        return self.directory / "reference.csv"
