"""The verdict: every figure on drives that are known exactly, and a reason for everything that can go wrong."""

import json
import math

import numpy as np
import pytest

from dbc.vehicle import load_vehicle
from tests.support.recorded_drive import RecordedDrive
from xil.metrics import Verdict, evaluate
from xil.recording import Recording
from xil.scenario import Stage, load_scenario

VEHICLE = load_vehicle()
ISO = load_scenario("iso3888-1")
LANE_KEEPING = load_scenario("lane-keeping")


def judged(scenario=ISO, stage=Stage.HIL, interruption="", **spoiled) -> Verdict:
    return evaluate(RecordedDrive(scenario, VEHICLE, **spoiled).recording, scenario, VEHICLE, stage, interruption)


def metric(verdict: Verdict, name: str):
    (found,) = [m for m in (*verdict.metrics, *verdict.timing) if m.name == name]
    return found


@pytest.fixture(scope="module")
def perfect() -> Verdict:
    return judged()


@pytest.mark.parametrize("scenario", [ISO, LANE_KEEPING], ids=lambda scenario: scenario.name)
@pytest.mark.parametrize("stage", list(Stage))
def test_perfect_drive_passes_at_every_stage(scenario, stage):
    verdict = judged(scenario, stage)
    assert verdict.passed, verdict.reason
    assert verdict.reason == "every limit kept"
    assert all(m.passed for m in (*verdict.metrics, *verdict.timing))


def test_perfect_drive_has_the_clearance_of_the_reference(perfect):
    clearances = [metric(perfect, f"clearance in gate {k}").value for k in (1, 2, 3)]
    assert clearances == pytest.approx([0.194, 0.211, 0.218], abs=0.002)


def test_perfect_drive_has_no_error_and_the_planned_acceleration(perfect):
    assert metric(perfect, "lateral error, largest").value == pytest.approx(0.0, abs=1e-6)
    assert metric(perfect, "speed error, RMS").value == pytest.approx(0.0, abs=1e-6)
    assert metric(perfect, "lateral acceleration, largest").value == pytest.approx(6.85, abs=0.1)
    assert metric(perfect, "engaged at station").value == pytest.approx(-120.0 + 22.2 * 1.0, abs=0.5)


def test_known_errors_are_measured():
    verdict = judged(LANE_KEEPING, left_of_reference_m=lambda s: 0.06, yaw_error_rad=math.radians(-0.5), speed_factor=0.99)
    assert metric(verdict, "lateral error, RMS").value == pytest.approx(0.06, abs=1e-3)
    assert metric(verdict, "lateral error, largest").value == pytest.approx(0.06, abs=1e-3)
    assert metric(verdict, "heading error, largest").value == pytest.approx(0.5, abs=0.01)
    assert metric(verdict, "speed error, RMS").value == pytest.approx(0.01 * 60.0 / 3.6, abs=1e-3)
    assert metric(verdict, "entry speed error").value == pytest.approx(0.6, abs=0.01)
    assert metric(verdict, "smallest room in the corridor").value == pytest.approx(1.75 - 1.823 / 2.0 - 0.06, abs=1e-3)


def test_error_before_the_judged_part_is_not_judged():
    verdict = judged(LANE_KEEPING, left_of_reference_m=lambda s: -0.3 * math.exp(-s / 15.0))
    assert verdict.passed
    assert metric(verdict, "lateral error, largest").value < 0.001


def test_touched_gate_is_named_with_place_and_depth():
    # 0.33 m to the right in the second gate, where the outline has 0.307 m on the straight.
    verdict = judged(left_of_reference_m=lambda s: -0.33 if 55.0 < s < 60.0 else 0.0)
    assert not verdict.passed
    assert verdict.reason.startswith("gate 2 touched by 0.0")
    depth_m = -metric(verdict, "clearance in gate 2").value
    assert depth_m == pytest.approx(0.33 - (2.4376 - 1.823) / 2.0, abs=0.01)
    assert 52.0 < float(verdict.reason.split("x = ")[1].removesuffix(" m")) < 63.0


def test_silent_controller_is_the_reason_and_that_the_car_stopped():
    verdict = judged(leaves_engaged=(6.31, "SAFE_STOP", "controller silent: command older than 100 ms"))
    assert verdict.reason == "controller silent: command older than 100 ms at t = 6.31 s, the car stopped"
    assert metric(verdict, "disengagements before the end").value == 1.0
    assert metric(verdict, "time engaged").value == pytest.approx(5.31, abs=0.02)
    assert not metric(verdict, "station reached").passed


def test_car_that_rolls_on_after_a_fault_is_said_to():
    verdict = judged(leaves_engaged=(6.0, "FAULT", "robot fault: SR"), duration_s=7.0)
    assert verdict.reason == "robot fault: SR at t = 6.00 s, the car did not stop"


def test_driver_who_takes_over_ends_the_run():
    verdict = judged(leaves_engaged=(6.0, "STANDBY", "driver override"))
    assert verdict.reason == "driver override at t = 6.00 s, the car stopped"


def test_disengagement_that_the_operator_asked_for_after_the_end_is_none():
    verdict = judged(leaves_engaged=(20.1, "STANDBY", "operator disengaged"))
    assert verdict.passed, verdict.reason


def test_safe_stop_after_the_end_is_none():
    verdict = judged(leaves_engaged=(20.1, "SAFE_STOP", "controller silent: command older than 100 ms"))
    assert verdict.passed, verdict.reason


def test_operator_who_gives_up_early_leaves_the_drive_incomplete():
    verdict = judged(leaves_engaged=(7.8, "STANDBY", "operator disengaged"))
    assert verdict.reason.startswith("not completed: the car got to 1")


def test_drive_that_never_engaged_says_what_was_in_the_way():
    verdict = judged(engaged_s=math.inf, blockers=("robots not ready", "dead-man not pressed"))
    assert verdict.reason == "never engaged: robots not ready, dead-man not pressed"


def test_engagement_after_the_first_gate_began_is_too_late():
    verdict = judged(engaged_s=5.8)
    assert verdict.reason.startswith("engaged too late: at 8.9 m, the judged part begins at 0.0 m")


def test_drive_cut_short_is_not_completed():
    verdict = judged(duration_s=9.8)
    assert verdict.reason.startswith("not completed: the car got to 97.")
    assert metric(verdict, "final speed").value == pytest.approx(80.0 / 3.6)


def test_car_that_still_rolls_fails():
    verdict = judged(duration_s=16.8)
    assert verdict.reason.startswith("the car still rolled at ")


def test_gate_that_was_not_reached_is_no_passed_gate():
    verdict = judged(duration_s=6.8)
    assert metric(verdict, "clearance in gate 2").failure == "gate 2 not reached"
    assert metric(verdict, "clearance in gate 2").value is None


def test_wrong_entry_speed_fails():
    verdict = judged(speed_factor=0.95)
    assert metric(verdict, "entry speed error").value == pytest.approx(4.0, abs=0.01)
    assert verdict.reason == "entry speed error 4.00 km/h, limit 3 km/h"


def test_left_corridor_fails_with_the_place():
    verdict = judged(LANE_KEEPING, left_of_reference_m=lambda s: 0.9 if 200.0 < s < 220.0 else 0.0)
    assert verdict.reason.startswith("corridor left by 0.06")
    assert "at station 2" in verdict.reason


def test_missing_poses_make_the_recording_incomplete():
    verdict = judged(keep=lambda topic, t_s: topic != "world" or not 5.0 < t_s < 5.075)
    assert verdict.reason == "recording incomplete: no pose of the car for 80 ms at t = 5.00 s, limit 50 ms"
    assert metric(verdict, "poses lost").value == 7.0


def test_few_lost_poses_are_counted_not_judged():
    verdict = judged(keep=lambda topic, t_s: topic != "world" or not 5.0 < t_s < 5.035)
    assert verdict.passed, verdict.reason
    assert metric(verdict, "poses lost").value == 3.0


def test_gap_before_engagement_does_not_matter():
    verdict = judged(keep=lambda topic, t_s: topic != "world" or not 0.2 < t_s < 0.4)
    assert verdict.passed, verdict.reason


def test_vehicle_in_the_loop_is_judged_by_the_state_estimate():
    keep = {"keep": lambda topic, t_s: topic != "world"}
    assert judged(stage=Stage.VEHIL, **keep).passed
    verdict = judged(stage=Stage.HIL, **keep)
    assert verdict.reason == "nothing to judge: no sample of 'world' was recorded"


def test_failed_commands_fail_and_degraded_ones_are_counted():
    verdict = judged(command_status=lambda t_s: "FAILED" if 5.0 <= t_s < 5.1 else "DEGRADED" if 6.0 <= t_s < 6.1 else "OK")
    assert verdict.reason == "commands without a usable solution: 3"
    assert metric(verdict, "degraded commands").value == 3.0


def test_slow_solver_fails_in_real_time_only():
    slow = {"solve_time_ms": lambda t_s: 45.0 if t_s % 2.0 < 0.3 else 3.0}
    verdict = judged(stage=Stage.HIL, **slow)
    assert verdict.reason == "solve time, 99th percentile 45.00 ms, limit 40 ms"
    assert metric(verdict, "solves longer than the sample time").value > 30
    in_virtual_time = judged(stage=Stage.SIL, **slow)
    assert in_virtual_time.passed
    assert metric(in_virtual_time, "solve time, 99th percentile").limit is None


def test_one_slow_solve_is_shown_not_judged():
    verdict = judged(solve_time_ms=lambda t_s: 55.0 if 5.0 <= t_s < 5.04 else 3.0)
    assert verdict.passed, verdict.reason
    assert metric(verdict, "solve time, largest").value == 55.0


def test_real_time_without_any_command_recorded_is_not_passed():
    verdict = judged(keep=lambda topic, t_s: topic != "command")
    assert verdict.reason == "solve time, mean could not be measured"


def test_metrics_in_lockstep_do_not_depend_on_the_machine():
    quick, slow = (judged(stage=Stage.SIL, solve_time_ms=lambda t_s, ms=ms: ms) for ms in (2.0, 30.0))
    assert quick.metrics == slow.metrics
    assert quick.timing != slow.timing


def test_interruption_begins_the_reason():
    assert judged(interruption="gateway died").reason == "gateway died"
    spoiled = {"leaves_engaged": (6.0, "SAFE_STOP", "controller silent"), "interruption": "controller died (killed)"}
    assert judged(**spoiled).reason == "controller died (killed); controller silent at t = 6.00 s, the car stopped"
    assert evaluate(Recording(0), ISO, VEHICLE, Stage.HIL, "bus died").reason == "bus died"


def test_figures_are_plain_numbers(perfect):
    values = [m.value for m in (*perfect.metrics, *perfect.timing)]
    assert all(isinstance(value, float) and not isinstance(value, np.floating) for value in values)
    assert json.loads(json.dumps(values)) == values


def test_commands_before_engagement_are_not_judged():
    verdict = judged(command_status=lambda t_s: "FAILED" if t_s < 0.5 else "OK", solve_time_ms=lambda t_s: 90.0 if t_s < 0.9 else 3.0)
    assert verdict.passed, verdict.reason
    assert metric(verdict, "solve time, largest").value == 3.0
