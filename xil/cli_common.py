"""What the modules of the command line share: exit codes, options, daemons, output."""

import importlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dbc.errors import SetupFailure, UserMistake

if TYPE_CHECKING:
    from gateway.telemetry import TlsSection

EXIT_FAIL, EXIT_USER, EXIT_SETUP, EXIT_INTERRUPTED = 1, 2, 3, 130

DbcOption = Annotated[list[Path], typer.Option("--dbc", help="DBC file; repeat for several")]
MappingOption = Annotated[Path | None, typer.Option("--mapping", help="TOML file of the names and units that a site's DBC has for ours")]
VehicleOption = Annotated[Path, typer.Option("--vehicle", help="vehicle file")]


def _either(context: typer.Context, value: Any) -> Any:  # noqa: ANN401 - of both options
    """Refuse one of two options that exclude each other: whichever comes second finds the other one given."""
    given = [context.get_parameter_source(name) for name in ("telemetry_port", "tls")]
    if all(source is not None and source.name == "COMMANDLINE" for source in given):
        raise UserMistake("--telemetry-port: not beside --tls; the address of the other machine in that file names its port")
    return value


PortOption = Annotated[
    int,
    typer.Option("--telemetry-port", min=1024, max=65000, help="first of five loopback ports for telemetry", callback=_either),
]
TlsOption = Annotated[
    Path | None,
    typer.Option(
        "--tls", help="instead of --telemetry-port: TOML file with address of another machine and our certificate", callback=_either
    ),
]
ControlOption = Annotated[
    Path | None, typer.Option("--control", help="directory of the control sockets and their key; default: one of the user's own")
]
KeyOption = Annotated[Path | None, typer.Option("--key", help="key file of the rig; default: the key in the directory of the sockets")]
RigOption = Annotated[
    Path | None, typer.Option("--rig", help="rig file of the gateway, for what both have in common: sockets, key, ports, vehicle")
]
JsonOption = Annotated[bool, typer.Option("--json", help="one JSON object instead of a table")]


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set; a daemon then ends in order."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    yield stop


def run_daemon(module: str, make_options: Callable[[Any], object]) -> None:
    """Run `module.run` with its options until a signal comes."""
    from gateway.logs import PlainFormatter  # noqa: PLC0415 - imports are late so that every command starts quickly

    handler = logging.StreamHandler()
    handler.setFormatter(PlainFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    daemon = importlib.import_module(module)
    with stop_on_signal() as stop:
        daemon.run(make_options(daemon), stop)


def tls_of(path: Path | None) -> "TlsSection | None":
    """How a rig on another machine is reached, where a file says so.

    Raises:
        TlsMistake: see `gateway.telemetry.read_tls`.
    """
    from gateway.telemetry import read_tls  # noqa: PLC0415

    return None if path is None else read_tls(path)


def exit_code_of(error: UserMistake | SetupFailure) -> int:
    """Exit code of a command that such an error ends."""
    return EXIT_USER if isinstance(error, UserMistake) else EXIT_SETUP


def refuse_beside_rig(context: typer.Context, *allowed: str) -> None:
    """Refuse settings beside a rig file: nobody would find them again.

    Args:
        allowed: parameters of the command that are no settings of the rig.
    """
    for name in context.params.keys() - {"rig", *allowed}:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            raise UserMistake(f"--{name.replace('_', '-')}: not beside --rig; write it into the rig file")


def progress(text: str) -> None:
    """Tell what goes on, apart from the output."""
    print(text, file=sys.stderr)


def as_json_text(content: object) -> str:
    """What is to be shown, as one line for programs."""
    import json  # noqa: PLC0415

    import msgspec  # noqa: PLC0415

    return json.dumps(content, default=msgspec.to_builtins)


def show(content: object, as_json: bool) -> None:
    """Print a text or a table for people, or with `as_json` an object for programs."""
    if as_json:
        print(as_json_text(content))
    elif isinstance(content, str):
        print(content)  # as it is: names of others may look like markup
    else:
        from rich.console import Console  # noqa: PLC0415

        # A table keeps its columns when it is piped into a file.
        Console(width=None if sys.stdout.isatty() else int(os.environ.get("COLUMNS", "140"))).print(content)
