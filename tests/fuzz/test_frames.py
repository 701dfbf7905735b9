"""A million malformed frames: the gateway neither fails nor grows, and no frame of its own is wrong."""

import random

import pytest

from dbc.catalogue import load
from gateway.messages import Mode, Operation
from tests.fuzz.junk import Junk
from tests.support.campaign import MS, drives
from tests.support.drive import GatewayDrive
from tests.support.soak import rss_bytes

CATALOGUE = load()
PER_TICK = 100
QUIET_TICKS, LOUD_TICKS = 260, 100
MAX_GROWTH_BYTES = 8_000_000
STEERING_DPS, STEP_DEG = 796.5, 0.05
MAX_CAUSES = 8 * len(CATALOGUE.by_id)
"""Names under which frames may be counted: a few for each message."""


class Flooded:
    """A gateway that drives whenever it is let, and is flooded again and again."""

    def __init__(self, seed):
        self.drive = GatewayDrive()
        self.drive.car.is_following = True
        self.junk = Junk(CATALOGUE, seed)
        self.count = self.engagements = 0
        self.before_deg = None

    def run(self, frames):
        """Until so many malformed frames were received."""
        speak, drive = self.drive.car.speak, self.drive
        target = self.count + frames
        while self.count < target:
            drive.car.speak = speak
            self.engagements += self.engage()
            drive.car.speak = lambda now_ns: self.spoilt(speak(now_ns), now_ns)
            for _ in range(min(LOUD_TICKS, -(-(target - self.count) // PER_TICK))):
                self.tick()

    def engage(self):
        drive = self.drive
        if drive.core.mode in (Mode.SAFE_STOP, Mode.COMFORT_STOP, Mode.FAULT):
            drive.car.vx_mps = 0.0
            for _ in range(QUIET_TICKS):
                self.tick()
            drive.ask(Operation.RESET)
            self.tick()
        drive.car.vx_mps = 15.0
        for operation in (None, Operation.ARM, Operation.ENGAGE):
            if operation is not None:
                drive.ask(operation)
            for _ in range(QUIET_TICKS if operation is None else 2):
                self.tick()
        return drive.core.mode is Mode.ENGAGED

    def spoilt(self, good, now_ns):
        self.junk.hear(good)
        self.count += PER_TICK
        return self.junk.among(good, PER_TICK, now_ns)

    def tick(self):
        """One step; what is sent is what the DBC allows, and within the rate of the steering wheel."""
        drive = self.drive
        drive.tick()
        if drive.core.mode in (Mode.SILENT, Mode.STANDBY, Mode.READY, Mode.FAULT):
            self.before_deg = None
            assert not any(drive.car.told.get(f"{node}_Command", {"Enable": 0})["Enable"] for node in ("SR", "AR", "BR")) or (
                drive.core.mode is Mode.FAULT  # nothing is told any more
            )
            return
        angle_deg = drive.car.told["SR_Command"]["AngleCommand"]
        assert self.before_deg is None or abs(angle_deg - self.before_deg) <= STEERING_DPS * 0.01 + STEP_DEG
        self.before_deg = angle_deg


def flood(count, figure):
    flooded = Flooded(seed=1)
    flooded.run(count // 2)
    before = rss_bytes()
    flooded.run(count - count // 2)
    growth = rss_bytes() - before
    figure(f"{flooded.count} malformed frames, engaged {flooded.engagements} times between them", growth / 1e6, "MB more", "<= 8")
    assert flooded.count >= count
    assert flooded.engagements > 1
    assert growth <= MAX_GROWTH_BYTES
    assert len(flooded.drive.core.supervisor.rejected) <= MAX_CAUSES
    assert flooded.drive.core.supervisor.received > count


@pytest.mark.req("F7", "F11", "G2")
def test_a_hundred_thousand_malformed_frames(figure):
    flood(100_000, figure)


@pytest.mark.long
@pytest.mark.timeout(3_600)
@pytest.mark.req("F7", "F11", "G2")
def test_a_million_malformed_frames(figure):
    flood(1_000_000, figure)


@pytest.mark.req("F11")
def test_frames_of_unknown_identifiers_do_not_end_an_engagement():
    drive = GatewayDrive().engage()
    junk, speak = Junk(CATALOGUE, 2, only_unknown=True), drive.car.speak
    drive.car.speak = lambda now_ns: junk.among(speak(now_ns), PER_TICK, now_ns)
    drive.tick(100)
    assert (drive.core.mode, drive.core.findings) == (Mode.ENGAGED, [])
    assert drive.core.supervisor.rejected == {"unknown id": 100 * PER_TICK}


@pytest.mark.req("F9", "F11", "G1")
@pytest.mark.parametrize("seed", range(6))
def test_no_limit_is_broken_by_a_flood_while_the_car_is_driven(seed):
    world = drives()[seed].branch(seed)
    junk, rng = Junk(CATALOGUE, seed), random.Random(seed)
    for _ in range(40):
        junk.hear([frame for _, frame in world._sent])
        start_ns = world.now_ns
        world.strangers += [(start_ns + rng.randrange(10 * MS), frame) for frame in junk.frames(20, start_ns)]
        world.tick()
    world.run(500 * MS)
    assert world.mode is not Mode.ENGAGED
    assert world.oracle.finish(world.now_ns) == []
