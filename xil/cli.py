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
from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
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

class OperationName(StrEnum):
    """What an operator can ask for."""

    ENGAGE = "engage"
    DISENGAGE = "disengage"
    RESET = "reset"


BusOption = Annotated[str, typer.Option("--bus", help="auto, emulated, socketcan:INTERFACE or xilgate:CHANNEL")]
DbcOption = Annotated[list[Path], typer.Option("--dbc", help="DBC file; repeat for several")]
VehicleOption = Annotated[Path, typer.Option("--vehicle", help="vehicle file")]
PortOption = Annotated[int, typer.Option("--telemetry-port", min=1024, max=65000, help="first of five loopback ports for telemetry")]
SolverOption = Annotated[
    str | None,
    typer.Option("--solver", help="riccati (soft bounds), casadi-c or qrqp (hard ones), casadi-vm (uncompiled); default: by the stage"),
]
JsonOption = Annotated[bool, typer.Option("--json", help="one JSON object instead of a table")]
DBC_FILES = [ROBOTS_DBC, GNSS_IMU_DBC]


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
    solver: SolverOption = None,
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
        solver=solver,
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
    bus: Annotated[str, typer.Option("--bus", help="python-can name of the bus, for example socketcan:can0")] = "socketcan:can0",
    dbc: DbcOption = DBC_FILES,
    vehicle: VehicleOption = FOCUS,
    gateway_socket: Annotated[str, typer.Option(help="control socket of the gateway")] = "/tmp/xilgate-gateway.sock",
    controller_socket: Annotated[str, typer.Option(help="control socket of the controller")] = "/tmp/xilgate-controller.sock",
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The gateway process: the only one that writes to the car's bus."""
    _run_daemon(
        "gateway.app",
        lambda m: m.GatewayOptions(bus, tuple(dbc), vehicle, gateway_socket, controller_socket, telemetry_port),
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
    bus: Annotated[str, typer.Option("--bus", help="python-can name of the bus")] = "xilgate:bus0",
    x_m: Annotated[float, typer.Option("--x-m", help="start position")] = 0.0,
    y_m: Annotated[float, typer.Option("--y-m", help="start position")] = 0.0,
    yaw_rad: Annotated[float, typer.Option("--yaw-rad", help="start heading")] = 0.0,
    speed_mps: Annotated[float, typer.Option("--speed-mps", min=0.0, help="start speed")] = 0.0,
    grade_percent: Annotated[float, typer.Option("--grade-percent", help="how the road climbs where the car points")] = 0.0,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    dbc: DbcOption = DBC_FILES,
    vehicle: VehicleOption = FOCUS,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
) -> None:
    """The emulated car with its robots and navigation system."""
    from vehicle_emulator.emulator import StartPose  # noqa: PLC0415

    _run_daemon(
        "vehicle_emulator.app",
        lambda m: m.EmulatorOptions(
            bus_name=bus,
            dbc=tuple(dbc),
            vehicle=vehicle,
            start=StartPose(x_m, y_m, yaw_rad, speed_mps, 0.01 * grade_percent),
            seed=seed,
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
def bus_hub(channel: Annotated[str, typer.Argument(help="name of the channel")] = "bus0") -> None:
    """The emulated CAN bus; any python-can tool joins it with `-i xilgate -c CHANNEL`."""
    from vehicle_emulator.bus import hub  # noqa: PLC0415

    become_realtime(BUS_PRIORITY)
    with _stop_on_signal() as stop:
        hub.run(channel, stop)


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
