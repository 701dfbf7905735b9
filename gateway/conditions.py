"""What is true of the car, the robots, the buses and the controller in one tick, and the findings and refusals that follow from it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dbc.health import BusState, LinkHealth
from gateway.causes import Cause, Finding
from gateway.codec import Measurement
from gateway.commands import NEVER_NS, CommandGate
from gateway.limits import LimitProfile
from gateway.messages import CommandStatus, Operation, OperatorRequest
from gateway.safe_stop import plan_index

COMMAND_TIMEOUT_NS = 100_000_000
"""Age at which a command is too old: one missed solve is tolerated, two are not."""
MAX_BAD_COMMANDS = 2
"""Commands in a row, and of a second sender, that are only counted and dropped."""
MAX_DEGRADED = 3
"""Shifted plans in a row that are followed."""
MAX_TICK_GAP_NS = 50_000_000
"""A gateway that slept longer must not go on with what it did before."""
MAX_UNCONFIRMED_NS = 50_000_000
"""Age of an own frame that has not got onto the bus: nobody acknowledges, or somebody floods."""
WATCHDOG_TIMEOUT_NS = 100_000_000
"""Time in which the robot controller has to ask another question."""

READY_COMMANDS = 25
"""Good commands in a row before the gateway is ready: one second of the controller."""
HOLD_NS = 1_000_000_000
"""How long the preconditions have to hold without a break."""
BUS_QUIET_NS = 10_000_000_000
"""How long a bus must not have been bus-off."""
MIN_DISK_FREE = 0.07
"""Share of the record's disk that must be free: the figure of openpilot."""
MAX_ENGAGE_COMMAND_AGE_NS = 60_000_000
MAX_ENGAGE_STATE_AGE_NS = 50_000_000
MAX_ENGAGE_STEER_RAD = 0.0349
"""Difference between demanded and measured road-wheel angle: 2 degrees."""
MAX_ENGAGE_LATERAL_M = 1.5
MAX_ENGAGE_HEADING_RAD = 0.26
"""Distance and heading from the path: Autoware's 1.5 m, and half of its 0.52 rad."""
MAX_REQUEST_AGE_NS = 1_000_000_000
"""A request that is older was not meant for now."""
MAX_REQUEST_AHEAD_NS = 10_000_000
"""A request may be younger than the time of the step that reads it, by what the step has taken until then: at most a period."""
STANDING_MPS = 0.1
"""Below this speed the car stands."""
RESET_PATIENCE_NS = 30_000_000_000
"""After this time a stop may be reset without a speed that says the car stands: from 36 m/s at 2.5 m/s2 it takes 15 s."""

_MS_PER_NS = 1e-6
_TROUBLED = (BusState.ERROR_WARNING, BusState.ERROR_PASSIVE)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the process around the core tells it.

    Args:
        links: health of the bus of every network.
        is_recording: whether the recorder takes what it is given.
        disk_free_share: of the disk that it writes to.
        bus_load_norm: share of the time in which the busiest of the buses carries a frame.
        cpu_load_norm: share of a core that the control thread takes.
    """

    links: Mapping[str, LinkHealth] = field(default_factory=dict)
    is_recording: bool = True
    disk_free_share: float = 1.0
    bus_load_norm: float = 0.0
    cpu_load_norm: float = 0.0


UNDISTURBED = Surroundings()


@dataclass(frozen=True, slots=True)
class Situation:
    """All that decides on the mode.

    Args:
        observed: findings of supervision, plausibility and latency.
        state_age_ns: time since the newest time of validity of the navigation data [ns].
        navigation_timeout_ns: age from which they count as frozen [ns].
        question_age_ns: time since the robot controller last asked another question [ns].
        tick_gap_ns: time since the previous step [ns].
        is_driving: the gateway moves the car.
        is_settled: the robots have had time to follow into Engaged.
        steer_rad: road-wheel angle that is measured [rad].
        lateral_mps2: what the limits make of it: kinematic lateral acceleration [m/s2].
        speed_mps: of the car, by navigation or wheels, whoever says more [m/s].
        allowed_mps: the largest speed of a car that slows down as it is asked to [m/s]; infinite when it is not asked to gently.
        stopping_ns: time since the present stop began [ns]; 0 when there is none.
    """

    now_ns: int
    measurement: Measurement
    commands: CommandGate
    surroundings: Surroundings
    profile: LimitProfile
    observed: Sequence[Finding]
    state_age_ns: int
    navigation_timeout_ns: int
    question_age_ns: int
    tick_gap_ns: int
    is_driving: bool
    is_settled: bool
    steer_rad: float
    lateral_mps2: float
    speed_mps: float
    allowed_mps: float
    stopping_ns: int


def state_findings(s: Situation) -> list[Finding]:
    """Why the state estimate cannot be used; empty when it can."""
    found = [finding for finding in s.observed if finding.cause in _STATE_CAUSES]
    if s.state_age_ns > s.navigation_timeout_ns:
        found.append(Finding(Cause.NAVIGATION_FROZEN, s.state_age_ns * _MS_PER_NS, s.navigation_timeout_ns * _MS_PER_NS, "navigation"))
    if not s.measurement.is_navigation_precise:
        found.append(Finding(Cause.NAVIGATION_COARSE, 0, 1, "navigation"))
    return found


_STATE_CAUSES = (
    *(Cause.MESSAGE_MISSING, Cause.MESSAGE_INVALID, Cause.FRAMES_LOST, Cause.SPEED_IMPLAUSIBLE, Cause.POSITION_IMPLAUSIBLE),
    *(Cause.YAW_RATE_IMPLAUSIBLE, Cause.STEERING_IMPLAUSIBLE),
)


def unsound_messages(observed: Sequence[Finding]) -> frozenset[str]:
    """Messages that are missing or invalid. A driver who takes over is not told by these: a moving car would be released to nobody."""
    return frozenset(finding.source for finding in observed if finding.cause in (Cause.MESSAGE_MISSING, Cause.MESSAGE_INVALID))


def findings(s: Situation, of_state: Sequence[Finding]) -> list[Finding]:
    """What would end an engagement now.

    Args:
        of_state: `state_findings` of the same situation.
    """
    found = [*of_state, *(finding for finding in s.observed if finding.cause not in _STATE_CAUSES)]
    found += _bus_findings(s)
    found += [finding for is_true, finding in _robot_findings(s) if is_true]
    found += [finding for is_true, finding in _command_findings(s) if is_true]
    if s.tick_gap_ns > MAX_TICK_GAP_NS:
        found.append(Finding(Cause.TICK_GAP, s.tick_gap_ns * _MS_PER_NS, MAX_TICK_GAP_NS * _MS_PER_NS, "gateway"))
    if s.is_driving:
        found += [finding for is_true, finding in _driving_findings(s) if is_true]
    return found


def _bus_findings(s: Situation) -> list[Finding]:
    found = []
    for network, link in s.surroundings.links.items():
        # A driver that restarts its controller by itself may have done so since the step before.
        was_off = link.last_bus_off_ns is not None and s.now_ns - link.last_bus_off_ns <= MAX_UNCONFIRMED_NS
        if link.state is BusState.DOWN:
            found.append(Finding(Cause.BUS_DOWN, 1, 0, network))
        elif link.state is BusState.BUS_OFF or was_off:
            found.append(Finding(Cause.BUS_OFF, link.bus_offs, 0, network))
        elif link.unconfirmed_ns > MAX_UNCONFIRMED_NS:
            found.append(Finding(Cause.BUS_BLOCKED, link.unconfirmed_ns * _MS_PER_NS, MAX_UNCONFIRMED_NS * _MS_PER_NS, network))
    return found


Judged = Sequence[tuple[bool, Finding]]


def _robot_findings(s: Situation) -> Judged:
    m, unsound = s.measurement, unsound_messages(s.observed)
    overridden = [node for node in m.overridden_robots if f"{node}_Status" not in unsound]
    is_overridden = m.is_driver_override and "RC_SafetyStatus" not in unsound
    question_ms = s.question_age_ns * _MS_PER_NS
    return (
        (m.is_emergency_stopped, Finding(Cause.ROBOTS_EMERGENCY_STOP, 1, 0, m.stop_source)),
        (m.is_stopped_by_robots, Finding(Cause.ROBOTS_STOPPED, 1, 0, m.stop_source)),
        (bool(m.faulty_robots), Finding(Cause.ROBOT_FAULT, len(m.faulty_robots), 0, ", ".join(m.faulty_robots))),
        (s.question_age_ns > WATCHDOG_TIMEOUT_NS, Finding(Cause.WATCHDOG_SILENT, question_ms, WATCHDOG_TIMEOUT_NS * _MS_PER_NS, "RC")),
        (bool(overridden), Finding(_override(overridden), len(overridden), 0, ", ".join(overridden))),
        (is_overridden and not overridden, Finding(Cause.DRIVER_OVERRIDE, 1, 0, "RC")),
        (not m.is_in_drive, Finding(Cause.SELECTOR_NOT_IN_DRIVE, 0, 1, "CAR_Powertrain")),
        (abs(m.vx_mps) > s.profile.max_speed_mps, Finding(Cause.OVERSPEED, abs(m.vx_mps), s.profile.max_speed_mps, "navigation")),
    )


_OVERRIDES = {"SR": Cause.DRIVER_STEERS, "BR": Cause.DRIVER_BRAKES, "AR": Cause.DRIVER_ACCELERATES}


def _override(nodes: Sequence[str]) -> Cause:
    """What the driver does, by the first of the robots that he overrides; only asked when there is one."""
    return next((cause for node, cause in _OVERRIDES.items() if node in nodes), Cause.DRIVER_OVERRIDE)


def _command_findings(s: Situation) -> Judged:
    c = s.commands
    age_ms, limit_ms = min(c.age_ns(s.now_ns) * _MS_PER_NS, 1e6), COMMAND_TIMEOUT_NS * _MS_PER_NS
    what = c.last_cause if c.bad_in_a_row else "not heard" if c.age_ns(s.now_ns) == NEVER_NS else ""
    sender = f"controller ({what})" if what else "controller"
    return (
        (c.status is CommandStatus.FAILED, Finding(Cause.COMMAND_FAILED, 1, 0, "controller")),
        (c.degraded_in_a_row > MAX_DEGRADED, Finding(Cause.COMMAND_FAILED, c.degraded_in_a_row, MAX_DEGRADED, "controller (degraded)")),
        (age_ms > limit_ms, Finding(Cause.COMMAND_LOST, age_ms, limit_ms, sender)),
        (c.bad_in_a_row > MAX_BAD_COMMANDS, Finding(Cause.COMMAND_INVALID, c.bad_in_a_row, MAX_BAD_COMMANDS, c.last_cause)),
        (c.strangers > MAX_BAD_COMMANDS, Finding(Cause.SECOND_CONTROLLER, c.strangers, MAX_BAD_COMMANDS, "controller")),
    )


def _driving_findings(s: Situation) -> Judged:
    m = s.measurement
    deaf = ", ".join(m.deaf_robots)
    return (
        (s.is_settled and bool(m.deaf_robots), Finding(Cause.ROBOT_MISSES_COMMANDS, len(m.deaf_robots), 0, deaf)),
        (s.is_settled and not m.is_engaged, Finding(Cause.ROBOTS_NOT_ENGAGED, 0, 1, "RC")),
        (s.speed_mps > s.allowed_mps, Finding(Cause.CAR_NOT_SLOWING, s.speed_mps, s.allowed_mps, "car")),
    )


def blockers(s: Situation, found: Sequence[Finding]) -> list[str]:
    """What keeps the gateway from READY, each by name; empty when nothing does.

    Args:
        found: `findings` of the same situation.
    """
    m = s.measurement
    conditions = (
        (not m.are_robots_ready, "robots not ready"),
        (not m.is_dead_man_pressed, "dead-man not pressed"),
        (not s.surroundings.is_recording, "recorder does not record"),
        (
            s.surroundings.disk_free_share < MIN_DISK_FREE,
            f"{100 * s.surroundings.disk_free_share:.1f} % of the record's disk free, {100 * MIN_DISK_FREE:.1f} % needed",
        ),
    )
    blocked = [str(finding) for finding in found] + [name for is_true, name in conditions if is_true]
    for network, link in s.surroundings.links.items():
        if link.state in _TROUBLED:
            blocked.append(f"bus {network} is {link.state.value}")
        if link.last_bus_off_ns is not None and s.now_ns - link.last_bus_off_ns < BUS_QUIET_NS:
            blocked.append(f"bus {network} was bus-off {(s.now_ns - link.last_bus_off_ns) * 1e-9:.0f} s ago")
    return blocked


def settling(good_ns: int, good_commands: int) -> list[str]:
    """What has been good for too short a time; empty when all has been for long enough.

    Args:
        good_ns: time for which nothing has been in the way [ns].
        good_commands: of status OK, in a row.
    """
    conditions = (
        (good_commands < READY_COMMANDS, f"{good_commands} good commands in a row, {READY_COMMANDS} needed"),
        (good_ns < HOLD_NS, f"everything good for {good_ns * 1e-9:.1f} s, {HOLD_NS * 1e-9:.1f} s needed"),
    )
    return [name for is_true, name in conditions if is_true]


def untimely(request: OperatorRequest, now_ns: int, last_ns: int) -> str:
    """Why a request must not act at this time; empty when it may. A STOP always may: at worst, a replay stops the car.

    Args:
        last_ns: time of the request that was looked at last [ns]; all who ask share one clock.
    """
    if request.operation is Operation.STOP:
        return ""
    age_ns = now_ns - request.t_ns
    if age_ns < -MAX_REQUEST_AHEAD_NS:
        return "the request is from the future"
    if request.t_ns <= last_ns:
        return "the request is repeated, or made before another one"
    if age_ns > MAX_REQUEST_AGE_NS:
        return f"the request is {age_ns * 1e-9:.1f} s old, limit {MAX_REQUEST_AGE_NS * 1e-9:.0f} s"
    return ""


def refusals(operation: Operation, s: Situation, blocked_by: Sequence[str]) -> list[str]:
    """What of the operator's request cannot be granted because of the situation; empty when all is well."""
    match operation:
        case Operation.ARM:
            return list(blocked_by)
        case Operation.ENGAGE:
            return [*blocked_by, *_engage_refusals(s)]
        case Operation.DISENGAGE if s.stopping_ns:
            return ["a stop is ended by a reset"]
        case Operation.RESET if 0 < s.stopping_ns < RESET_PATIENCE_NS and s.speed_mps > STANDING_MPS:
            return [f"the car moves: {s.speed_mps:.1f} m/s"]
    return []


def _engage_refusals(s: Situation) -> list[str]:
    m, command = s.measurement, s.commands.newest
    if command is None:
        return ["no command"]
    command_age_ns = s.commands.age_ns(s.now_ns)
    steer_rad = abs(command.plan_steer_rad[plan_index(command, s.now_ns)] - s.steer_rad)
    wheel_rad, lateral_mps2, p = abs(m.steering_wheel_rad), abs(s.lateral_mps2), s.profile
    conditions = (
        (not m.is_armed, "robots not armed"),
        (command_age_ns > MAX_ENGAGE_COMMAND_AGE_NS, f"newest command {command_age_ns * _MS_PER_NS:.0f} ms old, limit 60 ms"),
        (s.state_age_ns > MAX_ENGAGE_STATE_AGE_NS, f"state {s.state_age_ns * _MS_PER_NS:.0f} ms old, limit 50 ms"),
        (steer_rad > MAX_ENGAGE_STEER_RAD, f"steering {steer_rad:.3f} rad from the demand, limit {MAX_ENGAGE_STEER_RAD} rad"),
        (
            wheel_rad > p.steering_wheel_limit_rad,
            f"steering wheel at {wheel_rad:.2f} rad, limit of {p.name} {p.steering_wheel_limit_rad} rad",
        ),
        (
            lateral_mps2 > p.lateral_acceleration_mps2,
            f"a bend of {lateral_mps2:.1f} m/s2, limit of {p.name} {p.lateral_acceleration_mps2} m/s2",
        ),
        (
            abs(command.lateral_error_m) > MAX_ENGAGE_LATERAL_M,
            f"{command.lateral_error_m:.2f} m beside the path, limit {MAX_ENGAGE_LATERAL_M} m",
        ),
        (
            abs(command.heading_error_rad) > MAX_ENGAGE_HEADING_RAD,
            f"heading {command.heading_error_rad:.2f} rad from the path, limit {MAX_ENGAGE_HEADING_RAD} rad",
        ),
    )
    return [name for is_true, name in conditions if is_true]
