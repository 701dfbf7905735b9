"""Commands that build and measure: build, bench."""

from pathlib import Path
from typing import Annotated

import typer

from controller.export.targets import TargetName
from dbc.vehicle import FOCUS
from xil.cli_common import JsonOption, VehicleOption, progress, show

making = typer.Typer()
bench = typer.Typer(help="Measure: every command prints a table, or with --json one object.", no_args_is_help=True)
making.add_typer(bench, name="bench")


@making.command()
def build(
    target: Annotated[TargetName, typer.Option(help="processor that the library is for")] = TargetName.HOST,
    export: Annotated[Path | None, typer.Option(help="write C sources with Makefile and checker into this new directory")] = None,
    vehicle: VehicleOption = FOCUS,
    as_json: JsonOption = False,
) -> None:
    """Compile the controller's solver, or export it as a self-contained C library."""
    from controller.export import library  # noqa: PLC0415

    if export is None:
        facts = library.build_for(target, vehicle, progress)
    else:
        from controller.export.directory import export as write_directory  # noqa: PLC0415

        facts = write_directory(export, vehicle, target, progress)
    show(facts if as_json else library.to_table(facts), as_json)


@bench.command("solver")
def bench_solver(
    *,
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
    result = solver_bench.bench_solver(options, progress=progress)
    show(result if as_json else to_table(result), as_json)


@bench.command("loop")
def bench_loop(
    seeds: Annotated[int, typer.Option(min=1, help="of each of the five cases with four times the sensor noise")] = 40,
    solver: Annotated[str, typer.Option(help="name of a solver")] = "riccati",
    as_json: JsonOption = False,
) -> None:
    """Closed loop in virtual time: noise, slow robots, slopes and a heavy car, each figure beside its target."""
    from xil import bench_loop as loop_bench  # noqa: PLC0415

    result = loop_bench.bench_loop(solver, seeds, progress)
    show(result if as_json else loop_bench.to_table(result), as_json)


@bench.command("bus")
def bench_bus(
    seconds: Annotated[float, typer.Option(min=0.5, help="of each of the two measurements on the hub")] = 5.0, as_json: JsonOption = False
) -> None:
    """Throughput and latency of the emulated bus with three nodes, through its real hub, beside the targets."""
    from xil import bench_bus as bus_bench  # noqa: PLC0415

    result = bus_bench.bench_bus(seconds, progress)
    show(result if as_json else bus_bench.to_table(result), as_json)


@bench.command("gateway")
def bench_gateway(
    seconds: Annotated[float, typer.Option(min=1.0, help="recorded driving")] = 10.0,
    rounds: Annotated[int, typer.Option(min=1)] = 5,
    as_json: JsonOption = False,
) -> None:
    """CPU time of one step of the gateway on recorded frames."""
    from xil import bench as gateway_bench  # noqa: PLC0415

    result = gateway_bench.bench_gateway(seconds=seconds, rounds=rounds)
    show(result if as_json else gateway_bench.to_table(result), as_json)


@bench.command("latency")
def bench_latency(
    seconds: Annotated[float, typer.Option(min=1.0, help="of traffic that is measured")] = 10.0, as_json: JsonOption = False
) -> None:
    """From a frame to the state at the controller, and from a command to the frame on the bus, with real processes."""
    from xil import bench_latency as latency_bench  # noqa: PLC0415

    result = latency_bench.bench_latency(seconds)
    show(result if as_json else latency_bench.to_table(result), as_json)


@bench.command("plant")
def bench_plant(
    vehicle: VehicleOption = FOCUS,
    seconds: Annotated[float, typer.Option(min=1.0, help="simulated driving of each measurement")] = 10.0,
    as_json: JsonOption = False,
) -> None:
    """Time of one step of the emulated car, and how far its integrator is from its limit, beside their targets."""
    from xil import bench_plant as plant_bench  # noqa: PLC0415

    result = plant_bench.bench_plant(vehicle, seconds, progress)
    show(result if as_json else plant_bench.to_table(result), as_json)
