"""F12: the gateway dies, and the robots, the emulator's, stop the car by themselves. They share no code with the gateway."""

import random

import pytest

from tests.vehicle_emulator.robots.bench import Bench

PHASES, PHASES_LONG = 30, 1_000
WITHIN_MS = 110  # B3, F12: timeout of 100 ms, and one period


def silence_to_stop_ms(seed: int) -> int:
    """Time from the moment the gateway dies to the moment the robots no longer follow it."""
    rng = random.Random(f"dead/{seed}")
    bench = Bench(seed=seed)
    bench.run(100, "Arm")
    bench.run(100 + rng.randrange(20), "Engage", sr_deg=rng.uniform(-90.0, 90.0), ar_percent=rng.uniform(0.0, 60.0))
    assert bench.system.is_engaged
    for silent_ms in range(1, 300):
        bench.step()
        if not bench.system.is_engaged:
            return silent_ms
    raise AssertionError(f"seed {seed}: still engaged 300 ms after the gateway died")


def check(phases, figure):
    slowest_ms = max(silence_to_stop_ms(seed) for seed in range(phases))
    figure(f"F12: {phases} phases, robots let go after {slowest_ms} ms at most, allowed {WITHIN_MS} ms")
    assert slowest_ms <= WITHIN_MS


@pytest.mark.req("F12")
def test_the_robots_stop_the_car_when_the_gateway_dies(figure):
    check(PHASES, figure)


@pytest.mark.long
@pytest.mark.req("F12")
@pytest.mark.timeout(3_600)
def test_the_robots_stop_the_car_when_the_gateway_dies_at_a_thousand_phases(figure):
    check(PHASES_LONG, figure)
