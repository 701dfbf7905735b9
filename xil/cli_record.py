"""Commands that work with records: replay, resim."""

import threading
from pathlib import Path
from typing import Annotated

import typer

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from xil.cli_common import EXIT_FAIL, EXIT_INTERRUPTED, EXIT_USER, DbcOption, JsonOption, MappingOption, progress, show, stop_on_signal

records = typer.Typer()

_DBC_FILES = [ROBOTS_DBC, GNSS_IMU_DBC]


@records.command()
def replay(
    log: Annotated[Path, typer.Argument(help="bus record: .blf, .asc, or .log of candump")],
    *,
    bus: Annotated[
        list[str] | None,
        typer.Option("--bus", help="CHANNEL=INTERFACE:NAME, repeat for several; or INTERFACE:NAME for all. Without: what is in the record"),
    ] = None,
    speed: Annotated[float, typer.Option(min=1e-3, max=1e3, help="2 is twice as fast")] = 1.0,
    arbitration_id: Annotated[list[str] | None, typer.Option("--id", help="only these: 0x110 or a name of the DBC; repeat")] = None,
    sender: Annotated[list[str] | None, typer.Option("--sender", help="only messages of this node of the DBC; repeat")] = None,
    with_gateway: Annotated[bool, typer.Option("--with-gateway", help="messages of the gateway too: never where one lives")] = False,
    dbc: DbcOption = _DBC_FILES,
    mapping: MappingOption = None,
    as_json: JsonOption = False,
) -> None:
    """Play a bus record back, every frame at its time; without --bus tell what is in it."""
    from dbc.catalogue import load  # noqa: PLC0415
    from xil import replay as playing  # noqa: PLC0415

    if not bus:
        found = playing.contents(playing.read_record(log))
        show(found if as_json else playing.contents_table(str(log), found), as_json)
        return
    selection = playing.select(load(dbc, mapping), arbitration_id, sender, with_gateway=with_gateway)
    with stop_on_signal() as stop, playing.open_buses(bus, log) as send:
        player = playing.Player(send, selection, speed, sleep=lambda duration_ns: _wait(stop, duration_ns))
        player.play(playing.read_record(log), stop.is_set)
    show(player.played if as_json else playing.played_text(player.played), as_json)
    if stop.is_set():
        raise typer.Exit(EXIT_INTERRUPTED)


def _wait(stop: threading.Event, duration_ns: int) -> None:
    """Sleep, but not longer than until somebody wants an end."""
    stop.wait(min(duration_ns * 1e-9, threading.TIMEOUT_MAX))


@records.command()
def resim(
    path: Annotated[Path, typer.Argument(help="run directory, directory of a recorder, or one journal")],
    as_json: JsonOption = False,
) -> None:
    """Run gateway and controller again from their journals and compare every answer: exit code 0 the same, 1 another."""
    from xil import resim as again  # noqa: PLC0415

    comparisons = again.resim(path, progress)
    show(comparisons if as_json else "\n".join(map(again.told, comparisons)), as_json)
    if not all(comparison.is_same for comparison in comparisons):
        raise typer.Exit(EXIT_FAIL)
    if any(comparison.missing for comparison in comparisons):
        raise typer.Exit(EXIT_USER)
