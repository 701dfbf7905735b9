"""Independent judge of everything that the gateway sends.

It is fed with all frames of all buses in order, and with what happened to the gateway (faults, operator requests, restarts), and knows
nothing but the DBC files and `oracle_limits`. It shares no code with the product.
"""

import math
from collections import deque
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from tests.support.oracle_limits import (
    COMFORT_STOP_JERK_MPS3,
    COMFORT_STOP_MPS2,
    ENVELOPES,
    MAX_COMMAND_AGE_MS,
    MESSAGE_RATE_RATIO,
    MS,
    PLAN_TAIL_NS,
    REACTIONS,
    REQUEST_WINDOW_NS,
    SAFE_STOP_JERK_MPS3,
    SAFE_STOP_MPS2,
    STANDING_MPS,
    STANDSTILL_BRAKE_PERCENT,
    WATCHDOG_ANSWER_NS,
    Car,
    Kind,
)
from tests.support.oracle_wire import Wire, WireMessage, counter_of, profile2_crc

SAFETY, STEER, DRIVE, BRAKE = "GW_SafetyCommand", "SR_Command", "AR_Command", "BR_Command"
STATUS = "GW_Status"
_TICK_NS = 10 * MS
_RATE_WINDOW_NS = 1_000 * MS
_DEMAND_WINDOW_NS = 250 * MS  # panda's real-time window
_SPEED_WINDOW_NS = 120 * MS  # age of a speed that the gateway may still rely on
_STEER_LSB_DEG, _PEDAL_LSB_PERCENT, _ACCELERATION_LSB_MPS2 = 0.05, 0.01, 0.01
_NEUTRAL_MODES = ("Off", "Standby")
_SILENT_NS = 30 * MS
_DRIVER_NS = 100 * MS
_NEVER_NS = 1 << 62
_UNSAFE = {Kind.STOP: ("Engage",), Kind.RELEASE: ("Engage", "Stop"), Kind.SILENCE: ("Engage", "Stop")}
"""What the gateway must no longer claim after a fault, by the reaction that is due."""


class Violation(NamedTuple):
    """Something that must never be on the bus."""

    t_ns: int
    rule: str
    detail: str


class Answer(NamedTuple):
    """How long the gateway took to react to a fault."""

    fault: str
    latency_ns: int


@dataclass
class _Stream:
    """One protected or cyclic message of the gateway as seen so far."""

    counter: int | None = None
    last_ns: int = 0
    times: "deque[int] | None" = None


@dataclass
class _Pending:
    """A fault whose reaction is awaited."""

    fault: str
    marked_ns: int
    kind: Kind
    deadline_ns: int


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
        reactions: time from each marked fault to the first safe frame.
        authority: what the newest safety command asks for: None before the first, else "None", "Disarm", "Arm", "Engage" (follows the
            controller) or "Stop" (the gateway stops the car itself).
    """

    def __init__(
        self, profile: str = "nominal", car: Car | None = None, *, jitter_ns: int = 0, is_lossless: bool = True,
        knows_requests: bool = True, is_virtual: bool = True, wire: Wire | None = None,
    ) -> None:
        self._limits, self._car = ENVELOPES[profile], car or Car()
        self._jitter_ns, self._is_lossless, self._knows_requests = jitter_ns, is_lossless, knows_requests
        self._is_virtual = is_virtual
        self._wire = wire or _shared_wire()
        self._own = {message.name for message in self._wire.of_gateway()}
        self.violations: list[Violation] = []
        self.reactions: list[Answer] = []
        self._pending: list[_Pending] = []
        self._requests: dict[str, int] = {}
        self._now_ns = 0
        self._speeds: deque[tuple[int, float]] = deque()
        self._felt_deceleration_mps2 = 0.0
        self._driver_ns = -_NEVER_NS
        self._question_counter = 0
        self._questions: deque[tuple[int, int]] = deque(maxlen=8)
        self._commanded_ns = 0
        self._gap_until_ns = 0
        self._start()

    def _start(self) -> None:
        self._streams = {name: _Stream(times=deque()) for name in self._own}
        self.authority: str | None = None
        self._entered_ns = 0
        self._steer: deque[tuple[int, float]] = deque()
        self._brake_percent = self._drive_percent = 0.0
        self._pedals_ns = 0
        self._entry_deceleration_mps2 = self._deceleration_mps2 = 0.0
        self._acceleration_mps2 = 0.0
        self._measurement_id: int | None = None
        self.status_mode = "Silent"
        self._told_ns = 0

    def mark_fault(self, t_ns: int, fault: str) -> None:
        """A fault of the table begins at `t_ns`."""
        reaction = REACTIONS[fault]
        if self.authority == "Engage" or (self.authority == "Stop" and reaction.kind in (Kind.RELEASE, Kind.SILENCE)):
            within_ns = reaction.within_ns if self._is_virtual else reaction.within_process_ns or reaction.within_ns
            deadline_ns = max(t_ns + within_ns + self._jitter_ns, self._gap_until_ns)
            self._pending.append(_Pending(fault, t_ns, reaction.kind, deadline_ns))

    def mark_gap(self, t_ns: int, until_ns: int) -> None:
        """The gateway's process is stopped from `t_ns` to `until_ns`: what is due in this time is due at its first frame after it."""
        self._gap_until_ns = until_ns
        for pending in self._pending:
            if pending.deadline_ns > t_ns:
                pending.deadline_ns = max(pending.deadline_ns, until_ns)

    def mark_end(self, fault: str) -> None:
        """A fault to which no reaction is due is over."""
        self._pending = [pending for pending in self._pending if pending.fault != fault]

    def mark_undone(self, t_ns: int) -> None:
        """Faults that were to begin after `t_ns` do not."""
        self._pending = [pending for pending in self._pending if pending.marked_ns <= t_ns]

    def mark_request(self, t_ns: int, operation: str) -> None:
        """The operator asks for `operation` ("ARM", "ENGAGE", "DISENGAGE", "STOP", "RESET")."""
        self._requests[operation] = t_ns

    def mark_restart(self, t_ns: int) -> None:
        """The gateway's process starts anew: silent, with counters of its own."""
        self._start()
        self._requests.clear()

    def observe(self, t_ns: int, network: str, arbitration_id: int, data: bytes, *, is_from_gateway: bool) -> None:
        """Judge one frame; frames come in the order in which they were on the bus."""
        self._expire(t_ns)
        self._now_ns = t_ns
        message = self._wire.by_id.get((network, arbitration_id))
        if is_from_gateway:
            self._judge(t_ns, message, network, arbitration_id, data)
        elif message is not None and len(data) == message.length:
            self._learn(t_ns, message, data)

    def finish(self, t_ns: int) -> list[Violation]:
        """All violations, with the reactions that are overdue at `t_ns`."""
        self._expire(t_ns)
        return self.violations

    def _violate(self, t_ns: int, rule: str, detail: str) -> None:
        self.violations.append(Violation(t_ns, rule, detail))

    # ---- what the car says

    def _learn(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        if message.name == "VelocityLevel":
            self._speeds.append((t_ns, abs(message.value(data, "VelForward"))))
            while self._speeds[0][0] < t_ns - _SPEED_WINDOW_NS and len(self._speeds) > 1:
                self._speeds.popleft()
        elif message.name == "AccelLevel":
            self._felt_deceleration_mps2 = -message.value(data, "AccelForward")
        elif message.data_id is not None and profile2_crc(data, message.data_id) == data[0]:
            if message.value(data, "DriverOverride"):
                self._driver_ns = t_ns
            if message.name == "RC_SafetyStatus":
                self._learn_question(t_ns, message, data)

    def _learn_question(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        step, self._question_counter = (counter_of(data) - self._question_counter) % 16, counter_of(data)
        if 1 <= step <= 3:  # AUTOSAR profile 2: a receiver may lose two frames in a row
            self._questions.append((t_ns, int(message.value(data, "WatchdogQuestion"))))

    def _speed_mps(self) -> float:
        """The smallest speed that the gateway may have relied on."""
        return min((speed for _, speed in self._speeds), default=0.0)

    def _fastest_mps(self) -> float:
        """The largest one."""
        return max((speed for _, speed in self._speeds), default=0.0)

    # ---- what the gateway sends

    def _judge(self, t_ns: int, message: WireMessage | None, network: str, arbitration_id: int, data: bytes) -> None:
        if message is None or message.name not in self._own or len(data) != message.length:
            self._violate(t_ns, "allow-list", f"{network} 0x{arbitration_id:X} with {len(data)} bytes")
            return
        self._judge_stream(t_ns, message, data)
        match message.name:
            case "GW_SafetyCommand":
                self._judge_safety(t_ns, message, data)
            case "SR_Command" | "AR_Command" | "BR_Command":
                self._judge_robot(t_ns, message, data)
            case "GW_Status":
                self._judge_status(t_ns, message, data)

    def _judge_stream(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        stream = self._streams[message.name]
        if message.data_id is not None:
            if profile2_crc(data, message.data_id) != data[0]:
                self._violate(t_ns, "crc", message.name)
            counter = counter_of(data)
            if stream.counter is not None:
                step = (counter - stream.counter) % 16
                lost_ns = (step - 1) * message.cycle_ns
                if step == 0 or (step > 1 and (self._is_lossless or t_ns - stream.last_ns + self._jitter_ns < lost_ns)):
                    self._violate(t_ns, "counter", f"{message.name}: {stream.counter} -> {counter}")
            stream.counter = counter
        stream.last_ns = t_ns
        if message.cycle_ns and stream.times is not None:
            stream.times.append(t_ns)
            while stream.times[0] <= t_ns - _RATE_WINDOW_NS:
                stream.times.popleft()
            if len(stream.times) > MESSAGE_RATE_RATIO * (_RATE_WINDOW_NS + self._jitter_ns) / message.cycle_ns:
                self._violate(t_ns, "message rate", f"{message.name}: {len(stream.times)} in 1 s")

    def _judge_safety(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        request = message.choice(data, "SystemRequest")
        is_following = bool(message.value(data, "TrajectoryValid"))
        authority = ("Engage" if is_following else "Stop") if request == "Engage" else request
        if is_following and request != "Engage":
            self._violate(t_ns, "authority", f"trajectory valid with request {request}")
        if authority != self.authority:
            self._judge_change(t_ns, authority)
        is_continuous = t_ns - self._commanded_ns < 2 * _TICK_NS
        self._settle(t_ns, authority)
        if is_following and message.value(data, "CommandAge") > MAX_COMMAND_AGE_MS:
            self._violate(t_ns, "stale command", f"{message.value(data, 'CommandAge'):.0f} ms")
        if message.value(data, "MaxSpeed") > self._limits.max_speed_kmh:
            self._violate(t_ns, "max speed", f"{message.value(data, 'MaxSpeed'):.0f} km/h")
        self._judge_watchdog(t_ns, int(message.value(data, "WatchdogAnswer")), authority)
        measurement_id = int(message.value(data, "MeasurementId"))
        if self._is_lossless and is_continuous and self._measurement_id is not None and (measurement_id - self._measurement_id) % 16 > 1:
            self._violate(t_ns, "measurement id", f"{self._measurement_id} -> {measurement_id}")
        self._measurement_id = measurement_id

    def _judge_change(self, t_ns: int, authority: str) -> None:
        before = self.authority
        may_follow = {
            "None": ("Arm", "Engage", "Stop", "Disarm"),
            "Disarm": (None, "None", "Arm", "Engage", "Stop"),
            "Arm": (None, "Disarm"),
            "Engage": ("Arm",),
            "Stop": ("Engage",),
        }
        if before not in may_follow.get(authority, ()):
            self._violate(t_ns, "authority", f"{before or 'silent'} -> {authority}")
        if self._knows_requests:
            needed = {"Arm": ("ARM",), "Engage": ("ENGAGE",)}.get(authority, ("ARM", "RESET") if before is None else ())
            if needed and not any(t_ns - self._requests.get(name, -_NEVER_NS) <= REQUEST_WINDOW_NS + self._jitter_ns for name in needed):
                self._violate(t_ns, "unasked", f"{before or 'silent'} -> {authority} without a request for it")
        if before in ("Engage", "Stop") and authority != "Stop" and t_ns - self._commanded_ns <= _SILENT_NS:
            self._judge_letting_go(t_ns, before, authority)
        if authority == "Stop":
            # A car that brakes already goes on braking; it feels a little more than the pedal is asked for.
            self._entry_deceleration_mps2 = max(self._deceleration_mps2, self._felt_deceleration_mps2 + _ACCELERATION_LSB_MPS2)
        if authority not in ("Engage", "Stop"):
            self._steer.clear()
        self.authority, self._entered_ns = authority, t_ns

    def _judge_letting_go(self, t_ns: int, before: str, authority: str) -> None:
        """A moving car is let go when somebody has taken it: a driver whom the robots feel, or an operator who has said so."""
        is_taken = t_ns - self._driver_ns <= _DRIVER_NS
        is_asked = before == "Engage" and t_ns - self._requests.get("DISENGAGE", -_NEVER_NS) <= REQUEST_WINDOW_NS + self._jitter_ns
        if self._speed_mps() > STANDING_MPS and not is_taken and not (is_asked or not self._knows_requests):
            self._violate(t_ns, "abandoned", f"{before} -> {authority} at {self._speed_mps():.1f} m/s, and nobody has taken over")

    def _judge_watchdog(self, t_ns: int, answer: int, authority: str) -> None:
        if not self._questions or authority not in ("Engage", "Stop"):
            return
        live = [question for asked_ns, question in self._questions if t_ns - asked_ns <= WATCHDOG_ANSWER_NS]
        live = live or [self._questions[-1][1]]
        if all(answer != ((question << 3 | question >> 5) & 0xFF) ^ 0xA7 for question in live):
            self._violate(t_ns, "watchdog", f"{answer} answers none of {live}")

    def _judge_robot(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        mode = message.choice(data, "Mode")
        is_enabled = bool(message.value(data, "Enable"))
        demand = message.value(data, "AngleCommand" if message.name == STEER else "PositionCommand")
        if self.authority not in ("Engage", "Stop"):
            if is_enabled or mode not in _NEUTRAL_MODES or demand != 0.0:
                self._violate(t_ns, "not neutral", f"{message.name}: {mode}, enable {is_enabled}, {demand:g} in {self.authority or 'silence'}")
            self._forget_demand(message.name)
        elif not is_enabled or mode != ("AnglePosition" if message.name == STEER else "Position"):
            self._violate(t_ns, "authority", f"{message.name}: {mode}, enable {is_enabled} in {self.authority}")
        elif message.name == STEER:
            self._judge_steering(t_ns, demand)
        elif message.name == DRIVE:
            self._drive_percent = demand
        else:
            self._brake_percent = demand
            self._judge_pedals(t_ns)

    def _forget_demand(self, name: str) -> None:
        if name == DRIVE:
            self._drive_percent = 0.0
        elif name == BRAKE:
            self._brake_percent, self._pedals_ns, self._deceleration_mps2, self._acceleration_mps2 = 0.0, 0, 0.0, 0.0

    def _judge_steering(self, t_ns: int, angle_deg: float) -> None:
        car, limits = self._car, self._limits
        if abs(angle_deg) > limits.steering_wheel_limit_deg + _STEER_LSB_DEG:
            self._violate(t_ns, "steering angle", f"{angle_deg:.2f} deg")
        if not self._steer:
            self._steer.append((t_ns, angle_deg))
            return
        previous_ns, previous_deg = self._steer[-1]
        dt_s = max(t_ns - previous_ns + self._jitter_ns, _TICK_NS) * 1e-9
        step_deg = angle_deg - previous_deg
        if abs(step_deg) > limits.steering_wheel_rate_dps * dt_s + _STEER_LSB_DEG:
            self._violate(t_ns, "steering rate", f"{step_deg / dt_s:.0f} deg/s")
        window_ns, window_deg = self._steer[0]
        reach_s = max(t_ns - window_ns + self._jitter_ns, _TICK_NS) * 1e-9
        if abs(angle_deg - window_deg) > limits.steering_wheel_rate_dps * reach_s + _STEER_LSB_DEG:
            self._violate(t_ns, "steering window", f"{angle_deg - window_deg:.1f} deg in {reach_s * 1e3:.0f} ms")
        gain = self._speed_mps() ** 2 / car.wheelbase_m
        now_mps2, was_mps2, lsb_mps2 = (
            gain * math.tan(math.radians(angle) / car.steering_ratio) for angle in (angle_deg, previous_deg, _STEER_LSB_DEG)
        )
        # A demand that comes back from outside is no violation: the car was handed over like this, or has become faster.
        if abs(now_mps2) > limits.lateral_acceleration_mps2 + lsb_mps2 and abs(now_mps2) >= abs(was_mps2):
            self._violate(t_ns, "lateral acceleration", f"{now_mps2:.2f} m/s2")
        if abs(now_mps2 - was_mps2) > limits.lateral_jerk_mps3 * dt_s + lsb_mps2:
            self._violate(t_ns, "lateral jerk", f"{(now_mps2 - was_mps2) / dt_s:.2f} m/s3")
        if self.authority == "Stop" and previous_ns - self._entered_ns > PLAN_TAIL_NS + 200 * MS and abs(step_deg) > _STEER_LSB_DEG \
                and self._fastest_mps() ** 2 * math.tan(math.radians(abs(angle_deg)) / car.steering_ratio) / car.wheelbase_m < 0.9 * limits.lateral_acceleration_mps2:
            self._violate(t_ns, "steering tail", f"{step_deg:.2f} deg in one frame after the end of any plan")
        self._steer.append((t_ns, angle_deg))
        while self._steer[0][0] < t_ns - _DEMAND_WINDOW_NS:
            self._steer.popleft()

    def _judge_pedals(self, t_ns: int) -> None:
        car, limits = self._car, self._limits
        for name, percent in (("accelerator", self._drive_percent), ("brake", self._brake_percent)):
            if not 0.0 <= percent <= 100.0:
                self._violate(t_ns, "pedal range", f"{name} {percent:g} %")
        if self._drive_percent > 0.0 and self._brake_percent > 0.0:
            self._violate(t_ns, "both pedals", f"{self._drive_percent:g} % and {self._brake_percent:g} %")
        lsb_mps2 = 1e-2 * _PEDAL_LSB_PERCENT * car.full_brake_force_n / car.mass_kg
        acceleration_mps2 = 1e-2 * self._drive_percent * car.full_drive_force_n / car.mass_kg
        deceleration_mps2 = 1e-2 * self._brake_percent * car.full_brake_force_n / car.mass_kg
        if acceleration_mps2 > limits.acceleration_mps2 + lsb_mps2:
            self._violate(t_ns, "acceleration", f"{acceleration_mps2:.2f} m/s2")
        if deceleration_mps2 > limits.deceleration_mps2 + lsb_mps2 and deceleration_mps2 > self._deceleration_mps2:
            self._violate(t_ns, "deceleration", f"{deceleration_mps2:.2f} m/s2")
        if self._pedals_ns:
            dt_s = max(t_ns - self._pedals_ns + self._jitter_ns, _TICK_NS) * 1e-9
            pressed_mps2 = acceleration_mps2 - self._acceleration_mps2
            if pressed_mps2 > limits.drive_jerk_mps3 * dt_s + lsb_mps2:
                self._violate(t_ns, "drive jerk", f"{pressed_mps2 / dt_s:.1f} m/s3")
            braked_mps2 = deceleration_mps2 - self._deceleration_mps2
            if abs(braked_mps2) > limits.brake_jerk_mps3 * dt_s + lsb_mps2:
                self._violate(t_ns, "brake jerk", f"{braked_mps2 / dt_s:.1f} m/s3")
            if self.authority == "Stop":
                self._judge_stop(t_ns, deceleration_mps2, dt_s, lsb_mps2)
        self._pedals_ns, self._acceleration_mps2, self._deceleration_mps2 = t_ns, acceleration_mps2, deceleration_mps2

    def _judge_stop(self, t_ns: int, deceleration_mps2: float, dt_s: float, lsb_mps2: float) -> None:
        """The minimal risk manoeuvre: no accelerator, deceleration built up at a limited jerk, reached and held."""
        if self._drive_percent > 0.0:
            self._violate(t_ns, "stop accelerates", f"{self._drive_percent:g} %")
        if self._speed_mps() < STANDING_MPS:
            if self._brake_percent > STANDSTILL_BRAKE_PERCENT and deceleration_mps2 >= self._deceleration_mps2:
                self._violate(t_ns, "standstill brake", f"{self._brake_percent:g} %")
            return
        ceiling_mps2 = max(SAFE_STOP_MPS2, self._entry_deceleration_mps2)
        if deceleration_mps2 > ceiling_mps2 + lsb_mps2:
            self._violate(t_ns, "stop deceleration", f"{deceleration_mps2:.2f} m/s2")
        elapsed_s = (t_ns - self._entered_ns + self._jitter_ns + _TICK_NS) * 1e-9
        if deceleration_mps2 > self._entry_deceleration_mps2 + SAFE_STOP_JERK_MPS3 * elapsed_s + lsb_mps2:
            self._violate(t_ns, "stop jerk", f"{deceleration_mps2:.2f} m/s2 after {elapsed_s:.2f} s")
        floor_mps2 = min(COMFORT_STOP_MPS2, COMFORT_STOP_JERK_MPS3 * (elapsed_s - 0.1))
        if deceleration_mps2 < 0.9 * floor_mps2 - lsb_mps2:
            self._violate(t_ns, "stop too weak", f"{deceleration_mps2:.2f} m/s2 after {elapsed_s:.2f} s")

    def _judge_status(self, t_ns: int, message: WireMessage, data: bytes) -> None:
        """The mode that is told must be the mode that is acted; it is sent after the commands of its tick."""
        mode, cause = message.choice(data, "Mode"), message.choice(data, "Cause")
        expected = {
            None: (), "None": ("Fault",), "Disarm": ("Standby", "Fault"), "Arm": ("Ready",), "Engage": ("Engaged",),
            "Stop": ("SafeStop", "ComfortStop"),
        }
        is_commanding = t_ns - self._commanded_ns <= self._jitter_ns  # in Fault nothing is commanded any more, not even to let go
        if mode not in expected.get(self.authority, ()) and (is_commanding or mode != "Fault"):
            self._violate(t_ns, "status", f"mode {mode} while {self.authority}")
        if mode in ("SafeStop", "ComfortStop", "Fault") and cause == "None":
            self._violate(t_ns, "status", f"{mode} without a cause")
        if mode != self.status_mode:
            self._told_ns = t_ns
        if mode == "SafeStop" and t_ns - self._told_ns > 2_500 * MS and self._speed_mps() > 1.0:
            floor_mps2 = 0.9 * min(SAFE_STOP_MPS2, self._limits.deceleration_mps2)
            if self._deceleration_mps2 < floor_mps2:
                self._violate(t_ns, "stop too weak", f"{self._deceleration_mps2:.2f} m/s2 in {mode}")
        if mode == "ComfortStop":
            elapsed_s = (t_ns - self._entered_ns + self._jitter_ns + _TICK_NS) * 1e-9
            allowed_mps2 = max(self._entry_deceleration_mps2, COMFORT_STOP_MPS2)
            allowed_mps2 = min(allowed_mps2, self._entry_deceleration_mps2 + COMFORT_STOP_JERK_MPS3 * elapsed_s)
            if self._deceleration_mps2 > allowed_mps2 + 0.02 and self._speed_mps() > STANDING_MPS:
                self._violate(t_ns, "comfort stop", f"{self._deceleration_mps2:.2f} m/s2, allowed {allowed_mps2:.2f}")
        self.status_mode = mode

    # ---- reactions

    def _settle(self, t_ns: int, authority: str) -> None:
        """Judge the safety command, which opens the frames of its tick, against the faults that are open."""
        self._commanded_ns = t_ns
        still: list[_Pending] = []
        for pending in self._pending:
            latency_ns = t_ns - pending.marked_ns
            is_safe = latency_ns >= 0 and authority not in _UNSAFE.get(pending.kind, ())
            if pending.kind is Kind.NONE:
                if authority != "Engage":
                    self._violate(t_ns, "false reaction", f"{pending.fault}: {authority} after {latency_ns / MS:.1f} ms")
                else:
                    still.append(pending)
            elif t_ns > pending.deadline_ns:
                what = f"first safe frame only after {latency_ns / MS:.1f} ms" if is_safe else f"{authority} after {latency_ns / MS:.1f} ms"
                self._violate(t_ns, "reaction", f"{pending.fault}: {what}, allowed {(pending.deadline_ns - pending.marked_ns) / MS:.0f} ms")
            elif is_safe:
                self.reactions.append(Answer(pending.fault, latency_ns))
            else:
                still.append(pending)
        self._pending = still

    def _expire(self, t_ns: int) -> None:
        """A gateway that has fallen silent has let go: the robots' own timeout stops the car."""
        if not self._pending or t_ns - self._commanded_ns <= _SILENT_NS:
            return
        still: list[_Pending] = []
        for pending in self._pending:
            if pending.kind in _UNSAFE and t_ns > pending.deadline_ns:
                self.reactions.append(Answer(pending.fault, max(0, self._commanded_ns + _TICK_NS - pending.marked_ns)))
            else:
                still.append(pending)
        self._pending = still
