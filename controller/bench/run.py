"""`xilgate bench solver`: every solver on the same recorded problems, side by side in one process on one core."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from controller.bench import sets, targets
from controller.bench.agreement import compare
from controller.bench.check import OptimalityCheck
from controller.bench.hard import run_hard
from controller.bench.instructions import count_instructions, find_valgrind
from controller.bench.library import describe_library, describe_machine
from controller.bench.limit import limit_of
from controller.bench.measure import SOFT_SOLVERS, UNIT_SOLVER, Measurement, interleaved
from controller.bench.sets import Instance
from controller.problem import OcpOptions
from controller.solver import Solver
from controller.solvers import LIBRARIES, SOLVERS, make_solver
from dbc.build import Build
from dbc.errors import UserMistake
from dbc.vehicle import FOCUS, Vehicle, load_vehicle

Progress = Callable[[str], None]

SETS = ("nominal", "active", "hard")
NOT_TIMED = ("ipopt",)
"""Solvers for comparing answers, not times."""
RICCATI_SOLVERS = ("riccati", "riccati-scalar")
"""Those with an answer from everywhere, and with parts that can be measured alone.

Hard constraints can make a hard start infeasible, and the paper's solver takes seconds on it.
"""
CALLGRIND_INSTANCES = 20


@dataclass(frozen=True)
class BenchOptions:
    """What to measure.

    Args:
        sets: of `SETS`; the unit is measured on the nominal set in any case.
        instances: problems of the nominal set, and of the active one; at least 8, so that each scenario is there with a warm start.
        rounds: times that each solver solves each problem. The quiet time of a problem is the smallest of its rounds: what the
            solver needs when the machine leaves it alone.
        starts: of the hard set.
        solvers: names; none for all that are timed.
        agreement: compare the answers with those of other solvers, on `agreement_instances` problems of all sets.
        callgrind: count instructions.
    """

    sets: tuple[str, ...] = SETS
    instances: int = 300
    rounds: int = 5
    starts: int = 10_000
    solvers: tuple[str, ...] = ()
    agreement: bool = False
    agreement_instances: int = 150
    callgrind: bool = False

    def __post_init__(self) -> None:
        for name in self.sets:
            if name not in SETS:
                raise UserMistake(f"set {name!r}: there are {', '.join(SETS)} and all")
        for name in self.solvers:
            if name not in SOLVERS:
                raise UserMistake(f"solver {name!r}: there are {', '.join(SOLVERS)}")
            if name in NOT_TIMED:
                raise UserMistake(f"solver {name!r} is never timed; --agreement compares its answers")

    @property
    def timed(self) -> list[str]:
        """Names of the solvers to time, in the order of their turns."""
        return [name for name in SOLVERS if name in (self.solvers or SOLVERS) and name not in NOT_TIMED]


def bench_solver(options: BenchOptions, progress: Progress, vehicle_path: Path = FOCUS) -> dict[str, Any]:
    """Measure solvers.

    Args:
        progress: told in one line each what takes time.

    Returns:
        `machine`, `unit`, `solvers` (libraries), `rows` (nominal and active set), `profile`, `limit`, `hard`,
        `agreement`, `instructions` and `targets`; a part that was not asked for is an empty list.

    Raises:
        SetupFailure: no compiler, or no valgrind to count with.
    """
    if options.callgrind:
        find_valgrind()
    vehicle = load_vehicle(vehicle_path)
    run = _Run(options, vehicle, progress)
    measurements = run.nominal() + run.active()
    nominal_unit = next(m for m in measurements if (m.solver, m.set_name) == (UNIT_SOLVER, "nominal"))
    unit_us = float(nominal_unit.quiet_us.mean())
    result = {
        "machine": describe_machine(),
        "unit": {"solver": UNIT_SOLVER, "set": "nominal", "quiet_mean_us": round(unit_us, 1)},
        "solvers": run.libraries(),
        "rows": [measurement.row(unit_us) for measurement in measurements],
        "profile": [row for m in measurements if m.set_name == "nominal" for row in m.profile()],
        "limit": run.limit(measurements),
        "hard": run.hard(unit_us),
        "agreement": run.agreement(),
        "instructions": run.instructions(),
    }
    return result | {"targets": targets.judged(result)}


class _Run:
    """The solvers and problems of one run; each problem set is recorded once, when it is needed first."""

    def __init__(self, options: BenchOptions, vehicle: Vehicle, progress: Progress) -> None:
        self._options, self._vehicle, self._progress = options, vehicle, progress
        self._solvers: dict[str, Solver] = {}
        self._recorded: dict[str, list[Instance]] = {}

    def nominal(self) -> list[Measurement]:
        names = self._options.timed if "nominal" in self._options.sets else []
        return self._timed([name for name in SOLVERS if name in names or name == UNIT_SOLVER], "nominal")

    def active(self) -> list[Measurement]:
        if "active" not in self._options.sets:
            return []
        measurements = self._timed([name for name in self._options.timed if name != "casadi-vm"], "active")
        return [part for m in measurements for part in ((m, m.feasible()) if m.solver in SOFT_SOLVERS else (m,))]

    def hard(self, unit_us: float) -> list[dict[str, Any]]:
        names = [name for name in self._options.timed if name in RICCATI_SOLVERS]
        if "hard" not in self._options.sets or not names:
            return []
        starts = sets.hard(self._set("nominal") + self._set("active"), self._options.starts)
        self._progress(f"solving {len(starts)} hard starts with {', '.join(names)}")
        check = OptimalityCheck(self._library(UNIT_SOLVER).library, OcpOptions())
        return run_hard([self._solver(name) for name in names], starts, check, unit_us)

    def limit(self, measurements: list[Measurement]) -> list[dict[str, Any]]:
        found = {m.solver: m for m in measurements if m.set_name == "nominal" and m.solver in RICCATI_SOLVERS}
        return [limit_of(self._solver(name), self._library(name), measurement, OcpOptions()) for name, measurement in found.items()]

    def agreement(self) -> list[dict[str, Any]]:
        if not self._options.agreement:
            return []
        third = -(-self._options.agreement_instances // 3)
        nominal, active = self._set("nominal"), self._set("active")
        problems = [*_thinned(nominal, third), *_thinned(active, third), *sets.hard(nominal + active, third, seed=2)]
        others = [name for name in (UNIT_SOLVER, "qrqp", "ipopt") if name in SOLVERS]
        self._progress(f"comparing riccati with {', '.join(others)} on {len(problems)} problems")
        return [compare(self._solver("riccati"), self._solver(name), problems) for name in others]

    def instructions(self) -> list[dict[str, Any]]:
        if not self._options.callgrind:
            return []
        car, options = self._vehicle.model, OcpOptions()
        builds = {name: self._library(name) for name in self._options.timed if name in LIBRARIES}
        return count_instructions(builds, _thinned(self._set("nominal"), CALLGRIND_INSTANCES), car, options, self._progress)

    def libraries(self) -> list[dict[str, Any]]:
        names = [name for name in SOLVERS if name in self._solvers and name in LIBRARIES]
        return [describe_library(name, self._library(name)) for name in names]

    def _timed(self, names: list[str], set_name: str) -> list[Measurement]:
        solvers, instances = [self._solver(name) for name in names], self._set(set_name)
        self._progress(f"solving {len(instances)} problems of the {set_name} set {self._options.rounds} times with {', '.join(names)}")
        return interleaved(solvers, instances, self._options.rounds, set_name)

    def _solver(self, name: str) -> Solver:
        if name not in self._solvers:
            self._solvers[name] = make_solver(name, self._vehicle.model, OcpOptions(), self._progress)
        return self._solvers[name]

    def _library(self, name: str) -> Build:
        return LIBRARIES[name](self._vehicle.model, OcpOptions(), self._progress)

    def _set(self, name: str) -> list[Instance]:
        if name not in self._recorded:
            record = {"nominal": sets.nominal, "active": sets.active}[name]
            self._recorded[name] = record(self._vehicle, self._options.instances, self._progress)
        return self._recorded[name]


def _thinned(instances: Sequence[Instance], count: int) -> list[Instance]:
    """About `count` of them, evenly spread."""
    return list(instances[:: max(1, len(instances) // count)])[:count]
