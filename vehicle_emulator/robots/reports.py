"""Diagnosis of the robots and the memory of their troubles, as SR_Diag, AR_Diag, BR_Diag and RC_FaultReport show them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from dbc.robots import Robots

SOFTWARE_VERSION = 1
WARMING_NS = 100_000_000
"""Time between two looks at the temperatures [ns]."""
_WARMING_S = WARMING_NS * 1e-9
_AMBIENT_DEGC = 25.0
_MOTOR_RISE_K = 60.0
_DRIVE_RISE_K = 30.0
_MOTOR_S = 300.0
_DRIVE_S = 120.0
_RATED_A = 30.0
_SUPPLY_V = 13.5
_RIPPLE_V = 0.2
_RIPPLE_S = 45.0
_DROP_V = 0.5
_CONTROLLER_RISE_K = 15.0
"""Assumptions: what a robot and its controller do at their limits for long, how fast, and a charged 12 V system."""
_LIMIT_PAGES = 3


def supply_v(now_s: float, efforts: Iterable[float]) -> float:
    """Voltage of the car's supply: it wanders, and drops by what the motors draw."""
    return _SUPPLY_V + _RIPPLE_V * math.sin(2.0 * math.pi * now_s / _RIPPLE_S) - _DROP_V * sum(efforts) / 3.0


def controller_degc(now_s: float) -> float:
    """Temperature of the robot controller since its start."""
    return _AMBIENT_DEGC + _CONTROLLER_RISE_K * (1.0 - math.exp(-now_s / _MOTOR_S))


class Thermometer:
    """Temperatures of one robot: they follow the square of its effort slowly."""

    def __init__(self) -> None:
        self._motor_k = 0.0
        self._drive_k = 0.0

    def step(self, effort: float) -> None:
        """Heat or cool for `WARMING_NS`.

        Args:
            effort: torque or force, share of its limit.
        """
        heat = effort * effort
        self._motor_k += _WARMING_S / _MOTOR_S * (_MOTOR_RISE_K * heat - self._motor_k)
        self._drive_k += _WARMING_S / _DRIVE_S * (_DRIVE_RISE_K * heat - self._drive_k)

    def signals(self, effort: float) -> dict[str, float]:
        """Signals of NODE_Diag that follow from effort."""
        return {
            "MotorTemperature": _AMBIENT_DEGC + self._motor_k,
            "DriveTemperature": _AMBIENT_DEGC + self._drive_k,
            "MotorCurrent": _RATED_A * effort,
        }


@dataclass(slots=True)
class Entry:
    """One trouble of one node, as it is remembered.

    Args:
        count: how often it came.
        first_s: when it came first, since the start of the robot controller.
    """

    node: str
    dtc: int
    is_active: bool
    is_latched: bool
    count: int
    first_s: float


class FaultMemory:
    """Every trouble since the start or since the faults of its node were cleared, in the order of their coming."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, int], Entry] = {}
        self._noted: dict[str, tuple[frozenset[int], int]] = {}

    def note(self, now_s: float, node: str, troubles: frozenset[int], latched: int) -> None:
        """Take what is wrong with a node now."""
        before, latched_before = self._noted.get(node, (frozenset(), 0))
        if (troubles, latched) == (before, latched_before):
            return
        self._noted[node] = troubles, latched
        for dtc in sorted(troubles - before):
            entry = self._entries.setdefault((node, dtc), Entry(node, dtc, False, False, 0, now_s))
            entry.count = min(entry.count + 1, 255)
        for (name, dtc), entry in self._entries.items():
            if name == node:
                entry.is_active, entry.is_latched = dtc in troubles, dtc == latched

    def clear(self, node: str) -> None:
        """Forget what is no longer wrong with a node."""
        self._entries = {key: entry for key, entry in self._entries.items() if entry.node != node or entry.is_active}

    @property
    def entries(self) -> list[Entry]:
        """All entries."""
        return list(self._entries.values())


class FaultReport:
    """Makes RC_FaultReport: every other frame the next entry of the memory, in between the learned limits of SR, AR and BR in turn.

    Args:
        nodes: value table of the signal Robot.
    """

    def __init__(self, robots: Robots, nodes: dict[str, int]) -> None:
        self._nodes = nodes
        self._next_page = 0
        sr, ar, br = robots.steering, robots.accelerator, robots.brake
        self._limits: tuple[dict[str, float], ...] = (
            {
                "Page": 1,
                "MaxAngle": math.degrees(sr.learned_range_rad),
                "MaxRate": math.degrees(sr.rate_limit_radps),
                "MaxTorque": sr.torque_limit_nm,
            },
            {"Page": 2, "ArStroke": 1e3 * ar.stroke_m, "ArMaxForce": ar.force_limit_n},
            {"Page": 3, "BrStroke": 1e3 * br.stroke_m, "BrMaxForce": br.force_limit_n},
        )

    def signals(self, memory: FaultMemory) -> dict[str, float]:
        """Signals of the next page; call it once for each frame."""
        turn, is_limits = divmod(self._next_page, 2)
        self._next_page += 1
        if is_limits:
            return self._limits[turn % _LIMIT_PAGES]
        entries = memory.entries
        if not entries:
            return {"Page": 0}
        entry = entries[turn % len(entries)]
        return {
            "Page": 0,
            "Robot": self._nodes[entry.node],
            "Active": entry.is_active,
            "Latched": entry.is_latched,
            "Dtc": entry.dtc,
            "Count": entry.count,
            "TimeStamp": entry.first_s,
        }
