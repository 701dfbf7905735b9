"""What a step tells the world."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import msgspec
import pytest

from controller.nmpc import Nmpc
from controller.parameters import ParameterStore
from controller.planning.options import PlannerOptions
from controller.problem import OcpOptions
from controller.samples import PROFILE_PERIOD_NS, UNKNOWN, Circumstances, ProfileMeter, command_sample, parameters_sample
from controller.solver import Effort, SubFunction
from gateway.messages import PLAN_PERIOD_NS, Mode, VehicleState
from gateway.telemetry import decode


@pytest.fixture
def output(solver, wavy_path, vehicle):
    x_m, y_m, yaw_rad = (float(column[5]) for column in (wavy_path.x_m, wavy_path.y_m, wavy_path.yaw_rad))
    state = VehicleState(1, 7, 0, Mode.READY, True, x_m, y_m, yaw_rad, 60 / 3.6, 0.0, 0.0, 0.0, 0.0, 0.1)
    return Nmpc(solver, wavy_path, vehicle, boot_id=1).step(state, 0)


def with_effort(output, effort):
    return replace(output, solution=replace(output.solution, result=replace(output.solution.result, effort=effort)))


def test_a_command_tells_the_solvers_effort_and_what_it_was_made_with(output):
    told = with_effort(output, Effort(2, 5, 7.5))
    sample = command_sample(told, "riccati", 3_000_000, Circumstances(4, 2, 1))
    assert (sample.sqp_iterations, sample.qp_iterations, sample.work) == (2, 5, 7.5)
    assert (sample.parameters_version, sample.objects, sample.objects_rejected) == (4, 2, 1)
    assert sample.disturbance_mps2 == output.disturbance_mps2
    assert sample.step_time_ms == pytest.approx(3.0)
    assert decode("command", msgspec.json.encode(sample)) == sample


@pytest.mark.parametrize("lacks", [lambda output: with_effort(output, Effort()), lambda output: replace(output, solution=None)])
def test_what_the_solver_does_not_tell_is_marked(output, lacks):
    sample = command_sample(lacks(output), "casadi-vm", 0)
    assert (sample.sqp_iterations, sample.qp_iterations, sample.work) == (UNKNOWN, UNKNOWN, UNKNOWN)
    assert decode("command", msgspec.json.encode(sample)) == sample


def profiled(qp_ns, calls):
    effort = Effort(profile={"qp": SubFunction(qp_ns, calls), "hessian": SubFunction(1_000, 1)})
    return SimpleNamespace(solution=SimpleNamespace(result=SimpleNamespace(effort=effort)))


def test_profiles_are_means_per_cycle_a_few_times_a_second():
    meter = ProfileMeter("qrqp")
    samples = []
    for k in range(50):
        now_ns = 10**9 + k * PLAN_PERIOD_NS
        if (sample := meter.add(profiled(1000 * (k + 1), 2), now_ns)) is not None:
            samples.append(sample)
    assert [sample.seq for sample in samples] == list(range(10))
    assert all(after.t_ns - before.t_ns >= PROFILE_PERIOD_NS for before, after in pairwise(samples))
    assert (samples[0].cycles, samples[0].time_us["qp"]) == (1, 1.0)
    second = samples[1]
    assert (second.cycles, second.calls) == (5, {"qp": 2.0, "hessian": 1.0})
    assert second.time_us == pytest.approx({"qp": 4.0, "hessian": 1.0})  # cycles 2 to 6
    assert decode("profile", msgspec.json.encode(second)) == second


def test_without_a_profile_there_is_no_sample(output):
    meter = ProfileMeter("casadi-vm")
    assert meter.add(with_effort(output, Effort()), 10**9) is None
    assert meter.add(replace(output, solution=None), 2 * 10**9) is None


def test_a_change_of_parameters_says_from_which_cycle_on():
    store = ParameterStore(OcpOptions(), PlannerOptions())
    store.propose({"planner.safe_time_s": 1.8}, "ann", 10)
    _, (entry,) = store.take()
    sample = parameters_sample(entry, 40)
    assert (sample.t_ns, sample.accepted_ns, sample.version, sample.seq, sample.who) == (40, 10, 1, 1, "ann")
    assert [(one.name, one.old, one.new) for one in sample.changes] == [("planner.safe_time_s", 1.2, 1.8)]
    assert decode("parameters", msgspec.json.encode(sample)) == sample
