"""The command line. Every command is a few lines: parse, call, print. Errors of the user's or of the set-up are one line each.

Exit codes: 0 pass, 1 the verdict is fail, 2 the user's mistake, 3 the set-up could not run, 130 interrupted.
"""

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from dbc.catalogue import GNSS_IMU_DBC, NAVIGATION, NETWORKS, ROBOTS, ROBOTS_DBC
from dbc.errors import SetupFailure, UserMistake
from dbc.realtime import BUS_PRIORITY, become_realtime
from dbc.vehicle import FOCUS
from gateway.telemetry import DEFAULT_BASE_PORT
from xil import cli_bench, cli_dbc, cli_gateway, cli_live, cli_record
from xil.cli_common import (
    EXIT_FAIL,
    EXIT_INTERRUPTED,
    ControlOption,
    DbcOption,
    JsonOption,
    KeyOption,
    MappingOption,
    PortOption,
    RigOption,
    TlsOption,
    VehicleOption,
    exit_code_of,
    refuse_beside_rig,
    run_daemon,
    show,
    stop_on_signal,
    tls_of,
)
from xil.scenario import Stage

app = typer.Typer(
    help="CAN vehicle interface and hardware-in-the-loop bench for optimisation-based driving control.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

BusOption = Annotated[str, typer.Option("--bus", help="auto, emulated, socketcan:INTERFACE or xilgate:CHANNEL")]
NavigationBusOption = Annotated[
    str | None, typer.Option("--navigation-bus", help="the same for the navigation system; default: as --bus, or a second emulated bus")
]
PlantOption = Annotated[str, typer.Option("--plant", help="emulated car: multibody, bicycle, commonroad or fmu:FILE")]
LiftedOption = Annotated[bool, typer.Option("--lifted/--on-the-road", help="begin with the car on the lift, wheels in the air")]
SolverOption = Annotated[
    str | None,
    typer.Option("--solver", help="riccati (soft bounds), casadi-c or qrqp (hard ones), casadi-vm (uncompiled); default: by the stage"),
]
DEFAULT_PLANT = "multibody"
DBC_FILES = [ROBOTS_DBC, GNSS_IMU_DBC]
CHANNELS = list(NETWORKS)


def main() -> None:
    """Run the command line; the only place that turns an exception into an exit code."""
    from gateway.logs import escaped  # noqa: PLC0415 - imports are late so that every command starts quickly
    from xil.processes import die_with_parent  # noqa: PLC0415

    die_with_parent()
    try:
        app()
    except (UserMistake, SetupFailure) as error:
        for line in str(error).splitlines():
            print(f"xilgate: {escaped(line)}", file=sys.stderr)
        sys.exit(exit_code_of(error))


@app.command()
def drive(
    scenario: Annotated[str, typer.Argument(help="name of a scenario, or path of a scenario file")] = "iso3888-1",
    stage: Annotated[
        Stage, typer.Option(help="mil, sil: virtual time; hil: processes in real time; vehil: a car on the bus")
    ] = Stage.HIL,
    bus: BusOption = "auto",
    navigation_bus: NavigationBusOption = None,
    solver: SolverOption = None,
    plant: PlantOption = DEFAULT_PLANT,
    is_lifted: LiftedOption = False,
    seed: Annotated[int, typer.Option(min=0, help="of all noise")] = 1,
    out: Annotated[Path | None, typer.Option(help="run directory; default: runs/SCENARIO-STAGE")] = None,
    view: Annotated[bool, typer.Option("--view", help="serve the virtual world while driving")] = False,
    view_port: Annotated[int, typer.Option(min=1024, max=65535, help="port of the page")] = 8080,
    dbc: DbcOption = DBC_FILES,
    mapping: MappingOption = None,
    vehicle: VehicleOption = FOCUS,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """One run, one verdict, one report."""
    from xil.drive import DriveOptions, run_drive  # noqa: PLC0415

    options = DriveOptions(
        scenario=scenario,
        stage=stage,
        bus=bus,
        navigation_bus=navigation_bus,
        solver=solver,
        plant=plant,
        is_lifted=is_lifted,
        seed=seed,
        out=out or Path("runs") / f"{Path(scenario).stem}-{stage.value}",
        view_port=view_port if view else None,
        dbc_paths=tuple(dbc),
        mapping_path=mapping,
        vehicle_path=vehicle,
        telemetry_base_port=telemetry_port,
    )
    # Whoever ends the runner wants its processes ended in order as well.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        verdict = run_drive(options)
    except KeyboardInterrupt:
        raise typer.Exit(EXIT_INTERRUPTED) from None
    if not verdict.passed:
        raise typer.Exit(EXIT_FAIL)


@app.command()
def controller(
    context: typer.Context,
    *,
    reference: Annotated[Path, typer.Option(help="path to follow, CSV")],
    rig: RigOption = None,
    vehicle: VehicleOption = FOCUS,
    solver: SolverOption = None,
    control: ControlOption = None,
    key: KeyOption = None,
    journal: Annotated[Path | None, typer.Option("--journal", help="directory for what `xilgate resim` needs of the controller")] = None,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The controller process: planner and NMPC at 25 Hz."""
    from gateway.channel import control_path  # noqa: PLC0415

    if rig is None:
        common = {"vehicle_path": vehicle, "control": control_path(control, key), "telemetry_base_port": telemetry_port}
    else:
        from gateway.rig import read_rig  # noqa: PLC0415

        refuse_beside_rig(context, "reference", "solver", "journal")
        found = read_rig(rig)
        common = {
            "vehicle_path": found.car.vehicle,
            "control": found.control.path,
            "telemetry_base_port": found.telemetry.base_port,
            "tls": found.telemetry.tls,
        }
    run_daemon(
        "controller.app",
        lambda m: m.ControllerOptions(reference_csv=reference, solver=solver or m.DEFAULT_SOLVER, journal=journal, **common),
    )


@app.command()
def emulator(
    bus: Annotated[str | None, typer.Option("--bus", help="python-can name of the bus; default: the two that `xilgate bus` serves")] = None,
    navigation_bus: Annotated[str | None, typer.Option("--navigation-bus", help="that of the navigation system; default: as --bus")] = None,
    x_m: Annotated[float, typer.Option("--x-m", help="start position")] = 0.0,
    y_m: Annotated[float, typer.Option("--y-m", help="start position")] = 0.0,
    yaw_rad: Annotated[float, typer.Option("--yaw-rad", help="start heading")] = 0.0,
    speed_mps: Annotated[float, typer.Option("--speed-mps", min=0.0, help="start speed")] = 0.0,
    road: Annotated[Path | None, typer.Option("--road", help="TOML file of the road; default: a level one")] = None,
    plant: PlantOption = DEFAULT_PLANT,
    is_lifted: LiftedOption = False,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    faults: Annotated[Path | None, typer.Option("--faults", help="TOML file with a table of faults to inject; a scenario is one")] = None,
    dbc: DbcOption = DBC_FILES,
    mapping: MappingOption = None,
    vehicle: VehicleOption = FOCUS,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The emulated car with its robots and navigation system."""
    from dbc.link import bus_names  # noqa: PLC0415
    from vehicle_emulator.emulator import StartPose  # noqa: PLC0415

    run_daemon(
        "vehicle_emulator.app",
        lambda m: m.EmulatorOptions(
            buses=bus_names(bus, navigation_bus) if bus else bus_names(f"xilgate:{ROBOTS}", navigation_bus or f"xilgate:{NAVIGATION}"),
            dbc=tuple(dbc),
            mapping=mapping,
            vehicle=vehicle,
            start=StartPose(x_m, y_m, yaw_rad, speed_mps),
            road=road,
            plant=plant,
            is_lifted=is_lifted,
            seed=seed,
            faults=faults,
            telemetry_base_port=telemetry_port,
        ),
    )


@app.command("bus")
def bus_hub(
    channels: Annotated[list[str], typer.Argument(metavar="CHANNEL...", help="names of the buses")] = CHANNELS,
    bitrate: Annotated[list[int], typer.Option(min=10_000, max=1_000_000, help="bit/s; once, or once for every channel")] = [500_000],  # noqa: B006
    data_bitrate: Annotated[int, typer.Option(min=10_000, max=8_000_000, help="bit/s in the data phase of CAN FD")] = 2_000_000,
    tcp: Annotated[int | None, typer.Option(min=1, max=65_000, help="port on 127.0.0.1 as well; the next channel has the next one")] = None,
    restart_ms: Annotated[int, typer.Option(min=0, help="time after which a node leaves bus-off by itself; 0: never")] = 100,
) -> None:
    """Emulated CAN buses; any python-can tool joins one with `-i xilgate -c CHANNEL`, or `-c tcp://127.0.0.1:PORT`."""
    from vehicle_emulator.bus import hub  # noqa: PLC0415

    if len(bitrate) not in (1, len(channels)):
        raise UserMistake(f"--bitrate: {len(bitrate)} values for {len(channels)} channels, expected 1 or {len(channels)}")
    bitrates = bitrate * len(channels) if len(bitrate) == 1 else bitrate
    options = {
        channel: hub.HubOptions(bitrate_bps, data_bitrate, None if tcp is None else tcp + index, restart_ms)
        for index, (channel, bitrate_bps) in enumerate(zip(channels, bitrates, strict=True))
    }
    become_realtime(BUS_PRIORITY)
    with stop_on_signal() as stop:
        hub.run(options, stop)


@app.command()
def view(
    port: Annotated[int, typer.Option(min=1024, max=65535, help="port of the page")] = 8080,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    tls: TlsOption = None,
) -> None:
    """Serve the virtual world to a browser."""
    section = tls_of(tls)
    print(f"http://127.0.0.1:{port}/", flush=True)
    run_daemon("visualiser.bridge", lambda m: m.ViewOptions(port=port, telemetry_base_port=telemetry_port, tls=section))


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """What this machine can do, and what to do about each gap."""
    from xil import doctor as examination  # noqa: PLC0415

    checks = examination.checks()
    show(examination.as_data(checks) if as_json else examination.as_table(checks), as_json)


app.add_typer(cli_gateway.driving)
app.add_typer(cli_live.live)
app.add_typer(cli_bench.making)
app.add_typer(cli_record.records)
app.add_typer(cli_dbc.tools, name="dbc")
