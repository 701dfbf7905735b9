"""The control loop: closed loop on a car that is not the model, failures, and that nothing but finite numbers comes out."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.bench.loop import drive
from controller.bench.scenarios import Scenario, nominal_scenarios
from controller.disturbance import DisturbanceOptions
from controller.nmpc import DRIVE_MODEL, Nmpc, NmpcOptions
from controller.planning.obstacles import Obstacle
from controller.planning.options import PlannerOptions
from controller.problem import SINGLE_TRACK, SINGLE_TRACK_LAG, OcpOptions
from controller.samples import command_sample, plan_sample
from controller.solver import Effort, SolveResult, SolveStatus, WarmStart
from controller.solvers import make_solver
from gateway.messages import CommandStatus, ControlCommand, Mode, VehicleState, pack, unpack
from gateway.telemetry import decode, topic_of

KEY = bytes(range(32))
PERIOD_NS = 40_000_000
SCENARIOS = {scenario.name: scenario for scenario in nominal_scenarios()}


def state_on(path, seq=0, t_ns=0, mode=Mode.ENGAGED, **changes):
    row = 20
    numbers = {
        "x_m": float(path.x_m[row]), "y_m": float(path.y_m[row]), "yaw_rad": float(path.yaw_rad[row]), "vx_mps": float(path.speed_mps[row]),
        "vy_mps": 0.0, "yaw_rate_radps": 0.0, "ax_mps2": 0.0, "steer_rad": 0.0, "drive_norm": 0.05,
    }  # fmt: skip
    return VehicleState(boot_id=7, seq=seq, t_ns=t_ns, mode=mode, is_valid=True, **{**numbers, **changes})


FULL_DRIVE_MPS2 = 1500.0 / 0.31 / 1500.0  # of the model at t_r = 1


class StubSolver:
    """Answers with what the test says; straight ahead otherwise."""

    name = "stub"
    warm_start = None

    def __init__(self) -> None:
        self.status, self.solve_time_ns, self.asked, self.begun_from = SolveStatus.CONVERGED, 0, [], []
        self.options = OcpOptions()
        self.drive_norm = None

    def solve(self, state, previous_input, horizon):
        self.asked.append((state, previous_input, horizon))
        self.begun_from.append(self.warm_start)
        layout = self.options.layout
        self.warm_start = WarmStart(*(np.full(n, len(self.asked)) for n in (layout.n_variables, layout.n_variables, layout.n_constraints)))
        self.seen_options = self.options
        value = np.nan if self.status is SolveStatus.NOT_FINITE else 0.01 * np.arange(30.0)[:, None] * np.ones(2)
        inputs = np.array(np.broadcast_to(value, (30, 2)))
        if self.drive_norm is not None:
            inputs[:, 1] = self.drive_norm
        return SolveResult(self.status, np.tile(state, (31, 1)), inputs, 0.0, 0.0, Effort(1, 1), self.solve_time_ns)

    def advance(self, state, inputs, duration_s):
        return state + np.append(duration_s * FULL_DRIVE_MPS2 * inputs[1], np.zeros(5))

    def reset(self):
        self.warm_start = None


@pytest.fixture
def stub():
    return StubSolver()


@pytest.fixture
def loop(stub, wavy_path, vehicle):
    return Nmpc(stub, wavy_path, vehicle, boot_id=5, options=NmpcOptions(deadline_ns=PERIOD_NS, disturbance=None))


@pytest.mark.parametrize("name", SCENARIOS)
def test_nominal_scenarios_converge_always_and_stay_on_the_path(solver, vehicle, name):
    scenario = SCENARIOS[name]
    outputs, states = drive(Nmpc(solver, scenario.path, vehicle, boot_id=1), vehicle, scenario, seed=2)
    results = [output.solution.result for output in outputs]
    assert all(output.command.status is CommandStatus.OK for output in outputs)
    assert np.percentile([result.effort.sqp_iterations for result in results], 95) <= 2  # as the paper reports
    errors = np.abs([output.solution.lateral_error_m for output in outputs])
    assert errors.max() < {"dlc80": 0.25, "lane60": 0.55, "park10": 0.20}[name]  # lane60 starts 0.5 m beside
    assert errors[-25:].max() < 0.15
    speed_errors = np.array([output.solution.speed_error_mps for output in outputs[100:]])
    assert np.sqrt(np.mean(speed_errors**2)) < 0.3
    assert np.abs(states[-1, 1]) < 0.5


@pytest.mark.parametrize(
    "changes",
    [{"offset_m": 0.5}, {"offset_m": -0.5}, {"speed_mps": 80 / 3.6 + 5.0}, {"speed_mps": 80 / 3.6 - 5.0}, {"offset_m": 1.2}],
    ids=str,
)
def test_a_start_beside_the_path_or_off_its_speed_is_feasible(solver, vehicle, changes):
    scenario = replace(SCENARIOS["dlc80"], duration_s=4.0, **changes)
    outputs, _ = drive(Nmpc(solver, scenario.path, vehicle, boot_id=1), vehicle, scenario, seed=3)
    assert all(output.command.status is CommandStatus.OK for output in outputs)
    assert abs(outputs[-1].solution.lateral_error_m) < 0.25


def test_delay_compensation_steadies_the_steering(solver, vehicle):
    """The same drive, blind to the delay: it steers visibly more for the same path."""

    def work(delays_s):
        solver.reset()
        scenario = SCENARIOS["dlc80"]
        outputs, _ = drive(Nmpc(solver, scenario.path, vehicle, 1, NmpcOptions(delays_s=delays_s)), vehicle, scenario, seed=1)
        return np.abs(np.diff([output.command.steer_rad for output in outputs], n=2)).sum()

    assert work(None) < 0.9 * work((0.0, 0.0))


def test_two_runs_are_the_same_to_the_last_bit(solver, vehicle):
    def run():
        solver.reset()
        scenario: Scenario = replace(SCENARIOS["dlc80"], duration_s=1.0)
        outputs, _ = drive(Nmpc(solver, scenario.path, vehicle, 1), vehicle, scenario, seed=1)
        return [pack(replace(output.command, solve_time_ns=0), KEY) for output in outputs]

    assert run() == run()


def test_a_command_answers_its_state(loop, wavy_path):
    output = loop.step(state_on(wavy_path, seq=42, t_ns=995), 1_000)
    command = output.command
    assert (command.boot_id, command.seq, command.state_seq, command.t_ns) == (5, 1, 42, 1_000)
    assert command.status is CommandStatus.OK
    assert (command.steer_rad, command.drive_norm) == (command.plan_steer_rad[0], command.plan_drive_norm[0])
    assert command.plan_steer_rad == pytest.approx(tuple(0.01 * np.arange(30)))
    assert loop.step(state_on(wavy_path, seq=43), 2_000).command.seq == 2
    assert unpack(pack(command, KEY), KEY) == command


CAR_AHEAD = Obstacle("car", 500.0, 0.0, 0.0, 4.0, 1.8)
FAILURES = {
    "not converged": ({"status": SolveStatus.NOT_CONVERGED}, {}, ()),
    "not finite": ({"status": SolveStatus.NOT_FINITE}, {}, ()),
    "late": ({"solve_time_ns": PERIOD_NS + 1}, {}, ()),
    "state not valid": ({}, {"is_valid": False}, ()),
    "state too old": ({}, {"t_ns": -200_000_000}, ()),
    "state from the future": ({}, {"t_ns": 2_000_000_000}, ()),
    "position off the planet": ({}, {"x_m": 1e200}, ()),
    "position not finite": ({}, {"x_m": math.nan}, ()),
    "steering not finite": ({}, {"steer_rad": math.inf}, ()),
    "heading not finite": ({}, {"yaw_rad": math.inf}, ()),
    "object not finite": ({}, {}, (replace(CAR_AHEAD, x_m=math.nan),)),
    "object without size": ({}, {}, (CAR_AHEAD, replace(CAR_AHEAD, width_m=0.0))),
}


@pytest.mark.parametrize("name", FAILURES)
def test_every_failure_degrades_then_fails_then_recovers(loop, stub, wavy_path, name):
    of_solver, of_state, objects = FAILURES[name]
    good = state_on(wavy_path)
    statuses = [loop.step(good, 0).command.status]
    for attribute, value in of_solver.items():
        setattr(stub, attribute, value)
    for cycle in range(1, 6):
        now_ns = cycle * PERIOD_NS
        output = loop.step(replace(good, **{"t_ns": now_ns, **of_state}), now_ns, objects)
        statuses.append(output.command.status)
        assert output.command.plan_steer_rad[0] == pytest.approx(0.01 * cycle)  # the old plan, where it would be now
        assert unpack(pack(output.command, KEY), KEY) == output.command
        assert decode("command", msgspec.json.encode(command_sample(output, "stub", 0))) is not None
    assert statuses == [CommandStatus.OK] + [CommandStatus.DEGRADED] * 3 + [CommandStatus.FAILED] * 2
    stub.status, stub.solve_time_ns = SolveStatus.CONVERGED, 0
    assert loop.step(replace(good, t_ns=6 * PERIOD_NS), 6 * PERIOD_NS).command.status is CommandStatus.OK


def test_virtual_time_knows_no_late_solve(stub, wavy_path, vehicle):
    stub.solve_time_ns = 10 * PERIOD_NS
    assert Nmpc(stub, wavy_path, vehicle, 1).step(state_on(wavy_path), 0).command.status is CommandStatus.OK


def test_without_any_plan_the_command_is_failed_and_zero(loop, wavy_path):
    output = loop.step(state_on(wavy_path, vx_mps=math.nan), 0)
    assert output.command.status is CommandStatus.FAILED
    assert not any(output.command.plan_steer_rad)
    assert plan_sample(output) is None


def test_while_someone_else_drives_his_inputs_are_the_previous_ones(loop, stub, wavy_path):
    loop.step(state_on(wavy_path, mode=Mode.READY, steer_rad=0.2, drive_norm=-0.3), 0)
    loop.step(state_on(wavy_path, mode=Mode.READY, steer_rad=0.25, drive_norm=-0.3, t_ns=PERIOD_NS), PERIOD_NS)
    np.testing.assert_array_equal(stub.asked[1][1], (0.25, -0.3))
    loop.step(state_on(wavy_path, steer_rad=0.9, drive_norm=0.9, t_ns=2 * PERIOD_NS), 2 * PERIOD_NS)
    np.testing.assert_array_equal(stub.asked[2][1], (0.0, 0.0))  # engaged: our own last command


def test_the_heading_passes_pi_without_a_jump(loop, stub, wavy_path):
    for cycle, yaw in enumerate((3.10, 3.14, -3.12, -3.08)):
        loop.step(state_on(wavy_path, yaw_rad=yaw, t_ns=cycle * PERIOD_NS), cycle * PERIOD_NS)
    headings = [asked[0][5] for asked in stub.asked]
    assert np.max(np.abs(np.diff(headings))) < 0.1
    references = [asked[2].reference[0, 5] for asked in stub.asked]
    assert np.max(np.abs(np.diff(references))) < 0.1


def test_a_solver_of_another_horizon_is_refused(stub, wavy_path, vehicle):
    stub.options = OcpOptions(horizon_steps=20)
    with pytest.raises(ValueError, match="30 steps"):
        Nmpc(stub, wavy_path, vehicle, 1)


wild = st.one_of(st.floats(-50.0, 50.0), st.floats())


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(*[wild] * 9, st.sampled_from(list(Mode)), st.booleans()), min_size=1, max_size=4))
def test_whatever_is_measured_the_command_is_finite(solver, wavy_path, vehicle, rows):
    names = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps", "ax_mps2", "steer_rad", "drive_norm")
    nmpc = Nmpc(solver, wavy_path, vehicle, 1)
    for cycle, (*numbers, mode, is_valid) in enumerate(rows):
        now_ns = cycle * PERIOD_NS
        output = nmpc.step(VehicleState(1, cycle, now_ns, mode, is_valid, **dict(zip(names, numbers, strict=True))), now_ns)
        command = output.command
        assert isinstance(command, ControlCommand)
        assert np.isfinite([command.steer_rad, command.drive_norm, *command.plan_steer_rad, *command.plan_drive_norm]).all()
        if command.status is CommandStatus.OK:
            assert np.abs(command.plan_steer_rad).max() <= 0.55 + 1e-6
            assert np.abs(command.plan_drive_norm).max() <= 1.0 + 1e-6


def test_samples_carry_the_plan_and_the_corridor(solver, wavy_path, vehicle):
    output = Nmpc(solver, wavy_path, vehicle, 1).step(state_on(wavy_path, seq=9), 0)
    command, plan = command_sample(output, "casadi-c", 2_500_000), plan_sample(output)
    assert (command.status, command.solver, command.state_seq, command.step_time_ms) == ("OK", "casadi-c", 9, 2.5)
    assert command.sqp_iterations == output.solution.result.effort.sqp_iterations
    assert plan.x_m[0] == pytest.approx(output.solution.start[3])
    left = np.hypot(np.subtract(plan.left_x_m, plan.reference_x_m), np.subtract(plan.left_y_m, plan.reference_y_m))
    right = np.hypot(np.subtract(plan.right_x_m, plan.reference_x_m), np.subtract(plan.right_y_m, plan.reference_y_m))
    np.testing.assert_allclose(left, 2.0)
    np.testing.assert_allclose(right, 1.5)
    assert plan.left_y_m[0] > plan.reference_y_m[0] > plan.right_y_m[0]
    assert {len(value) for value in (plan.x_m, plan.left_x_m, plan.reference_y_m)} == {31}
    assert (topic_of(command), topic_of(plan)) == ("command", "plan")


@pytest.mark.parametrize(("status", "next_guess"), [(SolveStatus.NOT_CONVERGED, 1.0), (SolveStatus.NOT_FINITE, 1.0)])
def test_after_a_failure_the_solver_begins_from_the_last_good_answer(loop, stub, wavy_path, status, next_guess):
    good = state_on(wavy_path)
    loop.step(good, 0)
    stub.status = status
    loop.step(replace(good, t_ns=PERIOD_NS), PERIOD_NS)
    loop.step(replace(good, t_ns=2 * PERIOD_NS), 2 * PERIOD_NS)
    assert stub.begun_from[0] is None
    assert [guess.w[0] for guess in stub.begun_from[1:]] == [next_guess] * 2  # never from the failed answers 2 and 3


def test_after_a_late_answer_the_solver_begins_from_it(loop, stub, wavy_path):
    good = state_on(wavy_path)
    loop.step(good, 0)
    stub.solve_time_ns = PERIOD_NS + 1
    loop.step(replace(good, t_ns=PERIOD_NS), PERIOD_NS)
    loop.step(replace(good, t_ns=2 * PERIOD_NS), 2 * PERIOD_NS)
    assert stub.begun_from[2].w[0] == 2.0


class Interrupted:
    """A solver whose answers in some cycles are bad, and leave a bad guess behind."""

    def __init__(self, solver, failing):
        self._solver, self._failing, self.results = solver, failing, []
        self.name, self.advance, self.reset = solver.name, solver.advance, solver.reset

    options = property(lambda self: self._solver.options, lambda self, value: setattr(self._solver, "options", value))
    warm_start = property(lambda self: self._solver.warm_start, lambda self, value: setattr(self._solver, "warm_start", value))

    def solve(self, *problem):
        result = self._solver.solve(*problem)
        if len(self.results) in self._failing:
            guess = self.warm_start
            self.warm_start = WarmStart(*(1e3 * np.ones_like(part) for part in (guess.w, guess.lam_w, guess.lam_g)))
            result = replace(result, status=SolveStatus.NOT_CONVERGED)
        self.results.append(result)
        return result


def test_a_primed_solver_converges_faster_than_a_cold_one(solver, vehicle, monkeypatch):
    """In the middle of a lane change three solves fail; the fourth needs less from the old plan than from nothing."""

    def iterations_after_failure():
        interrupted, scenario = Interrupted(solver, {50, 51, 52}), replace(SCENARIOS["dlc80"], duration_s=2.4)
        outputs, _ = drive(Nmpc(interrupted, scenario.path, vehicle, 1), vehicle, scenario, seed=1)
        assert outputs[53].command.status is CommandStatus.OK
        return interrupted.results[53].effort.sqp_iterations

    primed = iterations_after_failure()
    monkeypatch.setattr("controller.fallback.Fallback.guess", lambda self, now_ns: None)
    assert primed < iterations_after_failure()


def test_parameters_take_effect_at_the_next_step_and_all_at_once(loop, stub, wavy_path):
    good = state_on(wavy_path, vx_mps=10.0)
    loop.step(good, 0)
    heavier = OcpOptions(state_weights=(2.0, 0.02, 0.02, 5.0, 5.0, 100.0))
    loop.tune(heavier, PlannerOptions(speed_margin_mps=0.0, acceleration_mps2=0.5))
    assert stub.options == OcpOptions()
    output = loop.step(replace(good, t_ns=PERIOD_NS), PERIOD_NS)
    assert stub.seen_options == heavier
    assert output.solution.horizon.reference[-1, 0] == pytest.approx(10.0 + 0.5 * 1.2, abs=0.05)


def test_parameters_that_are_written_into_the_code_are_refused_whole(loop, stub, wavy_path):
    with pytest.raises(ValueError, match="written into"):
        loop.tune(OcpOptions(integrator_steps=5, state_weights=(9.0,) * 6), PlannerOptions(speed_margin_mps=0.0))
    output = loop.step(state_on(wavy_path, vx_mps=10.0), 0)
    assert stub.seen_options == OcpOptions()
    assert output.solution.horizon.reference[0, 0] == pytest.approx(11.0, abs=0.1)


def test_the_disturbance_shifts_the_problem_and_the_command_is_shifted_back(stub, wavy_path, vehicle):
    """0.3 is commanded all the time, and the car keeps its speed; the stub's model would accelerate."""
    loop, shift = Nmpc(stub, wavy_path, vehicle, 1), 0.0
    for cycle in range(200):
        now_ns, stub.drive_norm = cycle * PERIOD_NS, 0.3 + shift
        output = loop.step(state_on(wavy_path, t_ns=now_ns, vx_mps=16.0), now_ns)
        shift = output.disturbance_mps2 / FULL_DRIVE_MPS2
    assert output.disturbance_mps2 == pytest.approx(-0.3 * FULL_DRIVE_MPS2, rel=0.01)
    assert stub.seen_options.input_bounds[1] == pytest.approx((-1.0 + shift, 1.0 + shift))
    assert output.command.drive_norm == pytest.approx(0.3, abs=0.01)
    assert stub.asked[-1][1][1] == pytest.approx(0.3 + shift, abs=0.01)  # the previous input in the problem's terms
    assert stub.options == OcpOptions()  # as it was found
    stub.drive_norm = 1.2 + shift
    command = loop.step(state_on(wavy_path, t_ns=200 * PERIOD_NS, vx_mps=16.0), 200 * PERIOD_NS).command
    assert command.plan_drive_norm == (1.0,) * 30


def end_of(path, t_ns, **changes):
    return replace(state_on(path, t_ns=t_ns), x_m=float(path.x_m[-1]) + 0.5, y_m=float(path.y_m[-1]), vx_mps=0.0, **changes)


def test_a_car_that_is_to_stand_is_held_by_the_brake(stub, wavy_path, vehicle):
    """The model drives backwards when it brakes at rest, so that the solver lets the brake go; on a slope the car would roll."""
    loop, stub.drive_norm = Nmpc(stub, wavy_path, vehicle, 1), 0.03
    loop.step(end_of(wavy_path, 0, mode=Mode.READY), 0)
    commands = [loop.step(end_of(wavy_path, k * PERIOD_NS), k * PERIOD_NS).command for k in range(1, 30)]
    drives = np.array([command.drive_norm for command in commands])
    assert (np.diff(drives) <= 0.0).all()
    assert np.abs(np.diff(drives)).max() < 0.1
    assert drives[-1] == -1.0
    assert all(command.status is CommandStatus.OK and min(command.plan_drive_norm) >= -1.0 for command in commands)
    assert commands[-1].plan_drive_norm == (-1.0,) * 30
    np.testing.assert_allclose(stub.asked[-1][1], (0.0, 0.0), atol=1e-3)  # in the model nothing brakes

    noisy = loop.step(replace(end_of(wavy_path, 30 * PERIOD_NS), vx_mps=0.7), 30 * PERIOD_NS).command
    assert noisy.drive_norm == -1.0
    rolling = loop.step(end_of(wavy_path, 31 * PERIOD_NS, mode=Mode.READY), 31 * PERIOD_NS).command
    assert rolling.drive_norm == pytest.approx(0.03, abs=1e-3)


def test_a_car_that_is_held_drives_on_when_the_reference_does(stub, wavy_path, vehicle):
    loop, stub.drive_norm = Nmpc(stub, wavy_path, vehicle, 1), 0.2
    loop.step(state_on(wavy_path), 0)
    wall = (Obstacle("wall", 12.5, float(wavy_path.y_m[25]), np.pi / 2, 12.0, 0.5),)
    standing = replace(state_on(wavy_path), vx_mps=0.0)
    held = [loop.step(replace(standing, t_ns=k * PERIOD_NS), k * PERIOD_NS, wall).command.drive_norm for k in range(1, 30)]
    assert held[-1] == -1.0
    flickering = [wall if k % 4 == 0 else () for k in range(60)]
    flickers = [loop.step(replace(standing, t_ns=k * PERIOD_NS), k * PERIOD_NS, flickering[k]).command.drive_norm for k in range(30, 60)]
    assert flickers == [-1.0] * 30  # a report that comes and goes must not saw at the brake
    gone = [loop.step(replace(standing, t_ns=k * PERIOD_NS), k * PERIOD_NS).command.drive_norm for k in range(60, 75)]
    assert gone[-1] > 0.1


def test_time_that_goes_back_is_no_exception(stub, wavy_path, vehicle):
    loop = Nmpc(stub, wavy_path, vehicle, 1)
    for k in (50, 51, 1, 2):
        output = loop.step(replace(state_on(wavy_path), t_ns=k * PERIOD_NS), k * PERIOD_NS)
        assert math.isfinite(output.command.steer_rad)


def test_a_moving_car_is_not_held(stub, wavy_path, vehicle):
    loop, stub.drive_norm = Nmpc(stub, wavy_path, vehicle, 1, NmpcOptions(disturbance=None)), -0.4
    loop.step(replace(end_of(wavy_path, 0, mode=Mode.READY), vx_mps=2.0), 0)
    output = loop.step(replace(end_of(wavy_path, PERIOD_NS), vx_mps=2.0), PERIOD_NS)
    assert not output.solution.horizon.reference[:, 0].all()
    assert output.command.plan_drive_norm == (-0.4,) * 30


@pytest.fixture(scope="module")
def lag_solver(vehicle):
    return make_solver("casadi-c", vehicle.model, OcpOptions(model=SINGLE_TRACK_LAG), print)


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_model_with_lag_drives_as_well(lag_solver, vehicle, name):
    scenario = replace(SCENARIOS[name], duration_s=min(SCENARIOS[name].duration_s, 8.0))
    outputs, _ = drive(Nmpc(lag_solver, scenario.path, vehicle, boot_id=1), vehicle, scenario, seed=2)
    assert all(output.command.status is CommandStatus.OK for output in outputs)
    assert outputs[-1].plan.states.shape == (31, 8)
    errors = np.abs([output.solution.lateral_error_m for output in outputs])
    assert errors.max() < {"dlc80": 0.25, "lane60": 0.55, "park10": 0.20}[name]
    speed_errors = np.array([output.solution.speed_error_mps for output in outputs[100:]])
    assert np.sqrt(np.mean(speed_errors**2)) < 0.1


def test_the_drive_model_is_one_of_a_car():
    assert DRIVE_MODEL in (SINGLE_TRACK, SINGLE_TRACK_LAG)


def test_an_observer_takes_the_speed_error_away(solver, vehicle):
    """The bench's car is 8 % heavier than the model, 7 % weaker and rolls worse."""

    def error(disturbance):
        scenario = SCENARIOS["dlc80"]
        outputs, states = drive(Nmpc(solver, scenario.path, vehicle, 1, NmpcOptions(disturbance=disturbance)), vehicle, scenario, seed=1)
        return np.sqrt(np.mean((states[125:, 0] - 80 / 3.6) ** 2)), outputs[-1].disturbance_mps2

    (without, nothing), (with_it, found) = error(None), error(DisturbanceOptions())
    assert nothing == 0.0 > found
    assert with_it < 0.75 * without
