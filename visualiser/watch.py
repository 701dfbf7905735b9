"""`xilgate watch`: the newest telemetry as a live table, or as one line per second where there is no terminal."""

import math
import threading
import time
from dataclasses import dataclass
from typing import TypeVar

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gateway.telemetry import (
    DEFAULT_BASE_PORT,
    TOPICS,
    CommandSample,
    ProfileSample,
    Sample,
    SceneSample,
    StateSample,
    StatusSample,
    Subscriber,
    TlsSection,
    WorldSample,
)
from visualiser.board import Board

_TABLE_PERIOD_S = 0.25
_LINE_PERIOD_S = 1.0
_SOLVE_BUDGET_MS = 40.0  # one control cycle
_MODE_STYLES = {
    "SILENT": "bold white on grey37",
    "STANDBY": "bold white on grey37",
    "READY": "bold white on blue",
    "ENGAGED": "bold black on green",
    "COMFORT_STOP": "bold black on yellow",
    "SAFE_STOP": "bold black on yellow",
    "FAULT": "bold white on red",
}

Row = tuple[str, str, str]
SampleT = TypeVar("SampleT", bound=Sample)


@dataclass(frozen=True)
class WatchOptions:
    """Settings of the watch.

    Args:
        telemetry_base_port: first telemetry port of the processes to look at.
        tls: for a rig that is another machine; None for this one.
    """

    telemetry_base_port: int = DEFAULT_BASE_PORT
    tls: TlsSection | None = None


def _newest(board: Board, topic: str, kind: type[SampleT]) -> SampleT | None:
    received = board.newest.get(topic)
    return received.sample if received is not None and isinstance(received.sample, kind) else None


def _state_rows(state: StateSample) -> list[Row]:
    return [
        ("Speed", f"{state.vx_mps * 3.6:z.1f} km/h", ""),
        ("Pose", f"x {state.x_m:z.2f} m   y {state.y_m:z.2f} m   yaw {math.degrees(state.yaw_rad):z.1f}°", "" if state.is_valid else "red"),
        ("SR", f"{math.degrees(state.sr_angle_rad):+z.1f}°   commanded {math.degrees(state.sr_command_rad):+z.1f}°", ""),
        ("AR", f"{state.ar_position_norm * 100:z.0f} %   commanded {state.ar_command_norm * 100:z.0f} %", ""),
        ("BR", f"{state.br_position_norm * 100:z.0f} %   commanded {state.br_command_norm * 100:z.0f} %", ""),
    ]


def _command_rows(command: CommandSample) -> list[Row]:
    solve_style = "red" if command.solve_time_ms > _SOLVE_BUDGET_MS else ""
    iterations = f"{command.sqp_iterations} SQP, {command.qp_iterations} QP iterations"
    solved = f"{command.solver}   {command.solve_time_ms:.2f} ms of {_SOLVE_BUDGET_MS:.0f} ms   {iterations}"
    rejected = f"   {command.objects_rejected} rejected" if command.objects_rejected else ""
    return [
        ("Command", command.status, "" if command.status == "OK" else "yellow"),
        ("Solver", solved, solve_style),
        ("Tracking", f"lateral {command.lateral_error_m:+z.3f} m   speed {command.speed_error_mps * 3.6:+z.1f} km/h", ""),
        ("Disturbance", f"{command.disturbance_mps2:+z.2f} m/s²", ""),
        ("Objects", f"{command.objects} considered{rejected}", "yellow" if rejected else ""),
        ("Parameters", f"version {command.parameters_version}", ""),
    ]


def _profile_row(profile: ProfileSample) -> Row:
    parts = "   ".join(f"{name} {time_us:.0f}" for name, time_us in profile.time_us.items())
    return ("Profile", f"{parts}   µs per cycle", "")


def _status_rows(status: StatusSample) -> list[Row]:
    rejected = sum(status.frames_rejected.values())
    refused = sum(status.commands_rejected.values())
    return [
        ("Reason", status.reason, ""),
        ("Blockers", ", ".join(status.blockers) or "none", "yellow" if status.blockers else ""),
        ("Command age", f"{status.command_age_ms:.0f} ms", ""),
        ("Frames", f"{status.frames_received} received   {rejected} rejected", "yellow" if rejected else ""),
        ("Commands", f"{refused} rejected", "yellow" if refused else ""),
        ("Limits", _limits_text(status), "yellow" if status.limits else ""),
        ("Actuation", f"on a measurement {status.actuation_age_ms:z.0f} ms old   largest {status.actuation_age_max_ms:z.0f} ms", ""),
        *([("Buses", _buses_text(status), "red" if status.dead_buses else "")] if status.buses else []),
        ("Ticks", f"{status.ticks}   {status.ticks_late} late   step {status.step_cpu_ms:.2f} ms CPU", ""),
    ]


def _limits_text(status: StatusSample) -> str:
    acted = "   ".join(f"{name} {limit.ticks}" for name, limit in status.limits.items())
    return f"{status.profile}   held back {100 * status.limited_share:.1f} %   {acted}".rstrip()


def _buses_text(status: StatusSample) -> str:
    return "   ".join(f"{network} {state} {100 * status.bus_load.get(network, 0.0):.0f} %" for network, state in status.buses.items())


def _age_rows(board: Board, now_ns: int) -> list[Row]:
    rows = []
    for topic in TOPICS:
        received = board.newest.get(topic)
        if received is None:
            rows.append((f"Age {topic}", "not seen", "dim"))
            continue
        is_lost = board.is_lost(topic, now_ns)
        text = f"{board.age_ms(topic, now_ns):.0f} ms   {received.number} samples" + ("   LOST" if is_lost else "")
        rows.append((f"Age {topic}", text, "red" if is_lost else ""))
    return rows


def _mode(board: Board, now_ns: int) -> tuple[str, str]:
    state, status = _newest(board, "state", StateSample), _newest(board, "status", StatusSample)
    sample = state or status
    if sample is None:
        return "NO LINK", "dim"
    if board.is_lost("state" if state else "status", now_ns):
        return f"NO LINK, last {sample.mode}", "bold red"
    return sample.mode, _MODE_STYLES.get(sample.mode, "bold")


def table(board: Board, now_ns: int) -> Group:
    """The live table for a terminal."""
    mode, style = _mode(board, now_ns)
    rows: list[Row] = []
    if status := _newest(board, "status", StatusSample):
        rows += _status_rows(status)
    if state := _newest(board, "state", StateSample):
        rows += _state_rows(state)
    if command := _newest(board, "command", CommandSample):
        rows += _command_rows(command)
    if profile := _newest(board, "profile", ProfileSample):
        rows.append(_profile_row(profile))
    if world := _newest(board, "world", WorldSample):
        rows.append(("Ground truth", f"x {world.x_m:z.2f} m   y {world.y_m:z.2f} m   {world.vx_mps * 3.6:z.1f} km/h", ""))
    grid = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column()
    for name, text, row_style in [*rows, *_age_rows(board, now_ns)]:
        grid.add_row(name, Text(text, style=row_style))
    title = Text.assemble((f" {mode} ", style), "  ", _scenario(board))
    return Group(title, grid)


def line(board: Board, now_ns: int) -> str:
    """The same in one line, for a log or a pipe."""
    parts = [_mode(board, now_ns)[0]]
    if state := _newest(board, "state", StateSample):
        parts.append(f"{state.vx_mps * 3.6:z.1f} km/h x {state.x_m:z.2f} m y {state.y_m:z.2f} m")
    if command := _newest(board, "command", CommandSample):
        parts.append(f"command {command.status} solve {command.solve_time_ms:.2f} ms")
    if status := _newest(board, "status", StatusSample):
        parts.append(f"frames {status.frames_received} rejected {sum(status.frames_rejected.values())}")
    lost = [topic for topic in TOPICS if board.is_lost(topic, now_ns)]
    if lost:
        parts.append(f"lost: {', '.join(lost)}")
    return "  ".join(parts)


def _scenario(board: Board) -> str:
    scene = _newest(board, "scene", SceneSample)
    return f"{scene.scenario} at stage {scene.stage}" if scene else ""


def run(options: WatchOptions, stop: threading.Event) -> None:
    """Show telemetry until `stop` is set."""
    board = Board(is_clock_shared=options.tls is None)
    lock = threading.Lock()
    console = Console()

    def on_sample(topic: str, payload: bytes) -> None:
        with lock:
            board.accept(topic, payload, time.monotonic_ns())

    with Subscriber(on_sample, list(TOPICS), options.telemetry_base_port, options.tls):
        if not console.is_terminal:
            while not stop.wait(_LINE_PERIOD_S):
                with lock:
                    text = line(board, time.monotonic_ns())
                print(text, flush=True)
            return
        with Live(console=console, auto_refresh=False) as live:
            while not stop.wait(_TABLE_PERIOD_S):
                with lock:
                    picture = table(board, time.monotonic_ns())
                live.update(picture, refresh=True)
