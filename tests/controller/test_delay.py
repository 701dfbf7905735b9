"""Delay compensation."""

import numpy as np
import pytest

from controller.delay import TRANSPORT_DELAY_S, DelayCompensator, actuation_delays_s
from controller.problem import SINGLE_TRACK, SINGLE_TRACK_LAG

MS = 1_000_000


def double_integrator(state, inputs, duration_s):
    """v_x is driven by the second input; X follows."""
    assert duration_s <= 0.04 + 1e-12
    after = np.array(state)
    after[3] += duration_s * state[0] + 0.5 * duration_s**2 * inputs[1]
    after[0] += duration_s * inputs[1]
    return after


@pytest.fixture
def compensator():
    c = DelayCompensator(double_integrator, delays_s=(0.060, 0.060), longest_step_s=0.04)
    c.restart(np.array((0.0, 1.0)))
    return c


START = np.array((10.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def test_a_model_without_lag_takes_it_for_delay(vehicle):
    steering = vehicle.robots.steering
    lag = 2 * steering.damping_ratio / (2 * np.pi * steering.bandwidth_hz)
    delays_s = actuation_delays_s(vehicle, SINGLE_TRACK)
    assert delays_s == pytest.approx((TRANSPORT_DELAY_S + steering.dead_time_s + lag,) * 2)
    assert 0.05 < delays_s[0] < 0.07


def test_a_model_with_lag_leaves_each_robots_dead_time(vehicle):
    slow = vehicle.robots.accelerator.model_copy(update={"dead_time_s": 0.1})
    other = vehicle.model_copy(update={"robots": vehicle.robots.model_copy(update={"accelerator": slow})})
    assert actuation_delays_s(other, SINGLE_TRACK_LAG) == pytest.approx((0.03, 0.11))


def test_each_input_acts_after_its_own_delay():
    """The steering input drives X here, the drive v_x: both from zero, commanded at once, seen at different times."""

    def both(state, inputs, duration_s):
        return state + duration_s * np.array((inputs[1], 0.0, 0.0, inputs[0], 0.0, 0.0))

    c = DelayCompensator(both, delays_s=(0.030, 0.100), longest_step_s=0.04)
    c.restart(np.zeros(2))
    c.commanded(1000 * MS, np.array((1.0, 2.0)))
    after = c.drive(np.zeros(6), 1000 * MS, 1200 * MS)
    assert (after[3], after[0]) == pytest.approx((0.170, 0.2))
    # Predicted is the moment when steering acts.
    assert c.predict(np.zeros(6), 1000 * MS, 1100 * MS)[3] == pytest.approx(0.1)


def test_what_acts_is_integrated_from_the_measurement_to_the_effect(compensator):
    predicted = compensator.predict(START, t_ns=995 * MS, now_ns=1000 * MS)
    assert predicted[0] == pytest.approx(10.0 + 0.065 * 1.0)
    assert predicted[3] == pytest.approx(0.65 + 0.5 * 0.065**2)


def test_commands_act_late_and_in_their_order(compensator):
    compensator.commanded(1000 * MS, np.array((0.0, -2.0)))  # acts from 1060
    compensator.commanded(1040 * MS, np.array((0.0, 5.0)))  # acts from 1100
    predicted = compensator.predict(START, t_ns=1050 * MS, now_ns=1080 * MS)  # until 1140
    assert predicted[0] == pytest.approx(10.0 + 0.010 * 1.0 - 0.040 * 2.0 + 0.040 * 5.0)
    np.testing.assert_array_equal(compensator.last_input, (0.0, 5.0))


def test_prediction_does_not_change_what_it_is_given(compensator):
    start = START.copy()
    compensator.predict(start, 0, 40 * MS)
    np.testing.assert_array_equal(start, START)


def test_old_commands_are_forgotten_once_they_have_acted(compensator):
    for k in range(1000):
        compensator.commanded(k * 40 * MS, np.array((0.0, float(k))))
        compensator.forget(k * 40 * MS)
        expected = 10.0 + 0.04 * (k - 1) + 0.02 * (k - 2) if k > 2 else None
        if expected is not None:
            assert compensator.predict(START, k * 40 * MS, k * 40 * MS)[0] == pytest.approx(expected)
    assert len(compensator._commanded) < 5
    predicted = compensator.predict(START, 999 * 40 * MS + 60 * MS, 999 * 40 * MS + 60 * MS)
    assert predicted[0] == pytest.approx(10.0 + 0.060 * 999)


def test_after_a_restart_only_the_measured_input_counts(compensator):
    compensator.commanded(0, np.array((0.0, 50.0)))
    compensator.restart(np.array((0.0, 0.0)))
    assert compensator.predict(START, 80 * MS, 80 * MS)[0] == 10.0


def test_a_brake_stops_the_car_and_does_not_drive_it_backwards(compensator):
    compensator.restart(np.array((0.0, -20.0)))
    assert compensator.predict(np.array((0.1, 0, 0, 0, 0, 0)), 0, 0)[0] == 0.0
    assert compensator.predict(np.array((-0.2, 0, 0, 0, 0, 0)), 0, 0)[0] == -0.2


def test_a_time_stamp_beyond_the_effect_leaves_the_state_alone(compensator):
    np.testing.assert_array_equal(compensator.predict(START, t_ns=100 * MS, now_ns=10 * MS), START)


def test_commands_that_nobody_asks_for_do_not_pile_up(compensator):
    for k in range(10_000):
        compensator.commanded(k * 40 * MS, np.array((0.0, 0.0)))
    assert len(compensator._commanded) <= 100
