"""The control loop: closed loop on a car that is not the model, failures, and that nothing but finite numbers comes out."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.bench_loop import Scenario, drive, nominal_scenarios
from controller.nmpc import Nmpc, NmpcOptions
from controller.problem import OcpOptions
from controller.samples import command_sample, plan_sample
from controller.solver import Effort, SolveResult, SolveStatus
from gateway.messages import CommandStatus, ControlCommand, Mode, VehicleState, pack, unpack
from gateway.telemetry import decode, topic_of

PERIOD_NS = 40_000_000
SCENARIOS = {scenario.name: scenario for scenario in nominal_scenarios()}


def state_on(path, seq=0, t_ns=0, mode=Mode.ENGAGED, **changes):
    row = 20
    numbers = {
        "x_m": float(path.x_m[row]), "y_m": float(path.y_m[row]), "yaw_rad": float(path.yaw_rad[row]), "vx_mps": float(path.speed_mps[row]),
        "vy_mps": 0.0, "yaw_rate_radps": 0.0, "ax_mps2": 0.0, "steer_rad": 0.0, "drive_norm": 0.05,
    }  # fmt: skip
    return VehicleState(boot_id=7, seq=seq, t_ns=t_ns, mode=mode, is_valid=True, **{**numbers, **changes})


class StubSolver:
    """Answers with what the test says; straight ahead otherwise."""

    name = "stub"
    options = OcpOptions()
    warm_start = None

    def __init__(self) -> None:
        self.status, self.solve_time_ns, self.resets, self.asked = SolveStatus.CONVERGED, 0, 0, []

    def solve(self, state, previous_input, horizon):
        self.asked.append((state, previous_input, horizon))
        value = np.nan if self.status is SolveStatus.NOT_FINITE else 0.01 * np.arange(30.0)[:, None] * np.ones(2)
        inputs = np.broadcast_to(value, (30, 2))
        return SolveResult(self.status, np.tile(state, (31, 1)), inputs, 0.0, 0.0, Effort(1, 1), self.solve_time_ns)

    def advance(self, state, inputs, duration_s):
        return state

    def reset(self):
        self.resets += 1


@pytest.fixture
def stub():
    return StubSolver()


@pytest.fixture
def loop(stub, wavy_path, vehicle):
    return Nmpc(stub, wavy_path, vehicle, boot_id=5, options=NmpcOptions(deadline_ns=PERIOD_NS))


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

    def work(delay_s):
        solver.reset()
        scenario = SCENARIOS["dlc80"]
        outputs, _ = drive(Nmpc(solver, scenario.path, vehicle, 1, NmpcOptions(delay_s=delay_s)), vehicle, scenario, seed=1)
        return np.abs(np.diff([output.command.steer_rad for output in outputs], n=2)).sum()

    assert work(None) < 0.9 * work(0.0)


def test_two_runs_are_the_same_to_the_last_bit(solver, vehicle):
    def run():
        solver.reset()
        scenario: Scenario = replace(SCENARIOS["dlc80"], duration_s=1.0)
        outputs, _ = drive(Nmpc(solver, scenario.path, vehicle, 1), vehicle, scenario, seed=1)
        return [pack(replace(output.command, solve_time_ns=0)) for output in outputs]

    assert run() == run()


def test_a_command_answers_its_state(loop, wavy_path):
    output = loop.step(state_on(wavy_path, seq=42, t_ns=995), 1_000)
    command = output.command
    assert (command.boot_id, command.seq, command.state_seq, command.t_ns) == (5, 1, 42, 1_000)
    assert command.status is CommandStatus.OK
    assert (command.steer_rad, command.drive_norm) == (command.plan_steer_rad[0], command.plan_drive_norm[0])
    assert command.plan_steer_rad == pytest.approx(tuple(0.01 * np.arange(30)))
    assert loop.step(state_on(wavy_path, seq=43), 2_000).command.seq == 2
    assert unpack(pack(command)) == command


FAILURES = {
    "not converged": ({"status": SolveStatus.NOT_CONVERGED}, {}, True),
    "not finite": ({"status": SolveStatus.NOT_FINITE}, {}, True),
    "late": ({"solve_time_ns": PERIOD_NS + 1}, {}, False),
    "state not valid": ({}, {"is_valid": False}, False),
    "state too old": ({}, {"t_ns": -200_000_000}, False),
    "state from the future": ({}, {"t_ns": 2_000_000_000}, False),
    "position off the planet": ({}, {"x_m": 1e200}, False),
    "position not finite": ({}, {"x_m": math.nan}, False),
    "steering not finite": ({}, {"steer_rad": math.inf}, False),
    "heading not finite": ({}, {"yaw_rad": math.inf}, False),
}


@pytest.mark.parametrize("name", FAILURES)
def test_every_failure_degrades_then_fails_then_recovers(loop, stub, wavy_path, name):
    of_solver, of_state, resets = FAILURES[name]
    good = state_on(wavy_path)
    statuses = [loop.step(good, 0).command.status]
    for attribute, value in of_solver.items():
        setattr(stub, attribute, value)
    for cycle in range(1, 6):
        now_ns = cycle * PERIOD_NS
        output = loop.step(replace(good, **{"t_ns": now_ns, **of_state}), now_ns)
        statuses.append(output.command.status)
        assert output.command.plan_steer_rad[0] == pytest.approx(0.01 * cycle)  # the old plan, where it would be now
        assert unpack(pack(output.command)) == output.command
        assert decode("command", msgspec.json.encode(command_sample(output, "stub", 0))) is not None
    assert statuses == [CommandStatus.OK] + [CommandStatus.DEGRADED] * 3 + [CommandStatus.FAILED] * 2
    assert (stub.resets > 0) == resets
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
