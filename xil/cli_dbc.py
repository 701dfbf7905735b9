"""Commands that look at DBC files: check, diff, list."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.lint import DEFAULT_MAX_LOAD, Severity
from xil.cli_common import EXIT_FAIL, JsonOption, MappingOption, show

tools = typer.Typer(help="Look at DBC files: what is in them, what is wrong with them, what a new version breaks.", no_args_is_help=True)

FilesArgument = Annotated[list[Path], typer.Argument(metavar="[FILES]...", help="DBC files that are used together")]
OWN_FILES = [ROBOTS_DBC, GNSS_IMU_DBC]


@tools.callback()
def quiet() -> None:
    """What the parser would warn about, such as an identifier that is there twice, is a finding of ours."""
    logging.getLogger("cantools").setLevel(logging.ERROR)


@tools.command()
def check(
    files: FilesArgument = OWN_FILES,
    mapping: MappingOption = None,
    max_load: Annotated[float, typer.Option(min=0.01, max=1.0, help="share of a bus that may be taken")] = DEFAULT_MAX_LOAD,
    as_json: JsonOption = False,
) -> None:
    """Mistakes and risks: layout, ranges, times, protection, load of each bus, response times. Exit code 1 when there are errors."""
    from xil import dbc_report  # noqa: PLC0415

    findings = dbc_report.check(files, mapping, max_load)
    show(dbc_report.findings_data(findings) if as_json else dbc_report.findings_table(findings), as_json)
    if any(finding.severity is Severity.ERROR for finding in findings):
        raise typer.Exit(EXIT_FAIL)


@tools.command()
def diff(
    old: Annotated[Path, typer.Argument(help="DBC file")],
    new: Annotated[Path, typer.Argument(help="DBC file")],
    as_json: JsonOption = False,
) -> None:
    """What a new version breaks for those who stay with the old one, and what it does not. Exit code 1 when something breaks."""
    from dbc.catalogue import read_files  # noqa: PLC0415
    from dbc.difference import compare  # noqa: PLC0415
    from xil import dbc_report  # noqa: PLC0415

    changes = compare(*read_files([old, new], is_strict=False))
    show(dbc_report.changes_data(changes) if as_json else dbc_report.changes_table(changes), as_json)
    if any(change.is_breaking for change in changes):
        raise typer.Exit(EXIT_FAIL)


@tools.command("list")
def list_messages(
    files: FilesArgument = OWN_FILES,
    mapping: MappingOption = None,
    with_signals: Annotated[bool, typer.Option("--signals", help="every signal as well")] = False,
    as_json: JsonOption = False,
) -> None:
    """Messages with cycle, timeout, protection, load and worst-case response time."""
    from dbc.catalogue import read_files  # noqa: PLC0415
    from xil import dbc_report  # noqa: PLC0415

    read = read_files(files, mapping)
    rows, loads = dbc_report.messages(read), {timing.network: timing.load for timing in dbc_report.timings(read)}
    signals = dbc_report.signals(read) if with_signals else []
    if as_json:
        show({"loads": loads, "messages": rows} | ({"signals": signals} if with_signals else {}), as_json)
        return
    show(dbc_report.messages_table(rows, loads), as_json)
    if with_signals:
        show(dbc_report.signals_table(signals), as_json)
