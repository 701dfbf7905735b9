"""The journal of the controller: what every `Nmpc.step` was given and the command that came of it, in the files of `gateway.journal`."""

from collections.abc import Callable, Mapping, Sequence

import msgspec

from controller.nmpc import Nmpc, NmpcOptions, NmpcOutput
from controller.parameters import ParameterSet, table
from controller.planning.obstacles import Obstacle
from controller.planning.options import PlannerOptions
from controller.planning.reference import ReferencePath
from controller.problem import OcpOptions
from controller.solver import Solver
from dbc.vehicle import Vehicle
from gateway.journal import Session, pack_value, unpack_as
from gateway.messages import ControlCommand, VehicleState


class ControllerSession(Session, frozen=True, kw_only=True, tag="controller"):
    """A controller.

    Args:
        solver: its name.
        deadline_ns: see `nmpc.NmpcOptions`.
        reference: content of the file of the path.
        vehicle: content of the vehicle file.
    """

    solver: str
    deadline_ns: int | None
    reference: str
    vehicle: str


class CycleRecord(msgspec.Struct, frozen=True, array_like=True):
    """One step of the controller.

    Args:
        seq: number of the step since the start; one that is not there was not recorded.
        objects: that the step was given.
        parameters: all of them, where some changed since the step before.
        command: as it was written: the same bytes are the same command.
    """

    seq: int
    now_ns: int
    state: VehicleState
    objects: tuple[Obstacle, ...]
    parameters: dict[str, float] | None
    command: msgspec.Raw

    @property
    def solve_time_ns(self) -> int:
        """Solve time of this step: what the machine decided on and not the controller."""
        return unpack_as(_SolveTime, bytes(self.command), "command").solve_time_ns


class _SolveTime(msgspec.Struct, frozen=True):
    solve_time_ns: int


def pack_cycle(
    seq: int,
    now_ns: int,
    state: VehicleState,
    objects: Sequence[Obstacle],
    *,
    parameters: Mapping[str, float] | None,
    command: ControlCommand,
) -> bytes:
    """The record of one step."""
    return pack_value((seq, now_ns, state, objects, parameters, command))


def unpack_cycle(record: bytes, what: str) -> CycleRecord:
    """The step in a record.

    Args:
        what: names the record in the error.

    Raises:
        JournalError: it holds none, or one of another build.
    """
    return unpack_as(CycleRecord, record, what)


class RecordedNmpc(Nmpc):
    """A controller whose every step is recorded.

    Args:
        keep: takes each record, and never waits.
    """

    def __init__(
        self, solver: Solver, path: ReferencePath, vehicle: Vehicle, boot_id: int, options: NmpcOptions, *, keep: Callable[[bytes], None]
    ) -> None:
        super().__init__(solver, path, vehicle, boot_id, options)
        self._keep = keep
        self._steps = 0
        self._changed: dict[str, float] | None = None

    def tune(self, ocp: OcpOptions, planner: PlannerOptions) -> None:
        """Drive with other numbers from the next step on; see `Nmpc`."""
        super().tune(ocp, planner)
        tuned = ParameterSet(0, ocp, planner)
        self._changed = {parameter.name: tuned.value(parameter) for parameter in table(ocp)}

    def step(self, state: VehicleState, now_ns: int, objects: Sequence[Obstacle] = ()) -> NmpcOutput:
        """Answer one state; see `Nmpc`."""
        output = super().step(state, now_ns, objects)
        self._keep(pack_cycle(self._steps, now_ns, state, objects, parameters=self._changed, command=output.command))
        self._steps, self._changed = self._steps + 1, None
        return output
