"""All that a run is made of, worked out before anything starts, so that a mistake costs no driving."""

from dataclasses import dataclass
from pathlib import Path

from dbc.build import Build
from dbc.catalogue import Catalogue
from dbc.vehicle import Vehicle
from xil.bus import BusChoice
from xil.scenario import Scenario, Stage


@dataclass(frozen=True)
class RunSetup:
    """One run.

    Args:
        build: the compiled controller, or None for the uncompiled solver.
        bus: the bus of a real-time stage, None in lockstep.
        view_port: port of the virtual world's page, or None.
        directory: where the run leaves its files.
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

    @property
    def bus_log(self) -> Path:
        """The bus record."""
        return self.directory / "bus.log"

    @property
    def configuration(self) -> Path:
        """The effective configuration."""
        return self.directory / "configuration.json"

    @property
    def reference_csv(self) -> Path:
        """The path that the controller follows."""
        return self.directory / "reference.csv"
