"""What the model is told of the car: measured states, the drive from commands, the disturbance as drive, and the moment of actuation."""

import numpy as np
import pytest

from controller.disturbance import DisturbanceOptions
from controller.estimator import StateEstimator
from controller.problem import SINGLE_TRACK, SINGLE_TRACK_LAG, Model, OcpOptions

MS = 1_000_000
PERIOD_NS = 40 * MS
CAR_STATE = np.array((20.0, 0.0, 0.0, 0.0, 0.0, 0.0))
REST = np.zeros(2)


class PointMass:
    """v_x is driven by 3.2 t_r, behind a lag of 0.2 s where there are eight states; besides that by `slope_mps2`."""

    def __init__(self, vehicle, slope_mps2=0.0):
        self._per_drive = vehicle.model.max_wheel_torque_nm / vehicle.model.wheel_radius_m / vehicle.model.mass_kg
        self.slope_mps2 = slope_mps2

    def __call__(self, state, inputs, duration_s):
        after = np.array(state)
        drive = inputs[1]
        if len(state) == 8:
            after[6] += (inputs[0] - state[6]) * -np.expm1(-duration_s / 0.029)
            after[7] += (inputs[1] - state[7]) * -np.expm1(-duration_s / 0.2)
            drive = 0.5 * (state[7] + after[7])
        after[0] += duration_s * (self._per_drive * drive + self.slope_mps2)
        after[3] += duration_s * 0.5 * (state[0] + after[0])
        return after


def make(vehicle, model, disturbance=None, delays_s=(0.03, 0.03)):
    return StateEstimator(PointMass(vehicle), vehicle.model, OcpOptions(model=model), delays_s, disturbance)


def follow(estimator, car, state, commands, delay_ns=30 * MS):
    """Drive `car` with commands, one each period; its state at the end."""
    acting = [(-1, REST)]
    for k, command in enumerate(commands):
        estimator.commanded(k * PERIOD_NS, command)
        acting.append((k * PERIOD_NS + delay_ns, command))
        for t_ns in range(k * PERIOD_NS, (k + 1) * PERIOD_NS, MS):
            state = car(state, [inputs for since_ns, inputs in acting if since_ns <= t_ns][-1], 0.001)
        estimator.observe(state[:6], np.array((state[6] if len(state) == 8 else 0.0, 99.0)), (k + 1) * PERIOD_NS)
    return state


def test_the_drive_state_follows_the_commands_and_not_the_measured_pedal(vehicle):
    estimator = make(vehicle, SINGLE_TRACK_LAG)
    estimator.restart(CAR_STATE, REST, 0)
    state = follow(estimator, PointMass(vehicle), np.append(CAR_STATE, REST), [np.array((0.01, 0.5))] * 6)
    now_ns = 6 * PERIOD_NS
    start = estimator.predict(now_ns)
    assert start.shape == (8,)
    assert start[7] == pytest.approx(0.5 * -np.expm1(-(0.24 - 0.03 + 0.03) / 0.2), rel=0.02)
    ahead = state
    for _ in range(30):
        ahead = PointMass(vehicle)(ahead, np.array((0.01, 0.5)), 0.001)
    np.testing.assert_allclose(start, ahead, atol=2e-3)


def test_the_road_wheel_angle_is_the_measured_one(vehicle):
    estimator = make(vehicle, SINGLE_TRACK_LAG, delays_s=(0.0, 0.0))
    estimator.restart(CAR_STATE, np.array((0.1, 0.0)), 0)
    estimator.commanded(0, np.array((0.1, 0.0)))
    estimator.observe(CAR_STATE, np.array((0.08, 0.0)), PERIOD_NS)
    assert estimator.predict(PERIOD_NS)[6] == 0.08


@pytest.mark.parametrize("model", [SINGLE_TRACK, SINGLE_TRACK_LAG], ids=lambda model: model.name)
def test_a_slope_becomes_drive_and_speed_has_no_offset(vehicle, model):
    estimator, slope_mps2 = make(vehicle, model, DisturbanceOptions()), -0.6
    estimator.restart(CAR_STATE, REST, 0)
    start = np.append(CAR_STATE, REST)[: model.n_states]
    state = follow(estimator, PointMass(vehicle, slope_mps2), start, [np.array((0.0, 0.1))] * 125)
    assert estimator.disturbance_mps2 == pytest.approx(slope_mps2, rel=0.02)
    shift = estimator.input_shift
    assert shift[1] == pytest.approx(slope_mps2 / (1500.0 / 0.31 / 1500.0), rel=0.02)
    np.testing.assert_allclose(estimator.previous_input, (0.0, 0.1 + shift[1]))
    predicted = estimator.predict(125 * PERIOD_NS)
    assert predicted[0] == pytest.approx(state[0] + 0.03 * (0.1 * 1500.0 / 0.31 / 1500.0 + slope_mps2), abs=0.005)
    if model is SINGLE_TRACK_LAG:
        assert predicted[7] == pytest.approx(0.1 + shift[1], abs=0.005)
    estimator.hold(CAR_STATE, REST, 126 * PERIOD_NS)
    assert estimator.input_shift[1] == shift[1]  # the slope is still there
    estimator.restart(CAR_STATE, REST, 127 * PERIOD_NS)
    assert (estimator.disturbance_mps2, estimator.input_shift[1]) == (0.0, 0.0)  # somebody may have driven elsewhere
    np.testing.assert_array_equal(estimator.predict(127 * PERIOD_NS)[6:], 0.0)


def test_a_disturbance_that_is_still_being_learnt_does_not_touch_the_drive_of_the_commands(vehicle):
    estimator = make(vehicle, SINGLE_TRACK_LAG, DisturbanceOptions())
    estimator.restart(CAR_STATE, np.array((0.0, 0.1)), 0)
    follow(estimator, PointMass(vehicle, -2.0), np.append(CAR_STATE, (0.0, 0.1)), [np.array((0.0, 0.1))] * 12, delay_ns=0)
    assert -1.5 < estimator.disturbance_mps2 < -0.3
    assert estimator.predict(12 * PERIOD_NS)[7] - estimator.input_shift[1] == pytest.approx(0.1, abs=0.002)


def test_without_an_observer_what_is_measured_is_believed(vehicle):
    estimator = make(vehicle, SINGLE_TRACK)
    estimator.restart(CAR_STATE, REST, 0)
    state = follow(estimator, PointMass(vehicle, -0.6), CAR_STATE, [REST] * 50)
    assert estimator.disturbance_mps2 == 0.0
    assert estimator.predict(50 * PERIOD_NS)[0] == state[0]


def test_a_command_at_its_bound_teaches_nothing(vehicle):
    estimator = make(vehicle, SINGLE_TRACK, DisturbanceOptions())
    estimator.restart(CAR_STATE, np.array((0.0, 1.0)), 0)
    follow(estimator, PointMass(vehicle, -2.0), CAR_STATE, [np.array((0.0, 1.0))] * 50)
    assert estimator.disturbance_mps2 == 0.0


def test_a_repeated_measurement_changes_nothing(vehicle):
    estimator = make(vehicle, SINGLE_TRACK, DisturbanceOptions())
    estimator.restart(CAR_STATE, REST, 0)
    before = estimator.predict(PERIOD_NS)
    estimator.observe(CAR_STATE + 1.0, REST, 0)
    np.testing.assert_array_equal(estimator.predict(PERIOD_NS), before)


@pytest.mark.parametrize("t_ns", [3_000 * MS, -PERIOD_NS], ids=["after a long silence", "older than before"])
def test_a_gap_is_a_new_beginning(vehicle, t_ns):
    estimator = make(vehicle, SINGLE_TRACK_LAG, DisturbanceOptions())
    estimator.restart(CAR_STATE, REST, 0)
    estimator.observe(CAR_STATE - 5.0, np.array((0.1, 0.2)), t_ns)
    assert estimator.disturbance_mps2 == 0.0
    assert estimator.predict(t_ns - 30 * MS)[[0, 6, 7]] == pytest.approx((15.0, 0.1, 0.2))


def test_a_model_that_is_not_one_of_a_car_is_refused(vehicle):
    other = Model("other", "a:b", SINGLE_TRACK.states[::-1], SINGLE_TRACK.inputs, SINGLE_TRACK.bounded)
    with pytest.raises(ValueError, match="other"):
        make(vehicle, other)
