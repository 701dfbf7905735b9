"""The path that the car is to follow: position, heading, speed and drivable width, sampled along the arc length."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_COLUMNS = ("x_m", "y_m", "yaw_rad", "speed_mps", "left_m", "right_m")


class ReferenceError(Exception):
    """A reference path cannot be used; one line that says where and why."""


@dataclass(frozen=True)
class ReferencePath:
    """Samples of the path, all of shape (n,), at least two, in driving order.

    Args:
        yaw_rad: heading of the path, unwrapped [rad].
        speed_mps: speed wanted there [m/s], not negative.
        left_m, right_m: drivable distance to the left and to the right of the path at the centre of gravity [m], positive.
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    left_m: Array
    right_m: Array
