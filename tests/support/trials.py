"""The campaign: which faults there are, and what one trial of one or two of them is.

    python -m tests.support.trials 'F6 a message missing' 17                             repeats one trial and prints what happened
    python -m tests.support.trials 'F6 a message missing + F10 interface down' 17        of two faults
"""

import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from dbc.health import BusState
from gateway.messages import CommandStatus
from tests.support import faults as f
from tests.support import taps
from tests.support.bus_oracle import Answer, Violation
from tests.support.campaign import MS, World, drives
from tests.support.faults import Fault
from tests.support.oracle_limits import REACTIONS

FAULTS = (
    Fault("F1", "controller dies", f.controller_dies, 400 * MS),
    Fault("F3", "one solve missed", f.one_solve_missed),
    Fault("F4", "solver fails at once", f.solver_fails(0, CommandStatus.FAILED), 200 * MS),
    Fault("F4", "solver fails after three shifted plans", f.solver_fails(3, CommandStatus.FAILED)),
    Fault("F4", "three shifted plans, then good ones", f.solver_fails(3, None)),
    Fault("F4", "shifted plans for ever", f.solver_fails(3, CommandStatus.DEGRADED)),
    *(Fault("F5", kind, f.bad_commands(kind)) for kind in f.BAD_COMMANDS),
    *(Fault("F5", f"{kind}, once", f.bad_commands(kind, count=1), 200 * MS) for kind in f.BAD_COMMANDS),
    Fault("F5", "second controller", f.second_controller),
    Fault("F6", "a message missing", f.missing(), 150 * MS),
    Fault("F6", "navigation missing", f.missing(*f.NAVIGATION_MESSAGES), 150 * MS),
    Fault("F6", "robots missing", f.missing(*f.PROTECTED_MESSAGES), 150 * MS),
    Fault("F7", "wrong CRC", f.bad_frames(taps.wrong_crc, f.PROTECTED_MESSAGES), 200 * MS),
    Fault("F7", "counter stuck", f.bad_frames(taps.same_counter, f.PROTECTED_MESSAGES), 200 * MS),
    Fault("F7", "counter jumps", f.bad_frames(taps.jumping_counter, f.PROTECTED_MESSAGES), 200 * MS),
    Fault("F7", "too short", f.bad_frames(taps.too_short, f.NEEDED_MESSAGES), 200 * MS),
    Fault("F8", "speed off", f.implausible(lambda rng: taps.shift("VelocityLevel", "VelForward", f.either(rng, 3.0, 8.0)))),
    Fault("F8", "speed gone", f.implausible(lambda rng: taps.fix("VelocityLevel", "VelForward", 0.0))),
    Fault("F8", "position jumps", f.implausible(lambda rng: taps.shift("PosLocal", f"PosLocal{rng.choice('XY')}", f.either(rng, 1, 50)))),
    Fault("F8", "heading jumps", f.implausible(lambda rng: taps.shift("VelYawLocal", "AngleLocalYaw", f.either(rng, 5, 90)))),
    Fault("F8", "yaw rate off", f.implausible(lambda rng: taps.shift("RateVehicle", "AngRateZ", f.either(rng, 12, 60)))),
    Fault(
        "F8", "steering angle off", f.implausible(lambda rng: taps.shift("SR_Status", "AngleActual", f.either(rng, 10, 200))),
        lies_about="SR_Status",
    ),
    Fault("F8", "position frozen", f.implausible(lambda rng: taps.freeze("PosLocal"))),
    Fault("F8", "navigation frozen", f.implausible(*(lambda rng, name=name: taps.freeze(name) for name in f.NAVIGATION_MESSAGES))),
    Fault("F8", "time of validity frozen", f.implausible(lambda rng: taps.freeze("MilliTime"))),
    Fault("F8", "steering angle frozen", f.frozen_while_turning, 900 * MS, "SR_Status"),
    Fault("F8", "a speed frozen", f.frozen_while_braking, 1_500 * MS),
    Fault("F9", "1 % lost", f.disturbed("F9 mild", taps.randomly(0.01, None, lambda t_ns, frame, rng: [])), 3_000 * MS),
    Fault("F9", "5 % lost", f.disturbed(None, taps.randomly(0.05, None, lambda t_ns, frame, rng: []))),
    Fault("F9", "20 % lost", f.disturbed("F9", taps.randomly(0.2, None, lambda t_ns, frame, rng: []))),
    Fault("F9", "duplicated", f.disturbed(None, taps.randomly(0.2, None, lambda t_ns, frame, rng: [(t_ns, frame)] * 2))),
    Fault("F9", "reordered", f.disturbed(None, taps.randomly(0.2, None, taps.overtaken))),
    Fault("F9", "10 ms late", f.disturbed(None, taps.late(10 * MS))),
    Fault("F9", "30 ms late", f.disturbed(None, taps.late(30 * MS))),
    Fault("F9", "60 ms late", f.disturbed(None, taps.late(60 * MS))),
    Fault("F9", "120 ms late", f.disturbed("F9", taps.late(120 * MS))),
    Fault("F9", "navigation later and later", f.navigation_lags, 1_300 * MS),
    Fault("F9", "bits flipped", f.disturbed(None, taps.noisy(1e-3))),
    Fault("F10", "bus-off, robots", f.bus_fails(BusState.BUS_OFF, "robots")),
    Fault("F10", "bus-off, navigation", f.bus_fails(BusState.BUS_OFF, "navigation")),
    Fault("F10", "interface down", f.bus_fails(BusState.DOWN, "robots")),
    Fault("F10", "frames not taken", f.bus_fails(BusState.ERROR_ACTIVE, "robots")),
    Fault("F11", "babbling idiot", f.babbling),
    Fault("F11", "unknown identifiers", f.strangers(26)),
    Fault("F11", "ten times the rate", f.tenfold),
    Fault("F12", "gateway dies", f.gateway_dies, 200 * MS),
    Fault("F13", "gateway sleeps", f.gateway_sleeps, 800 * MS),
    Fault("F14", "clock steps", f.no_fault),
    Fault("F15", "recorder fails", f.recorder_fails),
    Fault("F17", "junk for commands", f.junk_commands),
    Fault("F5", "second sender on the bus", f.second_sender, 100 * MS),
    *(Fault("E3", f"driver overrides {node}", f.driver(f._robot_overridden(node)), 100 * MS) for node in ("SR", "AR", "BR")),
    Fault("E3", "driver overrides", f.driver(f._controller_overridden), 100 * MS),
)


AFTERMATH_NS = 3_000 * MS
"""One trial of ten goes on with its fault: a stop that has begun must be held."""


@dataclass
class Trial:
    """What one trial found; its name repeats it (`repeat`).

    Args:
        seed: of everything that was random.
    """

    name: str
    seed: int
    violations: list[Violation]
    reactions: list[Answer] = field(default_factory=list)

    def __str__(self) -> str:
        found = "; ".join(f"{(v.t_ns / 1e9):.4f} s {v.rule}: {v.detail}" for v in self.violations[:4])
        return f"{self.name}, seed {self.seed}: {found or 'no violation'}"


def prepared(name: str, seed: int) -> World:
    """An engaged world at a random phase of all its cycles."""
    rng = random.Random(f"{name}/{seed}")
    world = rng.choice(drives()).branch(rng.randrange(1 << 62))
    for _ in range(rng.randrange(8)):
        world.tick()
    return world


@contextmanager
def named(name: str, seed: int) -> Iterator[None]:
    """An exception out of the gateway says which trial it was."""
    try:
        yield
    except Exception as error:
        error.add_note(f"in trial {name!r}, seed {seed}")
        raise


def run(fault: Fault, seed: int) -> Trial:
    """Try one fault."""
    world = prepared(str(fault), seed)
    with named(str(fault), seed):
        fault.inject(world)
        world.run(fault.duration_ns + (AFTERMATH_NS if seed % 10 == 9 else 0))
    return Trial(str(fault), seed, world.oracle.finish(world.now_ns), world.oracle.reactions)


def run_pair(first: Fault, second: Fault, seed: int) -> Trial:
    """Try two faults, one after the other within 150 ms or at once: the severer reaction in its own time."""
    name = f"{first} + {second}"
    world = prepared(name, seed)
    world.least_severity = severity(first, second)
    with named(name, seed):
        first.inject(world)
        for _ in range(world.rng.choice((0, 0, 1, 3, 7, 15))):
            world.tick()
        second.inject(world)
        world.run(max(first.duration_ns, second.duration_ns))
    return Trial(name, seed, world.oracle.finish(world.now_ns), world.oracle.reactions)


def severity(*chosen: Fault) -> int:
    """Of the severer of these faults, as the oracle ranks reactions; at least that of a stop, since two mild faults may make one."""
    return max(1, *(REACTIONS[fault.req].kind.severity for fault in chosen))


def summary(name: str, trials: list[Trial]) -> str:
    """One line about some trials, for people."""
    allowed = {answer.fault: REACTIONS[answer.fault].within_ns / MS for trial in trials for answer in trial.reactions}
    slowest = (
        f"{fault} {max(a.latency_ns for t in trials for a in t.reactions if a.fault == fault) / MS:.1f} of {allowed_ms:.0f} ms"
        for fault, allowed_ms in allowed.items()
    )
    bad = sum(bool(trial.violations) for trial in trials)
    return f"{name}: {len(trials)} trials, {bad} with a violation; slowest: {', '.join(slowest) or 'no reaction due'}"


def again(name: str, seed: int) -> Trial:
    """The trial of this name and seed once more."""
    chosen = [next(fault for fault in FAULTS if str(fault) == part) for part in name.split(" + ")]
    return run(chosen[0], seed) if len(chosen) == 1 else run_pair(chosen[0], chosen[1], seed)


if __name__ == "__main__":
    trial = again(sys.argv[1], int(sys.argv[2]))
    for violation in trial.violations:
        print(f"{violation.t_ns * 1e-9:.4f} s  {violation.rule}: {violation.detail}")
    for answer in trial.reactions:
        print(f"{answer.fault}: first safe frame after {answer.latency_ns / MS:.1f} ms")
    sys.exit(bool(trial.violations))
