"""`xilgate resim`: gateway and controller run again from their journals, and every answer compared with the recorded one, byte by byte.

Both cores are functions of what they are given, so that the same build answers the same. With another build, other limits say, the
first difference is named: when, in which message or datagram, which signal, both values. Solve times are taken from the record.
"""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from controller.journal import ControllerSession, unpack_cycle
from controller.nmpc import DRIVE_MODEL, Nmpc, NmpcOptions
from controller.parameters import ParameterStore, Refused
from controller.planning.reference import ReferencePath
from controller.problem import OcpOptions
from controller.solvers import make_solver
from dbc.catalogue import Catalogue, load
from dbc.frame import CanFrame
from dbc.packing import DecodeError
from dbc.vehicle import load_vehicle
from gateway.core import GatewayCore
from gateway.journal import GatewaySession, JournalError, Session, pack_value, plain, unpack_step
from gateway.limits import PROFILES, LimitProfile
from xil.journal_files import Journal, find_journals

_WRITTEN_BY_E2E = ("Crc", "AliveCounter")
"""Signals that follow from the others: named as the difference when there is no other."""

Progress = Callable[[str], None]
Describe = Callable[[Any, Any], tuple[str, Any, Any]]
"""Place, recorded value and present value of the first difference between two answers."""


@dataclass(frozen=True)
class Difference:
    """Where an answer is another one.

    Args:
        step: number of the step since the start.
        t_ns: time of the step, on the clock of the record [ns].
        since_start_s: since the first step [s].
        place: message and signal, or datagram and field.
        recorded, now: both values; None where there is none.
    """

    step: int
    t_ns: int
    since_start_s: float
    place: str
    recorded: Any
    now: Any


@dataclass(frozen=True)
class Comparison:
    """What came of one journal.

    Args:
        of: "gateway" or "controller".
        version, started_utc, sha256: of what was recorded, see `gateway.journal.Session`.
        steps: that were compared.
        compared: command frames of the gateway, or commands of the controller, that were compared.
        different: steps whose answer is another one.
        first: the first difference.
        notes: what was found to differ in what the journal was recorded with.
        missing: which steps were not recorded, after which nothing can be run again; empty when none are.
        cut: that the record ends as a crash leaves it; empty when it does not.
    """

    of: str
    source: str
    version: str
    started_utc: str
    sha256: Mapping[str, str]
    steps: int
    compared: int
    different: int
    first: Difference | None
    notes: tuple[str, ...]
    missing: str
    cut: str

    @property
    def is_same(self) -> bool:
        """Whether every answer that was compared is the recorded one."""
        return self.different == 0


def resim(path: Path, progress: Progress) -> list[Comparison]:
    """Run everything again that a run or a recorder left, the gateway's journals before the controller's.

    Raises:
        JournalError: a journal cannot be read.
        UserMistake: what it was recorded with is none any more.
    """
    found = [(journal.of(_RESIMULATIONS), journal) for journal in find_journals(path)]
    journals = sorted(found, key=lambda entry: (entry[0] != "gateway", entry[1].stem))
    comparisons = []
    for of, journal in journals:
        progress(f"running the {of} of {journal.name} again")
        comparisons.append(_RESIMULATIONS[of](journal, progress))
    return comparisons


class _Tally:
    """Compares answers as they come."""

    def __init__(self, of: str, journal: Journal, session: Session, notes: Iterable[str]) -> None:
        self._of = of
        self._journal = journal
        self._session = session
        self._notes = tuple(notes)
        self._steps = self._compared = self._different = 0
        self._first: Difference | None = None
        self._start_ns = 0
        self._missing = ""

    def is_next(self, seq: int, t_ns: int) -> bool:
        """Whether a step follows the one before; nothing after a step that is missing can be run again."""
        if seq == self._steps:
            return True
        self._missing = f"{seq - self._steps} steps before {t_ns * 1e-9:.3f} s were not recorded"
        return False

    def add(self, t_ns: int, compared: int, recorded: bytes, now: bytes, describe: Describe) -> None:
        """Compare one answer; `describe` is asked for the first difference."""
        self._start_ns = t_ns if self._steps == 0 else self._start_ns
        if recorded != now:
            self._different += 1
            if self._first is None:
                self._first = Difference(self._steps, t_ns, (t_ns - self._start_ns) * 1e-9, *describe(plain(recorded), plain(now)))
        self._steps += 1
        self._compared += compared

    def result(self) -> Comparison:
        """What came of it."""
        session = self._session
        return Comparison(
            of=self._of,
            source=self._journal.name,
            version=session.version,
            started_utc=session.started_utc,
            sha256=session.sha256,
            steps=self._steps,
            compared=self._compared,
            different=self._different,
            first=self._first,
            notes=self._notes,
            missing=self._missing,
            cut=self._journal.cut,
        )


def _resim_gateway(journal: Journal, progress: Progress) -> Comparison:
    session = journal.session(GatewaySession)
    profile = PROFILES.get(session.profile)
    if profile is None:
        raise JournalError(f"{journal.name}: limit profile {session.profile!r}: there are {', '.join(PROFILES)}")
    catalogue, core = _core_of(session, profile)
    tally = _Tally("gateway", journal, session, _notes(session, profile))
    for record in journal.records():
        step = unpack_step(record, f"{journal.name}: step")
        if not tally.is_next(step.seq, step.arguments.now_ns):
            break
        output = step.arguments.step(core)
        tally.add(step.arguments.now_ns, len(step.sent), bytes(step.output), pack_value(output), partial(_in_output, catalogue))
    return tally.result()


def _core_of(session: GatewaySession, profile: LimitProfile) -> tuple[Catalogue, GatewayCore]:
    """The catalogue and a gateway as it was at its start."""
    with tempfile.TemporaryDirectory(prefix="xilgate-") as folder:
        texts = {name: text.encode("latin-1") for name, text in session.dbc.items()} | {"vehicle": session.vehicle.encode()}
        if session.mapping is not None:
            texts["mapping"] = session.mapping.encode()
        for name, content in texts.items():
            (Path(folder) / Path(name).name).write_bytes(content)
        mapping = None if session.mapping is None else Path(folder) / "mapping"
        catalogue = load([Path(folder) / Path(name).name for name in session.dbc], mapping)
        vehicle = load_vehicle(Path(folder) / "vehicle")
    return catalogue, GatewayCore(catalogue, vehicle, session.boot_id, profile)


def _notes(session: GatewaySession, profile: LimitProfile) -> Iterator[str]:
    """What of the limits is another than recorded."""
    now = plain(pack_value(asdict(profile)))
    for place, recorded, present in differences(session.limits, now, f"limits {profile.name}"):
        yield f"{place}: recorded {recorded!r}, now {present!r}"


def _resim_controller(journal: Journal, progress: Progress) -> Comparison:
    session = journal.session(ControllerSession)
    clock = RecordedClock()
    nmpc, store = _nmpc_of(session, clock, progress)
    tally = _Tally("controller", journal, session, ())
    for record in journal.records():
        cycle = unpack_cycle(record, f"{journal.name}: step")
        if not tally.is_next(cycle.seq, cycle.now_ns):
            break
        if cycle.parameters is not None:
            _tune(nmpc, store, cycle.parameters, f"{journal.name}: step {cycle.seq}")
        clock.solve_time_ns = cycle.solve_time_ns
        command = nmpc.step(cycle.state, cycle.now_ns, cycle.objects).command
        tally.add(cycle.now_ns, 1, bytes(cycle.command), pack_value(command), partial(_first_of, "ControlCommand"))
    return tally.result()


def _nmpc_of(session: ControllerSession, clock: "RecordedClock", progress: Progress) -> tuple[Nmpc, ParameterStore]:
    """A controller as it was at its start, and its parameters."""
    ocp, options = OcpOptions(model=DRIVE_MODEL), NmpcOptions(deadline_ns=session.deadline_ns)
    with tempfile.TemporaryDirectory(prefix="xilgate-") as folder:
        reference_csv, vehicle_file = Path(folder) / "reference.csv", Path(folder) / "vehicle.toml"
        reference_csv.write_bytes(session.reference.encode())
        vehicle_file.write_bytes(session.vehicle.encode())
        path, vehicle = ReferencePath.from_csv(reference_csv), load_vehicle(vehicle_file)
    solver = make_solver(session.solver, vehicle.model, ocp, progress, clock)
    return Nmpc(solver, path, vehicle, session.boot_id, options), ParameterStore(ocp, options.planner)


def _tune(nmpc: Nmpc, store: ParameterStore, parameters: Mapping[str, float], where: str) -> None:
    """Drive with the recorded parameters from here on."""
    verdict = store.propose(parameters, "record", 0)
    if isinstance(verdict, Refused):
        raise JournalError(f"{where}: parameters that this build refuses: {verdict.reasons[0]}")
    if (taken := store.take()) is not None:
        nmpc.tune(taken[0].ocp, taken[0].planner)


class RecordedClock:
    """The clock of a solver, read once before and once after a solve: it shows the solve time of the record."""

    def __init__(self) -> None:
        self.solve_time_ns = 0
        self._is_solving = False

    def __call__(self) -> int:
        """The time [ns]."""
        self._is_solving = not self._is_solving
        return 0 if self._is_solving else self.solve_time_ns


def told(comparison: Comparison) -> str:
    """What came of one journal, for people, in lines of printable words."""
    answers = "command frames" if comparison.of == "gateway" else "commands"
    lines = [f"{comparison.of}: {comparison.steps} steps, {comparison.compared} {answers}: "]
    if (first := comparison.first) is None:
        lines[0] += "the same, byte by byte"
    else:
        lines[0] += f"{comparison.different} steps DIFFER"
        lines.append(f"  first {first.since_start_s:.3f} s after the start (t = {first.t_ns} ns, step {first.step}):")
        lines.append(f"  {first.place}: recorded {first.recorded!r}, now {first.now!r}")
    lines += [f"  {note}" for note in (*comparison.notes, comparison.missing, comparison.cut) if note]
    return "\n".join("".join(c if c.isprintable() else ascii(c)[1:-1] for c in line) for line in lines)


def differences(recorded: Any, now: Any, place: str) -> Iterator[tuple[str, Any, Any]]:  # noqa: ANN401 - plain data of any shape
    """Places in which two values of plain data differ, with both values; None stands for what is not there."""
    if isinstance(recorded, dict) and isinstance(now, dict):
        for key in [*recorded, *(key for key in now if key not in recorded)]:
            yield from differences(recorded.get(key), now.get(key), f"{place}.{key}")
    elif isinstance(recorded, list) and isinstance(now, list):
        for index in range(max(len(recorded), len(now))):
            a, b = (values[index] if index < len(values) else None for values in (recorded, now))
            yield from differences(a, b, f"{place}[{index}]")
    elif pack_value(recorded) != pack_value(now):  # NaN is equal to itself, and 1 is not 1.0
        yield place, recorded, now


def _first_of(place: str, recorded: Any, now: Any) -> tuple[str, Any, Any]:  # noqa: ANN401
    return next(differences(recorded, now, place), (f"{place}: order of its parts", None, None))


def _in_output(catalogue: Catalogue, recorded: dict[str, Any], now: dict[str, Any]) -> tuple[str, Any, Any]:
    """The first difference between two outputs of a step: in the frames, if there is one."""
    for index in range(max(len(recorded["frames"]), len(now["frames"]))):
        a, b = (CanFrame(*output["frames"][index]) if index < len(output["frames"]) else None for output in (recorded, now))
        if a != b:
            return _in_frame(catalogue, a, b)
    return _first_of("output", recorded, now)


def _in_frame(catalogue: Catalogue, recorded: CanFrame | None, now: CanFrame | None) -> tuple[str, Any, Any]:
    names = [None if frame is None else _name_of(catalogue, frame) for frame in (recorded, now)]
    if recorded is None or now is None or recorded.arbitration_id != now.arbitration_id:
        return "message sent", names[0], names[1]
    found = list(differences(_signals(catalogue, recorded), _signals(catalogue, now), str(names[0])))
    found.sort(key=lambda difference: difference[0].rpartition(".")[2] in _WRITTEN_BY_E2E)
    return found[0] if found else _first_of(str(names[0]), list(recorded), list(now))


def _name_of(catalogue: Catalogue, frame: CanFrame) -> str:
    spec = catalogue.by_id.get(frame.arbitration_id)
    return f"0x{frame.arbitration_id:03X}" if spec is None else spec.name


def _signals(catalogue: Catalogue, frame: CanFrame) -> dict[str, float]:
    spec = catalogue.by_id.get(frame.arbitration_id)
    try:
        return {} if spec is None else catalogue.decode(spec, frame)
    except DecodeError:
        return {}


_RESIMULATIONS: dict[str, Callable[[Journal, Progress], Comparison]] = {"gateway": _resim_gateway, "controller": _resim_controller}
