"""The disturbance observer: on a car that is a point mass with a slope under it."""

import numpy as np
import pytest

from controller.disturbance import DisturbanceObserver, DisturbanceOptions, equivalent_drive
from controller.model import single_track

PERIOD_S = 0.04


def observe(slope_mps2, seconds, *, noise_mps=0.0, speed_mps=20.0, drive_norm=0.1):
    """Estimates of d, cycle by cycle, for a model that knows nothing of the slope."""
    rng, observer = np.random.default_rng(1), DisturbanceObserver(DisturbanceOptions())
    observer.restart(speed_mps)
    estimates = []
    for k in range(1, round(seconds / PERIOD_S) + 1):
        measured = speed_mps + slope_mps2 * k * PERIOD_S + noise_mps * rng.standard_normal()
        predicted = observer.speed_mps + observer.disturbance_mps2 * PERIOD_S
        observer.update(predicted, measured, PERIOD_S, drive_norm)
        estimates.append(observer.disturbance_mps2)
    return np.array(estimates), observer


@pytest.mark.parametrize("slope_mps2", [-0.6, 0.3])
def test_a_slope_is_found_within_seconds_without_overshoot(slope_mps2):
    estimates, _ = observe(slope_mps2, 5.0)
    assert estimates[-1] == pytest.approx(slope_mps2, rel=0.01)
    assert np.abs(estimates).max() <= abs(slope_mps2) * 1.001
    assert (np.diff(np.abs(estimates)) >= -1e-12).all()


def test_the_filtered_speed_has_no_lag_on_a_slope():
    _, observer = observe(-0.6, 8.0)
    assert observer.speed_mps == pytest.approx(20.0 - 0.6 * 8.0, abs=1e-3)


def test_noise_of_the_navigation_system_hardly_shows(vehicle):
    estimates, _ = observe(0.0, 200.0, noise_mps=vehicle.ins.velocity_sigma_mps)
    assert np.std(estimates[100:]) < 0.004


def test_the_estimate_is_bounded():
    estimates, _ = observe(-3.0, 3.0)
    assert estimates[-1] == -DisturbanceOptions().largest_mps2


def test_a_jump_of_the_measured_speed_is_no_disturbance():
    _, observer = observe(-0.6, 5.0)
    learnt = observer.disturbance_mps2
    observer.update(observer.speed_mps, 3.0, PERIOD_S, 0.1)
    assert (observer.speed_mps, observer.disturbance_mps2) == (3.0, learnt)


@pytest.mark.parametrize("drive_norm", [-1.0, 1.0])
def test_a_saturated_drive_teaches_nothing(drive_norm):
    estimates, _ = observe(-0.6, 2.0, drive_norm=drive_norm)
    assert not estimates.any()


def test_a_car_that_brakes_near_standstill_teaches_nothing_and_its_speed_is_the_measured_one():
    estimates, observer = observe(-0.1, 2.0, speed_mps=0.8, drive_norm=-0.1)
    assert not estimates.any()
    assert observer.speed_mps == pytest.approx(0.6)


def test_a_car_that_is_driven_and_stands_learns_what_holds_it():
    observer = DisturbanceObserver(DisturbanceOptions())
    for _ in range(100):
        observer.update(observer.speed_mps + (0.5 + observer.disturbance_mps2) * PERIOD_S, 0.0, PERIOD_S, 0.2)
    assert observer.disturbance_mps2 == pytest.approx(-0.5, rel=0.02)


def test_a_restart_keeps_what_was_learnt():
    _, observer = observe(-0.6, 5.0)
    learnt = observer.disturbance_mps2
    observer.restart(3.0)
    assert (observer.speed_mps, observer.disturbance_mps2) == (3.0, learnt)


def test_a_push_that_is_not_there_any_more_does_not_hold_a_standing_car_for_ever():
    observer = DisturbanceObserver(DisturbanceOptions())
    observer.disturbance_mps2 = 1.5
    for _ in range(250):  # 10 s, standing, and the controller brakes because of the push
        observer.update(0.0, 0.0, 0.04, -0.1)
    assert 0.0 <= observer.disturbance_mps2 < 0.1
    observer.disturbance_mps2 = -0.6  # a slope up: needed for the start
    observer.update(0.0, 0.0, 0.04, -0.1)
    assert observer.disturbance_mps2 == -0.6


def test_the_equivalent_drive_accelerates_the_model_by_the_disturbance(vehicle):
    import casadi as ca  # noqa: PLC0415

    x, car = ca.DM((20.0, 0.0, 0.0, 0.0, 0.0, 0.0)), vehicle.model
    without, with_it = (float(single_track(x, ca.DM((0.0, drive)), car)[0]) for drive in (0.1, 0.1 + equivalent_drive(-0.6, car)))
    assert with_it - without == pytest.approx(-0.6)
