"""E1 to E4: whatever is toggled, asked for, repeated or restarted in whatever order, the rules of engagement hold.

500 sequences of 50 steps in an ordinary run, 20,000 of 100 in the long lane, by the same machine; hypothesis shrinks what it finds.
"""

import copy
import random
from functools import cache

import pytest
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from gateway.limits import PROFILES
from gateway.messages import Mode, Operation, OperatorRequest
from tests.support.campaign import MS, TICK_NS, World
from tests.support.engagement import CONDITIONS, SETTLED_TICKS, Rules, surroundings_of

SEQUENCES, STEPS = 500, 50
SEQUENCES_LONG, STEPS_LONG, PARTS = 20_000, 100, 4
STARTS, STARTS_LONG, START_TICKS = 300, 10_000, 30


@cache
def beginnings() -> dict[str, World]:
    """Worlds in which all has been good for long, in every mode."""
    silent = World(1).run((SETTLED_TICKS + 40) * TICK_NS)
    ready = copy.deepcopy(silent).arm()
    engaged = copy.deepcopy(ready)
    engaged.ask(Operation.ENGAGE)
    engaged.run(SETTLED_TICKS * TICK_NS)
    safe = copy.deepcopy(engaged)
    safe.controller.is_alive = False
    safe.run(300 * MS)
    safe.controller.is_alive = True
    standing = copy.deepcopy(safe)
    standing.run_until(lambda world: world.car.vx_mps == 0.0, 30_000 * MS).run(SETTLED_TICKS * TICK_NS)
    comfort = copy.deepcopy(engaged)
    comfort.ask(Operation.STOP)
    comfort.run(SETTLED_TICKS * TICK_NS)
    fault = copy.deepcopy(engaged)
    fault.car.emergency_stop = 1
    fault.run(100 * MS)
    fault.car.emergency_stop = 0
    standby = copy.deepcopy(engaged)
    standby.ask(Operation.DISENGAGE)
    standby.run(SETTLED_TICKS * TICK_NS)
    worlds = {"silent": silent, "ready": ready, "engaged": engaged, "safe": safe, "standing": standing, "comfort": comfort}
    return worlds | {"fault": fault, "standby": standby}


def test_the_beginnings_are_what_they_are_called():
    assert {name: world.mode for name, world in beginnings().items()} == {
        "silent": Mode.SILENT, "ready": Mode.READY, "engaged": Mode.ENGAGED, "safe": Mode.SAFE_STOP, "standing": Mode.SAFE_STOP,
        "comfort": Mode.COMFORT_STOP, "fault": Mode.FAULT, "standby": Mode.STANDBY,
    }


class Engagement(RuleBasedStateMachine):
    """One gateway and everybody who may do something to it."""

    @initialize(beginning=st.sampled_from(["silent", "ready", "engaged", "standby", "safe", "standing", "comfort", "fault"]))
    def begin(self, beginning):
        world = copy.deepcopy(beginnings()[beginning])
        surroundings_of(world)
        self.rules = Rules(world, 0 if beginning in ("safe", "fault") else SETTLED_TICKS)
        self.waits = 1
        self.last = None

    def go(self, operation=None, is_fresh=True):
        self.rules.step(operation, is_fresh)
        assert not self.rules.complaints, self.rules.complaints[0]

    @rule(name=st.sampled_from(sorted(CONDITIONS)))
    def switch(self, name):
        self.rules.switch(name)
        self.go()

    @rule()
    def heal(self):
        for name in list(self.rules.bad):
            self.rules.switch(name)
        self.go()

    @rule(operation=st.sampled_from(Operation))
    def ask(self, operation):
        self.rules.world.ask(operation)
        self.last = self.rules.world.requests[-1]
        self.go(operation)

    @rule(operation=st.sampled_from(Operation), name=st.sampled_from(sorted(CONDITIONS)))
    def ask_and_switch(self, operation, name):
        self.rules.switch(name)
        self.ask(operation)

    @precondition(lambda self: self.last is not None)
    @rule()
    def repeat(self):
        self.rules.world.requests.append(self.last)
        self.go(self.last.operation, is_fresh=False)

    @rule(operation=st.sampled_from(Operation), offset_ms=st.sampled_from((-1_500, 100)))
    def ask_at_a_wrong_time(self, operation, offset_ms):
        world = self.rules.world
        world.requests.append(OperatorRequest(9, 1 << 40, operation, world.now_ns + offset_ms * MS))
        self.go(operation, is_fresh=False)

    @rule()
    def restart(self):
        self.rules.restart()
        self.last = None
        self.go()

    @rule(ticks=st.sampled_from((2, 4, 8)))
    def wait(self, ticks):
        for _ in range(ticks):
            self.go()

    @precondition(lambda self: self.waits > 0)
    @rule(ticks=st.sampled_from((15, 30, 120)))
    def wait_long(self, ticks):
        self.waits -= 1
        for _ in range(ticks):
            self.go()


def run(sequences, steps, part=0):
    machine = seed(part)(type("Engagement", (Engagement,), {}))
    run_state_machine_as_test(machine, settings=settings(
        max_examples=sequences, stateful_step_count=steps, deadline=None, database=None, print_blob=False,
        suppress_health_check=list(HealthCheck), phases=[Phase.generate, Phase.shrink],
    ))


def start(seed):
    """A gateway that has just started, while anything may be wrong and anything is asked for; the oracle watches what it sends."""
    rng = random.Random(f"start/{seed}")
    world = World(seed, rng.choice(sorted(PROFILES)), rng.uniform(0.0, 8.0))
    surroundings_of(world)
    rules = Rules(world, 0)
    world.controller.steer_rad, world.controller.drive_norm = rng.uniform(-0.5, 0.5), rng.uniform(-1.0, 1.0)
    for name in rng.sample(sorted(CONDITIONS), rng.randrange(4)):
        rules.switch(name)
    enabled = 0
    for _ in range(START_TICKS):
        operation = rng.choice([None, None, None, *Operation])
        if operation is not None:
            world.ask(operation)
        rules.step(operation)
        enabled += world.mode not in (Mode.SILENT, Mode.STANDBY, Mode.READY)
        if world.mode is Mode.SILENT:
            assert world.sent == [], f"seed {seed}"
    assert not rules.complaints, f"seed {seed}: {rules.complaints[0]}"
    return enabled


@pytest.mark.req("E1")
@pytest.mark.parametrize("starts", [STARTS, pytest.param(STARTS_LONG, marks=[pytest.mark.long, pytest.mark.timeout(3_600)])])
def test_nothing_is_sent_and_nothing_moves_before_it_is_asked_for(starts, figure):
    assert sum(start(seed) for seed in range(starts)) == 0  # 0.3 s are too short for a second of good conditions
    figure(f"E1: {starts} random starts, 0 violations")


@pytest.mark.req("E1", "E2", "E3", "E4", "G1")
def test_the_rules_of_engagement_hold(figure):
    run(SEQUENCES, STEPS)
    figure(f"E1 to E4: {SEQUENCES} sequences of {STEPS} steps, 0 violations")


@pytest.mark.long
@pytest.mark.timeout(10_800)
@pytest.mark.req("E1", "E2", "E3", "E4", "G1")
@pytest.mark.parametrize("part", range(1, PARTS + 1))
def test_the_rules_of_engagement_hold_for_long(part, figure):
    run(SEQUENCES_LONG // PARTS, STEPS_LONG, part)
    figure(f"E1 to E4: {SEQUENCES_LONG // PARTS} sequences of {STEPS_LONG} steps, part {part} of {PARTS}, 0 violations")
