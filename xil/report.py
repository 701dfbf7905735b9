"""`report.html`: one file about one run, for people; it opens offline and asks no other host for anything."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

import visualiser
from dbc.vehicle import Vehicle
from xil.course import Array
from xil.map_view import Map, draw_map
from xil.metrics import SAMPLE_TIME_MS, Trace, Verdict, closest, trace
from xil.recording import Recording
from xil.scenario import Scenario, Stage

_HERE = Path(__file__).parent
_VENDOR = Path(visualiser.__path__[0]) / "page" / "vendor" / "uplot"
_MAX_POINTS = 1500



@dataclass(frozen=True)
class _Limits:
    """Limits to draw into a plot, and the span of time in which they hold."""

    values: tuple[float, ...]
    span_s: tuple[float, float]


_NO_LIMITS = _Limits((), (0.0, 0.0))
_STAGE_NAMES = {
    Stage.MIL: "model in the loop, virtual time",
    Stage.SIL: "software in the loop, virtual time",
    Stage.HIL: "hardware in the loop, real time",
    Stage.VEHIL: "vehicle in the loop, real time",
}


def write_report(  # noqa: PLR0917 - what a report is made of
    path: Path, summary: dict[str, Any], recording: Recording, scenario: Scenario, vehicle: Vehicle, verdict: Verdict
) -> None:
    """Write the report of a run.

    Args:
        summary: as `build_summary` makes it.

    Raises:
        OSError: the file cannot be written.
    """
    stage = Stage(summary["stage"])
    drive, the_map = None, None
    if recording.samples(stage.pose_topic):
        course = scenario.course(vehicle)
        drive = trace(recording, course, stage)
        meetings = [closest(recording, thing.name, course, drive) for thing in scenario.objects]
        the_map = draw_map(course, drive, [meeting for meeting in meetings if meeting is not None])
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"figure": _figure, "limit": _limit}
    content = environment.get_template("report.html.j2").render(
        summary=summary,
        stage_name=_STAGE_NAMES[stage],
        verdict=verdict,
        map=the_map,
        data=_data(recording, scenario, drive, the_map),
        css=_asset(_VENDOR / "uPlot.min.css") + _asset(_HERE / "report.css"),
        uplot=_without_banner(_asset(_VENDOR / "uPlot.iife.min.js")),
        script=_asset(_HERE / "report.js"),
    )
    path.write_text(content, encoding="utf-8")


def _asset(path: Path) -> Markup:
    return Markup(path.read_text(encoding="utf-8"))


def _without_banner(script: Markup) -> Markup:
    """A script without its leading comment, whose address would be the only one of another host in the report."""
    return Markup(script.partition("*/")[2])


def _figure(value: float | None, unit: str = "") -> str:
    """A measured figure as people read it: a count as such, anything else with about three significant digits."""
    if value is None:
        return "\N{EN DASH}"
    if not unit:
        return f"{value:.0f}"
    decimals = 3 if abs(value) < 1.0 else 2 if abs(value) < 100.0 else 1
    return f"{value:z.{decimals}f}{_printed(unit)}".replace("-", "\N{MINUS SIGN}")


def _limit(value: float, unit: str) -> str:
    """A limit as it was set."""
    return f"{value:g}{_printed(unit)}"


def _printed(unit: str) -> str:
    """A unit as it stands behind a number."""
    if unit in ("", "deg"):
        return "\N{DEGREE SIGN}" if unit else ""
    return "\N{NO-BREAK SPACE}" + unit.replace("s2", "s\N{SUPERSCRIPT TWO}")


def _data(recording: Recording, scenario: Scenario, drive: Trace | None, the_map: Map | None) -> dict[str, Any]:
    """All that the script of the report draws, rounded and thinned."""
    if drive is None or the_map is None:
        return {"plots": [], "modes": [], "judged_s": [0.0, 0.0], "end_s": 0.0, "marker": None}
    end_s = float(drive.t_s[-1])

    def passed_s(at_m: float) -> float:
        is_past = drive.along.station_m >= at_m
        return float(drive.t_s[np.argmax(is_past)]) if is_past.any() else end_s

    judged_s = (passed_s(scenario.judge.from_m), passed_s(scenario.judge.to_m))
    limit_m = scenario.judge.lateral_error_max_m
    lateral_limits = _Limits(() if limit_m is None else (-limit_m, limit_m), judged_s)
    solve_limits = _Limits((SAMPLE_TIME_MS,), (0.0, end_s))
    return {
        "plots": [*_motion(drive, lateral_limits), *_robots(recording), _solve_times(recording, solve_limits)],
        "modes": [{"t_s": round(change.t_s, 3), "mode": change.mode, "reason": change.reason} for change in drive.changes],
        "judged_s": judged_s,
        "end_s": end_s,
        "marker": the_map.marker,
    }


def _motion(drive: Trace, lateral_limits: _Limits) -> list[dict[str, Any]]:
    along, degrees, kmh = drive.along, 180.0 / np.pi, 3.6
    return [
        _plot("Speed", "km/h", drive.t_s, {"reference": along.speed_mps * kmh, "driven": drive.speed_mps * kmh}),
        _plot("Yaw", "deg", drive.t_s, {"reference": along.yaw_rad * degrees, "driven": drive.yaw_rad * degrees}),
        _plot("Lateral error", "m", drive.t_s, {"driven": along.lateral_error_m}, lateral_limits),
        _plot("Lateral acceleration", "m/s\N{SUPERSCRIPT TWO}", drive.t_s, {"driven": drive.lateral_acceleration_mps2}),
    ]


def _robots(recording: Recording) -> list[dict[str, Any]]:
    degrees, percent, t_s = 180.0 / np.pi, 100.0, recording.times_s("state")
    return [
        _plot(
            title, unit, t_s,
            {"commanded": recording.series("state", command) * scale, "measured": recording.series("state", measured) * scale},
        )
        for title, unit, command, measured, scale in (
            ("Steering robot (SR), steering wheel", "deg", "sr_command_rad", "sr_angle_rad", degrees),
            ("Accelerator robot (AR), position", "%", "ar_command_norm", "ar_position_norm", percent),
            ("Brake robot (BR), position", "%", "br_command_norm", "br_position_norm", percent),
        )
    ]  # fmt: skip


def _solve_times(recording: Recording, limits: _Limits) -> dict[str, Any]:
    return _plot("Solve time", "ms", recording.times_s("command"), {"measured": recording.series("command", "solve_time_ms")}, limits)


def _plot(title: str, unit: str, t_s: Array, lines: dict[str, Array], limits: _Limits = _NO_LIMITS) -> dict[str, Any]:
    """One plot over time; every second, third, ... sample where there are too many."""
    thin = slice(None, None, max(1, -(-len(t_s) // _MAX_POINTS)))
    columns = [np.round(t_s[thin], 3), *(np.round(values[thin], 4) for values in lines.values())]
    return {
        "title": title,
        "unit": unit,
        "lines": list(lines),
        "limits": limits.values,
        "limits_hold_s": limits.span_s,
        "data": [column.tolist() for column in columns],
    }
