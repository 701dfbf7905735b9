"""`summary.json`: what was run, on what, and how it came out, for machines and for the head of the report."""

import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from gateway.telemetry import Sample
from xil.injected import InjectedFault
from xil.metrics import Metric, Verdict
from xil.scenario import Scenario, Stage

_DISTRIBUTIONS = {
    "xilgate": "xilgate",
    "casadi": "casadi",
    "cantools": "cantools",
    "python-can": "python-can",
    "zenoh": "eclipse-zenoh",
    "numpy": "numpy",
}
_CPU_INFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class RunFacts:
    """What a run was made of.

    Args:
        started: when, with time zone.
        compiler: which compiler made the controller library; empty for the uncompiled solver.
        files: everything whose content decides on the run, by what it is: controller library, DBC files, vehicle, scenario, configuration.
        realtime_factor: how many times faster than real time the drive was; None where it was in real time.
        bus_load: share of the time in which each bus was busy, by the channel of the bus record; empty of a run that recorded nothing.
    """

    scenario: Scenario
    stage: Stage
    seed: int
    solver: str
    started: datetime
    duration_s: float
    compiler: str
    files: Mapping[str, Path]
    realtime_factor: float | None = None
    bus_load: Mapping[str, float] = field(default_factory=dict)


def build_summary(
    facts: RunFacts, verdict: Verdict, parameter_changes: Sequence[Sample], faults: Sequence[InjectedFault]
) -> dict[str, Any]:
    """The content of `summary.json`, made of what JSON can carry.

    `metrics` are what a seed determines in lockstep, `timing` what the machine determines; both are judged.

    Args:
        parameter_changes: samples of the topic `parameters`: what somebody tuned while it drove.
        faults: that were injected.

    Raises:
        OSError: a file of the run cannot be read.
    """
    return {
        "scenario": facts.scenario.name,
        "description": facts.scenario.description,
        "stage": facts.stage.value,
        "seed": facts.seed,
        "solver": facts.solver,
        "verdict": "pass" if verdict.passed else "fail",
        "reason": verdict.reason,
        "started": facts.started.astimezone(UTC).isoformat(timespec="seconds"),
        "duration_s": round(facts.duration_s, 3),
        "realtime_factor": None if facts.realtime_factor is None else round(facts.realtime_factor, 2),
        "bus_load": {network: round(load, 5) for network, load in facts.bus_load.items()},
        "versions": versions(),
        "git_revision": git_revision(Path(__file__).parent),
        "compiler": facts.compiler,
        "machine": machine(),
        "sha256": {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in facts.files.items()},
        "parameter_changes": [msgspec.to_builtins(change) for change in parameter_changes],
        "faults": [asdict(fault) for fault in faults],
        "metrics": _as_data(verdict.metrics),
        "timing": _as_data(verdict.timing),
    }


def _as_data(metrics: Iterable[Metric]) -> list[dict[str, Any]]:
    return [
        {"name": m.name, "value": m.value, "unit": m.unit, "relation": m.relation, "limit": m.limit, "passed": m.passed} for m in metrics
    ]


def versions() -> dict[str, str]:
    """Versions of xilgate, of Python and of the libraries that take part in a run."""
    return {"python": platform.python_version()} | {name: version(distribution) for name, distribution in _DISTRIBUTIONS.items()}


def git_revision(folder: Path) -> str:
    """Revision of the checkout that holds a folder, with "-dirty" when files differ from it; "unknown" outside a checkout."""
    try:
        described = subprocess.run(
            ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty"],
            capture_output=True, text=True, check=True, timeout=10.0,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return described.stdout.strip()


def machine() -> dict[str, str | int]:
    """Processor, cores and operating system."""
    return {"cpu": _cpu_name(), "cores": os.cpu_count() or 0, "system": f"{platform.system()} {platform.release()} {platform.machine()}"}


def _cpu_name() -> str:
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return names[0] if names else platform.processor() or "unknown"
