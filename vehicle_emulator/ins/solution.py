"""What the navigation system believes at one moment."""

from typing import NamedTuple

from vehicle_emulator.ins.errors import Accuracy
from vehicle_emulator.ins.motion import Motion


class Solution(NamedTuple):
    """One navigation solution.

    Args:
        valid_ms: time of validity, milliseconds of GPS time.
        motion: of the point that is output.
        distance_m, held_distance_m: way along the ground; the second stands still when the car seems to.
    """

    valid_ms: int
    motion: Motion
    distance_m: float = 0.0
    held_distance_m: float = 0.0


class Status(NamedTuple):
    """What the instrument says of itself.

    Args:
        valid_ms: time of validity, milliseconds of GPS time.
        mode: kind of fix, as the DBC numbers it.
        satellites: how many it tracks.
        accuracy: of the solution.
        blend_method: as the DBC numbers it.
        transmitted: messages sent since the start.
    """

    valid_ms: int
    mode: int
    satellites: int
    accuracy: Accuracy
    blend_method: int
    transmitted: int
