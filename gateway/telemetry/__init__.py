"""Telemetry: what every process tells the world, as JSON over Zenoh.

Each process that publishes listens on its own loopback port; readers connect to all of them. Nothing is discovered, nothing
leaves the machine unless the rig file says so (`security`), and a slow reader loses samples rather than holding a publisher up.
Readers judge the age of a sample themselves: `t_ns` is CLOCK_MONOTONIC of the sending host, and samples that waited in a socket
arrive late, not marked.

The control thread calls `Publisher.post`, which only stores a reference; encoding and sending happen on a thread of its own.

A publisher may also answer requests (`Publisher.serve`, `ask`): one JSON text there, one back, over the same port. Answers are
made on threads of Zenoh, one for each client at most, so that a crowd of clients waits for itself and for nobody else.
"""

import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Self

import msgspec
import zenoh

from dbc.errors import SetupFailure
from gateway.telemetry.samples import (
    MAX_SAMPLE_BYTES,
    TOPICS,
    CommandSample,
    DisengagementReport,
    FaultSample,
    Lane,
    LimitActivation,
    ObjectsSample,
    ParameterChange,
    ParametersSample,
    PlanSample,
    ProfileSample,
    Sample,
    SceneSample,
    Source,
    StateSample,
    StatusSample,
    WorldObject,
    WorldSample,
    decode,
    port_of,
    topic_of,
)
from gateway.telemetry.security import KEY_PREFIX, TlsSection, check_files, connecting_options, listening_options, read_tls

__all__ = [
    "DEFAULT_BASE_PORT",
    "KEY_PREFIX",
    "MAX_REQUEST_BYTES",
    "MAX_SAMPLE_BYTES",
    "TOPICS",
    "CommandSample",
    "DisengagementReport",
    "FaultSample",
    "Lane",
    "LimitActivation",
    "ObjectsSample",
    "ParameterChange",
    "ParametersSample",
    "PlanSample",
    "ProfileSample",
    "Publisher",
    "Sample",
    "SceneSample",
    "Source",
    "StateSample",
    "StatusSample",
    "Subscriber",
    "TelemetryError",
    "TlsSection",
    "WorldObject",
    "WorldSample",
    "ask",
    "check_files",
    "decode",
    "new_boot_id",
    "port_of",
    "read_tls",
    "topic_of",
]

DEFAULT_BASE_PORT = 7447
_QUEUE_LENGTH = 256
_MAX_MESSAGE_BYTES = 1 << 24
"""A longer message is dropped while it arrives [bytes]: what a stranger sends does not fill our memory."""
MAX_REQUEST_BYTES = 1 << 16
"""Longest request that is looked at [bytes]."""
_ASK_PERIOD_S = 0.02


class TelemetryError(SetupFailure):
    """Telemetry cannot be opened; one line that says why."""


def _session(
    listen: list[str], connect: list[str], more: Mapping[str, Any] | None = None, within_s: float | None = None
) -> zenoh.Session:
    """A session on these endpoints alone.

    Args:
        more: settings of Zenoh.
        within_s: time in which somebody has to answer, else it is an error [s]; None waits for ever, on threads of Zenoh's.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
        **(more or {}),
    }.items():
        config.insert_json5(key, json.dumps(value))
    if within_s is not None:
        config.insert_json5("connect/exit_on_failure", "true")
        config.insert_json5("connect/timeout_ms", str(round(within_s * 1e3)))
    return zenoh.open(config)


def _listening(source: Source, port: int, tls: TlsSection | None) -> zenoh.Session:
    local = f"tcp/127.0.0.1:{port}"
    try:
        if tls is None:
            return _session([local], [])
        _session([local], []).close()  # type: ignore[no-untyped-call] # so that what fails below is TLS
    except zenoh.ZError as error:
        raise TelemetryError(
            f"telemetry port {port} of the {source} is busy; is another run active? Choose another with --telemetry-port"
        ) from error
    check_files(tls)
    try:
        return _session([local, tls.endpoint(source)], [], listening_options(tls))
    except zenoh.ZError as error:
        files = f"{tls.certificate}, {tls.private_key} or {tls.authority}"
        raise TelemetryError(f"telemetry of the {source} on {tls.endpoint(source)}: the port is busy, or {files} not usable") from error


class Publisher:
    """Publishes samples of one source from a thread of its own.

    Args:
        tls: for readers on other machines; None for loopback alone.

    Raises:
        TelemetryError: the port of the source is busy, or TLS cannot be used.
        KeyMistake: others can read the private key.

    Attributes:
        dropped: samples lost because the thread did not keep up.
    """

    def __init__(self, source: Source, base_port: int = DEFAULT_BASE_PORT, tls: TlsSection | None = None) -> None:
        self._source = source
        self._session = _listening(source, port_of(source, base_port), tls)
        self._publishers = {
            topic: self._session.declare_publisher(f"{KEY_PREFIX}/{topic}", congestion_control=zenoh.CongestionControl.DROP)
            for topic, (owner, _) in TOPICS.items()
            if owner is source
        }
        self._services: list[zenoh.Queryable[None]] = []
        self._encoder = msgspec.json.Encoder()
        self._queue: deque[Sample] = deque(maxlen=_QUEUE_LENGTH)
        self.dropped = 0
        self._wake = threading.Event()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def post(self, sample: Sample) -> None:
        """Hand a sample over; never blocks. When the thread cannot keep up, the oldest samples are lost, and counted."""
        self.dropped += len(self._queue) == _QUEUE_LENGTH
        self._queue.append(sample)
        self._wake.set()

    def serve(self, service: str, answer: Callable[[bytes], bytes]) -> None:
        """Answer requests on the key `xilgate/SOURCE/SERVICE` from now on; see `ask`.

        Args:
            answer: is called on threads of Zenoh, on several at once when several clients ask.
        """
        key = _service_key(self._source, service)

        def reply(query: zenoh.Query) -> None:
            with query:
                payload = query.payload or b""
                if len(payload) > MAX_REQUEST_BYTES:
                    query.reply_err(f"request of {len(payload)} bytes: at most {MAX_REQUEST_BYTES}")
                else:
                    query.reply(key, answer(bytes(payload)))

        self._services.append(self._session.declare_queryable(key, zenoh.handlers.Callback(reply, indirect=False)))

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

    Args:
        tls: for a rig that is another machine.

    Raises:
        UserMistake: a certificate or the key cannot be used.
    """

    def __init__(
        self,
        on_sample: Callable[[str, bytes], None],
        topics: list[str],
        base_port: int = DEFAULT_BASE_PORT,
        tls: TlsSection | None = None,
    ) -> None:
        sources = sorted({TOPICS[topic][0] for topic in topics})
        if tls is None:
            self._session = _session([], [f"tcp/127.0.0.1:{port_of(source, base_port)}" for source in sources])
        else:
            check_files(tls)
            self._session = _session([], [tls.endpoint(source) for source in sources], connecting_options(tls))

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


def _service_key(source: Source, service: str) -> str:
    return f"{KEY_PREFIX}/{source}/{service}"


def ask(
    source: Source,
    service: str,
    request: bytes,
    base_port: int = DEFAULT_BASE_PORT,
    timeout_s: float = 2.0,
    *,
    tls: TlsSection | None = None,
) -> bytes:
    """Send a request to a service of a running process, once, and wait for the answer.

    Args:
        tls: for a rig that is another machine.

    Raises:
        UserMistake: a certificate or the key cannot be used.
        TelemetryError: the process does not run, does not answer in time, or does not take the request.
    """
    port = port_of(source, base_port)
    if tls is not None:
        check_files(tls)
    deadline_s = time.monotonic() + timeout_s
    try:
        if tls is None:
            session = _session([], [f"tcp/127.0.0.1:{port}"], within_s=timeout_s)
        else:
            session = _session([], [tls.endpoint(source)], connecting_options(tls), timeout_s)
    except zenoh.ZError as error:
        if tls is not None:
            raise TelemetryError(f"no {source} on {tls.endpoint(source)}, or it does not accept {tls.certificate}") from error
        raise TelemetryError(f"no {source} on port {port}, of --telemetry-port {base_port}; name the ports of your run") from error
    with session:
        while time.monotonic() < deadline_s:
            for reply in session.get(_service_key(source, service), payload=request, timeout=timeout_s):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                refusal = reply.err.payload.to_string() if reply.err is not None else ""
                raise TelemetryError(f"{source} on {tls.endpoint(source) if tls else f'telemetry port {port}'}, {service}: {refusal}")
            time.sleep(_ASK_PERIOD_S)  # nobody took the request: the process has not declared its service yet
    if tls is not None:
        raise TelemetryError(f"{tls.endpoint(source)} serves no {service}, or the rig does not name {tls.certificate} among its writers")
    raise TelemetryError(f"port {port}, of --telemetry-port {base_port}, serves no {service}; name the ports of your run")


def new_boot_id() -> int:
    """A number that tells this start of a process from every other."""
    return int.from_bytes(os.urandom(4))
