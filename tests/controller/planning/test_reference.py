"""The reference path: what is accepted, what is refused and how, and that a file gives back what was written."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.planning.reference import ReferencePath, ReferencePathError
from dbc.errors import UserMistake

GOOD = {
    "x_m": [0.0, 1.0, 2.0],
    "y_m": [0.0, 0.0, 0.5],
    "yaw_rad": [0.0, 0.2, 0.4],
    "speed_mps": [0.0, 3.0, 0.0],
    "left_m": [1.0, 1.0, 1.0],
    "right_m": [2.0, 2.0, 2.0],
}
HEADER = "x_m,y_m,yaw_rad,speed_mps,left_m,right_m\n"


def test_arc_length():
    np.testing.assert_allclose(ReferencePath(**GOOD).arc_length_m, [0.0, 1.0, 1.0 + np.hypot(1.0, 0.5)])


@pytest.mark.parametrize(
    ("column", "values", "named"),
    [
        ("y_m", [0.0, float("nan"), 0.0], "row 2, column y_m = nan: must be finite"),
        ("speed_mps", [0.0, 1.0, -0.1], "row 3, column speed_mps = -0.1: must not be negative"),
        ("left_m", [1.0, 0.0, 1.0], "row 2, column left_m = 0: must be positive"),
        ("right_m", [-1.0, 1.0, 1.0], "row 1, column right_m = -1: must be positive"),
        ("x_m", [0.0, 0.0, 1.0], "row 2, column x_m = 0: the path does not advance"),
        ("yaw_rad", [0.0, 3.0, 0.4], "row 2, column yaw_rad = 3: points more than 90 degrees away"),
        ("yaw_rad", [0.0, 2 * np.pi, 0.4], "row 2, column yaw_rad = 6.28319: jumps by more than pi"),
        ("left_m", [1.0, 1.0], r"column left_m: shape \(2,\), expected \(3,\)"),
    ],
)
def test_a_bad_sample_is_named(column, values, named):
    with pytest.raises(ReferencePathError, match=named):
        ReferencePath(**{**GOOD, column: values})


def test_one_sample_is_no_path():
    with pytest.raises(ReferencePathError, match="1 rows; a path needs at least 2"):
        ReferencePath(**{name: values[:1] for name, values in GOOD.items()})


@given(st.lists(st.tuples(*[st.floats(1e-3, 1e3)] * 4), min_size=2, max_size=20))
def test_a_file_gives_back_the_very_same_numbers(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("reference") / "path.csv"
    steps, speed, left, right = np.array(rows).T
    x = np.cumsum(steps)
    written = ReferencePath(x, 0.0 * x, 0.0 * x, speed, left, right)
    written.to_csv(path)
    read = ReferencePath.from_csv(path)
    for name in GOOD:
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "the first line must be x_m,y_m"),
        ("x,y\n1,2\n", "the first line must be x_m,y_m"),
        (HEADER, "0 rows; a path needs at least 2"),
        (HEADER + "0,0,0,1,1,1\n1,0,0,fast,1,1\n", "row 2, column speed_mps = 'fast': not a number"),
        (HEADER + "0,0,0,1,1,1\n1,0,0\n", "row 2: 3 columns, expected 6"),
        (HEADER + "0" * 200_000, "field larger than field limit"),
        (HEADER + "0,0,0,1,1,1\n1,0,0,-1,1,1\n", "row 2, column speed_mps = -1: must not be negative"),
    ],
)
def test_a_bad_file_is_named_with_the_row(tmp_path, text, named):
    path = tmp_path / "path.csv"
    path.write_text(text)
    with pytest.raises(UserMistake, match=named) as caught:
        ReferencePath.from_csv(path)
    assert "path.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ReferencePathError, match=r"none\.csv"):
        ReferencePath.from_csv(tmp_path / "none.csv")
