"""The shift: smooth everywhere, unchanged by being cut and continued, as gentle as asked for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.planning.shift import Knot, Shift, blend_length_m

KNOTS = (Knot(0.0), Knot(10.0), Knot(30.0, 2.0), Knot(45.0, 2.0), Knot(60.0, -1.0), Knot(70.0, -1.0), Knot(90.0))
FINE_M = np.linspace(-5.0, 100.0, 10501)


@st.composite
def shifts(draw):
    station, knots = 0.0, [Knot(0.0)]
    for step, offset in draw(st.lists(st.tuples(st.floats(2.0, 40.0), st.floats(-4.0, 4.0)), min_size=1, max_size=6)):
        station += step
        knots.append(Knot(station, offset))
    return Shift(tuple(knots))


def test_knots_are_met_and_the_shift_is_constant_outside():
    offset, slope, bend = Shift(KNOTS).sample(np.array([k.station_m for k in KNOTS] + [-50.0, 500.0]))
    np.testing.assert_allclose(offset, [k.offset_m for k in KNOTS] + [0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)
    np.testing.assert_allclose(bend, 0.0, atol=1e-12)


def test_offset_slope_and_bend_have_no_step_and_belong_together():
    offset, slope, bend = Shift(KNOTS).sample(FINE_M)
    step = FINE_M[1] - FINE_M[0]
    np.testing.assert_allclose(np.gradient(offset, step), slope, atol=1e-4)
    np.testing.assert_allclose(np.gradient(slope, step), bend, atol=1e-3)
    assert np.abs(np.diff(bend)).max() < 0.002


@given(shifts(), st.floats(0.5, 1.0))
def test_one_station_and_many_agree(shift, share):
    station = share * shift.knots[-1].station_m
    one = shift.at(station)
    np.testing.assert_allclose((one.offset_m, one.slope, one.bend_radpm), np.ravel(shift.sample(np.array([station]))), atol=1e-12)


@given(shifts(), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=5))
def test_a_shift_that_is_continued_as_it_was_is_the_same(shift, shares):
    stations = np.linspace(0.0, 1.2 * shift.knots[-1].station_m, 200)
    continued, last = shift, 0.0
    for share in sorted(shares):
        last = share * shift.knots[-1].station_m
        continued = continued.continued(last, continued.ahead(last), 2.0)
    ahead = stations[stations >= last - 2.0]
    for was, now in zip(shift.sample(ahead), continued.sample(ahead), strict=True):
        np.testing.assert_allclose(now, was, atol=1e-7)


@given(shifts(), st.floats(0.0, 1.0), st.floats(-3.0, 3.0), st.floats(5.0, 50.0))
def test_another_way_on_begins_without_a_step(shift, share, offset_m, length_m):
    here = share * shift.knots[-1].station_m
    changed = shift.continued(here, (Knot(here + length_m, offset_m),), 2.0)
    was, now = shift.at(here), changed.at(here + 1e-9)
    assert (now.offset_m, now.slope, now.bend_radpm) == pytest.approx((was.offset_m, was.slope, was.bend_radpm), abs=1e-6)
    assert changed.at(here + length_m).offset_m == pytest.approx(offset_m, abs=1e-9)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.01, 0.2))
def test_a_blend_from_rest_bends_as_much_as_allowed_and_no_more(start_m, end_m, bend_radpm):
    length = blend_length_m(Knot(0.0, start_m), end_m, bend_radpm, (-5.0, 5.0))
    bend = Shift((Knot(0.0, start_m), Knot(length, end_m))).sample(np.linspace(0.0, length, 501))[2]
    assert np.abs(bend).max() <= bend_radpm * 1.001
    if length > 1.0:
        assert np.abs(bend).max() >= bend_radpm * 0.999


@given(st.floats(-2.0, 2.0), st.floats(-0.2, 0.2), st.floats(-0.02, 0.02), st.floats(-2.0, 2.0), st.floats(0.01, 0.2))
def test_a_blend_from_the_midst_of_another_stays_gentle_and_on_the_road(offset_m, slope, start_bend, end_m, bend_radpm):
    start = Knot(0.0, offset_m, slope, start_bend)
    length = blend_length_m(start, end_m, bend_radpm, (-2.5, 2.5))
    if np.isfinite(length):
        fine = np.linspace(0.0, length, 501)
        offset, _, bend = Shift((Knot(-1.0, offset_m), start, Knot(length, end_m))).sample(fine)
        assert np.abs(bend).max() <= max(bend_radpm, abs(start_bend)) * 1.03
        assert np.abs(offset).max() <= 2.52
