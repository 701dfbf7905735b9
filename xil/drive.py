"""`xilgate drive`: set up, drive on the stage that was asked for, judge, report."""

import errno
import fcntl
import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.status import Status

from controller.nmpc import DRIVE_MODEL
from controller.problem import OcpOptions
from controller.solvers import DEFAULT_SOLVER, LIBRARIES, SOLVERS, make_solver
from dbc.catalogue import load
from dbc.errors import SetupFailure, UserMistake
from dbc.vehicle import load_vehicle
from gateway.core import GatewayCore
from gateway.record.session import refuse_equal_names
from gateway.telemetry import StateSample
from vehicle_emulator.emulator import Emulator
from vehicle_emulator.faults.targets import check
from xil.bus import choose
from xil.buslog import recorded_load
from xil.injected import injected_faults
from xil.lockstep import START_NS, LockstepRun, journals_of
from xil.metrics import Verdict, evaluate
from xil.realtime import RealtimeRun
from xil.recording import Recording
from xil.report import write_report
from xil.scenario import Stage, load_scenario, scenario_path
from xil.setup import RunSetup
from xil.summary import RunFacts, build_summary

SOLVER_OF_STAGE = {Stage.MIL: "casadi-vm"} | dict.fromkeys((Stage.SIL, Stage.HIL, Stage.VEHIL), DEFAULT_SOLVER)
"""MiL runs the controller as it was modelled; from SiL on it is the compiled library."""
OUTCOMES = ("summary.json", "report.html", "bus.log", "gateway-*.journal", "controller-*.journal")
"""What a run concludes with; the next one in the same directory starts without them."""

_REFUSALS_OF_A_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""A write that fails does not know the name of its file."""


@dataclass(frozen=True)
class DriveOptions:
    """What the user asked for.

    Args:
        navigation_bus: None for what goes with `bus`.
        solver: name, or None for what the stage stands for.
        view_port: port of the virtual world's page, or None for no page.
        mapping_path: names of the site for ours, see `dbc.mapping`; None where they are ours.
    """

    scenario: str
    stage: Stage
    bus: str
    navigation_bus: str | None
    solver: str | None
    plant: str
    is_lifted: bool
    seed: int
    out: Path
    view_port: int | None
    dbc_paths: tuple[Path, ...]
    mapping_path: Path | None
    vehicle_path: Path
    telemetry_base_port: int


class Display:
    """What a run shows while it goes on: one live line on a terminal, changes of mode elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._status: Status | None = None
        self._mode = ""

    def announce(self, text: str) -> None:
        """Print a line that stays, as it is: names are the user's and may hold brackets."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def progress(self, state: StateSample | None) -> None:
        """Show the newest state; None ends the live line."""
        if state is None:
            if self._status is not None:
                self._status.stop()
            return
        if state.mode != self._mode and state.is_valid:
            self._mode = state.mode
            self.announce(f"  x {state.x_m:7.1f} m  {abs(state.vx_mps) * 3.6:5.1f} km/h  {state.mode}")
        if self._console.is_terminal:
            if self._status is None:
                self._status = self._console.status("")
                self._status.start()
            self._status.update(f"{state.mode}  x {state.x_m:7.1f} m  y {state.y_m:6.2f} m  {state.vx_mps * 3.6:5.1f} km/h")


def run_drive(options: DriveOptions) -> Verdict:
    """One run: files in `options.out`, a verdict on the console.

    Raises:
        UserMistake: something asked for is not to be had.
        SetupFailure: the machine or its set-up does not allow the run.
    """
    display = Display(Console(stderr=True))
    setup = _prepare(options, display)
    try:
        with _sole_use_of(setup.directory):
            _write_inputs(setup, options)
            return _run(setup, options, display)
    except OSError as error:
        if error.filename is None and error.errno not in _REFUSALS_OF_A_DISK:
            raise
        raise SetupFailure(f"{error.filename or setup.directory}: {error.strerror}") from error


@dataclass(frozen=True)
class _Driven:
    """What came out of a drive; the rest as in `RunFacts`.

    Args:
        interruption: why it was cut short; empty when it was not.
    """

    recording: Recording
    interruption: str
    realtime_factor: float | None = None
    bus_load: Mapping[str, float] = field(default_factory=dict)


def _run(setup: RunSetup, options: DriveOptions, display: Display) -> Verdict:
    started, start_s = datetime.now(UTC), time.monotonic()
    display.announce(f"driving {setup.scenario.name} at stage {setup.stage.value} with {setup.solver}")
    driven = _in_virtual_time(setup, display) if setup.stage.is_lockstep else _in_real_time(setup, display)
    recording = driven.recording
    verdict = evaluate(recording, setup.scenario, setup.vehicle, setup.stage, driven.interruption)
    facts = _facts(setup, options, started, time.monotonic() - start_s, driven)
    summary = build_summary(facts, verdict, recording.samples("parameters"), injected_faults(recording))
    (setup.directory / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    write_report(setup.directory / "report.html", summary, recording, setup.scenario, setup.vehicle, verdict)
    print(f"{'PASS' if verdict.passed else 'FAIL'}  {verdict.reason}")
    print(f"report: {setup.directory / 'report.html'}")
    return verdict


def _in_virtual_time(setup: RunSetup, display: Display) -> _Driven:
    recording = Recording(START_NS)
    solver = make_solver(setup.solver, setup.vehicle.model, OcpOptions(model=DRIVE_MODEL), display.announce)
    with _deferred_interrupt() as interrupted, journals_of(setup) as journals:
        run = LockstepRun(setup, solver, recording, display.progress, interrupted.is_set, journals=journals)
        start_s = time.monotonic()
        interruption = run.drive()
        wall_s = time.monotonic() - start_s
    factor = run.driven_s / wall_s
    display.announce(f"{run.driven_s:.1f} s of driving in {wall_s:.1f} s, {factor:.1f} times real time")
    return _Driven(recording, interruption, factor, run.bus_load)


def _in_real_time(setup: RunSetup, display: Display) -> _Driven:
    recording = Recording(time.monotonic_ns())
    interruption = RealtimeRun(setup, recording, display.announce, display.progress).drive()
    names = setup.bus.names if setup.bus else {}
    bitrate_bps = {name.partition(":")[2]: setup.catalogue.bitrate_bps[network] for network, name in names.items()}
    return _Driven(recording, interruption, bus_load=recorded_load(setup.bus_log, bitrate_bps))


@contextmanager
def _sole_use_of(directory: Path) -> Iterator[None]:
    """Hold the run directory, empty of what an earlier run concluded: nobody is to find its verdict beside our record."""
    directory.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserMistake(f"run directory {directory} is in use by another run; choose another with --out") from None
        for path in [path for pattern in OUTCOMES for path in directory.glob(pattern)]:
            path.unlink(missing_ok=True)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """Note SIGINT and SIGTERM instead of raising: CasADi would turn the exception into another one, or lose it."""
    interrupted = threading.Event()
    before = {number: signal.signal(number, lambda *_: interrupted.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _prepare(options: DriveOptions, display: Display) -> RunSetup:
    """Work out everything that can be wrong before anything starts."""
    scenario = load_scenario(options.scenario)
    refuse_equal_names(options.dbc_paths, options.vehicle_path, options.mapping_path)
    vehicle = load_vehicle(options.vehicle_path)
    catalogue = load(options.dbc_paths, options.mapping_path)
    check(scenario.faults, catalogue)
    if scenario.faults and options.stage is Stage.VEHIL:
        raise UserMistake(f"scenario {scenario.name}: its faults are injected into the emulated car; stage vehil drives another")
    solver = options.solver or SOLVER_OF_STAGE[options.stage]
    if solver not in SOLVERS:
        raise UserMistake(f"solver {solver!r}: there are {', '.join(SOLVERS)}")
    if options.stage is Stage.VEHIL and {options.bus, options.navigation_bus} & {"auto", "emulated"}:
        raise UserMistake("stage vehil drives the car on its buses: name them, as in --bus socketcan:can0 --navigation-bus socketcan:can1")
    is_bus_chosen = options.bus != "auto" or options.navigation_bus is not None
    if options.stage.is_lockstep and (is_bus_chosen or options.view_port is not None):
        raise UserMistake(
            f"stage {options.stage.value} runs in one process in virtual time: it takes neither --bus, --navigation-bus nor --view"
        )
    bus = None if options.stage.is_lockstep else choose(options.bus, options.navigation_bus)
    scenario.reference(vehicle)  # refuses a road that leaves the car no room
    GatewayCore(catalogue, vehicle, boot_id=0)  # refuses a DBC that lacks something
    library = LIBRARIES[solver](vehicle.model, OcpOptions(model=DRIVE_MODEL), display.announce) if solver in LIBRARIES else None
    setup = RunSetup(
        scenario, options.stage, vehicle, catalogue, solver, library, bus, options.seed, options.out,
        options.dbc_paths, options.vehicle_path, options.view_port, options.telemetry_base_port, options.plant, options.is_lifted,
        options.mapping_path,
    )  # fmt: skip
    if options.stage is not Stage.VEHIL:
        Emulator(setup.emulator, catalogue, START_NS, display.announce)  # refuses what it cannot emulate, and builds the car
    return setup


def _write_inputs(setup: RunSetup, options: DriveOptions) -> None:
    """Keep what the run was made of beside what comes out of it."""
    scenario, copy = scenario_path(options.scenario), setup.scenario_copy
    if scenario.resolve() != copy.resolve():
        shutil.copyfile(scenario, copy)
    setup.road_file.write_text(setup.scenario.road_surface().to_toml(), encoding="utf-8")
    setup.scenario.reference(setup.vehicle).to_csv(setup.reference_csv)
    setup.configuration.write_text(json.dumps(_configuration(setup), indent=1) + "\n", encoding="utf-8")


def _configuration(setup: RunSetup) -> dict[str, object]:
    """The effective configuration: everything that was chosen, and everything that was taken as usual."""
    return {
        "stage": setup.stage.value,
        "seed": setup.seed,
        "solver": setup.solver,
        "plant": setup.plant,
        "is_lifted": setup.is_lifted,
        "bus": dict(setup.bus.names) if setup.bus else "lockstep",
        "dbc": [str(path) for path in setup.dbc_paths],
        "mapping": None if setup.mapping_path is None else str(setup.mapping_path),
        "vehicle": setup.vehicle.model_dump(),
        "ocp": asdict(OcpOptions(model=DRIVE_MODEL)),
        "limits": asdict(setup.profile),
    }


def _facts(setup: RunSetup, options: DriveOptions, started: datetime, duration_s: float, driven: _Driven) -> RunFacts:
    files = {path.name: path for path in setup.dbc_paths}
    files |= {} if setup.mapping_path is None else {"mapping": setup.mapping_path}
    files |= {"vehicle": setup.vehicle_path, "scenario": scenario_path(options.scenario), "configuration": setup.configuration}
    if setup.build is not None:
        files["controller library"] = setup.build.library
    compiler = setup.build.compiler if setup.build else ""
    return RunFacts(
        setup.scenario, setup.stage, setup.seed, setup.solver, started, duration_s, compiler, files,
        driven.realtime_factor, driven.bus_load,
    )  # fmt: skip
