"""The gateway's command: from a rig file as a daemon, or from a few options on a bench. Both make the same `Rig`."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.errors import SetupFailure, UserMistake
from dbc.vehicle import FOCUS
from gateway.telemetry import DEFAULT_BASE_PORT
from xil.cli_common import (
    ControlOption,
    DbcOption,
    JsonOption,
    KeyOption,
    MappingOption,
    PortOption,
    VehicleOption,
    exit_code_of,
    refuse_beside_rig,
    show,
)

if TYPE_CHECKING:
    from gateway.rig import Rig

driving = typer.Typer()
DBC_FILES = [ROBOTS_DBC, GNSS_IMU_DBC]


@driving.command()
def gateway(
    context: typer.Context,
    *,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="rig file with all settings; the process then logs JSON and heeds systemd")
    ] = None,
    is_check: Annotated[bool, typer.Option("--check", help="check what a start would meet, and print the effective settings")] = False,
    bus: Annotated[str, typer.Option("--bus", help="python-can name of the robots' bus, for example socketcan:can0")] = "socketcan:can0",
    navigation_bus: Annotated[str | None, typer.Option("--navigation-bus", help="that of the navigation system; default: the same")] = None,
    dbc: DbcOption = DBC_FILES,
    mapping: MappingOption = None,
    vehicle: VehicleOption = FOCUS,
    profile: Annotated[str, typer.Option("--profile", help="limit profile: nominal, proving_ground, lifted or bench")] = "proving_ground",
    control: ControlOption = None,
    key: KeyOption = None,
    record: Annotated[Path | None, typer.Option("--record", help="directory for what `xilgate resim` needs; default: no record")] = None,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """The gateway process: the only one that writes to the car's buses."""
    tree = {
        "name": "bench",
        "profile": profile,
        "buses": _given(robots=bus, navigation=navigation_bus),
        "car": {"dbc": list(map(str, dbc))} | _given(mapping=mapping, vehicle=vehicle),
        "control": _given(directory=control, key=key),
        "telemetry": {"base_port": telemetry_port},
    } | ({} if record is None else {"recorder": {"directory": str(record), "formats": []}})

    def read() -> "Rig":
        from gateway.rig import make_rig, read_rig  # noqa: PLC0415 - imports are late so that every command starts quickly

        return make_rig(Path("command line"), tree, Path.cwd()) if rig is None else read_rig(rig)

    if rig is not None:
        refuse_beside_rig(context, "is_check", "as_json")
    if is_check:
        _check(read, as_json)
    elif rig is None:
        _run_bench(read)
    else:
        _run_daemon(read)


def _given(**settings: str | Path | None) -> dict[str, Any]:
    return {name: str(value) for name, value in settings.items() if value is not None}


def _check(read: Callable[[], "Rig"], as_json: bool) -> None:
    from gateway import check  # noqa: PLC0415
    from gateway.preparation import prepare  # noqa: PLC0415

    preparation = prepare(read())
    check.check_machine(preparation.rig)
    content = check.report(preparation)
    show(content if as_json else check.as_text(content), as_json)


def _run_bench(read: Callable[[], "Rig"]) -> None:
    from gateway.daemon import serve  # noqa: PLC0415
    from gateway.logs import LogThread, PlainFormatter  # noqa: PLC0415
    from gateway.preparation import prepare  # noqa: PLC0415

    with LogThread(PlainFormatter()) as logs:
        serve(prepare(read()), logs)


def _run_daemon(read: Callable[[], "Rig"]) -> None:
    import logging  # noqa: PLC0415

    from gateway.check import check_machine  # noqa: PLC0415
    from gateway.daemon import serve  # noqa: PLC0415
    from gateway.logs import JsonFormatter, LogThread, is_journal, log_crashes  # noqa: PLC0415
    from gateway.preparation import Preparation, prepare  # noqa: PLC0415

    def prepare_anew() -> Preparation:
        preparation = prepare(read())
        check_machine(preparation.rig)
        return preparation

    formatter = JsonFormatter("gateway", has_level_prefix=is_journal(sys.stderr))
    log_crashes(formatter)
    with LogThread(formatter) as logs:
        try:
            serve(prepare_anew(), logs, prepare_anew)
        except (UserMistake, SetupFailure) as error:
            for line in str(error).splitlines():
                logging.getLogger("xilgate.gateway").error("%s", line)
            raise typer.Exit(exit_code_of(error)) from error
