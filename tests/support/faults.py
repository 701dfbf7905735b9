"""The faults of the campaign: each begins at a random time within the tick that comes next and tells the oracle what has to follow.

An injection returns nothing: what it does lasts until the end of the trial. `World.mark` is where the oracle's clock starts.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace

from dbc.frame import CanFrame
from dbc.health import BusState, LinkHealth
from gateway.conditions import Surroundings
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, VehicleState
from tests.support.campaign import MS, TICK_NS, Frames, Tap, World, catalogue
from tests.support.taps import Edit, freeze, later_and_later, lose, randomly, rewrite, wire

NAVIGATION_MESSAGES = ("PosLocal", "VelocityLevel", "VelYawLocal", "RateVehicle", "AccelLevel", "MilliTime")
PROTECTED_MESSAGES = ("RC_SafetyStatus", "SR_Status", "AR_Status", "BR_Status")
NEEDED_MESSAGES = (*NAVIGATION_MESSAGES, *PROTECTED_MESSAGES, "CAR_WheelSpeeds", "CAR_Powertrain")
"""Cyclic messages of 10 ms without which no drive goes on; NcomStatus00 has a timeout of 2 s of its own."""


def random_time(world: World) -> int:
    """A time within the tick that comes next [ns]."""
    return world.now_ns + world.rng.randrange(1, TICK_NS)


@dataclass(frozen=True)
class Fault:
    """One row of the list, or one of the ways in which it happens.

    Args:
        req: id of the row.
        name: of this way.
        inject: begins it.
        duration_ns: how long a trial watches.
        lies_about: message whose content is wrong; two lies about one may make a truth.
    """

    req: str
    name: str
    inject: Callable[[World], None]
    duration_ns: int = 300 * MS
    lies_about: str = ""

    def __str__(self) -> str:
        return f"{self.req} {self.name}"


def controller_dies(world: World) -> None:
    """Killed, stopped, hung or deadlocked: what it was computing never comes."""
    at_ns = random_time(world)
    world.controller.is_alive = False
    world.lose_commands(at_ns)
    world.mark(at_ns, world.rng.choice(("F1", "F2")))


def spoil_commands(world: World, spoil: Callable[[ControlCommand], ControlCommand | None]) -> None:
    """From now on commands are wrong in this way, and no longer in the one before: what is due to three of those in a row is not."""
    world.mark_end("F5")
    world.controller.spoil = spoil


def one_solve_missed(world: World) -> None:
    """One command does not come; the next one does."""
    missed: list[ControlCommand] = []

    def spoil(command: ControlCommand) -> ControlCommand | None:
        if not missed:
            missed.append(command)
            return None
        return command

    spoil_commands(world, spoil)
    world.mark(random_time(world), "F3")


def solver_fails(degraded: int, then: CommandStatus | None) -> Callable[[World], None]:
    """Some shifted plans, then a command without a plan that can be used."""

    def inject(world: World) -> None:
        count = [0]

        def spoil(command: ControlCommand) -> ControlCommand:
            count[0] += 1
            if count[0] <= degraded:
                return replace(command, status=CommandStatus.DEGRADED)
            if count[0] == degraded + 1 and then is not None:
                world.mark_end("F3")
                world.mark(command.t_ns + world.controller.delay_ns, "F4")
            return command if then is None else replace(command, status=then)

        spoil_commands(world, spoil)
        if degraded:
            world.mark(world.now_ns, "F3")  # as good as one missed solve: no reaction is due to three degraded commands

    return inject


Spoil = Callable[[ControlCommand, random.Random], ControlCommand]


def _in_plan(command: ControlCommand, value: float, rng: random.Random) -> ControlCommand:
    plan = list(command.plan_steer_rad)
    plan[rng.randrange(HORIZON_STEPS)] = value
    return replace(command, plan_steer_rad=tuple(plan))


def _in_drive(command: ControlCommand, value: float, rng: random.Random) -> ControlCommand:
    plan = list(command.plan_drive_norm)
    plan[rng.randrange(HORIZON_STEPS)] = value
    return replace(command, plan_drive_norm=tuple(plan))


BAD_COMMANDS: dict[str, Spoil] = {
    "steering not a number": lambda command, rng: _in_plan(command, math.nan, rng),
    "steering infinite": lambda command, rng: _in_plan(command, rng.choice((math.inf, -math.inf)), rng),
    "steering out of range": lambda command, rng: _in_plan(command, rng.choice((1.5, -1.5)), rng),
    "drive not a number": lambda command, rng: _in_drive(command, math.nan, rng),
    "drive infinite": lambda command, rng: _in_drive(command, rng.choice((math.inf, -math.inf)), rng),
    "drive out of range": lambda command, rng: _in_drive(command, rng.choice((9.0, -9.0)), rng),
    "answers an old state": lambda command, rng: replace(command, state_seq=command.state_seq - rng.randrange(15, 100)),
    "answers a state to come": lambda command, rng: replace(command, state_seq=command.state_seq + rng.randrange(20, 100)),
    "repeated number": lambda command, rng: replace(command, seq=1),
    "time of another clock": lambda command, rng: replace(command, t_ns=command.t_ns + rng.choice((-1, 1)) * 400 * MS),
    "other sender": lambda command, rng: replace(command, boot_id=command.boot_id + 1),
}


def bad_commands(kind: str, count: int = 1 << 30) -> Callable[[World], None]:
    """Commands go bad; the third in a row has to end it, one alone has to be dropped."""

    def inject(world: World) -> None:
        seen = [0]

        def spoil(command: ControlCommand) -> ControlCommand:
            seen[0] += 1
            if seen[0] == 1 and count >= 3:
                world.mark(command.t_ns + world.controller.delay_ns, "F5")
            return BAD_COMMANDS[kind](command, world.rng) if seen[0] <= count else command

        spoil_commands(world, spoil)
        if count < 3:
            world.mark(world.now_ns, "F5 one")

    return inject


def second_controller(world: World) -> None:
    """A second controller sends besides the first, in another phase: good commands come in between."""
    strangers = [0]
    phase_ns = (world.controller.phase_ns + world.rng.randrange(12 * MS, 28 * MS)) % (40 * MS)
    own = world.controller.commands

    def both(since_ns: int, now_ns: int, state: VehicleState | None) -> list[tuple[int, ControlCommand]]:
        commands = own(since_ns, now_ns, state)
        begun_ns = since_ns - (since_ns - phase_ns) % (40 * MS) + 40 * MS
        if begun_ns <= now_ns and state is not None:
            strangers[0] += 1
            plan = (0.3,) * HORIZON_STEPS
            arrival_ns = begun_ns + world.controller.delay_ns
            if strangers[0] == 1:
                world.mark(arrival_ns, "F5")
            commands.append((arrival_ns, ControlCommand(
                4711, strangers[0], state.seq, begun_ns, CommandStatus.OK, 0, 0.0, 0.0, 0.3, 1.0, plan, (1.0,) * HORIZON_STEPS
            )))
        return commands

    world.controller.commands = both  # type: ignore[method-assign]


def missing(*names: str) -> Callable[[World], None]:
    """Messages stop coming."""

    def inject(world: World) -> None:
        at_ns = random_time(world)
        world.taps.append((at_ns, lose(names or (world.rng.choice(NEEDED_MESSAGES),))))
        world.mark(at_ns, "F6")

    return inject


def bad_frames(edit: Edit, names: tuple[str, ...], share: float = 1.0) -> Callable[[World], None]:
    """One of these messages goes bad, always or often."""

    def inject(world: World) -> None:
        at_ns, name = random_time(world), world.rng.choice(names)
        tap = rewrite(name, edit)
        if share < 1.0:
            tap = randomly(share, name, tap)
        world.taps.append((at_ns, tap))
        world.mark(at_ns, "F7")

    return inject


def implausible(*taps: Callable[[random.Random], Tap]) -> Callable[[World], None]:
    """A signal is wrong and well protected."""

    def inject(world: World) -> None:
        at_ns = random_time(world)
        world.taps += [(at_ns, tap(world.rng)) for tap in taps]
        world.mark(at_ns, "F8")

    return inject


def navigation_lags(world: World) -> None:
    """The delay of the navigation data creeps up; beyond their timeout it counts."""
    at_ns, growth = random_time(world), world.rng.uniform(0.05, 0.5)
    world.taps.append((at_ns, later_and_later(NAVIGATION_MESSAGES, at_ns, growth)))
    world.mark(at_ns + round(50 * MS / growth), "F9")


def either(rng: random.Random, low: float, high: float) -> float:
    """A number of that size, with either sign."""
    return rng.choice((-1.0, 1.0)) * rng.uniform(low, high)


def frozen_while_turning(world: World) -> None:
    """The steering robot's status stands still; that shows when the steering is to move."""
    angle_deg = world.car.steering_wheel_deg
    world.taps.append((random_time(world), freeze("SR_Status")))
    world.controller.steer_rad += either(world.rng, 0.02, 0.03)

    def watch(world: World) -> bool:
        is_apart = abs(world.car.told["SR_Command"]["AngleCommand"] - angle_deg) > 4.0  # 0.05 rad and a degree
        if is_apart:
            world.mark(world.now_ns, "F8")
        return is_apart

    world.watches.append(watch)


def frozen_while_braking(world: World) -> None:
    """One of the two sources of speed stands still; that shows when the car becomes slower."""
    speed_mps = world.car.vx_mps
    world.taps.append((random_time(world), freeze(world.rng.choice(("VelocityLevel", "CAR_WheelSpeeds")))))
    world.controller.drive_norm = -1.0

    def watch(world: World) -> bool:
        is_apart = speed_mps - world.car.vx_mps > max(2.0, 0.1 * speed_mps) + 0.1
        if is_apart:
            world.mark(world.now_ns, "F8")
        return is_apart

    world.watches.append(watch)


def disturbed(key: str | None, *taps: Tap) -> Callable[[World], None]:
    """The buses do something to all frames."""

    def inject(world: World) -> None:
        at_ns = random_time(world)
        world.taps += [(at_ns, tap) for tap in taps]
        if key is not None:
            world.mark(at_ns, key)

    return inject


def change_surroundings(world: World, at_ns: int, change: Callable[[int, Surroundings], Surroundings]) -> None:
    """What the gateway's process tells its core changes from a time on; what was wrong before stays wrong."""
    before = world.surroundings
    world.surroundings = lambda now_ns: change(now_ns, before(now_ns)) if now_ns >= at_ns else before(now_ns)


def bus_fails(state: BusState, network: str) -> Callable[[World], None]:
    """A bus is gone, bus-off, or takes no frames any more; then nothing comes from it either."""

    def inject(world: World) -> None:
        at_ns = random_time(world)

        def worse(now_ns: int, before: Surroundings) -> Surroundings:
            link = LinkHealth(state=state, bus_offs=1, last_bus_off_ns=at_ns)
            if state is BusState.ERROR_ACTIVE:
                link = before.links.get(network, LinkHealth())
                link = replace(link, unconfirmed_ns=max(now_ns - at_ns, link.unconfirmed_ns))
            return replace(before, links={**before.links, network: link})

        change_surroundings(world, at_ns, worse)
        world.is_deaf = world.is_deaf or network == "robots"
        if world.rng.random() < 0.5:
            silent = [spec.name for spec in catalogue().by_name.values() if spec.network == network and spec.sender != "GW"]
            world.taps.append((at_ns, lose(silent)))
        world.mark(at_ns, "F10")

    return inject


def strangers(per_tick: int) -> Callable[[World], None]:
    """Frames that nobody knows, of the highest priority."""

    def inject(world: World) -> None:
        at_ns = random_time(world)

        def flood(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
            unknown = [CanFrame(rng.randrange(0x40), rng.randbytes(rng.randrange(9)), t_ns) for _ in range(per_tick // 13)]
            return [*((t_ns, stranger) for stranger in unknown), (t_ns, frame)]

        world.taps.append((at_ns, flood))
        world.mark(at_ns, "F11 idle")

    return inject


def babbling(world: World) -> None:
    """A node of the highest priority takes all the time of a bus: neither our frames nor the car's get through."""
    at_ns = random_time(world)
    network = world.rng.choice(("robots", "navigation"))
    others = {spec.arbitration_id for spec in catalogue().by_name.values() if spec.network == network}

    def flood(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
        if frame.arbitration_id not in others:
            return [(t_ns, frame)]
        return [(t_ns, CanFrame(0, bytes(8), t_ns)) for _ in range(6)]

    world.taps.append((at_ns, flood))
    is_blocked = network == "robots"
    if is_blocked:
        world.is_deaf = True
        change_surroundings(
            world, at_ns,
            lambda now_ns, before: replace(before, links={**before.links, network: LinkHealth(unconfirmed_ns=now_ns - at_ns)}),
        )
    world.mark(at_ns, "F11")


def tenfold(world: World) -> None:
    """A node sends each frame ten times as often, with counters that go on."""
    name = world.rng.choice(PROTECTED_MESSAGES)
    message, counter = wire().by_name[name], [0]

    def tap(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
        if frame.arbitration_id != message.arbitration_id:
            return [(t_ns, frame)]
        counter[0] += 10
        return [(t_ns + k * MS, frame._replace(data=message.sealed(frame.data, counter[0] + k))) for k in range(10)]

    world.taps.insert(0, (random_time(world), tap))  # the node itself does it, before anything else happens to its frames


def gateway_dies(world: World) -> None:
    """Killed, or stopped for good."""
    at_ns = random_time(world)
    world.mark(at_ns, "F12")
    world.sleep(1 << 60)


def gateway_sleeps(world: World) -> None:
    """Stopped for half a second: the first frame after waking must be safe."""
    world.sleep(500 * MS)
    world.mark(world.gap_until_ns, "F13")


def recorder_fails(world: World) -> None:
    """Disk full, read-only, or the recorder gone."""
    at_ns = random_time(world)
    broken = world.rng.choice(({"is_recording": False}, {"disk_free_share": 0.0}))
    change_surroundings(world, at_ns, lambda now_ns, before: replace(before, **broken))
    world.mark(at_ns, "F15")


def junk_commands(world: World) -> None:
    """The controller's session is gone, and what comes instead is junk."""
    at_ns = random_time(world)
    kinds = list(BAD_COMMANDS.values())
    world.lose_commands(at_ns)
    world.controller.spoil = lambda command: world.rng.choice(kinds)(command, world.rng)
    world.mark(at_ns, "F17")


def no_fault(world: World) -> None:
    """A step of CLOCK_REALTIME: nothing here knows that clock."""
    world.mark(random_time(world), "F14")


def second_sender(world: World) -> None:
    """Another node sends one of the gateway's messages, protected as ours are."""
    name = world.rng.choice(("GW_SafetyCommand", "SR_Command", "AR_Command", "BR_Command"))
    message, at_ns = wire().by_name[name], random_time(world)
    data = message.sealed(world.rng.randbytes(message.length), world.rng.randrange(16))
    world.strangers.append((at_ns, CanFrame(message.arbitration_id, data, at_ns)))
    world.mark(at_ns, "second sender")


def driver(act: Callable[[World], str]) -> Callable[[World], None]:
    """The driver takes over; from the frame that says so on, one tick is allowed."""

    def inject(world: World) -> None:
        name = act(world)
        world.mark(world.next_frame_ns(name), "E3")

    return inject


def _robot_overridden(node: str) -> Callable[[World], str]:
    def act(world: World) -> str:
        world.car.override_of.add(node)
        return f"{node}_Status"

    return act


def _controller_overridden(world: World) -> str:
    world.car.override = 1
    return "RC_SafetyStatus"
