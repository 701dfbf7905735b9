"""Faults of real processes: how each is made, what undoes it, and what one trial of it is."""

import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from tests.support.controller_process import BAD
from tests.support.faults import NEEDED_MESSAGES, PROTECTED_MESSAGES
from tests.support.lines import Helper
from tests.support.oracle_limits import MS, REACTIONS, Kind
from tests.support.process_bench import ProcessBench
from tests.support.quiet import Quiet

ATTEMPTS = 4
"""A trial that proves nothing is repeated three times."""
ANSWER_S = 1.0
"""Longest wait for what the oracle says, which is long after every limit [s]."""
HELD_BACK_S = 0.15
PHASE_S = 0.1
"""Faults begin at a random phase of everything that is cyclic."""
OFF_BUS = 40
"""Destroyed attempts to send that take a node to bus-off: 32 in a row, and some for frames that get through in between."""
OWN_MESSAGES = (0xA0, 0x110, 0x120, 0x130)


@dataclass(frozen=True)
class Way:
    """One way in which a fault of the list happens.

    Args:
        req: its id.
        key: of the reaction that the oracle awaits.
        inject: begins it; the time at which it is there [ns].
        mode: that the gateway then tells the controller; empty where one of the two is gone.
        undo: ends it; the gateway may be in any mode.
        lasts_s: how long one is watched to which no reaction is due [s].
    """

    req: str
    name: str
    key: str
    mode: str
    inject: Callable[[ProcessBench, random.Random], int]
    undo: Callable[[ProcessBench], object] = lambda bench: None
    lasts_s: float = 0.5

    def __str__(self) -> str:
        return f"{self.req} {self.name}"

    @property
    def within_ms(self) -> float:
        """Longest time to the first safe frame [ms]; 0 where none is due."""
        reaction = REACTIONS[self.key]
        return (reaction.within_process_ns or reaction.within_ns) / MS


@dataclass(frozen=True)
class Outcome:
    """What one trial found.

    Args:
        latency_ms: to the first safe frame; None where none is due, or where it did not come in its time.
        failures: what must not be.
    """

    latency_ms: float | None
    failures: tuple[str, ...]


def run(bench: ProcessBench, way: Way, count: int, seed: int) -> list[Outcome]:
    """Try a fault several times, and again where the machine was not fit for it.

    Raises:
        AssertionError: it never was.
    """
    dice = random.Random(f"{way}/{seed}")
    return [_conclusive(bench, way, dice) for _ in range(count)]


def _conclusive(bench: ProcessBench, way: Way, dice: random.Random) -> Outcome:
    disturbances = []
    for _ in range(ATTEMPTS):
        outcome, disturbance = _try(bench, way, dice)
        if not disturbance:
            return outcome
        disturbances.append(disturbance)
    raise AssertionError(f"{way}: {ATTEMPTS} times inconclusive: {', '.join(disturbances)}")


def _try(bench: ProcessBench, way: Way, dice: random.Random) -> tuple[Outcome, str]:
    bench.engage()
    time.sleep(dice.uniform(0.0, PHASE_S))
    begin = len(bench.oracle.said)
    with Quiet() as quiet:
        is_to_go_on = REACTIONS[way.key].kind is Kind.NONE
        latency_ms, failures = (_goes_on if is_to_go_on else _reacts)(bench, way, dice)
    way.undo(bench)
    bench.release()
    time.sleep(HELD_BACK_S)
    return Outcome(latency_ms, (*failures, *bench.violations(begin))), quiet.disturbance


def _goes_on(bench: ProcessBench, way: Way, dice: random.Random) -> tuple[None, list[str]]:
    bench.oracle.tell(fault=way.key, t_ns=way.inject(bench, dice))
    time.sleep(way.lasts_s)
    bench.oracle.tell(end=way.key)
    failures = [] if bench.mode == way.mode else [f"mode {bench.mode}"]
    time.sleep(HELD_BACK_S)
    return None, failures


def _reacts(bench: ProcessBench, way: Way, dice: random.Random) -> tuple[float | None, list[str]]:
    begin, said_begin = len(bench.oracle.said), len(bench.controller.said)
    begin_ns = way.inject(bench, dice)
    bench.oracle.tell(fault=way.key, t_ns=begin_ns)
    latency_ms = bench.reaction_ms(way.key, begin, ANSWER_S)
    if latency_ms is None:
        return None, ["no reaction in its time"]
    if not way.mode:
        return latency_ms, []
    told = bench.controller.look_for(lambda line: line.get("mode") == way.mode, said_begin, ANSWER_S)
    if told is None:
        return latency_ms, [f"mode {bench.mode}"]
    if way.mode == "FAULT":  # the bus cannot tell whether the gateway or the fault has silenced it
        latency_ms = (told["t_ns"] - begin_ns) / MS
        return latency_ms, [] if latency_ms <= way.within_ms else [f"FAULT only after {latency_ms:.0f} ms"]
    return latency_ms, []


# ---- the faults


Inject = Callable[[ProcessBench, random.Random], int]


def _controller_signalled(number: signal.Signals) -> Inject:
    return lambda bench, dice: bench.controller.signal(number)


def _another_controller(bench: ProcessBench) -> None:
    bench.controller.close()
    bench.start_controller()


def _controller_told(**what: object) -> Inject:
    return lambda bench, dice: bench.controller.ask(**what)


def _bad_commands(bench: ProcessBench, dice: random.Random) -> int:
    return bench.controller.ask(bad=dice.choice(list(BAD)))


def _missing(bench: ProcessBench, dice: random.Random) -> int:
    return bench.car.ask(silent=[dice.choice(NEEDED_MESSAGES)])


def _corrupt(bench: ProcessBench, dice: random.Random) -> int:
    return bench.car.ask(corrupt=[dice.choice(PROTECTED_MESSAGES)])


def _speed_off(bench: ProcessBench, dice: random.Random) -> int:
    return bench.car.ask(wheel_speed_offset_mps=dice.choice((-1.0, 1.0)) * dice.uniform(3.0, 8.0))


def _overridden(bench: ProcessBench, dice: random.Random) -> int:
    node = dice.choice(("SR", "AR", "BR", None))
    return bench.car.ask(override=1) if node is None else bench.car.ask(override_of=[node])


def _car_told(**what: object) -> Inject:
    return lambda bench, dice: bench.car.ask(**what)


def _car_heals(**what: object) -> Callable[[ProcessBench], int]:
    return lambda bench: bench.car.ask(**what)


def _bus_off(bench: ProcessBench, dice: random.Random) -> int:
    t_ns = time.monotonic_ns()
    bench.saboteur.disturb(dice.choice(OWN_MESSAGES), OFF_BUS)
    return t_ns


def _babbler(bench: ProcessBench) -> Helper:
    return bench.helper("babbler_process", bench.buses["robots"])


def _babbling(bench: ProcessBench, dice: random.Random) -> int:
    return _babbler(bench).ask(rate_hz=None)


def _strangers(bench: ProcessBench, dice: random.Random) -> int:
    return _babbler(bench).ask(rate_hz=400, identifier=dice.randrange(1, 0x90))


def _quiet_again(bench: ProcessBench) -> None:
    _babbler(bench).ask(rate_hz=0)
    time.sleep(HELD_BACK_S)  # frames that were handed to the controller before the fault was found get out now; no operator is so quick


def _gateway_signalled(number: signal.Signals) -> Inject:
    return lambda bench, dice: bench.signal_gateway(number)


def _gateway_sleeps(seconds: float) -> Inject:
    def inject(bench: ProcessBench, dice: random.Random) -> int:
        bench.signal_gateway(signal.SIGSTOP)
        time.sleep(seconds)
        return bench.signal_gateway(signal.SIGCONT)

    return inject


def _flood(kind: str) -> Inject:
    def inject(bench: ProcessBench, dice: random.Random) -> int:
        return bench.helper("flood_process", str(bench.base_port), str(bench.directory)).ask(kind=kind)

    return inject


def _no_flood(bench: ProcessBench) -> None:
    bench.helper("flood_process", str(bench.base_port), str(bench.directory)).ask(kind=None)


WAYS = (
    Way("F1", "controller killed", "F1", "", _controller_signalled(signal.SIGKILL), _another_controller),
    Way("F2", "controller stopped", "F2", "", _controller_signalled(signal.SIGSTOP), lambda bench: bench.controller.signal(signal.SIGCONT)),
    Way("F3", "one solve missed", "F3", "ENGAGED", _controller_told(skip=1)),
    Way("F4", "solver fails", "F4", "SAFE_STOP", _controller_told(status="FAILED"), lambda bench: bench.controller.ask(status="OK")),
    Way("F5", "bad commands", "F17", "SAFE_STOP", _bad_commands, lambda bench: bench.controller.ask(bad=None)),
    Way("F6", "a message missing", "F6", "SAFE_STOP", _missing, _car_heals(silent=[])),
    Way("F7", "wrong CRC", "F7", "SAFE_STOP", _corrupt, _car_heals(corrupt=[])),
    Way("F8", "speeds differ", "F8", "SAFE_STOP", _speed_off, _car_heals(wheel_speed_offset_mps=0.0)),
    Way("F8", "navigation frozen", "F8", "SAFE_STOP", _car_told(is_time_frozen=True), _car_heals(is_time_frozen=False)),
    Way("F9", "1 % lost", "F9 mild", "ENGAGED", _car_told(lose_norm=0.01), _car_heals(lose_norm=0.0), 2.0),
    Way("F9", "20 % lost", "F9", "SAFE_STOP", _car_told(lose_norm=0.2), _car_heals(lose_norm=0.0)),
    Way("F9", "120 ms late", "F9", "SAFE_STOP", _car_told(late_ms=120), _car_heals(late_ms=0)),
    Way("F10", "bus-off", "F10", "FAULT", _bus_off, ProcessBench.restart_gateway),
    Way("F11", "babbling idiot", "F11", "FAULT", _babbling, _quiet_again),
    Way("F11", "unknown identifiers", "F11 idle", "ENGAGED", _strangers, _quiet_again),
    Way("F12", "gateway killed", "F12", "", _gateway_signalled(signal.SIGKILL), ProcessBench.restart_gateway),
    Way("F12", "gateway stopped", "F12", "", _gateway_signalled(signal.SIGSTOP), ProcessBench.restart_gateway),
    Way("F13", "gateway sleeps for 70 ms", "F13", "SAFE_STOP", _gateway_sleeps(0.07)),
    Way("F13", "gateway sleeps for 500 ms, robots have let go", "F13", "STANDBY", _gateway_sleeps(0.5)),
    Way("F17", "telemetry flooded", "F17 telemetry", "ENGAGED", _flood("telemetry"), _no_flood, 1.0),
    Way("F17", "junk on the control sockets", "F17 telemetry", "ENGAGED", _flood("sockets"), _no_flood, 1.0),
    Way("E3", "driver overrides", "E3", "STANDBY", _overridden, _car_heals(override=0, override_of=[])),
)
