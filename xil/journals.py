"""The journals of a run in virtual time, in the files and of the content of those that processes write."""

from pathlib import Path
from typing import Self

from controller.journal import ControllerSession
from controller.record import STEM as CONTROLLER_STEM
from gateway.core import StepOutput
from gateway.journal import GatewaySession, StepArguments, pack_step, pack_value
from gateway.record.files import JOURNAL_SUFFIX, FileOptions, JournalFile

GATEWAY_STEM = "gateway"
_RECORDS_PER_BLOCK = 400


class Journals:
    """Keeps what gateway and controller are given and answer; the files are complete after `close`."""

    def __init__(self, directory: Path, gateway: GatewaySession, controller: ControllerSession) -> None:
        self._steps = _Journal(FileOptions(directory, GATEWAY_STEM), pack_value(gateway))
        self._cycles = _Journal(FileOptions(directory, CONTROLLER_STEM), pack_value(controller))
        self._seq = 0

    def keep_step(self, arguments: StepArguments, output: StepOutput) -> None:
        """Keep one step of the gateway."""
        self._steps.keep(pack_step(self._seq, arguments, output))
        self._seq += 1

    def keep_cycle(self, record: bytes) -> None:
        """Keep one step of the controller."""
        self._cycles.keep(record)

    def close(self) -> None:
        """Write what is left."""
        self._steps.write()
        self._cycles.write()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Journal:
    def __init__(self, options: FileOptions, session: bytes) -> None:
        self._file = JournalFile(options.path(0, JOURNAL_SUFFIX), session)
        self._records: list[bytes] = []

    def keep(self, record: bytes) -> None:
        self._records.append(record)
        if len(self._records) >= _RECORDS_PER_BLOCK:
            self.write()

    def write(self) -> None:
        self._file.append(self._records)
        self._records = []
