"""What telemetry carries: sources, topics, and a sample of each topic. JSON on the wire, so that a browser reads it as well."""

from enum import StrEnum

import msgspec

MAX_SAMPLE_BYTES = 1 << 22
"""Longest payload that is looked at [bytes]: a scene with some 30,000 points."""


class Source(StrEnum):
    """A process that publishes. Its port is the base port plus its place in this list.

    WORLD is whoever plays the world around the car: the runner when its scenario has objects, else any tool that takes the port.
    """

    GATEWAY = "gateway"
    CONTROLLER = "controller"
    EMULATOR = "emulator"
    RUNNER = "runner"
    WORLD = "world"


def port_of(source: Source, base_port: int) -> int:
    """TCP port on which a source listens."""
    return base_port + list(Source).index(source)


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """Part of every sample.

    Args:
        t_ns: monotonic time at which the sample was made [ns]; virtual time in lockstep.
        seq: number of the sample on its topic, without gaps at the sender.
    """

    t_ns: int
    seq: int


class StateSample(Sample, frozen=True, kw_only=True):
    """The gateway's state estimate and the measured robots."""

    mode: str
    is_valid: bool
    x_m: float
    y_m: float
    yaw_rad: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    sr_angle_rad: float
    ar_position_norm: float
    br_position_norm: float
    sr_command_rad: float
    ar_command_norm: float
    br_command_norm: float


class CommandSample(Sample, frozen=True, kw_only=True):
    """One command of the controller and how the solver came to it.

    Args:
        lateral_error_m: distance to the left of the path [m].
        speed_error_mps: speed above the reference [m/s].
        sqp_iterations, qp_iterations, work: -1 where the solver does not tell; work in Riccati factorizations.
        primal_residual, dual_residual: -1 when nothing finite was solved.
        disturbance_mps2: longitudinal acceleration that the model does not explain, as estimated [m/s2].
        parameters_version: version of the parameters that were in force.
        objects: objects that the planner was given.
        objects_rejected: things on the topic of the objects that were none, since the start of the controller.
        controller_sha256: of all that the controller decides with: compiled solver, vehicle file, path.
    """

    state_seq: int
    status: str
    solver: str
    steer_rad: float
    drive_norm: float
    solve_time_ms: float
    step_time_ms: float
    sqp_iterations: int
    qp_iterations: int
    work: float
    primal_residual: float
    dual_residual: float
    lateral_error_m: float
    speed_error_mps: float
    disturbance_mps2: float
    parameters_version: int
    objects: int
    objects_rejected: int
    controller_sha256: str = ""


class PlanSample(Sample, frozen=True, kw_only=True):
    """Predicted trajectory, reference and corridor over the horizon; every list has N+1 entries."""

    x_m: list[float]
    y_m: list[float]
    yaw_rad: list[float]
    vx_mps: list[float]
    reference_x_m: list[float]
    reference_y_m: list[float]
    left_x_m: list[float]
    left_y_m: list[float]
    right_x_m: list[float]
    right_y_m: list[float]


class ProfileSample(Sample, frozen=True, kw_only=True):
    """Where the solver spent its time, measured inside its C code; a few times per second.

    Args:
        cycles: control cycles since the sample before, over which the figures are means.
        time_us: time per cycle of each part of the solver [us].
        calls: calls per cycle of each part.
    """

    solver: str
    cycles: int
    time_us: dict[str, float]
    calls: dict[str, float]


class ParameterChange(msgspec.Struct, frozen=True, kw_only=True):
    """One parameter took another value."""

    name: str
    old: float
    new: float


class ParametersSample(Sample, frozen=True, kw_only=True):
    """A change of the controller's parameters; `t_ns` is the cycle edge from which it was in force.

    Args:
        version: number of the change, and of the set of parameters that it made.
        accepted_ns: monotonic time at which the controller accepted it [ns].
        who: whoever asked for it, as he called himself.
        reverts: numbers of the changes that it took back.
    """

    version: int
    accepted_ns: int
    who: str
    changes: list[ParameterChange]
    reverts: list[int]


class LimitActivation(msgspec.Struct, frozen=True, kw_only=True):
    """How often a limit of the gateway has changed a demand, and the last time it did.

    Args:
        ticks: in which it did, since the start.
        asked, limit, given: what came in, what is allowed, what went out, in `unit`.
    """

    ticks: int
    unit: str
    asked: float
    limit: float
    given: float


class DisengagementReport(msgspec.Struct, frozen=True, kw_only=True):
    """How an engagement ended.

    Args:
        t_ns: monotonic time [ns].
        cause, code: by name, and by the number on the bus.
        value, limit: what was found and what is allowed, in `unit`.
        source: message, robot, bus or process in which it was found.
    """

    t_ns: int
    cause: str
    code: int
    value: float
    limit: float
    unit: str
    source: str


class StatusSample(Sample, frozen=True, kw_only=True):
    """Mode, reasons and counters of the gateway.

    Args:
        reason: why the mode is what it is, for people.
        blockers: what keeps the gateway from the next mode; empty when it may engage.
        dead_buses: networks whose bus refuses to deliver or to accept frames.
        buses: state of our CAN controller on the bus of every network.
        bus_errors: frames that were destroyed on the bus of every network, or that nobody acknowledged.
        bus_refusals: why our CAN controller could not be asked to leave bus-off, by network.
        frames_unsent: frames that were to be sent and were not, by cause.
        ticks_unrecorded: ticks that are missing in the record.
        record_problem: why nothing is recorded; empty while all is well or nothing is to be.
        realtime: what the control thread asked of the machine, and what it was refused, for people.
        hashes: SHA-256 of files, limits and configuration, by name.
        profile: limits in force, by name.
        limits: activations of each limit that has acted.
        limited_share: of the driven ticks, those in which a limit held a demand back.
        disengagement: how the last engagement ended; None when none has.
        actuation_age_ms, actuation_age_max_ms: age of the measurement on which the robots act, newest and largest of this engagement.
        bus_load: share of the last second in which each bus was busy with known frames.
        message_rates_hz: frames per second of the last second, by message.
    """

    mode: str
    reason: str
    blockers: list[str]
    command_age_ms: float
    frames_received: int
    frames_rejected: dict[str, int]
    commands_rejected: dict[str, int]
    ticks: int
    ticks_late: int
    step_cpu_ms: float
    dead_buses: list[str] = []
    buses: dict[str, str] = {}
    bus_errors: dict[str, int] = {}
    bus_refusals: dict[str, str] = {}
    frames_unsent: dict[str, int] = {}
    ticks_unrecorded: int = 0
    record_problem: str = ""
    realtime: dict[str, str] = {}
    hashes: dict[str, str] = {}
    profile: str = ""
    limits: dict[str, LimitActivation] = {}
    limited_share: float = 0.0
    disengagement: DisengagementReport | None = None
    actuation_age_ms: float = 0.0
    actuation_age_max_ms: float = 0.0
    bus_load: dict[str, float] = {}
    message_rates_hz: dict[str, float] = {}


class WorldObject(msgspec.Struct, frozen=True, kw_only=True):
    """A thing on the road: a box on the ground."""

    name: str
    x_m: float
    y_m: float
    yaw_rad: float
    length_m: float
    width_m: float
    vx_mps: float = 0.0
    vy_mps: float = 0.0


class WorldSample(Sample, frozen=True, kw_only=True):
    """Ground truth of the emulated car at its centre of gravity; wheels front left, front right, rear left, rear right.

    Args:
        z_m, roll_rad, pitch_rad: roll to the right and pitch nose down are positive.
        is_lifted: whether the car hangs on a lift; steering, wheels, engine and gear are then those of the car that hangs there, and
            the motion is that of a virtual one.
    """

    x_m: float
    y_m: float
    z_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    ay_mps2: float
    sr_angle_rad: float
    ar_position_norm: float
    br_position_norm: float
    wheel_speeds_radps: list[float] = []
    engine_speed_radps: float = 0.0
    gear: int = 0
    robots_engaged: bool
    is_lifted: bool = False


class FaultSample(Sample, frozen=True, kw_only=True):
    """An injected fault began or ended.

    Args:
        name: of the fault.
        what: the fault as it was asked for.
        event: begins, ends, or cleared when somebody took it back before its end.
        hits: frames that it has hit so far.
    """

    name: str
    what: str
    event: str
    hits: int


class ObjectsSample(Sample, frozen=True, kw_only=True):
    """All objects around the car, where they are at `t_ns`; what a sample does not name is not there any more."""

    objects: list[WorldObject]


class Lane(msgspec.Struct, frozen=True, kw_only=True):
    """A gate of cones: a straight lane along x between two lateral limits."""

    name: str
    start_m: float
    end_m: float
    right_m: float
    left_m: float


class SceneSample(Sample, frozen=True, kw_only=True):
    """What stands still: the road, the gates and the reference; repeated every second for those who join late."""

    scenario: str
    stage: str
    car_length_m: float
    car_width_m: float
    car_front_m: float
    steering_ratio: float
    reference_x_m: list[float]
    reference_y_m: list[float]
    left_x_m: list[float]
    left_y_m: list[float]
    right_x_m: list[float]
    right_y_m: list[float]
    lanes: list[Lane]


TOPICS: dict[str, tuple[Source, type[Sample]]] = {
    "state": (Source.GATEWAY, StateSample),
    "status": (Source.GATEWAY, StatusSample),
    "command": (Source.CONTROLLER, CommandSample),
    "plan": (Source.CONTROLLER, PlanSample),
    "profile": (Source.CONTROLLER, ProfileSample),
    "parameters": (Source.CONTROLLER, ParametersSample),
    "world": (Source.EMULATOR, WorldSample),
    "faults": (Source.EMULATOR, FaultSample),
    "scene": (Source.RUNNER, SceneSample),
    "objects": (Source.WORLD, ObjectsSample),
}
"""Every topic: who publishes it and what it carries. The key expression is `xilgate/TOPIC`."""

_TOPIC_OF: dict[type[Sample], str] = {kind: topic for topic, (_, kind) in TOPICS.items()}


def topic_of(sample: Sample) -> str:
    """The topic on which a sample travels."""
    return _TOPIC_OF[type(sample)]


def decode(topic: str, payload: bytes) -> Sample | None:
    """The sample in a payload, or None when it is not one."""
    if len(payload) > MAX_SAMPLE_BYTES:
        return None
    try:
        return msgspec.json.decode(payload, type=TOPICS[topic][1])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, KeyError):
        return None
