"""Where the car is along its path."""

import numpy as np

from controller.planning.reference import ReferencePath


class Localiser:
    """Closest point of a path to the car, that only ever moves forward, by what the car can have driven.

    So it stays on its branch of a path that crosses itself.
    """

    def __init__(self, path: ReferencePath) -> None:
        self._points = np.column_stack((path.x_m, path.y_m))
        self._steps = np.diff(self._points, axis=0)
        self._lengths = np.diff(path.arc_length_m)
        self._arc_length = path.arc_length_m
        self._last: float | None = None

    def reset(self) -> None:
        """Forget where the car was: the next search covers the whole path."""
        self._last = None

    def locate(self, x_m: float, y_m: float, yaw_rad: float, reach_m: float) -> float:
        """Arc length of the closest point [m].

        Args:
            yaw_rad: heading of the car; a search of the whole path prefers branches that run its way.
            reach_m: how far the car can have moved since the last call [m].
        """
        if self._last is None:
            found = self._search(x_m, y_m, 0, len(self._lengths), yaw_rad)
        else:
            first = int(np.searchsorted(self._arc_length, self._last, side="right")) - 1
            beyond = int(np.searchsorted(self._arc_length, self._last + reach_m, side="left"))
            first = min(first, len(self._lengths) - 1)
            found = min(max(self._search(x_m, y_m, first, max(beyond, first + 1), None), self._last), self._last + reach_m)
        self._last = found
        return found

    def _search(self, x_m: float, y_m: float, first: int, beyond: int, yaw_rad: float | None) -> float:
        starts, steps, lengths = self._points[first:beyond], self._steps[first:beyond], self._lengths[first:beyond]
        offsets = np.array((x_m, y_m)) - starts[: len(steps)]
        share = np.clip(np.sum(offsets * steps, axis=1) / lengths**2, 0.0, 1.0)
        squared = np.sum((offsets - share[:, None] * steps) ** 2, axis=1)
        if yaw_rad is not None:
            runs_our_way = steps @ np.array((np.cos(yaw_rad), np.sin(yaw_rad))) > 0.0
            if runs_our_way.any():
                squared = np.where(runs_our_way, squared, np.inf)
        best = int(np.argmin(squared))
        return float(self._arc_length[first + best] + share[best] * lengths[best])
