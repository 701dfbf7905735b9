"""Hours of driving with a fault a minute, and an operator who brings the car to a stop, resets, arms and engages again."""

import math
import os
import random
from collections import Counter
from dataclasses import dataclass

from gateway.conditions import UNDISTURBED
from gateway.messages import Mode, Operation
from tests.support.bus_oracle import Violation
from tests.support.campaign import MS, TICK_NS, Controller, World
from tests.support.trials import FAULTS

HOUR_NS = 3_600_000 * MS
OPERATOR_TICKS = 20
"""The operator looks five times a second."""
FOOT_PERCENT = 25.0
CRUISE_MPS = 14.0
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Soak:
    """What came of it.

    Args:
        engaged_share: of the time.
        rss_bytes: resident memory at the end of each part.
        part_ns: simulated time of a part [ns].
    """

    seed: int
    violations: list[Violation]
    faults: Counter[str]
    disengagements: Counter[str]
    engaged_share: float
    rss_bytes: list[int]
    part_ns: int

    @property
    def growth_bytes_per_h(self) -> float:
        """Slope of the resident memory after the first third, by least squares [B per simulated hour]."""
        kept = self.rss_bytes[len(self.rss_bytes) // 3 :]
        mean_k, mean = (len(kept) - 1) / 2.0, sum(kept) / len(kept)
        spread = sum((k - mean_k) ** 2 for k in range(len(kept)))
        return sum((k - mean_k) * (rss - mean) for k, rss in enumerate(kept)) / max(spread, 1.0) * HOUR_NS / self.part_ns


def rss_bytes() -> int:
    """Resident memory of this process [B]."""
    with open("/proc/self/statm", encoding="ascii") as statm:
        return int(statm.read().split()[1]) * _PAGE_BYTES


def heal(world: World) -> None:
    """Everything but the gateway is as it should be again; a gateway that has died is started anew."""
    world.taps, world.strangers, world.watches = [], [], []
    world.surroundings = lambda now_ns: UNDISTURBED
    world.is_deaf = False
    world.car.override, world.car.override_of = 0, set()
    seq = world.controller.seq
    world.controller = Controller(world.rng, world.controller.boot_id)
    world.controller.seq = seq
    world.oracle.mark_undone(-1)
    if world.gap_until_ns > world.now_ns + HOUR_NS:
        world.restart_gateway()


def operate(world: World) -> None:
    """What operator and driver do now."""
    car, mode = world.car, world.mode
    if mode in (Mode.SILENT, Mode.FAULT):
        car.let_go()  # nobody commands the robots
    is_driven = mode in (Mode.ENGAGED, Mode.COMFORT_STOP, Mode.SAFE_STOP)
    car.foot_percent = FOOT_PERCENT if not is_driven and (mode is Mode.FAULT or world.core.blockers) else 0.0
    if mode in (Mode.SAFE_STOP, Mode.COMFORT_STOP, Mode.FAULT) and car.vx_mps < 0.05:
        world.ask(Operation.RESET)
    elif mode in (Mode.SILENT, Mode.STANDBY) and not world.core.blockers and world.core.ticks > 5:
        world.ask(Operation.ARM)
    elif mode is Mode.READY:
        world.ask(Operation.ENGAGE)


def steer(world: World, phase: float) -> None:
    """What the controller plans: cruise along gentle bends; while nobody drives, what the car does."""
    controller, car = world.controller, world.car
    controller.steer_rad = 0.02 * math.sin(phase) if world.mode is Mode.ENGAGED else math.radians(car.steering_wheel_deg) / 14.7
    controller.drive_norm = max(-1.0, min(0.6, 0.3 * (CRUISE_MPS - car.vx_mps)))


def soak(seed: int, duration_ns: int, fault_every_ns: int, parts: int) -> Soak:
    """Drive for some time, measured in equal parts."""
    rng = random.Random(f"soak/{seed}")
    world = World(seed, "nominal", speed_mps=0.0)
    result = Soak(seed, [], Counter(), Counter(), 0.0, [], duration_ns // parts)
    start_ns, engaged_ticks, before = world.now_ns, 0, Mode.SILENT
    fault_ns, heal_ns = start_ns + fault_every_ns // 2, None
    for k in range(duration_ns // TICK_NS):
        if k % OPERATOR_TICKS == 0:
            operate(world)
            if heal_ns is None:  # some faults show in a plan of their own alone
                steer(world, 2e-3 * k)
        if heal_ns is not None and world.now_ns >= heal_ns:
            heal(world)
            heal_ns = None
        elif world.now_ns >= fault_ns:
            fault = rng.choice(FAULTS)
            result.faults[fault.req] += 1
            fault.inject(world)
            fault_ns += fault_every_ns
            heal_ns = world.now_ns + fault.duration_ns + rng.randrange(2_000) * MS
        world.tick()
        engaged_ticks += world.mode is Mode.ENGAGED
        if before is Mode.ENGAGED and world.mode is not Mode.ENGAGED:
            finding = world.core.disengagement.finding if world.core.disengagement else None
            result.disengagements[finding.cause.name if finding else "restart"] += 1
        before = world.mode
        if (k + 1) % (duration_ns // TICK_NS // parts) == 0:
            world.replies.clear()
            world.oracle.reactions.clear()
            result.rss_bytes.append(rss_bytes())
    result.violations = world.oracle.finish(world.now_ns)
    result.engaged_share = engaged_ticks / (duration_ns // TICK_NS)
    return result
