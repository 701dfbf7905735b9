"""The command line. Every command is a few lines: parse, call, print. Errors of the user's or of the set-up are one line each.

Exit codes: 0 pass, 1 the verdict is fail, 2 the user's mistake, 3 the set-up could not run, 130 interrupted.
"""

import importlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from controller.export.targets import TargetName
from dbc.catalogue import GNSS_IMU_DBC, NAVIGATION, NETWORKS, ROBOTS, ROBOTS_DBC
from dbc.errors import SetupFailure, UserMistake
from dbc.realtime import BUS_PRIORITY, become_realtime
from dbc.vehicle import FOCUS
from gateway.telemetry import DEFAULT_BASE_PORT
from xil.scenario import Stage

EXIT_FAIL, EXIT_USER, EXIT_SETUP, EXIT_INTERRUPTED = 1, 2, 3, 130

app = typer.Typer(
    help="CAN vehicle interface and hardware-in-the-loop bench for optimisation-based driving control.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
bench = typer.Typer(help="Measure: every command prints a table, or with --json one object.", no_args_is_help=True)
app.add_typer(bench, name="bench")
params = typer.Typer(help="Look at and change the parameters of a running controller.", no_args_is_help=True)
app.add_typer(params, name="params")
fault = typer.Typer(help="Inject faults into a running emulator, look at them and take them back.", no_args_is_help=True)
app.add_typer(fault, name="fault")

class OperationName(StrEnum):
    """What an operator can ask for."""

    ENGAGE = "engage"
    DISENGAGE = "disengage"
    RESET = "reset"


BusOption = Annotated[str, typer.Option("--bus", help="auto, emulated, socketcan:INTERFACE or xilgate:CHANNEL")]
NavigationBusOption = Annotated[
    str | None, typer.Option("--navigation-bus", help="the same for the navigation system; default: as --bus, or a second emulated bus")
]
DbcOption = Annotated[list[Path], typer.Option("--dbc", help="DBC file; repeat for several")]
VehicleOption = Annotated[Path, typer.Option("--vehicle", help="vehicle file")]
PlantOption = Annotated[str, typer.Option("--plant", help="emulated car: multibody, bicycle, commonroad or fmu:FILE")]
LiftedOption = Annotated[bool, typer.Option("--lifted/--on-the-road", help="begin with the car on the lift, wheels in the air")]
PortOption = Annotated[int, typer.Option("--telemetry-port", min=1024, max=65000, help="first of five loopback ports for telemetry")]
SolverOption = Annotated[
    str | None,
    typer.Option("--solver", help="riccati (soft bounds), casadi-c or qrqp (hard ones), casadi-vm (uncompiled); default: by the stage"),
]
JsonOption = Annotated[bool, typer.Option("--json", help="one JSON object instead of a table")]
DEFAULT_PLANT = "multibody"
DBC_FILES = [ROBOTS_DBC, GNSS_IMU_DBC]
CHANNELS = list(NETWORKS)


def main() -> None:
    """Run the command line; the only place that turns an exception into an exit code."""
    from xil.processes import die_with_parent  # noqa: PLC0415 - imports are late so that every command starts quickly

    die_with_parent()
    try:
        app()
    except (UserMistake, SetupFailure) as error:
        for line in str(error).splitlines():
            print(f"xilgate: {line}", file=sys.stderr)
        sys.exit(EXIT_USER if isinstance(error, UserMistake) else EXIT_SETUP)


@contextmanager
def _stop_on_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set; a daemon then ends in order."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    yield stop


def _run_daemon(module: str, make_options: Callable[[Any], object]) -> None:
    """Run `module.run` with its options until a signal comes."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s", stream=sys.stderr)
    daemon = importlib.import_module(module)
    with _stop_on_signal() as stop:
        daemon.run(make_options(daemon), stop)


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
def gateway(
    bus: Annotated[str, typer.Option("--bus", help="python-can name of the robots' bus, for example socketcan:can0")] = "socketcan:can0",
    navigation_bus: Annotated[str | None, typer.Option("--navigation-bus", help="that of the navigation system; default: the same")] = None,
    dbc: DbcOption = DBC_FILES,
    vehicle: VehicleOption = FOCUS,
    gateway_socket: Annotated[str, typer.Option(help="control socket of the gateway")] = "/tmp/xilgate-gateway.sock",
    controller_socket: Annotated[str, typer.Option(help="control socket of the controller")] = "/tmp/xilgate-controller.sock",
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The gateway process: the only one that writes to the car's buses."""
    from dbc.link import bus_names  # noqa: PLC0415

    buses = bus_names(bus, navigation_bus)
    _run_daemon(
        "gateway.app",
        lambda m: m.GatewayOptions(buses, tuple(dbc), vehicle, gateway_socket, controller_socket, telemetry_port),
    )


@app.command()
def controller(
    reference: Annotated[Path, typer.Option(help="path to follow, CSV")],
    vehicle: VehicleOption = FOCUS,
    solver: SolverOption = None,
    gateway_socket: Annotated[str, typer.Option(help="control socket of the gateway")] = "/tmp/xilgate-gateway.sock",
    controller_socket: Annotated[str, typer.Option(help="control socket of the controller")] = "/tmp/xilgate-controller.sock",
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The controller process: planner and NMPC at 25 Hz."""
    _run_daemon(
        "controller.app",
        lambda m: m.ControllerOptions(
            reference_csv=reference,
            vehicle_path=vehicle,
            gateway_socket=gateway_socket,
            controller_socket=controller_socket,
            solver=solver or m.DEFAULT_SOLVER,
            telemetry_base_port=telemetry_port,
        ),
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
    faults: Annotated[Path | None, typer.Option("--faults", help="TOML file with [[faults]] to inject; a scenario is one")] = None,
    dbc: DbcOption = DBC_FILES,
    vehicle: VehicleOption = FOCUS,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The emulated car with its robots and navigation system."""
    from dbc.link import bus_names  # noqa: PLC0415
    from vehicle_emulator.emulator import StartPose  # noqa: PLC0415

    _run_daemon(
        "vehicle_emulator.app",
        lambda m: m.EmulatorOptions(
            buses=bus_names(bus, navigation_bus) if bus else bus_names(f"xilgate:{ROBOTS}", navigation_bus or f"xilgate:{NAVIGATION}"),
            dbc=tuple(dbc),
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


@app.command()
def operate(
    operation: Annotated[OperationName, typer.Argument(help="what to ask of the gateway")],
    gateway_socket: Annotated[str, typer.Option(help="control socket of the gateway")] = "/tmp/xilgate-gateway.sock",
) -> None:
    """Ask a running gateway to engage, disengage or reset; `xilgate watch` shows what it makes of it."""
    from gateway.channel import Channel  # noqa: PLC0415
    from gateway.messages import Operation, OperatorRequest  # noqa: PLC0415
    from gateway.telemetry import new_boot_id  # noqa: PLC0415

    with Channel(None, gateway_socket) as channel:
        channel.send(OperatorRequest(new_boot_id(), 1, Operation[operation.name]))
        if channel.unsent:
            raise SetupFailure(f"no gateway listens on {gateway_socket}")


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
    with _stop_on_signal() as stop:
        hub.run(options, stop)


@app.command()
def view(
    port: Annotated[int, typer.Option(min=1024, max=65535, help="port of the page")] = 8080, telemetry_port: PortOption = DEFAULT_BASE_PORT
) -> None:
    """Serve the virtual world to a browser."""
    print(f"http://127.0.0.1:{port}/", flush=True)
    _run_daemon("visualiser.bridge", lambda m: m.ViewOptions(port=port, telemetry_base_port=telemetry_port))


@app.command()
def watch(telemetry_port: PortOption = DEFAULT_BASE_PORT) -> None:
    """A live table of what runs."""
    _run_daemon("visualiser.watch", lambda m: m.WatchOptions(telemetry_base_port=telemetry_port))


@app.command("object")
def object_from_outside(
    name: Annotated[str, typer.Argument(help="by which the object is known again")],
    x_m: Annotated[float, typer.Option("--x-m", help="centre, in the local frame")],
    y_m: Annotated[float, typer.Option("--y-m", help="centre, in the local frame")],
    heading_deg: Annotated[float, typer.Option("--heading-deg", help="counter-clockwise from x")] = 0.0,
    speed_kmh: Annotated[float, typer.Option("--speed-kmh", help="along its heading")] = 0.0,
    kind: Annotated[str, typer.Option("--kind", help="car, adult, child or cyclist: gives the size")] = "car",
    length_m: Annotated[float | None, typer.Option("--length-m", help="default: by the kind")] = None,
    width_m: Annotated[float | None, typer.Option("--width-m", help="default: by the kind")] = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, help="time after which it goes; an interrupt ends it too")] = 600.0,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """Put an object in the car's way while a run goes on whose scenario has none."""
    from xil.objects import OutsideObject, publish  # noqa: PLC0415

    thing = OutsideObject(name, x_m, y_m, heading_deg, speed_kmh, kind, length_m, width_m)
    with _stop_on_signal() as stop:
        publish(thing, telemetry_port, seconds, stop)


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """What this machine can do, and what to do about each gap."""
    from xil import doctor as examination  # noqa: PLC0415

    checks = examination.checks()
    _print(examination.as_data(checks) if as_json else examination.as_table(checks), as_json)


@params.command("list")
def params_list(telemetry_port: PortOption = DEFAULT_BASE_PORT, as_json: JsonOption = False) -> None:
    """All parameters with value, unit, range and default."""
    params_get([], telemetry_port, as_json)


@params.command("get")
def params_get(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="parameters; `params list` has them all")],
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """Some parameters."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.values(names, telemetry_port)
    _print(answer if as_json else tuner.values_table(answer), as_json)


@params.command("set")
def params_set(
    assignments: Annotated[list[str], typer.Argument(metavar="NAME=VALUE...", help="for example planner.safe_time_s=1.8")],
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """Change parameters between two cycles: all that are named, or none when one is refused."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.change(assignments, telemetry_port)
    _print(answer if as_json else tuner.changes_table(answer), as_json)


@params.command("revert")
def params_revert(
    what: Annotated[str, typer.Argument(help="number of a change, last or all")] = "last",
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """Take a change back: the parameters that it set get the values from before."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.revert(what, telemetry_port)
    _print(answer if as_json else tuner.changes_table(answer), as_json)


@params.command("history")
def params_history(telemetry_port: PortOption = DEFAULT_BASE_PORT, as_json: JsonOption = False) -> None:
    """Who changed what, and when."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.history(telemetry_port)
    _print(answer if as_json else tuner.history_table(answer), as_json)


@params.command("watch")
def params_watch(telemetry_port: PortOption = DEFAULT_BASE_PORT, as_json: JsonOption = False) -> None:
    """Print every change as it comes in force, until interrupted."""
    from xil import params as tuner  # noqa: PLC0415

    with _stop_on_signal() as stop:
        tuner.follow(telemetry_port, stop, lambda sample: print(_json(sample) if as_json else tuner.line(sample), flush=True))


@fault.command("add")
def fault_add(
    kind: Annotated[str, typer.Argument(help="kind of fault; `fault kinds` has them all")],
    assignments: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="as in messages=SR_Status duration_s=2")] = None,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """Inject a fault; its times count from now."""
    from xil import fault as injector  # noqa: PLC0415

    answer = injector.add(kind, assignments or [], telemetry_port)
    _print(answer if as_json else injector.table(answer, "added"), as_json)


@fault.command("list")
def fault_list(telemetry_port: PortOption = DEFAULT_BASE_PORT, as_json: JsonOption = False) -> None:
    """All faults of the emulator: waiting, active and over."""
    from xil import fault as injector  # noqa: PLC0415

    answer = injector.listing(telemetry_port)
    _print(answer if as_json else injector.table(answer, "faults"), as_json)


@fault.command("clear")
def fault_clear(
    name: Annotated[str | None, typer.Argument(help="name of a fault; default: all")] = None,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """Take a fault back, or all."""
    from xil import fault as injector  # noqa: PLC0415

    answer = injector.clear(name, telemetry_port)
    _print(answer if as_json else injector.table(answer, "cleared"), as_json)


@fault.command("kinds")
def fault_kinds(as_json: JsonOption = False) -> None:
    """What can go wrong, and the keys of each kind."""
    from xil import fault as injector  # noqa: PLC0415

    _print(injector.kinds_data() if as_json else injector.kinds_table(), as_json)


@app.command()
def build(
    target: Annotated[TargetName, typer.Option(help="processor that the library is for")] = TargetName.HOST,
    export: Annotated[Path | None, typer.Option(help="write C sources with Makefile and checker into this new directory")] = None,
    vehicle: VehicleOption = FOCUS,
    as_json: JsonOption = False,
) -> None:
    """Compile the controller's solver, or export it as a self-contained C library."""
    from controller.export import library  # noqa: PLC0415

    if export is None:
        facts = library.build_for(target, vehicle, _progress)
    else:
        from controller.export.directory import export as write_directory  # noqa: PLC0415

        facts = write_directory(export, vehicle, target, _progress)
    _print(facts if as_json else library.to_table(facts), as_json)


@bench.command("solver")
def bench_solver(
    sets: Annotated[str, typer.Option("--set", help="nominal, active, hard or all")] = "all",
    instances: Annotated[int, typer.Option(min=8, help="problems of the nominal set, and of the active one")] = 300,
    rounds: Annotated[int, typer.Option(min=1, help="times that each is solved by each solver")] = 5,
    starts: Annotated[int, typer.Option(min=4, help="problems of the hard set")] = 10_000,
    solver: Annotated[list[str] | None, typer.Option("--solver", help="only this one; repeat for several")] = None,
    agreement: Annotated[bool, typer.Option("--agreement", help="compare answers as well: some minutes")] = False,
    callgrind: Annotated[bool, typer.Option("--callgrind", help="count instructions as well; needs valgrind")] = False,
    as_json: JsonOption = False,
) -> None:
    """Solve time of every solver, interleaved problem by problem in one process on one core, beside its targets."""
    from controller.bench import run as solver_bench  # noqa: PLC0415
    from controller.bench.table import to_table  # noqa: PLC0415

    chosen = solver_bench.SETS if sets == "all" else (sets,)
    options = solver_bench.BenchOptions(
        chosen, instances, rounds, starts, tuple(solver or ()), agreement=agreement, callgrind=callgrind
    )
    result = solver_bench.bench_solver(options, progress=_progress)
    _print(result if as_json else to_table(result), as_json)


@bench.command("loop")
def bench_loop(
    seeds: Annotated[int, typer.Option(min=1, help="of each of the five cases with four times the sensor noise")] = 40,
    solver: Annotated[str, typer.Option(help="name of a solver")] = "riccati",
    as_json: JsonOption = False,
) -> None:
    """Closed loop in virtual time: noise, slow robots, slopes and a heavy car, each figure beside its target."""
    from xil import bench_loop as loop_bench  # noqa: PLC0415

    result = loop_bench.bench_loop(solver, seeds, _progress)
    _print(result if as_json else loop_bench.to_table(result), as_json)


@bench.command("bus")
def bench_bus(
    seconds: Annotated[float, typer.Option(min=0.5, help="of each of the two measurements on the hub")] = 5.0, as_json: JsonOption = False
) -> None:
    """Throughput and latency of the emulated bus with three nodes, through its real hub, beside the targets."""
    from xil import bench_bus as bus_bench  # noqa: PLC0415

    result = bus_bench.bench_bus(seconds, _progress)
    _print(result if as_json else bus_bench.to_table(result), as_json)


@bench.command("gateway")
def bench_gateway(
    seconds: Annotated[float, typer.Option(min=1.0, help="recorded driving")] = 10.0,
    rounds: Annotated[int, typer.Option(min=1)] = 5,
    as_json: JsonOption = False,
) -> None:
    """CPU time of one step of the gateway on recorded frames."""
    from xil import bench as gateway_bench  # noqa: PLC0415

    result = gateway_bench.bench_gateway(seconds=seconds, rounds=rounds)
    _print(result if as_json else gateway_bench.to_table(result), as_json)


@bench.command("plant")
def bench_plant(
    vehicle: VehicleOption = FOCUS,
    seconds: Annotated[float, typer.Option(min=1.0, help="simulated driving of each measurement")] = 10.0,
    as_json: JsonOption = False,
) -> None:
    """Time of one step of the emulated car, and how far its integrator is from its limit, beside their targets."""
    from xil import bench_plant as plant_bench  # noqa: PLC0415

    result = plant_bench.bench_plant(vehicle, seconds, _progress)
    _print(result if as_json else plant_bench.to_table(result), as_json)


def _progress(text: str) -> None:
    print(text, file=sys.stderr)


def _json(content: object) -> str:
    import json  # noqa: PLC0415

    import msgspec  # noqa: PLC0415

    return json.dumps(content, default=msgspec.to_builtins)


def _print(content: object, as_json: bool) -> None:
    if as_json:
        print(_json(content))
    else:
        from rich.console import Console  # noqa: PLC0415

        # A table keeps its columns when it is piped into a file.
        Console(width=None if sys.stdout.isatty() else int(os.environ.get("COLUMNS", "140"))).print(content)
