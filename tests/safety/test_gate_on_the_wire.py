"""G1: whatever a controller asks for, no frame breaks a limit. Judged on the bus, in every profile and at every speed."""

import random

import pytest

from gateway.messages import HORIZON_STEPS, Mode, Operation
from tests.support.campaign import MS, TICK_NS, World

DRIVES, DRIVES_LONG = 60, 3_000
DRIVE_TICKS = 250
SPEEDS_MPS = {"nominal": (0.0, 34.0), "proving_ground": (0.0, 34.0), "bench": (0.0, 8.0)}


def wild_plan(rng: random.Random, world: World) -> None:
    """A new plan: constant, jumping, swinging or at an end of its range."""
    steer_rad = rng.choice((0.0, rng.uniform(-1.0, 1.0), rng.gauss(0.0, 0.02), 1.0, -1.0))
    swing_rad = rng.choice((0.0, 0.0, rng.uniform(-0.5, 0.5)))
    controller = world.controller
    controller.steer_rad = steer_rad
    controller.plan_steer_rad = tuple(max(-1.0, min(1.0, steer_rad + swing_rad * (-1) ** k)) for k in range(HORIZON_STEPS))
    controller.drive_norm = rng.choice((0.0, rng.uniform(-4.0, 4.0), rng.uniform(-1.0, 1.0), 4.0, -4.0))


def wild_drive(seed: int) -> World:
    rng = random.Random(f"wild/{seed}")
    profile = rng.choice(sorted(SPEEDS_MPS))
    world = World(seed, profile, rng.uniform(*SPEEDS_MPS[profile])).engage()
    for _ in range(DRIVE_TICKS):
        if rng.random() < 0.1:
            wild_plan(rng, world)
        world.tick()
    if rng.random() < 0.5:
        world.ask(Operation.STOP) if rng.random() < 0.5 else setattr(world.controller, "is_alive", False)
        world.run(1_000 * MS)
    assert world.oracle.finish(world.now_ns) == [], f"seed {seed}, {profile}"
    return world


def check(count, figure):
    worlds = [wild_drive(seed) for seed in range(count)]
    limited = sum(world.core.actuation.limited.total() for world in worlds)
    simulated_s = count * DRIVE_TICKS * TICK_NS * 1e-9
    figure(f"G1: {count} wild drives, {simulated_s:.0f} s, limits acted {limited} times, 0 violations on the bus")
    assert limited > 10 * count  # else the drives are too tame to say anything
    assert {world.mode for world in worlds} > {Mode.ENGAGED, Mode.SAFE_STOP}


@pytest.mark.req("G1")
def test_wild_commands_never_break_a_limit(figure):
    check(DRIVES, figure)


@pytest.mark.long
@pytest.mark.timeout(3_600)
@pytest.mark.req("G1")
def test_wild_commands_never_break_a_limit_for_long(figure):
    check(DRIVES_LONG, figure)
