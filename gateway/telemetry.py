"""Telemetry: what every process tells the world, as JSON over Zenoh.

Each process that publishes listens on its own loopback port; readers connect to all of them. Nothing is discovered, nothing
leaves the machine, and a slow reader loses samples rather than holding a publisher up. Readers judge the age of a sample
themselves: `t_ns` is CLOCK_MONOTONIC of the sending host, and samples that waited in a socket arrive late, not marked.

The control thread calls `Publisher.post`, which only stores a reference; encoding and sending happen on a thread of its own.
"""

import json
import os
import threading
from collections import deque
from collections.abc import Callable
from enum import StrEnum
from typing import Self

import msgspec
import zenoh

from dbc.errors import SetupFailure

DEFAULT_BASE_PORT = 7447
KEY_PREFIX = "xilgate"


class Source(StrEnum):
    """A process that publishes. Its port is the base port plus its place in this list."""

    GATEWAY = "gateway"
    CONTROLLER = "controller"
    EMULATOR = "emulator"
    RUNNER = "runner"


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
        sqp_iterations: -1 where the solver does not tell.
        primal_residual, dual_residual: -1 when nothing finite was solved.
    """

    state_seq: int
    status: str
    solver: str
    steer_rad: float
    drive_norm: float
    solve_time_ms: float
    step_time_ms: float
    sqp_iterations: int
    primal_residual: float
    dual_residual: float
    lateral_error_m: float
    speed_error_mps: float


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


class StatusSample(Sample, frozen=True, kw_only=True):
    """Mode, reasons and counters of the gateway.

    Args:
        reason: why the mode is what it is, for people.
        blockers: what keeps the gateway from the next mode; empty when it may engage.
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
    """Ground truth of the emulated car at its centre of gravity, and the objects around it."""

    x_m: float
    y_m: float
    yaw_rad: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float
    ax_mps2: float
    ay_mps2: float
    sr_angle_rad: float
    ar_position_norm: float
    br_position_norm: float
    robots_engaged: bool
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
    "world": (Source.EMULATOR, WorldSample),
    "scene": (Source.RUNNER, SceneSample),
}
"""Every topic: who publishes it and what it carries. The key expression is `xilgate/TOPIC`."""

_TOPIC_OF: dict[type[Sample], str] = {kind: topic for topic, (_, kind) in TOPICS.items()}
_QUEUE_LENGTH = 256


def topic_of(sample: Sample) -> str:
    """The topic on which a sample travels."""
    return _TOPIC_OF[type(sample)]


class TelemetryError(SetupFailure):
    """Telemetry cannot be opened; one line that says why."""


def _session(listen: list[str], connect: list[str]) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Publisher:
    """Publishes samples of one source from a thread of its own.

    Raises:
        TelemetryError: the port of the source is busy.
    """

    def __init__(self, source: Source, base_port: int = DEFAULT_BASE_PORT) -> None:
        port = port_of(source, base_port)
        try:
            self._session = _session([f"tcp/127.0.0.1:{port}"], [])
        except zenoh.ZError as error:
            raise TelemetryError(
                f"telemetry port {port} of the {source} is busy; is another run active? Choose another with --telemetry-port"
            ) from error
        self._publishers = {
            topic: self._session.declare_publisher(f"{KEY_PREFIX}/{topic}", congestion_control=zenoh.CongestionControl.DROP)
            for topic, (owner, _) in TOPICS.items()
            if owner is source
        }
        self._encoder = msgspec.json.Encoder()
        self._queue: deque[Sample] = deque(maxlen=_QUEUE_LENGTH)
        self._wake = threading.Event()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def post(self, sample: Sample) -> None:
        """Hand a sample over; never blocks. When the thread cannot keep up, the oldest samples are lost."""
        self._queue.append(sample)
        self._wake.set()

    def _run(self) -> None:
        while not (self._is_closing and not self._queue):
            self._wake.wait(timeout=0.5)
            self._wake.clear()
            while self._queue:
                sample = self._queue.popleft()
                self._publishers[topic_of(sample)].put(self._encoder.encode(sample))

    def close(self) -> None:
        """Send what is queued and leave."""
        self._is_closing = True
        self._wake.set()
        self._thread.join(timeout=2.0)
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Subscriber:
    """Calls `on_sample(topic, payload)` for every sample of `topics`, on a thread of Zenoh.

    The payload is the JSON text as it came; `decode` turns it into a sample.
    """

    def __init__(self, on_sample: Callable[[str, bytes], None], topics: list[str], base_port: int = DEFAULT_BASE_PORT) -> None:
        sources = {TOPICS[topic][0] for topic in topics}
        self._session = _session([], [f"tcp/127.0.0.1:{port_of(source, base_port)}" for source in sorted(sources)])

        def receive(topic: str) -> "zenoh.handlers.Callback[zenoh.Sample]":
            # indirect=False: no Python thread of Zenoh's that would keep the interpreter from exiting.
            return zenoh.handlers.Callback(lambda sample: on_sample(topic, sample.payload.to_bytes()), indirect=False)

        self._subscribers = [self._session.declare_subscriber(f"{KEY_PREFIX}/{topic}", receive(topic)) for topic in topics]

    def close(self) -> None:
        """Leave; no callback comes after this."""
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def decode(topic: str, payload: bytes) -> Sample | None:
    """The sample in a payload, or None when it is not one."""
    try:
        return msgspec.json.decode(payload, type=TOPICS[topic][1])
    except (msgspec.DecodeError, KeyError):
        return None


def new_boot_id() -> int:
    """A number that tells this start of a process from every other."""
    return int.from_bytes(os.urandom(4))
