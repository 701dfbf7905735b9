"""A gateway in virtual time between a car that follows its robots, a controller, an operator and a bus oracle that judges it.

Nothing here happens on the steps of the gateway alone: each message of the car, each command of the controller and each fault has a phase
of its own, and the steps follow the commands as in the gateway's process. A world that drives can be copied, so that thousands of faults
are tried from a handful of drives.
"""

import copy
import random
from collections.abc import Callable, Sequence
from functools import cache

from dbc.catalogue import Catalogue, load
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle, load_vehicle
from gateway.conditions import UNDISTURBED, Surroundings
from gateway.core import GatewayCore, StepOutput
from gateway.limits import PROFILES
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Mode, Operation, OperatorReply, OperatorRequest, VehicleState
from gateway.pacing import Pacer
from tests.support.bus_oracle import BusOracle
from tests.support.oracle_limits import REACTIONS
from tests.support.robots import StubCar

MS = 1_000_000
TICK_NS = 10 * MS
CONTROL_PERIOD_NS = 40 * MS

Frames = list[tuple[int, CanFrame]]
"""Frames with the time at which they arrive."""
Tap = Callable[[int, CanFrame, random.Random], Frames]
"""What a disturbed bus makes of a frame that is sent at a time [ns]."""


@cache
def catalogue() -> Catalogue:
    """The catalogue that all worlds share."""
    return load()


@cache
def vehicle() -> Vehicle:
    """The car that all worlds share."""
    return load_vehicle()


class Controller:
    """Sends a plan every 40 ms: a turn of constant curvature, and as much drive as keeps its speed.

    Attributes:
        spoil: what becomes of a command before it is sent; None drops it.
        is_alive: whether it sends.
    """

    def __init__(self, rng: random.Random, boot_id: int = 7) -> None:
        self.boot_id = boot_id
        self.seq = 0
        self.is_alive = True
        self.status = CommandStatus.OK
        self.steer_rad = 0.0
        self.drive_norm = 0.0
        self.lateral_error_m = self.heading_error_rad = 0.0
        self.plan_steer_rad: tuple[float, ...] | None = None
        self.spoil: Callable[[ControlCommand], ControlCommand | None] = lambda command: command
        self.phase_ns = rng.randrange(CONTROL_PERIOD_NS)
        self.delay_ns = rng.randrange(2 * MS, 20 * MS)

    def commands(self, since_ns: int, now_ns: int, state: VehicleState | None) -> list[tuple[int, ControlCommand]]:
        """Commands that are begun in (since, now], with the time at which they arrive."""
        begun_ns = since_ns - (since_ns - self.phase_ns) % CONTROL_PERIOD_NS + CONTROL_PERIOD_NS
        if begun_ns > now_ns or state is None or not self.is_alive:
            return []
        self.seq += 1
        plan_steer_rad = self.plan_steer_rad or (self.steer_rad,) * HORIZON_STEPS
        command = self.spoil(ControlCommand(
            boot_id=self.boot_id, seq=self.seq, state_seq=state.seq, t_ns=begun_ns, status=self.status, solve_time_ns=self.delay_ns,
            lateral_error_m=self.lateral_error_m, heading_error_rad=self.heading_error_rad, steer_rad=self.steer_rad,
            drive_norm=self.drive_norm, plan_steer_rad=plan_steer_rad, plan_drive_norm=(self.drive_norm,) * HORIZON_STEPS,
        ))
        return [] if command is None else [(begun_ns + self.delay_ns, command)]


class World:
    """One gateway and all around it.

    Args:
        seed: of everything that is random in it.
        profile: limit profile of the gateway.

    Attributes:
        taps: what the buses do to the car's frames now, each with the time from which on it does it.
        commands: on their way to the gateway, by time of arrival.
        looks: how often the gateway looks at its buses between two steps.
        gap_until_ns: until then the gateway does not run.
        is_deaf: whether the car hears nothing of the gateway.
        watches: called after every tick until they answer True.
        least_severity: of the reactions that are awaited; of two faults only the severer has to be answered.
        replies: of the gateway to the operator.
    """

    def __init__(self, seed: int, profile: str = "nominal", speed_mps: float = 15.0) -> None:
        self.seed = seed
        self.rng = random.Random(seed)
        self.profile = profile
        self.core = new_core(profile, boot_id=1)
        self.car = StubCar(catalogue(), vx_mps=speed_mps, vy_mps=0.0, yaw_rate_radps=0.0, is_following=True)
        self.controller = Controller(self.rng)
        self.oracle = BusOracle(profile)
        self.now_ns = 1_000_000 * MS + self.rng.randrange(1_000 * MS)
        self.phases = {spec.arbitration_id: self.rng.randrange(1, TICK_NS) for spec in catalogue().by_name.values()}
        self.looks = self.rng.choice((0, 1, 4))
        self.stamps_arrivals = self.rng.random() < 0.5  # else frames carry the time of the look that fetched them
        self.surroundings: Callable[[int], Surroundings] = lambda now_ns: UNDISTURBED
        self.taps: list[tuple[int, Tap]] = []
        self.strangers: Frames = []
        self.commands: list[tuple[int, ControlCommand]] = []
        self.requests: list[OperatorRequest] = []
        self.replies: list[OperatorReply] = []
        self.gap_until_ns = 0
        self.is_deaf = False
        self.around: dict[str, object] = {}
        self.watches: list[Callable[[World], bool]] = []
        self.least_severity = 0
        self.output: StepOutput | None = None
        self.state: VehicleState | None = None
        self.sent: list[CanFrame] = []
        self.pacer = Pacer(self.now_ns, TICK_NS)
        self._begun_ns = self._car_ns = self.now_ns
        self._sent: Frames = []
        self._on_the_way: Frames = []
        self._request_seq = 0

    def __deepcopy__(self, memo: dict[int, object]) -> "World":
        """A copy that goes on alone; what never changes is shared."""
        for shared in (catalogue(), vehicle(), *catalogue().by_name.values(), *PROFILES.values(), PROFILES, UNDISTURBED):
            memo[id(shared)] = shared
        for container in (catalogue().by_name, catalogue().by_id):
            memo[id(container)] = container
        twin = object.__new__(World)
        memo[id(self)] = twin
        for name, value in self.__dict__.items():
            setattr(twin, name, copy.deepcopy(value, memo))
        return twin

    def branch(self, seed: int) -> "World":
        """A copy with dice of its own."""
        twin = copy.deepcopy(self)
        twin.seed, twin.rng = seed, random.Random(seed)
        return twin

    @property
    def mode(self) -> Mode:
        """Mode of the gateway."""
        return self.core.mode

    def mark(self, t_ns: int, fault: str) -> None:
        """A fault of the oracle's table begins; while the gateway sleeps it is due when it wakes."""
        if REACTIONS[fault].kind.severity >= self.least_severity:
            self.oracle.mark_fault(t_ns, fault)

    def mark_end(self, fault: str) -> None:
        """A fault to which no reaction is due is over."""
        self.oracle.mark_end(fault)

    def next_frame_ns(self, name: str) -> int:
        """When the car sends the first frame of a message that knows what is done to the car now."""
        return self._car_ns + self.phases[catalogue().by_name[name].arbitration_id]

    def lose_commands(self, from_ns: int) -> None:
        """Commands that would arrive from then on do not; what was wrong with them has not happened."""
        self.commands = [entry for entry in self.commands if entry[0] <= from_ns]
        self.oracle.mark_undone(from_ns)

    def sleep(self, duration_ns: int) -> None:
        """The gateway's process does not run, from now on."""
        self.gap_until_ns = max(self.gap_until_ns, self.now_ns + duration_ns)
        self.oracle.mark_gap(self.now_ns, self.gap_until_ns)

    def ask(self, operation: Operation) -> None:
        """The operator asks for something; it is heard in the next tick."""
        self._request_seq += 1
        self.requests.append(OperatorRequest(9, self._request_seq, operation, self.now_ns + 1))

    def restart_gateway(self) -> None:
        """A new process in place of the old one."""
        self.core = new_core(self.profile, boot_id=self.rng.randrange(2, 1 << 31))
        self.oracle.mark_restart()
        self.output, self.state, self.commands, self.gap_until_ns = None, None, [], 0
        self.pacer = Pacer(self.now_ns, TICK_NS)

    def run(self, duration_ns: int) -> "World":
        """Let time pass, to the first step at or after its end."""
        end_ns = self.now_ns + duration_ns
        while self.now_ns < end_ns:
            self.tick()
        return self

    def run_until(self, is_reached: Callable[["World"], bool], limit_ns: int) -> "World":
        """Let time pass until something is so, at most for `limit_ns`."""
        end_ns = self.now_ns + limit_ns
        while self.now_ns < end_ns and not is_reached(self):
            self.tick()
        return self

    def tick(self) -> None:
        """To the next step of the gateway: the buses carry what was sent, the gateway steps, the car hears."""
        self._begin_commands(self.pacer.deadline_ns)
        if self.now_ns + TICK_NS <= self.gap_until_ns - TICK_NS:
            self.now_ns += TICK_NS
            self._carry(self.now_ns)
            return
        since_ns, self.now_ns = self.now_ns, max(self._next_step_ns(), self.gap_until_ns)
        self.pacer.stepped(self.now_ns)
        self._carry(self.now_ns)
        frames = self._look(since_ns)
        request = self.requests.pop(0) if self.requests else None
        if request is not None:
            self.oracle.mark_request(self.now_ns, request.operation.name)
        self.output = self.core.step(self.now_ns, frames, self._newest_command(), request, self.surroundings(self.now_ns))
        self.state, self.sent = self.output.state, self.output.frames
        if self.output.reply is not None:
            self.replies.append(self.output.reply)
        for frame in self.sent:
            self.oracle.observe(self.now_ns, "robots", frame.arbitration_id, frame.data, is_from_gateway=True)
        if not self.is_deaf:
            self.car.hear(self.sent)
        if self.watches:
            self.watches = [watch for watch in self.watches if not watch(self)]

    def _begin_commands(self, until_ns: int) -> None:
        """What the controller begins until then."""
        if until_ns > self._begun_ns:
            self.commands += self.controller.commands(self._begun_ns, until_ns, self.state)
            self._begun_ns = until_ns

    def _next_step_ns(self) -> int:
        """When the gateway steps, as its process decides: at the deadline, or with a command shortly before it."""
        for arrival_ns in sorted(t_ns for t_ns, _ in self.commands):
            if arrival_ns >= self.pacer.deadline_ns:
                break
            self.pacer.command_arrived(arrival_ns)
            if self.pacer.is_due(arrival_ns):
                return arrival_ns
        return self.pacer.deadline_ns

    def _carry(self, until_ns: int) -> None:
        """The car speaks every 10 ms, each message at its phase; what is sent by then goes through whatever disturbs the buses."""
        while self._car_ns < until_ns:
            self._sent += [(self._car_ns + self.phases[frame.arbitration_id], frame) for frame in self.car.speak(self._car_ns)]
            self._car_ns += TICK_NS
        frames = [entry for entry in self._sent if entry[0] <= until_ns]
        self._sent = [entry for entry in self._sent if entry[0] > until_ns]
        for start_ns, tap in self.taps:
            frames = [
                arrival for t_ns, frame in frames for arrival in (tap(t_ns, frame, self.rng) if t_ns >= start_ns else [(t_ns, frame)])
            ]
        self._on_the_way += frames + self.strangers
        self.strangers = []

    def _look(self, since_ns: int) -> list[CanFrame]:
        """What has come by now, in its order; of it the gateway has already seen what came before one of its looks between two steps."""
        frames = self._arrived()
        for k in range(1, self.looks + 1):
            look_ns = since_ns + k * (self.now_ns - since_ns) // (self.looks + 1)
            seen = [frame for frame in frames if frame.t_ns <= look_ns]
            if seen:
                self.state = self.core.sense(look_ns, [self._stamped(frame, look_ns) for frame in seen]) or self.state
                frames = frames[len(seen) :]
        return [self._stamped(frame, self.now_ns) for frame in frames]

    def _arrived(self) -> list[CanFrame]:
        """Frames that are there by now, in the order of their arrival, with its time."""
        arrived = sorted((entry for entry in self._on_the_way if entry[0] <= self.now_ns), key=_time_of)
        self._on_the_way = [entry for entry in self._on_the_way if entry[0] > self.now_ns]
        known = catalogue().by_id
        for t_ns, frame in arrived:
            spec = known.get(frame.arbitration_id)
            if spec is not None and spec.sender != "GW":
                self.oracle.observe(t_ns, spec.network, frame.arbitration_id, frame.data, is_from_gateway=False)
        return [frame._replace(t_ns=t_ns) for t_ns, frame in arrived]

    def _stamped(self, frame: CanFrame, look_ns: int) -> CanFrame:
        return frame if self.stamps_arrivals else frame._replace(t_ns=look_ns)

    def _newest_command(self) -> ControlCommand | None:
        """The channel keeps the newest datagram only."""
        arrived = [entry for entry in self.commands if entry[0] <= self.now_ns]
        self.commands = [entry for entry in self.commands if entry[0] > self.now_ns]
        return max(arrived, key=_time_of)[1] if arrived else None

    def arm(self) -> "World":
        """Wait until everything is good and arm."""
        self.run_until(lambda world: not world.core.blockers and world.core.ticks > 5, 6_000 * MS)
        self.ask(Operation.ARM)
        self.run(60 * MS)
        assert self.mode is Mode.READY, (self.replies[-1:], self.core.blockers)
        return self

    def engage(self) -> "World":
        """Arm and engage."""
        self.arm()
        self.ask(Operation.ENGAGE)
        self.tick()
        assert self.mode is Mode.ENGAGED, self.replies[-1]
        return self


def _time_of(entry: tuple[int, object]) -> int:
    return entry[0]


def new_core(profile: str, boot_id: int) -> GatewayCore:
    """A gateway as its process makes it."""
    return GatewayCore(catalogue(), vehicle(), boot_id=boot_id, profile=PROFILES[profile])


@cache
def drives() -> Sequence[World]:
    """Engaged worlds to try faults on: straight and in bends, slow and fast, accelerating and braking, in each profile of the road."""
    return [drive(seed, *setting) for seed, setting in enumerate(_SETTINGS)]


_SETTINGS = (
    ("nominal", 15.0, 0.0, 0.05),
    ("nominal", 8.0, 0.04, 0.0),
    ("nominal", 25.0, -0.01, -0.1),
    ("proving_ground", 22.0, 0.02, 0.3),
    ("proving_ground", 12.0, -0.06, 0.0),
    ("nominal", 3.0, 0.2, 0.1),
)


def drive(seed: int, profile: str, speed_mps: float, steer_rad: float, drive_norm: float) -> World:
    """An engaged world that has settled on a plan."""
    world = World(seed, profile, speed_mps).engage()
    world.controller.steer_rad, world.controller.drive_norm = steer_rad, drive_norm
    world.run(1_500 * MS)
    assert world.mode is Mode.ENGAGED, world.core.reason
    assert not world.oracle.violations, world.oracle.violations[:3]
    return world
