"""All that a gateway works with, read and checked before anything is opened: what `--check` shows and what `run` is given."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from dbc.catalogue import Catalogue, load
from dbc.errors import UserMistake
from dbc.vehicle import Vehicle, load_vehicle
from gateway.core import GatewayCore
from gateway.limits import PROFILES, LimitProfile
from gateway.record.session import gateway_session, pinnable, refuse_equal_names, sha256_of_data
from gateway.recorder import FileOptions, Recorder
from gateway.rig import Recording, Rig, RigError

OWN_NODE = "GW"
"""Our node in the DBC."""
T = TypeVar("T")


@dataclass(frozen=True)
class Preparation:
    """One gateway, ready to be started.

    Args:
        hashes: SHA-256 of every file that the rig names, by its name, of the limits and of the whole configuration but for its own hashes.
    """

    rig: Rig
    catalogue: Catalogue
    vehicle: Vehicle
    profile: LimitProfile
    hashes: Mapping[str, str]

    def new_core(self, boot_id: int) -> GatewayCore:
        """A gateway at its start."""
        return GatewayCore(self.catalogue, self.vehicle, boot_id, self.profile)


def prepare(rig: Rig) -> Preparation:
    """Read all that a rig names.

    Raises:
        UserMistake: files that cannot be used, or that are not what the rig expects; one line per mistake, of all files at once.
    """
    mistakes: list[str] = []
    _try(lambda: refuse_equal_names(rig.car.dbc, rig.car.vehicle, rig.car.mapping), mistakes)
    catalogue = _try(lambda: load(rig.car.dbc, rig.car.mapping), mistakes)
    vehicle = _try(lambda: load_vehicle(rig.car.vehicle), mistakes)
    profile = PROFILES[rig.profile]
    if catalogue is None or vehicle is None:
        raise RigError("\n".join(mistakes))
    _try(lambda: GatewayCore(catalogue, vehicle, boot_id=0, profile=profile), mistakes)
    hashes = _hashes(rig, catalogue, profile)
    for name, expected in rig.hashes.items():
        if name not in hashes:
            mistakes.append(f"{rig.name}: hashes.{name}: unknown; known are {', '.join(hashes)}")
        elif hashes[name] != expected:
            mistakes.append(f"{rig.name}: hashes.{name} = {expected!r}: found {hashes[name]}")
    if mistakes:
        raise RigError("\n".join(mistakes))
    return Preparation(rig, catalogue, vehicle, profile, hashes)


def start_recorder(preparation: Preparation, recording: Recording, boot_id: int) -> Recorder:
    """Start the process that records the gateway of this boot id.

    Raises:
        SetupFailure: it does not start, or its directory cannot be used.
    """
    rig = preparation.rig
    stem = f"gateway-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    options = FileOptions(
        recording.directory, stem, recording.formats, recording.max_file_mb << 20, recording.max_file_s, recording.max_files
    )
    session = gateway_session(
        boot_id, preparation.profile, rig.car.dbc, rig.car.vehicle, configuration(rig), mapping_path=rig.car.mapping
    )
    return Recorder(options, session, preparation.catalogue)


def configuration(rig: Rig) -> dict[str, Any]:
    """The effective configuration as plain data, with every default; secrets are named by their files only."""
    return rig.model_dump(mode="json")


def _hashes(rig: Rig, catalogue: Catalogue, profile: LimitProfile) -> dict[str, str]:
    files = {path.name: _of_file(path) for path in (rig.car.vehicle, rig.car.mapping) if path is not None}
    data = {"limits": asdict(profile), "configuration": pinnable(configuration(rig))}
    return catalogue.sha256 | files | {name: sha256_of_data(content) for name, content in data.items()}


def _of_file(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _try(read: Callable[[], T], mistakes: list[str]) -> T | None:
    try:
        return read()
    except UserMistake as error:
        mistakes += str(error).splitlines()
        return None
