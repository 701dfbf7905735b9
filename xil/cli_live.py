"""Commands that talk to what runs: operate, make-key, watch, object, lift, params, fault."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gateway.telemetry import DEFAULT_BASE_PORT
from xil.cli_common import (
    EXIT_FAIL,
    ControlOption,
    JsonOption,
    KeyOption,
    PortOption,
    RigOption,
    TlsOption,
    as_json_text,
    refuse_beside_rig,
    run_daemon,
    show,
    stop_on_signal,
    tls_of,
)

live = typer.Typer()
params = typer.Typer(help="Look at and change the parameters of a running controller.", no_args_is_help=True)
live.add_typer(params, name="params")
fault = typer.Typer(help="Inject faults into a running emulator, look at them and take them back.", no_args_is_help=True)
live.add_typer(fault, name="fault")


class OperationName(StrEnum):
    """What an operator can ask for."""

    ARM = "arm"
    ENGAGE = "engage"
    DISENGAGE = "disengage"
    STOP = "stop"
    RESET = "reset"


class Movement(StrEnum):
    """What a lift can do."""

    RAISE = "raise"
    LOWER = "lower"


@live.command()
def operate(
    context: typer.Context,
    operation: Annotated[OperationName, typer.Argument(help="what to ask of the gateway")],
    *,
    rig: RigOption = None,
    control: ControlOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask a running gateway for an operation and tell its answer: granted, or every condition that is not met (exit code 1)."""
    from gateway.channel import control_path, operator_client  # noqa: PLC0415
    from gateway.messages import Operation  # noqa: PLC0415

    if rig is None:
        path = control_path(control, key)
    else:
        from gateway.rig import read_rig  # noqa: PLC0415

        refuse_beside_rig(context, "operation", "as_json")
        path = read_rig(rig).control.path
    with operator_client(path) as client:
        reply = client.ask(Operation[operation.name])
    if as_json:
        content = {"operation": operation.value, "granted": not reply.refusals, "mode": reply.mode.name, "refusals": reply.refusals}
        print(as_json_text(content))
    else:
        print("\n".join(f"refused: {refusal}" for refusal in reply.refusals) or f"granted: {reply.mode.name}")
    if reply.refusals:
        raise typer.Exit(EXIT_FAIL)


@live.command("make-key")
def make_key(file: Annotated[Path, typer.Argument(metavar="FILE", help="not there yet; its mode will be 0600")]) -> None:
    """Make the key of a rig: who can read it can command its gateway."""
    from gateway import keys  # noqa: PLC0415

    keys.make_key(file)
    print(f"{file}: new key")


@live.command()
def watch(telemetry_port: PortOption = DEFAULT_BASE_PORT, tls: TlsOption = None) -> None:
    """A live table of what runs."""
    section = tls_of(tls)
    run_daemon("visualiser.watch", lambda m: m.WatchOptions(telemetry_base_port=telemetry_port, tls=section))


@live.command("object")
def object_from_outside(
    name: Annotated[str, typer.Argument(help="by which the object is known again")],
    *,
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
    with stop_on_signal() as stop:
        print(f"{name} is on the road for {seconds:g} s; an interrupt takes it away", flush=True)
        publish(thing, telemetry_port, seconds, stop)


@live.command()
def lift(
    movement: Annotated[Movement, typer.Argument(help="what the lift is to do")], telemetry_port: PortOption = DEFAULT_BASE_PORT
) -> None:
    """Raise or lower the car of a running emulator; refused unless its wheels stand, its engine idles and its robots are off."""
    from xil import lift as hoist  # noqa: PLC0415

    print(hoist.move(movement.value, telemetry_port))


@params.command("list")
def params_list(telemetry_port: PortOption = DEFAULT_BASE_PORT, tls: TlsOption = None, as_json: JsonOption = False) -> None:
    """All parameters with value, unit, range and default."""
    params_get([], telemetry_port, tls, as_json)


@params.command("get")
def params_get(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="parameters; `params list` has them all")],
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    tls: TlsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Some parameters."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.values(names, telemetry_port, tls_of(tls))
    show(answer if as_json else tuner.values_table(answer), as_json)


@params.command("set")
def params_set(
    assignments: Annotated[list[str], typer.Argument(metavar="NAME=VALUE...", help="for example planner.safe_time_s=1.8")],
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    tls: TlsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Change parameters between two cycles: all that are named, or none when one is refused."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.change(assignments, telemetry_port, tls_of(tls))
    show(answer if as_json else tuner.changes_table(answer), as_json)


@params.command("revert")
def params_revert(
    what: Annotated[str, typer.Argument(help="number of a change, last or all")] = "last",
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    tls: TlsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take a change back: the parameters that it set get the values from before."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.revert(what, telemetry_port, tls_of(tls))
    show(answer if as_json else tuner.changes_table(answer), as_json)


@params.command("history")
def params_history(telemetry_port: PortOption = DEFAULT_BASE_PORT, tls: TlsOption = None, as_json: JsonOption = False) -> None:
    """Who changed what, and when."""
    from xil import params as tuner  # noqa: PLC0415

    answer = tuner.history(telemetry_port, tls_of(tls))
    show(answer if as_json else tuner.history_table(answer, tls is None), as_json)


@params.command("watch")
def params_watch(telemetry_port: PortOption = DEFAULT_BASE_PORT, tls: TlsOption = None, as_json: JsonOption = False) -> None:
    """Print every change as it comes in force, until interrupted."""
    from xil import params as tuner  # noqa: PLC0415

    with stop_on_signal() as stop:
        tuner.follow(
            telemetry_port,
            stop,
            lambda sample: print(as_json_text(sample) if as_json else tuner.line(sample, tls is None), flush=True),
            tls_of(tls),
        )


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
    show(answer if as_json else injector.table(answer, "added"), as_json)


@fault.command("list")
def fault_list(telemetry_port: PortOption = DEFAULT_BASE_PORT, as_json: JsonOption = False) -> None:
    """All faults of the emulator: waiting, active and over."""
    from xil import fault as injector  # noqa: PLC0415

    answer = injector.listing(telemetry_port)
    show(answer if as_json else injector.table(answer, "faults"), as_json)


@fault.command("clear")
def fault_clear(
    name: Annotated[str | None, typer.Argument(help="name of a fault; default: all")] = None,
    telemetry_port: PortOption = DEFAULT_BASE_PORT,
    as_json: JsonOption = False,
) -> None:
    """Take a fault back, or all."""
    from xil import fault as injector  # noqa: PLC0415

    answer = injector.clear(name, telemetry_port)
    show(answer if as_json else injector.table(answer, "cleared"), as_json)


@fault.command("kinds")
def fault_kinds(as_json: JsonOption = False) -> None:
    """What can go wrong, and the keys of each kind."""
    from xil import fault as injector  # noqa: PLC0415

    show(injector.kinds_data() if as_json else injector.kinds_table(), as_json)
