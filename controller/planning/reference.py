"""The path that the car is to follow: position, heading, speed and drivable width, sampled along the arc length."""

import csv
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dbc.errors import UserMistake
from dbc.whole_file import read_whole

Array = NDArray[np.float64]

_COLUMNS = ("x_m", "y_m", "yaw_rad", "speed_mps", "left_m", "right_m")
_MAX_FILE_BYTES = 64 << 20

SHORTEST_STEP_M = 1e-6
"""Distance by which every sample must advance."""


class ReferencePathError(UserMistake):
    """A reference path cannot be used; one line that says where and why."""


@dataclass(frozen=True)
class ReferencePath:
    """Samples of the path, all of shape (n,), at least two, in driving order.

    Args:
        yaw_rad: heading of the path, unwrapped [rad].
        speed_mps: speed wanted there [m/s], not negative.
        left_m, right_m: drivable distance to the left and to the right of the path at the centre of gravity [m], positive.

    Raises:
        ReferencePathError: a sample that breaks one of these rules, named by its row (from 1) and column.
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    left_m: Array
    right_m: Array

    def __post_init__(self) -> None:
        for column in fields(self):
            object.__setattr__(self, column.name, np.array(getattr(self, column.name), dtype=np.float64))
        _validate(self)

    @cached_property
    def arc_length_m(self) -> Array:
        """Distance driven along the path at each sample, from 0 on, shape (n,) [m]."""
        return np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(self.x_m), np.diff(self.y_m)))))

    @classmethod
    def from_csv(cls, path: Path) -> Self:
        """Read a path written by `to_csv`, or by hand: a header with the names of the columns, then numbers.

        Raises:
            ReferencePathError: the file cannot be read, or its content breaks a rule.
        """
        try:
            rows = list(csv.reader(read_whole(path, _MAX_FILE_BYTES).decode("utf-8").splitlines()))
        except OSError as error:
            raise ReferencePathError(f"{path}: {error.strerror or error}") from error
        except (UnicodeDecodeError, csv.Error) as error:
            raise ReferencePathError(f"{path}: {error}") from error
        if not rows or tuple(name.strip() for name in rows[0]) != _COLUMNS:
            raise ReferencePathError(f"{path}: the first line must be {','.join(_COLUMNS)}")
        numbers = [[_number(path, i, name, text) for name, text in zip(_COLUMNS, _complete(path, i, row), strict=True)]
                   for i, row in enumerate(rows[1:], start=1)]  # fmt: skip
        try:
            return cls(*np.array(numbers, dtype=np.float64).reshape(-1, len(_COLUMNS)).T)
        except ReferencePathError as error:
            raise ReferencePathError(f"{path}: {error}") from error

    def to_csv(self, path: Path) -> None:
        """Write the path so that `from_csv` gives back the very same numbers."""
        samples = np.column_stack([getattr(self, name) for name in _COLUMNS]).tolist()
        lines = [",".join(_COLUMNS), *(",".join(map(repr, sample)) for sample in samples)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _validate(path: ReferencePath) -> None:
    columns = {name: getattr(path, name) for name in _COLUMNS}
    n = path.x_m.size
    for name, values in columns.items():
        if values.shape != (n,):
            raise ReferencePathError(f"column {name}: shape {values.shape}, expected {(n,)} as x_m")
    if n < 2:
        raise ReferencePathError(f"{n} rows; a path needs at least 2")
    for name, values in columns.items():
        _refuse(name, values, ~np.isfinite(values), "must be finite")
    _refuse("speed_mps", path.speed_mps, path.speed_mps < 0.0, "must not be negative")
    for name in ("left_m", "right_m"):
        _refuse(name, columns[name], columns[name] <= 0.0, "must be positive")
    dx, dy = np.diff(path.x_m), np.diff(path.y_m)
    _refuse("x_m", path.x_m, np.append(False, np.hypot(dx, dy) < SHORTEST_STEP_M), "the path does not advance from the row before")
    # A wrapped or a swapped heading would turn the car round: it must agree with the way to the next sample.
    off = np.abs(np.exp(1j * path.yaw_rad[:-1]) - np.exp(1j * np.arctan2(dy, dx))) > np.sqrt(2.0)
    _refuse("yaw_rad", path.yaw_rad, np.append(off, False), "points more than 90 degrees away from the next row")
    jump = np.append(False, np.abs(np.diff(path.yaw_rad)) > np.pi)
    _refuse("yaw_rad", path.yaw_rad, jump, "jumps by more than pi; headings must be unwrapped")


def _refuse(name: str, values: Array, is_bad: NDArray[np.bool_], rule: str) -> None:
    if is_bad.any():
        row = int(np.argmax(is_bad))
        raise ReferencePathError(f"row {row + 1}, column {name} = {values[row]:g}: {rule}")


def _complete(path: Path, row: int, texts: list[str]) -> list[str]:
    if len(texts) != len(_COLUMNS):
        raise ReferencePathError(f"{path}: row {row}: {len(texts)} columns, expected {len(_COLUMNS)}")
    return texts


def _number(path: Path, row: int, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise ReferencePathError(f"{path}: row {row}, column {name} = {text!r}: not a number") from error
