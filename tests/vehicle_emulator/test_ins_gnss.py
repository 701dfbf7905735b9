"""What the navigation system does when satellites go and come back, and when something is wrong with it."""

import math
from random import Random
from statistics import fmean, pstdev
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.catalogue import load
from dbc.ins import GnssFix, InsParameters
from dbc.vehicle import load_vehicle
from vehicle_emulator import ins
from vehicle_emulator.ins import GnssMode, InsFaults, NavigationSystem, Solution
from vehicle_emulator.ins.errors import Accuracy, ErrorModel, Errors
from vehicle_emulator.ins.receiver import Receiver
from vehicle_emulator.plants.interface import PlantState

CATALOGUE = load()
P = load_vehicle().ins
QUIET = P.model_copy(update={key: 0.0 for key in InsParameters.model_fields if "sigma" in key})
MS_NS = 1_000_000
CYCLE_NS = 10 * MS_NS
S_NS = 1_000_000_000
MODES = {raw: name for name, raw in CATALOGUE.enumeration("NcomStatus00", "PosMode").items()}
OUTAGE = InsFaults(gnss_mode="None")
MOVING = PlantState(x_m=5.0, y_m=-2.0, z_m=1.0, yaw_rad=0.5, vx_mps=20.0, yaw_rate_radps=0.1, ax_mps2=1.0)


class Drive:
    """An instrument in a car that stands, driven from cycle to cycle."""

    def __init__(self, parameters: InsParameters = P, seed: int = 1, state: PlantState = PlantState()) -> None:  # noqa: B008
        self.system = NavigationSystem(parameters, CATALOGUE, Random(seed), period_ns=MS_NS, start_ns=0, state=state)
        self.now_ns = 0

    def cycle(self, faults: InsFaults) -> Solution:
        self.now_ns += CYCLE_NS
        self.system.faults = faults
        return self.system.solution(self.now_ns)

    def run(self, duration_s: float, faults: InsFaults = InsFaults()) -> list[Solution]:  # noqa: B008
        return [self.cycle(faults) for _ in range(round(100 * duration_s))]

    def received(self, name: str) -> dict[str, float]:
        return self.system.message(name, self.now_ns)

    @property
    def mode(self) -> str:
        status = self.received("NcomStatus00")
        assert status["PosMode"] == status["VelMode"] == status["OriMode"]
        return MODES[int(status["PosMode"])]

    @property
    def accuracy_m(self) -> float:
        return self.received("NcomStatus03")["PosAccNorth"]


def test_modes_are_entries_of_the_dbc():
    assert set(ins.GNSS_MODES) <= set(MODES.values())


def test_a_fix_is_lost_at_once_and_found_again_rung_by_rung():
    receiver = Receiver(search_s=2.0, ambiguity_s=8.0, now_ns=0)
    assert receiver.update(1, GnssMode.RTK_INTEGER) is GnssMode.RTK_INTEGER
    assert receiver.update(2, GnssMode.NONE) is GnssMode.NONE
    entered: dict[str, float] = {}
    for k in range(1500):
        entered.setdefault(receiver.update(2 + k * CYCLE_NS, GnssMode.RTK_INTEGER), k / 100)
    assert entered == {"Search": 0.0, "SPS": 2.0, "Differential": 3.0, "RTKFloat": 4.0, "RTKInteger": 12.0}


@pytest.mark.parametrize("sky", ins.GNSS_MODES)
def test_reception_is_the_ceiling(sky: str):
    drive = Drive()
    drive.run(0.1, InsFaults(gnss_mode=sky))
    assert drive.mode == sky
    drive.run(30.0, InsFaults(gnss_mode=sky))
    assert drive.mode == sky
    drive.run(30.0)
    assert drive.mode == "RTKInteger"
    assert drive.received("NcomStatus00")["NumSats"] == 14


def test_fewer_satellites_with_every_rung():
    counts = []
    for sky in ("RTKInteger", "RTKFloat", "Differential", "SPS", "Search", "Blanked"):
        drive = Drive()
        drive.run(0.1, InsFaults(gnss_mode=sky))
        counts.append(drive.received("NcomStatus00")["NumSats"])
    assert counts == sorted(set(counts), reverse=True)


@pytest.mark.parametrize(("sky", "fix"), [("RTKFloat", P.rtk_float), ("Differential", P.differential), ("SPS", P.sps)])
def test_accuracies_follow_the_fix_within_two_seconds(sky: str, fix):
    drive = Drive()
    drive.run(0.05, InsFaults(gnss_mode=sky))
    assert drive.accuracy_m < 0.2 * fix.position_sigma_m
    drive.run(1.95, InsFaults(gnss_mode=sky))
    assert drive.accuracy_m == pytest.approx(fix.position_sigma_m, rel=0.06)
    assert drive.received("NcomStatus03")["PosAccDown"] == pytest.approx(1.5 * drive.accuracy_m)
    assert drive.received("NcomStatus04")["VelAccNorth"] == pytest.approx(fix.velocity_sigma_mps, rel=0.06)
    drive.run(15.0)
    assert drive.accuracy_m == pytest.approx(math.hypot(P.position_sigma_m, P.position_white_sigma_m), rel=0.1)


def errors_after(duration_s: float, fix: GnssFix | None, parameters: InsParameters = P) -> list[tuple[Errors, Accuracy]]:
    """Errors of many instruments, that long after RTK integer has become `fix`."""
    integer = GnssFix(position_sigma_m=P.position_sigma_m, velocity_sigma_mps=P.velocity_sigma_mps)
    models = [ErrorModel(parameters, Random(seed), integer) for seed in range(200)]
    return [([model.step(1.0, fix, 1.0) for _ in range(round(duration_s))][-1], model.accuracy()) for model in models]


@pytest.mark.parametrize("fix", [P.rtk_float, P.sps])
def test_with_a_coarse_fix_the_position_wanders_as_far_as_is_stated(fix: GnssFix):
    late = [errors.position_m for errors, _ in errors_after(40.0, fix)]
    sigma_m = fix.position_sigma_m * math.sqrt(1.0 - math.exp(-80.0 / P.position_correlation_s))
    for axis, share in enumerate((1.0, 1.0, 1.5)):
        assert pstdev(position_m[axis] for position_m in late) == pytest.approx(share * sigma_m, rel=0.15)


def test_a_lost_fix_makes_no_step():
    drive = Drive()
    before_m = drive.run(1.0)[-1].motion.position_m
    for sky in ("RTKFloat", "SPS", "None"):
        after_m = drive.run(0.01, InsFaults(gnss_mode=sky))[-1].motion.position_m
        assert math.dist(before_m, after_m) < 0.2
        before_m = after_m


def test_without_satellites_the_position_runs_away_as_the_square_of_time():
    smooth = P.model_copy(update={"velocity_sigma_mps": 0.0})
    at_s = {t: pstdev(errors.position_m[0] for errors, _ in errors_after(t, None, smooth)) for t in (1.0, 30.0, 60.0)}
    assert at_s[1.0] < 0.015
    assert at_s[60.0] == pytest.approx(0.5 * P.drift_acceleration_sigma_mps2 * 60.0**2, rel=0.15)  # 1 m
    assert at_s[60.0] / at_s[30.0] == pytest.approx(4.0, rel=0.05)


def test_the_velocity_is_that_of_the_running_away():
    calm = GnssFix(position_sigma_m=0.0, velocity_sigma_mps=0.0)
    model = ErrorModel(P, Random(1), calm)
    errors = [model.step(0.1, None, 0.0) for _ in range(600)]
    positions_m, velocities_mps = [e.position_m[0] for e in errors], [e.velocity_mps[0] for e in errors]
    assert abs(velocities_mps[-1]) > 1e-5
    for k in range(1, 600):
        assert 10.0 * (positions_m[k] - positions_m[k - 1]) == pytest.approx(0.5 * (velocities_mps[k] + velocities_mps[k - 1]), abs=1e-9)


def test_without_satellites_the_heading_turns_with_the_bias_of_the_gyroscope():
    still = P.model_copy(update={"heading_sigma_rad": 0.0, "heading_white_sigma_rad": 0.0})
    late, accuracies = zip(*errors_after(60.0, None, still), strict=True)
    assert pstdev(errors.yaw_rad for errors in late) == pytest.approx(60.0 * P.gyro_bias_sigma_radps, rel=0.15)
    assert accuracies[0].heading_rad == pytest.approx(60.0 * P.gyro_bias_sigma_radps, rel=0.01)


@pytest.mark.parametrize("duration_s", [5.0, 20.0, 60.0])
def test_stated_accuracy_is_the_spread_of_the_drift(duration_s: float):
    late = errors_after(duration_s, None)
    for axis in range(2):
        assert pstdev(errors.position_m[axis] / accuracy.position_m for errors, accuracy in late) == pytest.approx(1.0, rel=0.15)
        assert pstdev(errors.velocity_mps[axis] / accuracy.velocity_mps for errors, accuracy in late) == pytest.approx(1.0, rel=0.15)
    assert pstdev(errors.position_m[2] / accuracy.height_m for errors, accuracy in late) == pytest.approx(1.0, rel=0.15)


def test_the_position_steps_when_the_integers_come_back():
    drive = Drive(P.model_copy(update={"ambiguity_s": 15.0}), seed=4)
    drive.run(10.0, InsFaults(gnss_mode="RTKFloat"))
    floating = drive.run(5.0)
    assert drive.mode == "RTKFloat"
    before, after = floating[-1], drive.run(0.02)[-1]
    assert drive.mode == "RTKInteger"
    step_m = math.dist(before.motion.position_m, after.motion.position_m)
    assert step_m > 0.05
    usual_m = max(math.dist(a.motion.position_m, b.motion.position_m) for a, b in zip(floating[-200:-1], floating[-199:], strict=True))
    assert step_m > 2.0 * usual_m
    assert math.dist(after.motion.position_m, (0.0, 0.0, 0.0)) < 0.06
    assert drive.accuracy_m > 0.1  # the accuracies follow
    drive.run(3.0)
    assert drive.accuracy_m < 0.012


def test_after_an_outage_the_error_is_gone_with_the_integers():
    drive = Drive()
    drive.run(60.0, OUTAGE)
    drive.run(30.0)
    late = drive.run(5.0)
    assert drive.accuracy_m < 0.012
    assert drive.received("NcomStatus04")["VelAccNorth"] == pytest.approx(P.velocity_sigma_mps, rel=0.01)
    assert max(math.dist(s.motion.position_m, (0.0, 0.0, 0.0)) for s in late) < 0.1
    assert abs(fmean(s.motion.velocity_mps[0] for s in late)) < 0.003


def faulty(faults: InsFaults, parameters: InsParameters = QUIET) -> tuple[Solution, Drive]:
    drive = Drive(parameters, state=MOVING)
    return drive.run(0.05, faults)[-1], drive


def test_biases_are_added():
    good, _ = faulty(InsFaults())
    bad, drive = faulty(
        InsFaults(position_bias_m=(1.0, -2.0, 3.0), velocity_bias_mps=0.5, yaw_rate_bias_radps=0.1, acceleration_bias_mps2=-0.7)
    )
    assert bad.motion.position_m == pytest.approx((6.0, -4.0, 4.0))
    assert drive.received("VelocityLevel")["VelForward"] == pytest.approx(20.5)
    assert drive.received("Velocity")["Speed2D"] == pytest.approx(20.5)
    assert drive.received("RateVehicle")["AngRateZ"] == pytest.approx(-math.degrees(0.2))
    assert bad.motion.specific_force_mps2[0] - good.motion.specific_force_mps2[0] == pytest.approx(-0.7)
    assert bad.motion.yaw_rad == good.motion.yaw_rad


def test_a_wrong_heading_turns_the_velocity_of_the_car_but_not_of_the_ground():
    bad, drive = faulty(InsFaults(yaw_bias_rad=0.1))
    assert bad.motion.yaw_rad == pytest.approx(0.6)
    assert bad.motion.velocity_mps[:2] == pytest.approx((20.0 * math.cos(0.5), 20.0 * math.sin(0.5)))
    assert drive.received("VelocityLevel")["VelLateral"] == pytest.approx(20.0 * math.sin(0.1))  # seems to slide to the right


def test_frozen_means_that_only_time_goes_on():
    drive = Drive(state=MOVING)
    last = drive.run(1.0)[-1]
    frozen = drive.run(0.5, InsFaults(is_frozen=True))
    assert {s._replace(valid_ms=0) for s in frozen} == {last._replace(valid_ms=0)}
    assert [s.valid_ms - last.valid_ms for s in frozen] == list(range(10, 501, 10))
    moved_on = drive.run(0.01)[-1]
    assert moved_on.motion != last.motion
    assert abs(moved_on.motion.specific_force_mps2[1]) < 0.5  # no jerk from the time that was missed


def test_frozen_time_means_that_all_else_goes_on():
    drive = Drive(state=MOVING)
    last = drive.run(1.0)[-1]
    frozen = drive.run(0.5, InsFaults(is_time_frozen=True))
    assert {s.valid_ms for s in frozen} == {last.valid_ms}
    assert len({s.motion for s in frozen}) == len(frozen)
    assert drive.run(0.01)[-1].valid_ms - last.valid_ms == 510


def test_silence_ends_with_the_next_cycle_of_the_grid():
    drive = Drive()
    drive.system.faults = InsFaults(is_silent=True)
    assert all(drive.system.due(k * MS_NS) == () for k in range(1, 96))
    drive.system.faults = InsFaults()
    assert [k for k in range(96, 121) if drive.system.due(k * MS_NS)] == [100, 110, 120]


def test_a_silent_instrument_goes_on_losing_and_finding_its_fix():
    drive = Drive()

    def silent(duration_s: float, mode: str | None) -> None:
        drive.system.faults = InsFaults(is_silent=True, gnss_mode=mode)
        for _ in range(round(100 * duration_s)):
            drive.now_ns += CYCLE_NS
            assert drive.system.due(drive.now_ns) == ()

    silent(20.0, "None")
    drive.run(0.01)
    assert drive.mode == "Search"
    assert drive.accuracy_m > 5.0 * Drive().received("NcomStatus03")["PosAccNorth"]
    silent(14.0, None)
    drive.run(0.01)
    assert drive.mode == "RTKInteger"


@pytest.mark.parametrize(("extra_s", "steps"), [(0.0, 4), (0.0001, 4), (0.0006, 5), (0.01, 14), (1.0, 1004)])
def test_extra_latency_is_exact_to_the_step_in_data_and_time(extra_s: float, steps: int):
    system = NavigationSystem(QUIET, CATALOGUE, Random(1), period_ns=MS_NS, start_ns=0, state=PlantState())
    system.faults = InsFaults(latency_extra_s=extra_s)
    for k in range(1, 2001):
        system.observe(PlantState(x_m=0.02 * k))
    solution = system.solution(2000 * MS_NS)
    assert solution.motion.position_m[0] == pytest.approx(0.02 * (2000 - steps), abs=1e-9)
    system.faults = InsFaults()
    assert system.solution(2010 * MS_NS).valid_ms - solution.valid_ms == 10 + steps - 4


def test_noise_factor_is_on_what_is_white():
    def spread(factor: float) -> float:
        return pstdev(s.motion.rates_radps[2] for s in Drive(seed=2).run(20.0, InsFaults(noise_factor=factor)))

    assert spread(5.0) == pytest.approx(5.0 * P.yaw_rate_sigma_radps, rel=0.1)
    assert spread(0.0) < 0.01 * P.yaw_rate_sigma_radps


def test_faults_that_cannot_be_are_refused_with_one_line():
    drive = Drive()
    with pytest.raises(ValueError, match=r"^gnss_mode 'Galileo': expected one of None, Blanked, .*RTKInteger$"):
        drive.system.faults = InsFaults(gnss_mode="Galileo")
    for extra_s in (-0.001, 1.001, math.nan):
        with pytest.raises(ValueError, match=r"^latency_extra_s .*: expected 0 to 1$"):
            drive.system.faults = InsFaults(latency_extra_s=extra_s)
    assert drive.system.faults == InsFaults()


angles = st.floats(-10.0, 10.0)
rates = st.floats(-3.0, 3.0)
speeds = st.floats(-80.0, 80.0)
accelerations = st.floats(-50.0, 50.0)
states = st.fixed_dictionaries({
    "x_m": st.floats(-1e5, 1e5), "y_m": st.floats(-1e5, 1e5), "z_m": angles, "roll_rad": angles, "pitch_rad": st.floats(-1.57, 1.57),
    "yaw_rad": angles, "vx_mps": speeds, "vy_mps": speeds, "roll_rate_radps": rates, "yaw_rate_radps": rates,
    "ax_mps2": accelerations, "ay_mps2": accelerations,
})  # fmt: skip
faults = st.fixed_dictionaries({
    "yaw_bias_rad": angles, "is_frozen": st.booleans(), "is_time_frozen": st.booleans(), "noise_factor": st.floats(0.0, 10.0),
    "gnss_mode": st.sampled_from([None, *ins.GNSS_MODES]), "latency_extra_s": st.floats(0.0, 1.0),
    "position_bias_m": st.tuples(angles, angles, angles),
})  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(states, faults, st.integers(1, 200)), min_size=1, max_size=4))
def test_signals_are_numbers_whatever_happens(story: list[tuple[dict[str, float], dict[str, Any], int]]):
    drive = Drive()
    for state, fault, milliseconds in story:
        drive.system.observe(PlantState(**state))
        drive.system.faults = InsFaults(**fault)
        drive.now_ns += milliseconds * MS_NS
        for name in ins.MESSAGES:
            for signal, value in drive.received(name).items():
                assert math.isfinite(value), (name, signal)
                if not signal.startswith(("AngAccel", "AngRate", "Accel", "Iso", "Curvature")):  # an instrument saturates there
                    low, high = CATALOGUE.bounds(name, signal)
                    assert low - 0.005 <= value <= high + 0.005, (name, signal)
