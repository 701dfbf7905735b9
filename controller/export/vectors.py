"""Test vectors: recorded problems with the answers of this machine's library, as C that holds every number exactly."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice, zip_longest
from pathlib import Path

import numpy as np

from controller.bench.loop import drive
from controller.bench.scenarios import Case, active_cases, nominal_cases
from controller.bench.sets import HARD_KINDS, Instance, RecordingSolver, hard
from controller.nmpc import Nmpc
from controller.problem import Array, OcpOptions
from controller.riccati.solver import RiccatiBackEnd, RiccatiSolver
from controller.soft import PENALTY_LINEAR, PENALTY_QUADRATIC
from controller.solver import Effort, NlpBuffers, SqpSolver
from dbc.build import Build
from dbc.errors import SetupFailure
from dbc.vehicle import Vehicle

_PROBLEM = {
    "w_guess": "w0", "lam_w_guess": "lam_w0", "lam_g_guess": "lam_g0", "parameters": "p",
    "w_lower": "lower_w", "w_upper": "upper_w", "g_lower": "lower_g", "g_upper": "upper_g",
}  # fmt: skip
"""Fields of `nmpc_problem`, and where the shared buffers have them."""
_ANSWER = ("w", "lam_w", "lam_g")

_LARGEST_WORK = 100.0
"""Far below what ends a solve on any target, as the bound is not the same on all of them."""
_NUDGE = 1e-9
_SAME = 1e-6
"""A problem whose answer moves by more than this when its guess is nudged says more about rounding than about a library."""
_LONGEST_S = 4.0
"""Of a recorded drive; the first seconds hold all that a scenario is about, except for the second half of parking."""
_HARD_STARTS = 200
_ROUNDS = 5

_SPECIAL = {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN", "0.0": "0"}

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Vector:
    """One problem and its answer.

    Args:
        name: set, case and number.
        problem: by field of `nmpc_problem`.
        status: value of `nmpc_status`.
        answer: w, lam_w and lam_g.
        is_active: whether a bound has a multiplier.
        time_us: the shortest of several solves on this machine [us].
    """

    name: str
    problem: dict[str, Array]
    status: int
    answer: dict[str, Array]
    is_active: bool
    effort: Effort
    time_us: float


class _Recorder:
    """The library behind the shell that packs a problem, where each solve can be looked at."""

    def __init__(self, build: Build, options: OcpOptions) -> None:
        self._solver = SqpSolver("recorder", options, self._make_back_end(build))

    def _make_back_end(self, build: Build) -> Callable[[NlpBuffers], RiccatiBackEnd]:
        def make(buffers: NlpBuffers) -> RiccatiBackEnd:
            self._buffers, self._back_end = buffers, RiccatiBackEnd(build.library, buffers)
            return self._back_end

        return make

    def vector(self, name: str, instance: Instance) -> Vector | None:
        """The instance solved; None where its answer is no good for a comparison."""
        self._solver.warm_start = instance.warm_start
        self._solver.solve(instance.state, instance.previous_input, instance.horizon)
        vector = self._again(name)
        if vector.status != 0 or (vector.effort.work or 0.0) > _LARGEST_WORK:
            return None
        guess = vector.problem["w_guess"]
        n_states = instance.state.size
        self._buffers.w0[n_states:] = guess[n_states:] * (1.0 + _NUDGE) + _NUDGE
        self._back_end.solve()
        if self._back_end.statistics.status != 0 or np.abs(self._buffers.w - vector.answer["w"]).max() > _SAME:
            return None
        return vector

    def not_a_number(self, instance: Instance) -> Vector:
        """The instance with a measured state that is not a number."""
        self._solver.warm_start = instance.warm_start
        self._solver.solve(instance.state, instance.previous_input, instance.horizon)
        self._buffers.w0[0] = np.nan
        return self._again("invalid/nan")

    def _again(self, name: str) -> Vector:
        """What is packed, solved several times."""
        problem = {field: getattr(self._buffers, place).copy() for field, place in _PROBLEM.items()}
        times_ns = []
        for _ in range(_ROUNDS):
            start_ns = time.perf_counter_ns()
            effort = self._back_end.solve()
            times_ns.append(time.perf_counter_ns() - start_ns)
        answer = {field: getattr(self._buffers, field).copy() for field in _ANSWER}
        layout = self._buffers.layout
        multipliers = np.concatenate((answer["lam_w"][layout.n_states :], answer["lam_g"][layout.n_gaps :]))
        status, is_active = self._back_end.statistics.status, bool(multipliers.any())
        return Vector(name, problem, status, answer, is_active, effort, min(times_ns) * 1e-3)


def record(vehicle: Vehicle, options: OcpOptions, build: Build, per_set: int, progress: Progress) -> list[Vector]:
    """`per_set` problems each without active bounds, with some, and from starts that are hard; and one that is not a number.

    Args:
        build: library of `riccati` that the closed loops are driven with and the answers come from.

    Raises:
        SetupFailure: a set is empty, as no problem of it converges with this car.
    """
    progress("recording test vectors")
    solver = RiccatiSolver(build.library, options, clock=lambda: 0)
    nominal, active = (
        [_driven(solver, case, vehicle) for case in {case.name: case for case in reversed(cases)}.values()]
        for cases in (nominal_cases(), active_cases())
    )
    bases = [instance for instances in nominal for instance in instances]
    starts = hard(bases, _HARD_STARTS)
    kinds = [[start for start in starts if start.kind == kind] for kind in HARD_KINDS]
    recorder = _Recorder(build, options)
    vectors = []
    for name, sources in {"nominal": nominal, "active": active, "hard": kinds}.items():
        turns = zip_longest(*(_usable(recorder, name, instances) for instances in sources))
        chosen = list(islice((vector for turn in turns for vector in turn if vector is not None), per_set))
        if not chosen:
            raise SetupFailure(f"no test vectors: with this car no problem of the set {name} converges")
        vectors += chosen
    return [*vectors, recorder.not_a_number(bases[0])]


def write_vectors(directory: Path, vectors: list[Vector]) -> None:
    """Write `vectors.c`, which `vectors.h` declares, into `directory`."""
    arrays: dict[bytes, tuple[str, Array]] = {}

    def named(values: Array) -> str:
        return arrays.setdefault(values.tobytes(), (f"numbers_{len(arrays)}", values))[0]

    rows = [_initialiser(vector, named) for vector in vectors]
    definitions = [f"static const double {name}[{values.size}] = {{{_numbers(values)}}};" for name, values in arrays.values()]
    count = f"const int TEST_VECTOR_COUNT = {len(vectors)};"
    head = ["/* Recorded problems and their answers, in hexadecimal: exact. */", '#include "vectors.h"', "#include <math.h>"]
    table = ["const test_vector TEST_VECTORS[] = {", *rows, "};", count]
    (directory / "vectors.c").write_text("\n".join([*head, *definitions, *table]) + "\n", encoding="ascii")


def _driven(solver: RiccatiSolver, case: Case, vehicle: Vehicle) -> list[Instance]:
    """The problems of a closed loop."""
    solver.reset()
    recorder = RecordingSolver(solver, case)
    scenario = replace(case.scenario, duration_s=min(case.scenario.duration_s, _LONGEST_S))
    drive(Nmpc(recorder, scenario.path, vehicle, boot_id=1, options=case.nmpc), vehicle, scenario, case.seed)
    return recorder.instances


def _usable(recorder: _Recorder, name: str, instances: list[Instance]) -> Iterator[Vector]:
    """The vectors of a set that come from one source, in any order; bounds are active where the set's name says so."""
    for i in np.random.default_rng(1).permutation(len(instances)):
        vector = recorder.vector(f"{name}/{instances[i].kind}", instances[i])
        if vector is not None and (name == "hard" or vector.is_active == (name == "active")):
            yield vector


def _initialiser(vector: Vector, named: Callable[[Array], str]) -> str:
    problem = ", ".join(f".{field} = {named(values)}" for field, values in vector.problem.items())
    penalties = f".penalty_linear = {PENALTY_LINEAR.hex()}, .penalty_quadratic = {PENALTY_QUADRATIC.hex()}"
    answer = ", ".join(f".{field} = {named(values)}" for field, values in vector.answer.items())
    return f'    {{.name = "{vector.name}", .problem = {{{problem}, {penalties}}}, .status = {vector.status}, {answer}}},'


def _numbers(values: Array) -> str:
    return ", ".join(_SPECIAL.get(str(value)) or value.hex() for value in values.tolist())
