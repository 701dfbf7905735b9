"""`xilgate bench loop`: what the controller makes of noise, slow robots, slopes and a heavy car, in closed loop in virtual time.

`loss`: the controller's own small car (`controller.bench.loop`), four times the noise of the navigation system, throttle and
corridor at their limits. `delay` and `slope`: the emulated car behind gateway and bus, stage sil. `cost`: CPU time of a step.
"""

import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from controller.bench.loop import drive
from controller.bench.scenarios import Scenario as SmallScenario
from controller.nmpc import DRIVE_MODEL, Nmpc, NmpcOptions, NmpcOutput
from controller.planning.obstacles import Obstacle
from controller.planning.options import PlannerOptions
from controller.planning.reference import ReferencePath
from controller.problem import SINGLE_TRACK, SINGLE_TRACK_LAG, Array, Model, OcpOptions
from controller.solver import Solver, SolveStatus
from controller.solvers import make_solver
from dbc.catalogue import load
from dbc.vehicle import Vehicle, load_vehicle
from gateway.messages import PLAN_PERIOD_NS, VehicleState
from xil.course import blend
from xil.figures import Row, figures_table
from xil.lockstep import START_NS, LockstepRun
from xil.metrics import Trace, trace
from xil.recording import Recording
from xil.scenario import Scenario, Stage, load_scenario
from xil.setup import RunSetup
from xil.summary import machine

NOISE = 4.0
LOST_M, LOST_AT_END_M = 1.5, 0.6
"""A car is lost that was farther from its path than the first, or than the second in the last second."""
DEAD_TIME_S = 0.08
DELAY_SEEDS = 3
GRADE_PERCENT, EXTRA_MASS = 6.0, 0.10
SETTLING_S = 5.0
SCENARIOS = ("iso3888-1", "lane-keeping")
_LAST_SECOND = round(1e9 / PLAN_PERIOD_NS)
_UNLIMITED = NmpcOptions(planner=PlannerOptions(speed_margin_mps=20.0))
"""The reference speed is the path's however slow the car is, so that it asks for full throttle."""


@dataclass(frozen=True)
class Variant:
    """A controller to drive with."""

    name: str
    model: Model
    options: NmpcOptions


BLIND = Variant("blind", SINGLE_TRACK, NmpcOptions(delays_s=(0.0, 0.0), disturbance=None))
"""The paper's model, for which commands act at once and nothing disturbs."""
BLIND_OBSERVED = Variant("blind, observer", SINGLE_TRACK, NmpcOptions(delays_s=(0.0, 0.0)))
AWARE = Variant("aware", SINGLE_TRACK_LAG, NmpcOptions(disturbance=None))
"""Dead time predicted, lag modelled, nothing else."""
AWARE_OBSERVED = Variant("aware, observer", SINGLE_TRACK_LAG, NmpcOptions())
UNOBSERVED = Variant("without observer", DRIVE_MODEL, NmpcOptions(disturbance=None))
DRIVEN = Variant("with observer", DRIVE_MODEL, NmpcOptions())


def bench_loop(solver: str, seeds: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Drive everything.

    Args:
        solver: name of the solver.
        seeds: of each of the five cases of `loss`.
        progress: told in one line each what takes time.

    Returns:
        `{"machine": ..., "solver": ..., "model": ..., "rows": [...]}`, one row for each figure.
    """
    for model in (SINGLE_TRACK, SINGLE_TRACK_LAG):
        make_solver(solver, load_vehicle().model, OcpOptions(model=model), progress)  # compiled once, before the workers ask for it
    rows: list[Row] = []
    with ProcessPoolExecutor() as pool:
        for name, part in (("loss", loss), ("delay", delay), ("slope", slope)):
            progress(f"driving: {name}")
            rows += part(solver, seeds, pool.map)
    rows += cost(solver)
    facts = machine()
    return {
        "machine": f"{facts['cpu']}, {facts['cores']} cores, {facts['system']}",
        "solver": solver,
        "model": DRIVE_MODEL.name,
        "rows": [row.judged() for row in rows],
    }


def to_table(result: dict[str, Any]) -> Table:
    """The result for people."""
    return figures_table("Closed loop", f"{result['solver']}, {result['model']}\n{result['machine']}", result["rows"])


Map = Callable[..., Iterable[Any]]
"""`map` of a pool of processes, or the ordinary one."""


def loss(solver: str, seeds: int, mapped: Map) -> list[Row]:
    """Cars lost with four times the sensor noise."""
    tasks = [(solver, name, seed) for name in loss_cases() for seed in range(1, seeds + 1)]
    drives = list(mapped(_small_drive, tasks))
    lost = sum(largest_m > LOST_M or at_end_m > LOST_AT_END_M for largest_m, at_end_m, _ in drives)
    return [
        Row("cars lost", f"{len(drives)} drives, {NOISE:g}x noise", lost, "", "at most", 0),
        Row("largest distance from the path", "the same", max(largest_m for largest_m, _, _ in drives), "m"),
        Row("solves converged", "the same", float(np.mean([converged for _, _, converged in drives])), ""),
    ]


def loss_cases() -> dict[str, tuple[SmallScenario, NmpcOptions]]:
    """Lane changes at the limits: of grip, of a corridor of 0.25 m to each side, of the throttle (14 km/h too slow)."""
    usual = NmpcOptions()
    return {
        "dlc80": (_lane_change(80.0, 80.0, 40.0, 0.8), usual),
        "tight80": (_lane_change(80.0, 80.0, 40.0, 0.25), usual),
        "sat80": (_lane_change(80.0, 66.0, 36.0, 0.25), _UNLIMITED),
        "tight90": (_lane_change(90.0, 90.0, 42.0, 0.25), usual),
        "sat90": (_lane_change(90.0, 76.0, 40.0, 0.25), _UNLIMITED),
    }


def _lane_change(speed_kmh: float, start_kmh: float, length_m: float, half_width_m: float) -> SmallScenario:
    """ISO 3888-1: 3.5 m aside and back, each along `length_m` with its middle between two gates."""
    x_m = np.arange(-40.0, 240.0, 0.25)
    (aside, rise), (back, fall) = (blend((x_m - middle_m) / length_m + 0.5) for middle_m in (31.25, 83.25))
    room_m = np.full(x_m.size, half_width_m)
    yaw_rad = np.arctan2(3.5 * (rise - fall), length_m)
    path = ReferencePath(x_m, 3.5 * (aside - back), yaw_rad, np.full(x_m.size, speed_kmh / 3.6), room_m, room_m)
    return SmallScenario(f"{speed_kmh:g} km/h", path, 0.0, start_kmh / 3.6, 8.0)


def _small_drive(task: tuple[str, str, int]) -> tuple[float, float, float]:
    """Largest distance from the path, that in the last second [m], and the share of solves that converged."""
    solver, name, seed = task
    scenario, options = loss_cases()[name]
    vehicle = load_vehicle()
    outputs, states = drive(Nmpc(_solver(solver, DRIVE_MODEL), scenario.path, vehicle, 1, options), vehicle, scenario, seed, NOISE)
    distance_m = distances_m(scenario.path, states[:, 3:5])
    return float(distance_m.max()), float(distance_m[-_LAST_SECOND:].max()), float(np.mean([_has_converged(o) for o in outputs]))


def distances_m(path: ReferencePath, points: Array) -> Array:
    """Distance of each of the points, shape (n, 2), from the path [m]."""
    corners = np.column_stack((path.x_m, path.y_m))
    steps = np.diff(corners, axis=0)
    offsets = points[:, None] - corners[:-1]
    share = np.clip(np.sum(offsets * steps, axis=2) / np.sum(steps**2, axis=1), 0.0, 1.0)
    return np.asarray(np.hypot(*np.moveaxis(offsets - share[..., None] * steps, 2, 0)).min(axis=1))


def _has_converged(output: NmpcOutput) -> bool:
    return output.solution is not None and output.solution.result.status is SolveStatus.CONVERGED


@cache
def _solver(name: str, model: Model) -> Solver:
    """One solver of a kind for each worker."""
    return make_solver(name, load_vehicle().model, OcpOptions(model=model), lambda _: None)


@dataclass(frozen=True)
class FullDrive:
    """A drive of the emulated car at stage sil."""

    solver: str
    variant: Variant
    scenario: Scenario
    vehicle: Vehicle
    seed: int


@dataclass(frozen=True)
class Figures:
    """What is measured on one drive, in the judged part of its scenario.

    Args:
        pedals_norm: total variation of the commands to accelerator robot and brake robot, as they are sent.
        speed_error_rms_mps: from `SETTLING_S` after the engagement on.
    """

    pedals_norm: float
    lateral_error_rms_m: float
    lateral_error_max_m: float
    speed_error_rms_mps: float


def delay(solver: str, seeds: int, mapped: Map) -> list[Row]:
    """Robots with a long dead time: what knowing it is worth, against the paper's model that knows none.

    Like is compared with like: both without the observer, whose filter quietens the pedals whatever is known of delays, and
    both with it, as the controller drives. The lateral error is judged in the lane change, where the delay decides on it. In lane
    keeping it is that of the navigation system: its heading error of 1.7 mrad, over the 1.8 m that are predicted, moves a car that
    knows of the delay by 3 mm more.
    """
    vehicle, rows = with_dead_time(load_vehicle(), DEAD_TIME_S), []
    chosen = range(1, min(seeds, DELAY_SEEDS) + 1)
    for scenario in map(load_scenario, SCENARIOS):
        variants = (BLIND, AWARE, BLIND_OBSERVED, AWARE_OBSERVED)
        drives = list(mapped(full_drive, [FullDrive(solver, v, scenario, vehicle, seed) for v in variants for seed in chosen]))
        means = [_mean(drives[k * len(chosen) : (k + 1) * len(chosen)]) for k in range(len(variants))]
        for k, least in ((0, None), (2, 0.3)):
            is_path_judged = least is not None and scenario.name == SCENARIOS[0]
            where = f"{scenario.name}, {DEAD_TIME_S * 1e3:g} ms"
            rows += _compared(where, variants[k : k + 2], means[k : k + 2], least, is_path_judged=is_path_judged)
    return rows


def _compared(
    where: str, variants: Sequence[Variant], means: Sequence[Figures], least: float | None, *, is_path_judged: bool
) -> list[Row]:
    """The second of two variants beside the first."""
    (first, second), (before, after) = variants, means
    case, worst_m = f"{where}, {second.name}", before.lateral_error_max_m if is_path_judged else None
    return [
        Row("variation of AR and BR commands saved", case, 1.0 - after.pedals_norm / before.pedals_norm, "", "at least", least),
        Row("lateral error, largest", f"{where}, {first.name}", before.lateral_error_max_m, "m"),
        Row("lateral error, largest", case, after.lateral_error_max_m, "m", "at most", worst_m),
        Row("lateral error, RMS", f"{where}, {first.name}", before.lateral_error_rms_m, "m"),
        Row("lateral error, RMS", case, after.lateral_error_rms_m, "m"),
    ]


def slope(solver: str, seeds: int, mapped: Map) -> list[Row]:
    """Speed error up and down a slope with a car heavier than the model's."""
    vehicle = with_mass(load_vehicle(), 1.0 + EXTRA_MASS)
    places = [(name, grade) for name in SCENARIOS for grade in (GRADE_PERCENT, -GRADE_PERCENT)]
    variants = ((UNOBSERVED, None), (DRIVEN, 0.1))
    tasks = [FullDrive(solver, v, on_grade(load_scenario(name), grade), vehicle, 1) for v, _ in variants for name, grade in places]
    drives = list(mapped(full_drive, tasks))
    rows = []
    for k, (variant, target) in enumerate(variants):
        for (name, grade), figures in zip(places, drives[k * len(places) :], strict=False):
            case = f"{name}, {grade:+g} %, mass +{EXTRA_MASS:.0%}, {variant.name}"
            rows.append(Row("speed error, RMS", case, figures.speed_error_rms_mps, "m/s", "at most", target))
    return rows


def cost(solver: str) -> list[Row]:
    """CPU time of one step of the controller without the numerical solver; the median, since this machine is shared."""
    vehicle, (scenario, options) = load_vehicle(), loss_cases()["dlc80"]
    made = make_solver(solver, vehicle.model, OcpOptions(model=DRIVE_MODEL), lambda _: None, time.thread_time_ns)
    nmpc = _TimedNmpc(made, scenario.path, vehicle, 1, options)
    nmpc.times_us = []
    drive(nmpc, vehicle, scenario, 1)
    return [Row("CPU time of a step without the solve", "dlc80, median", float(np.median(nmpc.times_us)), "us")]


class _TimedNmpc(Nmpc):
    """Notes the CPU time of each step, without that of the numerical solver."""

    times_us: list[float]

    def step(self, state: VehicleState, now_ns: int, objects: Sequence[Obstacle] = ()) -> NmpcOutput:
        start_ns = time.thread_time_ns()
        output = super().step(state, now_ns, objects)
        self.times_us.append((time.thread_time_ns() - start_ns - output.command.solve_time_ns) * 1e-3)
        return output


def with_dead_time(vehicle: Vehicle, dead_time_s: float) -> Vehicle:
    """The car with this dead time in all three robots."""
    names = ("steering", "accelerator", "brake")
    robots = {name: getattr(vehicle.robots, name).model_copy(update={"dead_time_s": dead_time_s}) for name in names}
    return vehicle.model_copy(update={"robots": vehicle.robots.model_copy(update=robots)})


def with_mass(vehicle: Vehicle, factor: float) -> Vehicle:
    """The emulated car with a mass that its controller does not know of."""
    masses = vehicle.multibody.masses
    names = ("mass_kg", "sprung_roll_inertia_kgm2", "sprung_pitch_inertia_kgm2", "sprung_yaw_inertia_kgm2")
    heavier = masses.model_copy(update={name: factor * getattr(masses, name) for name in names})
    return vehicle.model_copy(update={"multibody": vehicle.multibody.model_copy(update={"masses": heavier})})


def on_grade(scenario: Scenario, grade_percent: float) -> Scenario:
    """The scenario on a road that climbs."""
    return scenario.model_copy(update={"road": scenario.road.model_copy(update={"grade_percent": grade_percent})})


def full_drive(task: FullDrive) -> Figures:
    """Drive once, and measure.

    Raises:
        SetupFailure: the gateway never became ready.
    """
    scenario, vehicle, recording = task.scenario, task.vehicle, Recording(START_NS)
    with tempfile.TemporaryDirectory(prefix="xilgate-") as directory:
        setup = RunSetup(
            scenario=scenario, stage=Stage.SIL, vehicle=vehicle, catalogue=load(), solver=task.solver, build=None, bus=None,
            seed=task.seed, directory=Path(directory), dbc_paths=(), vehicle_path=Path(), view_port=None, telemetry_base_port=0,
        )  # fmt: skip
        solver = _solver(task.solver, task.variant.model)
        LockstepRun(setup, solver, recording, lambda _: None, lambda: False, options=task.variant.options).drive()
    return _figures(recording, scenario, trace(recording, scenario.course(vehicle), Stage.SIL))


def _figures(recording: Recording, scenario: Scenario, way: Trace) -> Figures:
    station_m = np.interp(recording.times_s("state"), way.t_s, way.along.station_m)
    is_sent = (station_m >= scenario.judge.from_m) & (station_m <= scenario.judge.to_m)
    is_judged = (way.along.station_m >= scenario.judge.from_m) & (way.along.station_m <= scenario.judge.to_m)
    is_settled = (way.t_s >= way.engaged_s + SETTLING_S) & (way.along.station_m <= scenario.judge.to_m)
    lateral_m = way.along.lateral_error_m[is_judged]

    def variation(field: str) -> float:
        return float(np.abs(np.diff(recording.series("state", field)[is_sent])).sum())

    return Figures(
        variation("ar_command_norm") + variation("br_command_norm"),
        _rms(lateral_m),
        float(np.abs(lateral_m).max()),
        _rms(way.speed_error_mps[is_settled]),
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mean(drives: Sequence[Figures]) -> Figures:
    return Figures(*(float(np.mean(values)) for values in zip(*map(astuple, drives), strict=True)))
