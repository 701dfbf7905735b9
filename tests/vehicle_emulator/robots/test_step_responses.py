"""Step responses of the three robots against the analytic model: dead time, trapezoid of rate and acceleration, second order.

The trapezoid is a sum of parabolas, so the response to it is a sum of the second-order system's responses to a parabola.
"""

import math
from itertools import pairwise

import pytest

from dbc.frame import CanFrame
from tests.vehicle_emulator.robots.bench import VEHICLE, Bench, LiftedWheel, ideal
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.interface import PlantState, SteeringInputs

CAR = ideal()


def parabola_response(t_s: float, bandwidth_hz: float, damping_ratio: float) -> float:
    """Response of omega^2 / (s^2 + 2 zeta omega s + omega^2) to t^2 / 2, at rest before."""
    if t_s <= 0.0:
        return 0.0
    omega, zeta = 2.0 * math.pi * bandwidth_hz, damping_ratio
    level = (4.0 * zeta**2 - 1.0) / omega**2
    decay = math.exp(-zeta * omega * t_s)
    slope = 2.0 * zeta / omega - zeta * omega * level
    if zeta == 1.0:
        return t_s**2 / 2.0 - 2.0 * zeta / omega * t_s + level + decay * (-level + slope * t_s)
    damped = omega * math.sqrt(1.0 - zeta**2)
    return (
        t_s**2 / 2.0 - 2.0 * zeta / omega * t_s + level
        + decay * (-level * math.cos(damped * t_s) + slope / damped * math.sin(damped * t_s))
    )  # fmt: skip


def model(t_s: float, step: float, rate: float, acceleration: float, robot) -> float:
    """Analytic response to a step at 0."""
    up_s = min(rate / acceleration, math.sqrt(step / acceleration))
    cruise_s = max(0.0, (step - rate**2 / acceleration) / rate)
    after_s = t_s - robot.dead_time_s
    return acceleration * sum(
        sign * parabola_response(after_s - start_s, robot.bandwidth_hz, robot.damping_ratio)
        for sign, start_s in ((1, 0.0), (-1, up_s), (-1, up_s + cruise_s), (1, 2 * up_s + cruise_s))
    )


def largest_error(track: list[float], step: float, rate: float, acceleration: float, robot) -> float:
    """Largest difference, as a share of the step; entry k of the track is k + 1 milliseconds after the command."""
    errors = [abs(x - model((k + 1) * 1e-3, step, rate, acceleration, robot)) for k, x in enumerate(track)]
    assert abs(track[-1] - step) < 1e-3 * step  # the response is complete
    return max(errors) / step


def test_the_analytic_model_is_right_where_it_is_known():
    robot = CAR.robots.steering
    fast = [model(k * 1e-3, 1.0, 1e5, 1e9, robot) for k in range(400)]
    omega, zeta = 2.0 * math.pi * robot.bandwidth_hz, robot.damping_ratio
    overshoot = math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2))
    assert max(fast) == pytest.approx(1.0 + overshoot, abs=1e-4)
    assert fast.index(max(fast)) * 1e-3 == pytest.approx(0.020 + math.pi / (omega * math.sqrt(1.0 - zeta**2)), abs=1e-3)


def sr_track(step_rad: float, command_rate_dps: float = 2550.0, wheel: LiftedWheel | None = None) -> list[float]:
    bench, track = Bench(CAR, wheel=wheel).engage(), []
    gateway = bench.gateway

    def frames() -> list[CanFrame]:
        steering = gateway.steering(math.degrees(step_rad), rate_dps=command_rate_dps)
        return [gateway.safety("Engage"), steering, gateway.pedal("AR", 0.0), gateway.pedal("BR", 0.0)]

    for _ in range(1000):
        bench.send(1, frames)
        track.append(bench.wheel.angle_rad)
    return track


@pytest.mark.parametrize("step_deg", [2.0, 10.0, 45.0, 90.0, 270.0, 450.0])
def test_steering(step_deg: float):
    robot, step_rad = CAR.robots.steering, math.radians(step_deg)
    track = sr_track(step_rad)
    assert largest_error(track, step_rad, robot.rate_limit_radps, robot.acceleration_limit_radps2, robot) < 0.01


@pytest.mark.parametrize("step_deg", [5.0, 90.0, 400.0])
def test_steering_of_the_multibody_car_in_the_air_without_friction(step_deg: float):
    column = CAR.multibody.steering.model_copy(update={"friction_nm": 0.0})
    car = CAR.model_copy(update={"multibody": CAR.multibody.model_copy(update={"steering": column})})
    robot, step_rad = CAR.robots.steering, math.radians(step_deg)
    track = sr_track(step_rad, wheel=LiftedWheel(car))
    assert largest_error(track, step_rad, robot.rate_limit_radps, robot.acceleration_limit_radps2, robot) < 0.01


def test_steering_at_the_rate_of_the_command():
    robot, step_rad, rate_dps = CAR.robots.steering, math.radians(90.0), 200.0
    track = sr_track(step_rad, rate_dps)
    assert largest_error(track, step_rad, math.radians(rate_dps), robot.acceleration_limit_radps2, robot) < 0.01
    assert max(b - a for a, b in pairwise(track)) == pytest.approx(math.radians(rate_dps) * 1e-3, rel=3e-3)


def pedal_track(node: str, step_percent: float, rate_mmps: float = 2550.0) -> list[float]:
    bench, track = Bench(CAR).engage(), []
    gateway, percent = bench.gateway, {"AR": 0.0, "BR": 0.0, node: step_percent}

    def frames() -> list[CanFrame]:
        pedals = [gateway.pedal(name, percent[name], rate_mmps=rate_mmps) for name in ("AR", "BR")]
        return [gateway.safety("Engage"), gateway.steering(0.0), *pedals]

    for _ in range(1500):
        bench.send(1, frames)
        track.append(bench.inputs.accelerator_norm if node == "AR" else bench.inputs.brake_norm)
    return track


@pytest.mark.parametrize(("node", "robot"), [("AR", CAR.robots.accelerator), ("BR", CAR.robots.brake)])
@pytest.mark.parametrize("step_percent", [5.0, 20.0, 50.0, 100.0])
def test_pedals(node: str, robot, step_percent: float):
    track = pedal_track(node, step_percent)
    assert largest_error(track, 0.01 * step_percent, robot.rate_limit_per_s, robot.acceleration_limit_per_s2, robot) < 0.01


@pytest.mark.parametrize(("node", "robot"), [("AR", CAR.robots.accelerator), ("BR", CAR.robots.brake)])
def test_pedals_at_the_rate_of_the_command(node: str, robot):
    track = pedal_track(node, 80.0, rate_mmps=150.0)
    assert largest_error(track, 0.8, 0.150 / robot.stroke_m, robot.acceleration_limit_per_s2, robot) < 0.01


def test_a_servo_that_lacks_torque_is_slower():
    weak, strong = SteeringWheel(VEHICLE, 1e-3), SteeringWheel(VEHICLE, 1e-3)
    for _ in range(40):
        weak.step(SteeringInputs(demand_rad=1.0, torque_limit_nm=5.0))
        strong.step(SteeringInputs(demand_rad=1.0, torque_limit_nm=500.0))
    assert weak.angle_rad < 0.5 * strong.angle_rad


def test_real_robots_reach_their_demand_within_play_and_resolution():
    bench = Bench().engage().run(600, sr_deg=-45.0, br_percent=30.0)
    p = VEHICLE.robots.steering
    assert bench.wheel.angle_rad == pytest.approx(math.radians(-45.0), abs=0.5 * p.play_rad + p.resolution_rad)
    assert bench.inputs.brake_norm == pytest.approx(0.3, abs=VEHICLE.robots.brake.resolution_norm)
    status = bench.status("BR_Status")
    assert status["PositionActual"] == pytest.approx(30.0, abs=0.3)
    assert status["PositionStroke"] == pytest.approx(300.0 * VEHICLE.robots.brake.stroke_m, abs=0.5)
    assert bench.status("SR_Status")["AngleActual"] == pytest.approx(math.degrees(bench.wheel.angle_rad), abs=0.1)


def test_jitter_of_one_seed_repeats():
    def angles(seed: int) -> list[float]:
        bench, track = Bench(seed=seed).engage(), []
        for k in range(300):
            bench.step(bench.gateway.frames("Engage", sr_deg=10.0 * math.sin(0.02 * k)) if k % 10 == 0 else None)
            track.append(bench.wheel.angle_rad)
        return track

    assert angles(1) == angles(1) != angles(2)


def test_play_is_felt_when_the_wheel_turns_back():
    bench = Bench().engage().run(500, sr_deg=10.0)
    there = bench.wheel.angle_rad
    bench.run(500, sr_deg=9.6)  # less than the play of 0.5 degrees
    assert bench.wheel.angle_rad == pytest.approx(there, abs=1e-6)
    bench.run(500, sr_deg=9.0)
    assert bench.wheel.angle_rad < there - math.radians(0.3)


def test_an_engagement_begins_where_the_wheel_is():
    bench = Bench()
    bench.wheel.angle_rad = math.radians(40.0)
    bench.run(50, "Disarm", sr_deg=40.0).run(30, "Arm", sr_deg=40.0)
    before = bench.wheel.angle_rad
    start_deg = math.degrees(before)
    track = []
    for _ in range(100):
        bench.run(1, sr_deg=start_deg)
        track.append(bench.wheel.angle_rad)
    assert bench.state == "Engaged"
    assert max(abs(x - before) for x in track) < math.radians(0.6)
    assert bench.inputs.steering.torque_limit_nm == 60.0


def test_the_car_itself_is_not_needed_for_the_demand():
    bench = Bench(CAR).engage()
    bench.run(100, sr_deg=20.0)
    inputs = bench.system.step((bench.ms + 1) * 1_000_000, [], PlantState(steering_wheel_rad=0.0), bench.driver)
    assert inputs.steering.demand_rad == pytest.approx(math.radians(20.0), abs=0.01)
