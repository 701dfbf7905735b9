"""Independent judge of everything that the gateway sends.

It is fed with all frames of all buses in order, and with what happened to the gateway (faults, operator requests, restarts), and knows
nothing but the DBC files and `oracle_limits`. It shares no code with the product. `oracle_process` is the same as a process of its own.
"""

from collections import deque
from dataclasses import dataclass, field
from functools import cache
from statistics import median
from typing import NamedTuple

from tests.support.oracle_limits import (
    ENVELOPES,
    MAX_COMMAND_AGE_MS,
    MESSAGE_RATE_RATIO,
    MS,
    REQUEST_WINDOW_NS,
    STANDING_MPS,
    WATCHDOG_ANSWER_NS,
    Car,
)
from tests.support.oracle_motion import STEER, CarSeen, MotionJudge
from tests.support.oracle_reactions import SILENT_NS, Answer, Stopwatch
from tests.support.oracle_wire import Wire, WireMessage, counter_of, profile2_crc

__all__ = ["Answer", "BusOracle", "Violation"]

_TICK_NS = 10 * MS
_RATE_WINDOW_NS = 1_000 * MS
_DRIVER_NS = 100 * MS
_RESYNC_NS = 60 * MS
_MAX_EARLY_NS = 2 * _TICK_NS  # of each message two may be on their way
_NEVER_NS = -(1 << 62)
_NEUTRAL_MODES = ("Off", "Standby")
_MAY_FOLLOW: dict[str, tuple[str | None, ...]] = {
    "None": ("Arm", "Engage", "Stop", "Disarm"),
    "Disarm": (None, "None", "Arm", "Engage", "Stop"),
    "Arm": (None, "Disarm"),
    "Engage": ("Arm",),
    "Stop": ("Engage",),
}
"""What the gateway may have claimed before what it claims now; None is silence."""
_TOLD: dict[str | None, tuple[str, ...]] = {
    None: (),
    "None": ("Fault",),
    "Disarm": ("Standby", "Fault"),
    "Arm": ("Ready",),
    "Engage": ("Engaged",),
    "Stop": ("SafeStop", "ComfortStop"),
}
"""Modes that the gateway may tell while it claims something."""


class Violation(NamedTuple):
    """Something that must never be on the bus."""

    t_ns: int
    rule: str
    detail: str


@dataclass
class _Stream:
    """One message of the gateway as seen so far."""

    counter: int | None = None
    last_ns: int = 0
    times: deque[int] = field(default_factory=deque)


@cache
def _shared_wire() -> Wire:
    return Wire()


class BusOracle:
    """Judges one gateway.

    Args:
        profile: limit profile that the gateway runs with.
        jitter_ns: how far the times of two frames may be off, 0 in virtual time.
        is_lossless: whether every frame that the gateway sends is seen here, so that counters have no gap.
        knows_requests: whether operator requests are told by `mark_request`.
        is_virtual: whether reactions are held to the times for virtual time, not to those for real processes.

    Attributes:
        violations: found so far.
        authority: what the newest safety command claims: None before the first, else "None", "Disarm", "Arm", "Engage" (follows the
            controller) or "Stop" (the gateway stops the car itself).
    """

    def __init__(
        self, profile: str = "nominal", car: Car | None = None, *, jitter_ns: int = 0, is_lossless: bool = True,
        knows_requests: bool = True, is_virtual: bool = True, wire: Wire | None = None,
    ) -> None:
        self._limits, self._car = ENVELOPES[profile], car or Car()
        self._jitter_ns, self._is_lossless, self._knows_requests = jitter_ns, is_lossless, knows_requests
        self._wire = wire or _shared_wire()
        self._own = {message.name for message in self._wire.of_gateway()}
        self.violations: list[Violation] = []
        self._stopwatch = Stopwatch(self._violate, jitter_ns, is_virtual=is_virtual)
        self._seen = CarSeen()
        self._requests: dict[str, int] = {}
        self._driver_ns = _NEVER_NS
        self._are_robots_engaged = True
        self._question_counter = 0
        self._questions: deque[tuple[int, int]] = deque(maxlen=16)
        self._asked_again_ns = _NEVER_NS
        self._start()

    def _start(self) -> None:
        self._streams = {name: _Stream() for name in self._own}
        self._motion = MotionJudge(self._limits, self._car, self._seen, self._jitter_ns, self._violate)
        self._measurement_id: int | None = None
        self._told_early: tuple[int, str] | None = None
        self.authority: str | None = None

    @property
    def reactions(self) -> list[Answer]:
        """Time from each marked fault to the first safe frame, of those that were in time."""
        return self._stopwatch.answers

    def mark_fault(self, t_ns: int, fault: str) -> None:
        """A fault of `oracle_limits.REACTIONS` begins at `t_ns`."""
        self._stopwatch.start(t_ns, fault, self.authority)

    def mark_end(self, fault: str) -> None:
        """A fault to which no reaction is due is over."""
        self._stopwatch.end(fault)

    def mark_undone(self, t_ns: int) -> None:
        """Faults that were to begin after `t_ns` do not."""
        self._stopwatch.undo(t_ns)

    def mark_gap(self, t_ns: int, until_ns: int) -> None:
        """The gateway's process is stopped from `t_ns` to `until_ns`."""
        self._stopwatch.gap(t_ns, until_ns)

    def mark_request(self, t_ns: int, operation: str) -> None:
        """The operator asks for `operation` ("ARM", "ENGAGE", "DISENGAGE", "STOP", "RESET")."""
        self._requests[operation] = t_ns

    def mark_restart(self) -> None:
        """The gateway's process starts anew: silent, with counters of its own."""
        self._start()
        self._requests.clear()

    def observe(self, t_ns: int, network: str, arbitration_id: int, data: bytes, *, is_from_gateway: bool) -> None:
        """Judge one frame; frames come in the order in which they were on the bus."""
        self._stopwatch.expire(t_ns)
        message = self._wire.by_id.get((network, arbitration_id))
        if is_from_gateway:
            self._judge(t_ns, message, network, arbitration_id, data)
        elif message is not None and len(data) == message.length:
            self._learn(t_ns, message, data)

    def finish(self, t_ns: int) -> list[Violation]:
        """All violations so far; silence until `t_ns` counts as an answer."""
        self._stopwatch.expire(t_ns)
        return self.violations

    def _violate(self, t_ns: int, rule: str, detail: str) -> None:
        self.violations.append(Violation(t_ns, rule, detail))

    def _is_asked(self, t_ns: int, *operations: str) -> bool:
        """Whether one of these was asked for just now."""
        return any(t_ns - self._requests.get(name, _NEVER_NS) <= REQUEST_WINDOW_NS + self._jitter_ns for name in operations)

    # ---- what the car says

    def _learn(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        if message.name == "VelocityLevel":
            self._seen.note_speed(t_ns, message.value(data, "VelForward"))
        elif message.name == "CAR_WheelSpeeds":
            wheels_radps = [message.value(data, signal) for signal in ("FrontLeft", "FrontRight", "RearLeft", "RearRight")]
            self._seen.note_wheels(t_ns, median(wheels_radps) * self._car.wheel_radius_m)
        elif message.name == "AccelLevel":
            self._seen.felt_deceleration_mps2 = -message.value(data, "AccelForward")
        elif message.data_id is not None and profile2_crc(data, message.data_id) == data[0]:
            if message.value(data, "DriverOverride"):
                self._driver_ns = t_ns
            if message.name == "RC_SafetyStatus":
                self._are_robots_engaged = message.choice(data, "SystemState") == "Engaged"
                self._learn_question(t_ns, message, data)

    def _learn_question(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        step, self._question_counter = (counter_of(data) - self._question_counter) % 16, counter_of(data)
        if 1 <= step <= 3:  # AUTOSAR profile 2: a receiver may lose two frames in a row
            if self._questions and t_ns - self._questions[-1][0] > WATCHDOG_ANSWER_NS:
                self._asked_again_ns = t_ns
            self._questions.append((t_ns, int(message.value(data, "WatchdogQuestion"))))

    # ---- what the gateway sends

    def _judge(self, t_ns: int, message: WireMessage | None, network: str, arbitration_id: int, data: bytes) -> None:
        if message is None or message.name not in self._own or len(data) != message.length:
            self._violate(t_ns, "allow-list", f"{network} 0x{arbitration_id:X} with {len(data)} bytes")
            return
        stream = self._streams[message.name]
        if message.data_id is not None:
            self._judge_protection(t_ns, message, stream, data)
        self._judge_message_rate(t_ns, message, stream)
        match message.name:
            case "GW_SafetyCommand":
                self._judge_safety(t_ns, message, data)
            case "SR_Command" | "AR_Command" | "BR_Command":
                self._judge_robot(t_ns, message, data)
            case "GW_Status":
                self._judge_status(t_ns, message, data)

    def _judge_protection(self, t_ns: int, message: WireMessage, stream: _Stream, data: bytes) -> None:
        if profile2_crc(data, message.data_id or 0) != data[0]:
            self._violate(t_ns, "crc", message.name)
        counter, before = counter_of(data), stream.counter
        if before is not None:
            step = (counter - before) % 16
            is_loss_possible = not self._is_lossless and t_ns - stream.last_ns + self._jitter_ns >= (step - 1) * message.cycle_ns
            if step == 0 or (step > 1 and not is_loss_possible):
                self._violate(t_ns, "counter", f"{message.name}: {before} -> {counter}")
        stream.counter, stream.last_ns = counter, t_ns

    def _judge_message_rate(self, t_ns: int, message: WireMessage, stream: _Stream) -> None:
        stream.times.append(t_ns)
        while stream.times[0] <= t_ns - _RATE_WINDOW_NS:
            stream.times.popleft()
        if message.cycle_ns and len(stream.times) > MESSAGE_RATE_RATIO * (_RATE_WINDOW_NS + self._jitter_ns) / message.cycle_ns:
            self._violate(t_ns, "message rate", f"{message.name}: {len(stream.times)} in 1 s")

    def _judge_safety(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        request, is_following = message.choice(data, "SystemRequest"), bool(message.value(data, "TrajectoryValid"))
        authority = ("Engage" if is_following else "Stop") if request == "Engage" else request
        if is_following and request != "Engage":
            self._violate(t_ns, "authority", f"trajectory valid with request {request}")
        if authority != self.authority:
            self._judge_change(t_ns, authority)
        is_continuous = t_ns - self._stopwatch.commanded_ns < 2 * _TICK_NS
        self._stopwatch.command(t_ns, authority)
        if self._told_early is not None:
            self._judge_told_early(t_ns, *self._told_early, is_continuous=is_continuous)
        if is_following and message.value(data, "CommandAge") > MAX_COMMAND_AGE_MS:
            self._violate(t_ns, "stale command", f"{message.value(data, 'CommandAge'):.0f} ms")
        if message.value(data, "MaxSpeed") > self._limits.max_speed_kmh:
            self._violate(t_ns, "max speed", f"{message.value(data, 'MaxSpeed'):.0f} km/h")
        if authority in ("Engage", "Stop"):
            self._judge_watchdog(t_ns, int(message.value(data, "WatchdogAnswer")))
        measurement_id, before = int(message.value(data, "MeasurementId")), self._measurement_id
        if self._is_lossless and is_continuous and before is not None and (measurement_id - before) % 16 > 1:
            self._violate(t_ns, "measurement id", f"{before} -> {measurement_id}")
        self._measurement_id = measurement_id

    def _judge_change(self, t_ns: int, authority: str) -> None:
        before, step = self.authority, f"{self.authority or 'silent'} -> {authority}"
        if before not in _MAY_FOLLOW.get(authority, ()):
            self._violate(t_ns, "authority", step)
        needed = {"Arm": ("ARM",), "Engage": ("ENGAGE",)}.get(authority, ("ARM", "RESET") if before is None else ())
        if self._knows_requests and needed and not self._is_asked(t_ns, *needed):
            self._violate(t_ns, "unasked", f"{step} without a request for it")
        if before in ("Engage", "Stop") and authority != "Stop" and t_ns - self._stopwatch.commanded_ns <= SILENT_NS:
            self._judge_letting_go(t_ns, before, step)
        self._motion.enter(t_ns, authority)
        self.authority = authority

    def _judge_letting_go(self, t_ns: int, before: str, step: str) -> None:
        """A moving car is let go when somebody has taken it, a driver or an operator, or when no robot has it."""
        speed_mps = self._seen.slowest_mps
        is_taken = t_ns - self._driver_ns <= _DRIVER_NS or not self._are_robots_engaged
        is_asked = not self._knows_requests or (before == "Engage" and self._is_asked(t_ns, "DISENGAGE"))
        if speed_mps > STANDING_MPS and not is_taken and not is_asked:
            self._violate(t_ns, "abandoned", f"{step} at {speed_mps:.1f} m/s, and nobody has taken over")

    def _judge_told_early(self, t_ns: int, told_ns: int, mode: str, *, is_continuous: bool) -> None:
        """While a bus was blocked, a status may have overtaken its commands: older ones were still in the controller, which has few places.

        Where it was blocked until the gateway fell silent, it is all that is left of them.
        """
        if mode in _TOLD.get(self.authority, ()) or not is_continuous:
            self._told_early = None
        elif t_ns - told_ns > _MAX_EARLY_NS + self._jitter_ns:
            self._violate(told_ns, "status", f"mode {mode} while {self.authority}")
            self._told_early = None

    def _judge_watchdog(self, t_ns: int, answer: int) -> None:
        # A receiver that has lost more needs some good frames until it trusts the next, and may ask for more of them than we do.
        since_ns = WATCHDOG_ANSWER_NS if t_ns - self._asked_again_ns > _RESYNC_NS else t_ns
        live = [question for asked_ns, question in self._questions if t_ns - asked_ns <= since_ns]
        live = live or [question for _, question in self._questions][-1:]
        if live and all(answer != ((question << 3 | question >> 5) & 0xFF) ^ 0xA7 for question in live):
            self._violate(t_ns, "watchdog", f"{answer} answers none of {live}")

    def _judge_robot(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        mode, is_enabled = message.choice(data, "Mode"), bool(message.value(data, "Enable"))
        demand = message.value(data, "AngleCommand" if message.name == STEER else "PositionCommand")
        if self.authority not in ("Engage", "Stop"):
            if is_enabled or mode not in _NEUTRAL_MODES or demand != 0.0:
                claim = self.authority or "silence"
                self._violate(t_ns, "not neutral", f"{message.name}: {mode}, enable {is_enabled}, {demand:g} in {claim}")
            self._motion.release(message.name)
        elif not is_enabled or mode != ("AnglePosition" if message.name == STEER else "Position"):
            self._violate(t_ns, "authority", f"{message.name}: {mode}, enable {is_enabled} in {self.authority}")
        else:
            self._motion.demand(t_ns, message.name, demand)

    def _judge_status(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        """The mode that is told must be the mode that is acted; it is sent after the commands of its tick."""
        mode, cause = message.choice(data, "Mode"), message.choice(data, "Cause")
        # In Fault nothing is commanded any more, not even to let go.
        is_commanding = t_ns - self._stopwatch.commanded_ns <= self._jitter_ns
        if mode not in _TOLD.get(self.authority, ()) and (is_commanding or mode != "Fault"):
            if self._is_lossless:
                self._violate(t_ns, "status", f"mode {mode} while {self.authority}")
            elif self._told_early is None:
                self._told_early = t_ns, mode
        if mode in ("SafeStop", "ComfortStop", "Fault") and cause == "None":
            self._violate(t_ns, "status", f"{mode} without a cause")
        self._motion.tell(t_ns, mode)
