"""The record of a controller: its session, and the journal that a thread of its own brings to the disk."""

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

from controller.journal import ControllerSession
from controller.nmpc import DRIVE_MODEL
from controller.problem import OcpOptions
from controller.solvers import LIBRARIES
from dbc.vehicle import load_vehicle
from gateway.journal import pack_value
from gateway.record.files import FileOptions, RecordFiles
from gateway.record.session import origin
from gateway.record.writer import RecordWriter

STEM = "controller"


def controller_session(boot_id: int, solver: str, deadline_ns: int | None, reference_csv: Path, vehicle_path: Path) -> ControllerSession:
    """What a controller is started with, as the journal keeps it.

    Raises:
        OSError: a file cannot be read.
    """
    decided_by = {"reference": reference_csv.read_bytes(), "vehicle": vehicle_path.read_bytes()}
    reference, vehicle = (content.decode("utf-8") for content in decided_by.values())
    if solver in LIBRARIES:
        model = load_vehicle(vehicle_path).model
        decided_by["controller library"] = LIBRARIES[solver](model, OcpOptions(model=DRIVE_MODEL), lambda _: None).library.read_bytes()
    return ControllerSession(
        **origin(boot_id, decided_by), solver=solver, deadline_ns=deadline_ns, reference=reference, vehicle=vehicle
    )


def fingerprint(session: ControllerSession) -> str:
    """One SHA-256 of all that a controller decides with."""
    lines = (f"{name} {digest}\n" for name, digest in sorted(session.sha256.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


@contextlib.contextmanager
def record_in(directory: Path, session: ControllerSession) -> Iterator[Callable[[bytes], None]]:
    """Where the records of a controller go, until the end of the context.

    Raises:
        SetupFailure: there is such a record already.
    """
    options = FileOptions(directory, STEM)
    options.refuse_existing()
    writer = RecordWriter(RecordFiles(options, pack_value(session), {}, session.wall_offset_ns))
    try:
        yield writer.put
    finally:
        writer.close()
