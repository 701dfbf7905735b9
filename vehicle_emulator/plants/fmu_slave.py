"""A co-simulation FMU of FMI 2.0 or 3.0, unpacked, loaded and running; built on the library fmpy."""

import ctypes
import os
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dbc.errors import SetupFailure, UserMistake
from vehicle_emulator.plants.extras import optional

_EXTRA = "fmu"
_FATAL = 4


class FmuUnusable(UserMistake):
    """A file is no FMU that can drive here; one line that says why."""


class FmuFailed(SetupFailure):
    """An FMU returned an error; one line with the call, and with the FMU's own last words where it said something."""


class _Log:
    """The last message of an FMU."""

    def __init__(self) -> None:
        self._message = ""

    def note(self, *arguments: Any) -> None:  # noqa: ANN401 - a callback: instance, name (FMI 2.0 only), status, category, message
        self._message = " ".join(arguments[-1].decode(errors="replace").split())

    @property
    def last_words(self) -> str:
        """The message as the end of a line."""
        return f": {self._message}" if self._message else ""


class _Instance:
    """What has to be ended: the FMU, as far as it got, and the directory that it was unpacked into."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.fmu: Any = None
        self.is_running = False
        self.failed_with: int | None = None

    def end(self) -> None:
        """End it as the standard allows it: no termination after an error, nothing at all after a fatal one."""
        if self.fmu is not None and self.failed_with != _FATAL:
            if self.is_running and self.failed_with is None:
                self.fmu.terminate()
            self.fmu.freeInstance()
        shutil.rmtree(self._directory, ignore_errors=True)


def _callbacks(module: Any, log: _Log) -> Any:  # noqa: ANN401 - fmpy has no types
    """What an FMU of FMI 2.0 calls us with: the library's own, but for the log."""
    callbacks, usual = module.fmi2CallbackFunctions(), module.defaultCallbacks
    callbacks.logger = module.fmi2CallbackLoggerTYPE(log.note)
    callbacks.allocateMemory, callbacks.freeMemory = usual.allocateMemory, usual.freeMemory
    return callbacks


class FmuSlave:
    """One instance of an FMU. It is ended, and what was unpacked is removed, when it is closed or nobody has it any more.

    Args:
        path: of the FMU.

    Attributes:
        variables: of its model description.

    Raises:
        ExtraMissing: fmpy is not installed.
        FmuUnusable: no FMU, not for co-simulation, of another FMI version, or without a binary for this machine.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._log = _Log()
        fmpy = optional("fmpy", _EXTRA)
        description = self._description(fmpy)
        self.variables: list[Any] = description.modelVariables
        self._is_fmi3 = description.fmiVersion.startswith("3.")
        self._time_s = 0.0
        directory = Path(tempfile.mkdtemp(prefix="xilgate-fmu-"))
        instance = _Instance(directory)
        self._close = weakref.finalize(self, instance.end)
        self._instance = instance
        try:
            with self._named():
                fmpy.extract(path, directory)
            instance.fmu = self._instantiated(description, directory)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the instance and remove what was unpacked; nothing else may be called afterwards."""
        self._close()

    def start(self, references: Sequence[int], values: Sequence[float]) -> None:
        """Set parameters and start values and initialize; from the start again when it ran before.

        Raises:
            FmuFailed: the FMU returned an error.
        """
        fmu = self._instance.fmu
        with self._named():
            if self._instance.is_running:
                fmu.terminate()
                self._instance.is_running = False
                fmu.reset()
            self._time_s = 0.0
            if self._is_fmi3:
                self.set(references, values)
                fmu.enterInitializationMode(startTime=0.0)
            else:
                fmu.setupExperiment(startTime=0.0)
                self.set(references, values)
                fmu.enterInitializationMode()
            fmu.exitInitializationMode()
            self._instance.is_running = True

    def set(self, references: Sequence[int], values: Sequence[float]) -> None:
        """Set variables.

        Raises:
            FmuFailed: the FMU returned an error.
        """
        if references:
            with self._named():
                (self._instance.fmu.setFloat64 if self._is_fmi3 else self._instance.fmu.setReal)(references, values)

    def get(self, references: Sequence[int]) -> list[float]:
        """Values of variables.

        Raises:
            FmuFailed: the FMU returned an error.
        """
        with self._named():
            values: list[float] = (self._instance.fmu.getFloat64 if self._is_fmi3 else self._instance.fmu.getReal)(references)
            return values

    def step(self, duration_s: float) -> None:
        """Advance by one communication step.

        Raises:
            FmuFailed: the FMU returned an error, or ended the simulation or the step before its time.
        """
        with self._named():
            flags = self._instance.fmu.doStep(currentCommunicationPoint=self._time_s, communicationStepSize=duration_s)
        if flags is not None and (flags[1] or flags[2]):
            what = "ended the simulation" if flags[1] else "returned early from a step"
            raise FmuFailed(f"{self._path}: the FMU {what} at {self._time_s:.3f} s{self._log.last_words}")
        self._time_s += duration_s

    def _description(self, fmpy: Any) -> Any:  # noqa: ANN401 - fmpy has no types
        if not os.path.isfile(self._path):
            raise FmuUnusable(f"{self._path}: no such file")
        if not zipfile.is_zipfile(self._path):
            raise FmuUnusable(f"{self._path}: no FMU: not a ZIP archive")
        with self._named():
            description = fmpy.read_model_description(self._path)
        if description.fmiVersion.startswith("1."):
            raise FmuUnusable(f"{self._path}: FMI {description.fmiVersion}; allowed: 2.0 and 3.0")
        if description.coSimulation is None:
            raise FmuUnusable(f"{self._path}: an FMU for model exchange; allowed: co-simulation")
        return description

    def _instantiated(self, description: Any, directory: Path) -> Any:  # noqa: ANN401 - fmpy has no types
        module = optional("fmpy.fmi3" if self._is_fmi3 else "fmpy.fmi2", _EXTRA)
        fmpy, identifier = optional("fmpy", _EXTRA), description.coSimulation.modelIdentifier
        platform = fmpy.platform_tuple if self._is_fmi3 else fmpy.platform
        library = directory / "binaries" / platform / f"{identifier}{fmpy.sharedLibraryExtension}"
        if not library.is_file():
            there = ", ".join(sorted(path.name for path in (directory / "binaries").glob("*"))) or "none"
            raise FmuUnusable(f"{self._path}: no binary for {platform}; it has: {there}")
        try:
            ctypes.CDLL(str(library))
        except OSError as error:
            raise FmuUnusable(f"{self._path}: its library cannot be loaded: {error}") from error
        make = module.FMU3Slave if self._is_fmi3 else module.FMU2Slave
        try:
            fmu = make(guid=description.guid, unzipDirectory=str(directory), modelIdentifier=identifier, instanceName="car")
        except AttributeError as error:
            raise FmuUnusable(f"{self._path}: its library is not complete: no {str(error).rpartition(': ')[2]}") from error
        with self._named():
            fmu.instantiate(**({"logMessage": self._log.note} if self._is_fmi3 else {"callbacks": _callbacks(module, self._log)}))
        return fmu

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Tell errors of fmpy in one line; beside those of calls it has no class for them."""
        try:
            yield
        except Exception as error:
            status = getattr(error, "status", None)
            if status is not None:
                self._instance.failed_with = status
                raise FmuFailed(f"{self._path}: {error}{self._log.last_words}") from error
            if type(error) is not Exception and not type(error).__module__.startswith(("fmpy", "lxml")):
                raise
            raise FmuUnusable(f"{self._path}: {' '.join(str(error).split())}{self._log.last_words}") from error
