"""The rig file: all that one gateway is told about the rig that it works on. Command-line options of a bench build the same object."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from dbc.can_io import INTERFACES
from dbc.catalogue import NAVIGATION, ROBOTS
from dbc.errors import UserMistake
from dbc.realtime import GATEWAY_PRIORITY
from dbc.section import Section, absolute, between, checked, misfit, read_toml
from gateway.channel import ControlPath, control_path
from gateway.limits import PROFILES
from gateway.record.files import BusFormat
from gateway.telemetry import DEFAULT_BASE_PORT, TlsSection

_SHA256_DIGITS = 64


class RigError(UserMistake):
    """A rig file cannot be used; one line per mistake, each with file, key, value and what is allowed."""


def _one_of(*allowed: str) -> AfterValidator:
    def check(value: str) -> str:
        if value not in allowed:
            raise misfit(", ".join(allowed))
        return value

    return AfterValidator(check)


def _bus(name: str) -> str:
    interface, _, channel = name.partition(":")
    if not (interface and channel):
        raise misfit("INTERFACE:CHANNEL, for example socketcan:can0")
    if interface not in INTERFACES:
        raise misfit(f"an interface of {', '.join(INTERFACES)}")
    return name


def _sha256(digest: str) -> str:
    if len(digest) != _SHA256_DIGITS or set(digest) - set("0123456789abcdef"):
        raise misfit(f"{_SHA256_DIGITS} hexadecimal digits, as `xilgate gateway --check` prints them")
    return digest


def _not_empty(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if not values:
        raise misfit("at least one")
    return values


def _distinct(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(values)) != len(values):
        raise misfit("each at most once")
    return values


BusName = Annotated[str, AfterValidator(_bus)]
FilePath = Annotated[Path, Field(strict=False)]
Port = Annotated[int, between(1024, 65000)]
Processor = Annotated[int, between(0, 1023)]


class Buses(Section):
    """The buses, as python-can names them.

    Args:
        navigation: None where the navigation system is on the robots' bus.
    """

    robots: BusName
    navigation: BusName | None = None

    @property
    def by_network(self) -> dict[str, str]:
        """Name of the bus of every network."""
        return {ROBOTS: self.robots, NAVIGATION: self.navigation or self.robots}


class Car(Section):
    """The car and its messages.

    Args:
        mapping: names that the site gives to messages and signals, see `dbc.mapping`; None where they are ours.
    """

    dbc: Annotated[tuple[FilePath, ...], Field(strict=False), AfterValidator(_not_empty), AfterValidator(_distinct)]
    vehicle: FilePath
    mapping: FilePath | None = None


class Control(Section):
    """The control path to controller and operator.

    Args:
        directory: of its sockets; None takes the run-time directory of the user.
        key: file with the key that signs what goes over it; None takes one in that directory, made on first use.
    """

    directory: FilePath | None = None
    key: FilePath | None = None

    @property
    def path(self) -> ControlPath:
        """Where the processes of the rig find each other.

        Raises:
            SetupFailure: no directory is named, and the user's cannot be used.
        """
        return control_path(self.directory, self.key)


class Telemetry(Section):
    """Telemetry.

    Args:
        base_port: first of five neighbouring ports of the loopback interface.
        tls: for readers on other machines; None for none.
    """

    base_port: Port = DEFAULT_BASE_PORT
    tls: TlsSection | None = None


class Recording(Section):
    """The record of all that the gateway received and sent.

    Args:
        formats: of the frames, for people; the journal for `xilgate resim` is always written.
        max_file_mb, max_file_s: size [MiB] and age [s] at which a file is closed and the next begun.
        max_files: of a kind; the oldest go.
    """

    directory: FilePath
    formats: Annotated[tuple[Annotated[BusFormat, Field(strict=False)], ...], Field(strict=False), AfterValidator(_distinct)] = (
        BusFormat.BLF,
    )
    max_file_mb: Annotated[int, between(1, 4096)] = 64
    max_file_s: Annotated[float, between(10.0, 86_400.0)] = 600.0
    max_files: Annotated[int, between(2, 10_000)] = 20


class Realtime(Section):
    """What the control thread asks of the machine; what it does not get is said in log and status.

    Args:
        priority: of SCHED_FIFO.
        cpus: processors for the control thread alone, numbered as Linux does; empty for all.
    """

    priority: Annotated[int, between(1, 98)] = GATEWAY_PRIORITY
    cpus: Annotated[tuple[Processor, ...], Field(strict=False), AfterValidator(_distinct)] = ()
    locks_memory: bool = True


class Metrics(Section):
    """Prometheus metrics, at http://127.0.0.1:PORT/metrics."""

    port: Port


class Daemon(Section):
    """How the process lives and ends.

    Args:
        watchdog_s: longest time without progress of the control loop until systemd restarts the process [s].
        stop_within_s: longest time that a stop of the car may take, when the process is asked to end while it drives [s].
    """

    watchdog_s: Annotated[float, between(0.2, 10.0)] = 1.0
    stop_within_s: Annotated[float, between(1.0, 60.0)] = 45.0


class Rig(Section):
    """One rig.

    Args:
        profile: limit profile, chosen at the start only.
        recorder: None records nothing.
        hashes: what files and limits are expected to be: SHA-256 by the name that `xilgate gateway --check` prints.
    """

    name: Annotated[str, Field(min_length=1, max_length=64)]
    profile: Annotated[str, _one_of(*PROFILES)]
    buses: Buses
    car: Car
    control: Control = Control()
    telemetry: Telemetry = Telemetry()
    recorder: Recording | None = None
    realtime: Realtime = Realtime()
    metrics: Metrics | None = None
    daemon: Daemon = Daemon()
    hashes: dict[str, Annotated[str, AfterValidator(_sha256)]] = Field(default_factory=dict)


def read_rig(path: Path) -> Rig:
    """Read a rig file. Files that it names without a leading slash are relative to it.

    Raises:
        RigError: missing file, malformed TOML, unknown or missing key, value out of range; one line per mistake.
    """
    return make_rig(path, read_toml(path, RigError), path.absolute().parent)


def make_rig(origin: Path, tree: dict[str, Any], base: Path) -> Rig:
    """A rig out of plain data.

    Args:
        origin: where the data are from, for messages.
        base: directory that relative paths start from.

    Raises:
        RigError: unknown or missing key, value out of range; one line per mistake.
    """
    rig: Rig = absolute(checked(origin, tree, Rig, RigError), base)
    return rig
