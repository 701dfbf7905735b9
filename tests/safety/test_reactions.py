"""Every fault of the list at random phases in virtual time, judged by the bus oracle: the reaction in its time, and never a broken limit.

100 phases of each row in an ordinary run, 1,000 in the long lane, over all ways in which it happens. A failure names its seed;
`python -m tests.support.trials 'F6 a message missing' 17` repeats one trial.
"""

from unittest import mock

import pytest

from gateway.messages import HORIZON_STEPS, Mode, Operation
from tests.support import trials
from tests.support.campaign import MS, TICK_NS, World, drives
from tests.support.faults import Fault, controller_dies, recorder_fails
from tests.support.trials import FAULTS

PHASES, PHASES_LONG = 100, 1_000
MISSED_SOLVES = 10_000  # B3, F3: none of so many may disengage

ROWS = list(dict.fromkeys(fault.req for fault in FAULTS))


def of_row(row: str) -> list[Fault]:
    return [fault for fault in FAULTS if fault.req == row]


def requirement(row: str) -> pytest.MarkDecorator:
    """F1 and F2 are one fault for the gateway: a controller that says nothing."""
    return pytest.mark.req("F1", "F2", "G1") if row == "F1" else pytest.mark.req(row, "G1")


def check(name: str, done: list[trials.Trial], figure) -> None:
    figure(trials.summary(name, done))
    failed = [trial for trial in done if trial.violations]
    assert not failed, f"{len(failed)} of {len(done)} trials; the first: {failed[0]}"


def react(row: str, phases: int, figure) -> None:
    ways = of_row(row)
    check(row, [trials.run(ways[k % len(ways)], k) for k in range(max(phases, 4 * len(ways)))], figure)


@pytest.mark.parametrize("row", [pytest.param(row, marks=requirement(row)) for row in ROWS])
def test_reaction(row, figure):
    react(row, PHASES, figure)


@pytest.mark.long
@pytest.mark.timeout(3_600)
@pytest.mark.parametrize("row", [pytest.param(row, marks=requirement(row)) for row in ROWS])
def test_reaction_at_a_thousand_phases(row, figure):
    react(row, PHASES_LONG, figure)


@pytest.mark.long
@pytest.mark.timeout(3_600)
@pytest.mark.req("F3")
def test_ten_thousand_missed_solves(figure):
    (fault,) = of_row("F3")
    check("F3, many", [trials.run(fault, seed) for seed in range(MISSED_SOLVES)], figure)


@pytest.mark.long
@pytest.mark.timeout(3_600)
@pytest.mark.req("F9")
def test_one_percent_of_loss_is_ridden_out_for_ten_minutes(figure):
    (fault,) = (fault for fault in FAULTS if fault.name == "1 % lost")
    world = trials.prepared(str(fault), 0)
    world.controller.drive_norm = 0.0
    fault.inject(world)
    world.run(600_000 * MS)
    figure(f"F9, 1 % lost for 10 min: mode {world.mode.name}, {len(world.oracle.violations)} violations")
    assert world.oracle.finish(world.now_ns) == []
    assert world.mode is Mode.ENGAGED


@pytest.mark.req("F1")
@pytest.mark.parametrize("seed", range(12))
def test_a_stop_ends_at_a_standstill_along_the_tail_of_the_plan(seed):
    """The plan turns to one side and back; the wheel has to follow it, held back by the limits alone, and then stay where it is."""
    world = trials.prepared("tail", seed)
    start_rad = world.controller.steer_rad
    bow_rad = 0.6 / max(world.car.vx_mps, 3.0) ** 2  # 0.2 m/s2 to the side in the plan: well within every limit
    plan = tuple(start_rad + bow_rad * (1.0 - abs(2.0 * k / HORIZON_STEPS - 1.0)) for k in range(HORIZON_STEPS))
    world.controller.plan_steer_rad = plan
    world.controller.drive_norm = 0.0
    begun = []
    world.controller.spoil = lambda command: begun.append(command) or command
    world.run(400 * MS)
    controller_dies(world)
    world.run_until(lambda world: world.mode is Mode.SAFE_STOP, 200 * MS)
    assert world.mode is Mode.SAFE_STOP
    last = world.core.commands.newest
    while world.now_ns < last.t_ns + 2_000 * MS and world.car.vx_mps > 1.0:
        world.tick()
        k = min((world.now_ns - last.t_ns) // (40 * MS), HORIZON_STEPS - 1)
        neighbours = [14.7 * plan[j] * 57.29578 for j in range(max(0, k - 2), min(k + 1, HORIZON_STEPS - 1) + 1)]
        told_deg = world.car.told["SR_Command"]["AngleCommand"]
        assert min(neighbours) - 0.2 <= told_deg <= max(neighbours) + 0.2, (k, told_deg, neighbours)
    world.run_until(lambda world: world.car.vx_mps == 0.0, 30_000 * MS)
    world.run(1_000 * MS)
    assert world.car.vx_mps == 0.0
    assert world.car.told["BR_Command"]["PositionCommand"] == pytest.approx(30.0, abs=0.1)  # held
    assert world.mode is Mode.SAFE_STOP
    assert world.oracle.finish(world.now_ns) == []


@pytest.mark.req("F12", "E4")
@pytest.mark.parametrize("seed", range(20))
def test_a_gateway_that_starts_again_is_silent_and_engages_by_two_requests_only(seed):
    world = trials.prepared("restart", seed)
    world.run(world.rng.randrange(300) * MS)
    world.restart_gateway()
    world.run(3_000 * MS)
    assert world.mode is Mode.SILENT
    assert world.sent == []
    world.car.vx_mps = 12.0
    world.ask(Operation.ENGAGE)
    world.run(50 * MS)
    assert world.mode is Mode.SILENT
    assert world.replies[-1].refusals
    assert world.oracle.finish(world.now_ns) == []


def frames_of(world: World, duration_ns: int) -> list[tuple[int, int, bytes]]:
    sent = []
    for _ in range(duration_ns // TICK_NS):
        world.tick()
        sent += [(world.now_ns, frame.arbitration_id, frame.data) for frame in world.sent]
    return sent


@pytest.mark.req("F14")
@pytest.mark.parametrize("step_s", [3_600.0, -3_600.0])
def test_steps_of_the_wall_clock_change_no_bit(step_s):
    for k, drive in enumerate(drives()):
        undisturbed = frames_of(drive.branch(k), 1_000 * MS)
        with (
            mock.patch("time.time", return_value=1.8e9 + step_s),
            mock.patch("time.time_ns", return_value=round((1.8e9 + step_s) * 1e9)),
        ):
            assert frames_of(drive.branch(k), 1_000 * MS) == undisturbed
        assert len(undisturbed) > 400


@pytest.mark.req("F15")
def test_a_broken_recorder_changes_no_bit_and_refuses_the_next_engagement():
    for k, drive in enumerate(drives()):
        undisturbed = frames_of(drive.branch(k), 1_000 * MS)
        world = drive.branch(k)
        recorder_fails(world)
        assert frames_of(world, 1_000 * MS) == undisturbed
        world.ask(Operation.DISENGAGE)
        world.run(3_000 * MS)
        world.ask(Operation.ARM)
        world.run(20 * MS)
        assert world.mode is Mode.STANDBY
        assert any("record" in refusal for refusal in world.replies[-1].refusals)


@pytest.mark.req("F16", "F13")
@pytest.mark.parametrize(("gap_ms", "may_stop"), [(30, False), (200, True)])
def test_a_gateway_that_gets_too_little_time(gap_ms, may_stop):
    """Short gaps are ridden out; whatever the gaps, only safe frames come between them."""
    for seed in range(12):
        world = trials.prepared(f"slow {gap_ms}", seed)
        for _ in range(20):
            world.run(world.rng.randrange(1, 10) * TICK_NS)
            world.sleep(world.rng.randrange(gap_ms + 1) * MS)
        world.run(300 * MS)
        assert world.oracle.finish(world.now_ns) == [], seed
        assert may_stop or world.mode is Mode.ENGAGED, (seed, world.core.reason)
