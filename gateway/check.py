"""`xilgate gateway --check`: all that a start would meet, without starting anything."""

import os
import stat
from pathlib import Path
from typing import Any

from dbc.errors import SetupFailure
from dbc.link import CanLink, LinkError
from gateway.preparation import Preparation, configuration
from gateway.rig import Rig
from gateway.telemetry import check_files


def check_machine(rig: Rig) -> None:
    """Look for what would keep a gateway from starting on this machine; buses may still come.

    Raises:
        UserMistake: a key file or a certificate is not usable.
        SetupFailure: a directory is missing or not writable; one line for each.
    """
    control = rig.control.path
    if rig.control.key is not None or os.path.lexists(control.key_file):
        control.key()
    if rig.telemetry.tls is not None:
        check_files(rig.telemetry.tls)
    directories = {"control.directory": control.directory}
    if rig.recorder is not None:
        directories["recorder.directory"] = rig.recorder.directory
    if failures := [line for key, directory in directories.items() for line in _unusable(key, directory)]:
        raise SetupFailure("\n".join(failures))


def warnings(rig: Rig) -> list[str]:
    """What a gateway would start without, or in spite of, for people."""
    found = []
    for network, bus_name in rig.buses.by_network.items():
        try:
            CanLink(bus_name).close()
        except LinkError as error:
            found.append(f"{network}: {error}")
    if missing := set(rig.realtime.cpus) - os.sched_getaffinity(0):
        found.append(f"realtime.cpus: no processor {', '.join(map(str, sorted(missing)))} for this process")
    if rig.recorder is None:
        found.append("recorder: none, nothing will be recorded")
    return found


def report(preparation: Preparation) -> dict[str, Any]:
    """The effective configuration with every default, the hashes of all that it names, and warnings, as plain data."""
    return {
        "configuration": configuration(preparation.rig),
        "hashes": dict(preparation.hashes),
        "warnings": warnings(preparation.rig),
    }


def as_text(content: dict[str, Any]) -> str:
    """The report for people: one `key = value` a line."""
    lines = list(_flat("", content["configuration"])) + [f"sha256 {name} = {digest}" for name, digest in content["hashes"].items()]
    return "\n".join([*lines, *(f"warning: {warning}" for warning in content["warnings"])])


def _flat(prefix: str, tree: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    for key, value in tree.items():
        lines += _flat(f"{prefix}{key}.", value) if isinstance(value, dict) else [f"{prefix}{key} = {value!r}"]
    return lines


def _unusable(key: str, directory: Path) -> list[str]:
    try:
        is_directory = stat.S_ISDIR(directory.stat().st_mode)
    except FileNotFoundError:
        is_directory = False
    except OSError as error:  # a directory above it that may not be entered, for one
        return [f"{key} = '{directory}': {error.strerror}"]
    if not is_directory:
        return [f"{key} = '{directory}': there is no such directory"]
    return [] if os.access(directory, os.W_OK | os.X_OK) else [f"{key} = '{directory}': not writable for this user"]
