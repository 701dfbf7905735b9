"""GNSS-aided inertial navigation system: true motion in, one noisy and late navigation solution out, as OxTS instruments send it."""

from vehicle_emulator.ins.instrument import MAX_LATENCY_EXTRA_S, START, InsFaults, NavigationSystem
from vehicle_emulator.ins.messages import CORE_MESSAGES, MESSAGES, STATUS_MESSAGES
from vehicle_emulator.ins.receiver import GNSS_MODES, GnssMode
from vehicle_emulator.ins.solution import Solution

__all__ = [
    "CORE_MESSAGES",
    "GNSS_MODES",
    "MAX_LATENCY_EXTRA_S",
    "MESSAGES",
    "START",
    "STATUS_MESSAGES",
    "GnssMode",
    "InsFaults",
    "NavigationSystem",
    "Solution",
]
