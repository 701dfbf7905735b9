"""What a record tells of the session that it is of: versions, hashes, clocks."""

import hashlib
import importlib.metadata
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypedDict

from dbc.errors import UserMistake
from gateway.journal import GatewaySession
from gateway.limits import LimitProfile

_EARLIEST_NS = 946_684_800_000_000_000
"""The year 2000 [ns]: a machine without a clock of its own starts in 1970, which the BLF format cannot tell."""
_OTHER_NAMES = ("configuration", "controller library", "limits", "mapping", "scenario", "vehicle")
"""What else has a hash, here and in the summary of a run."""


class Origin(TypedDict):
    """The fields of `gateway.journal.Session` that every session has."""

    version: str
    started_utc: str
    wall_offset_ns: int
    boot_id: int
    sha256: dict[str, str]


def origin(boot_id: int, decided_by: Mapping[str, bytes]) -> Origin:
    """Version, clocks, and hashes of what decides on what a process does."""
    wall_ns = max(time.time_ns(), _EARLIEST_NS)
    return Origin(
        version=importlib.metadata.version("xilgate"),
        started_utc=datetime.fromtimestamp(wall_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
        wall_offset_ns=wall_ns - time.monotonic_ns(),
        boot_id=boot_id,
        sha256={name: hashlib.sha256(content).hexdigest() for name, content in decided_by.items()},
    )


def refuse_equal_names(dbc_paths: Iterable[Path], vehicle_path: Path, mapping_path: Path | None) -> None:
    """Refuse files that hashes and journals could not tell apart: both know a file by the last part of its path.

    Raises:
        UserMistake: two have the same name, or one that stands for something else; one line for each.
    """
    by_name: dict[str, Path] = {}
    mistakes = []
    for path in (*dbc_paths, vehicle_path, *([] if mapping_path is None else [mapping_path])):
        if path.name in _OTHER_NAMES:
            mistakes.append(f"{path}: named as another hash; allowed: any name but {', '.join(_OTHER_NAMES)}")
        elif path.name in by_name:
            mistakes.append(f"{path}: named as {by_name[path.name]}, records could not tell them apart; allowed: a name of its own")
        by_name[path.name] = path
    if mistakes:
        raise UserMistake("\n".join(mistakes))


def sha256_of_data(content: object) -> str:
    """Of what JSON can carry."""
    return hashlib.sha256(_as_json(content)).hexdigest()


def pinnable(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration without the hashes that it expects, one of which may be its own."""
    return {name: value for name, value in configuration.items() if name != "hashes"}


def _as_json(content: object) -> bytes:
    return json.dumps(content, sort_keys=True).encode()


def gateway_session(
    boot_id: int,
    profile: LimitProfile,
    dbc_paths: Iterable[Path],
    vehicle_path: Path,
    configuration: dict[str, Any],
    *,
    mapping_path: Path | None = None,
) -> GatewaySession:
    """What a gateway is started with, as the journal keeps it.

    Args:
        configuration: the effective configuration, of what JSON can carry and without any key.

    Raises:
        OSError: a file cannot be read.
    """
    dbc = {path.name: path.read_bytes() for path in dbc_paths}
    limits, vehicle = asdict(profile), vehicle_path.read_bytes()
    decided_by = dbc | {"vehicle": vehicle, "limits": _as_json(limits), "configuration": _as_json(pinnable(configuration))}
    if mapping_path is not None:
        decided_by["mapping"] = mapping_path.read_bytes()
    return GatewaySession(
        **origin(boot_id, decided_by),
        profile=profile.name,
        limits=limits,
        dbc={name: content.decode("latin-1") for name, content in dbc.items()},
        mapping=None if mapping_path is None else decided_by["mapping"].decode("utf-8"),
        vehicle=vehicle.decode("utf-8"),
        configuration=configuration,
    )
