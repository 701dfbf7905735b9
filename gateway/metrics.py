"""Prometheus metrics of the gateway: a snapshot of its last status and its counters, served on the loopback interface."""

import contextlib
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import accumulate
from types import MappingProxyType
from typing import Any, Self
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from dbc.errors import SetupFailure
from dbc.health import BusState
from gateway.housekeeping import Pulse
from gateway.logs import LogThread
from gateway.loop import BUCKETS_NS, Histogram
from gateway.messages import Mode
from gateway.telemetry import StatusSample

_PREFIX = "xilgate_gateway_"
_REQUEST_TIMEOUT_S = 2.0
_PAUSE_S = 0.05
"""Pause after every request [s]: whoever asks in a loop gets no more than a few per cent of a processor."""
_POLL_S = 0.1
_S_PER_NS = 1e-9

Unsent = Mapping[str, Callable[[], int]]


class MetricsError(SetupFailure):
    """The port of the metrics cannot be opened; one line that says which."""


class GatewayCollector(Collector):
    """Makes metrics out of what the control thread has left, when somebody asks for them.

    Args:
        unsent: by whom it was for, how to read what was handed over and did not leave.
    """

    def __init__(self, pulse: Pulse, logs: LogThread, unsent: Unsent) -> None:
        self._pulse = pulse
        self._logs = logs
        self._unsent = unsent

    def collect(self) -> Iterator[Metric]:
        """All metrics of the moment."""
        pulse = self._pulse
        yield _histogram("tick_lateness_seconds", "Time from the deadline of a tick to its begin.", pulse.lateness)
        yield _histogram("step_cpu_seconds", "CPU time of a tick.", pulse.step_cpu)
        yield _counter("ticks", "Ticks since the start.", pulse.ticks)
        yield _counter("log_records_dropped", "Log records lost.", self._logs.dropped + pulse.events_dropped)
        yield _labelled(
            CounterMetricFamily, "messages_unsent", "Datagrams and samples that nobody took.", "to",
            {name: count() for name, count in self._unsent.items()},
        )  # fmt: skip
        yield _labelled(
            GaugeMetricFamily, "realtime_granted", "1 where what was asked of the machine was granted.", "what",
            {name: float(not grant.refusal) for name, grant in pulse.realtime.items()},
        )  # fmt: skip
        if pulse.status is not None:
            yield from _of_status(pulse.status)


def _of_status(status: StatusSample) -> Iterable[Metric]:
    return (
        _labelled(GaugeMetricFamily, "mode", "1 for the present one.", "mode", {mode.name: mode.name == status.mode for mode in Mode}),
        _counter("ticks_late", "Ticks skipped.", status.ticks_late),
        _counter("frames_received", "Frames received.", status.frames_received),
        _labelled(CounterMetricFamily, "frames_rejected", "Frames ignored.", "cause", status.frames_rejected),
        _labelled(CounterMetricFamily, "commands_rejected", "Commands ignored.", "cause", status.commands_rejected),
        _labelled(CounterMetricFamily, "frames_unsent", "Frames not sent.", "cause", status.frames_unsent),
        _bus_states(status.buses),
        _labelled(CounterMetricFamily, "bus_errors", "Frames destroyed on the bus, or not acknowledged.", "bus", status.bus_errors),
        _counter("ticks_unrecorded", "Ticks missing in the record.", status.ticks_unrecorded),
        GaugeMetricFamily(_PREFIX + "blockers", "Conditions that keep the gateway from the next mode.", len(status.blockers)),
        GaugeMetricFamily(_PREFIX + "command_age_seconds", "Age of the newest command.", status.command_age_ms * 1e-3),
        _labelled(CounterMetricFamily, "limited_ticks", "Ticks in which a limit changed the demand.", "limit",
                  {name: one.ticks for name, one in status.limits.items()}),
        GaugeMetricFamily(_PREFIX + "actuation_age_seconds", "Age of the measurement that robots act on.", status.actuation_age_ms * 1e-3),
        _labelled(GaugeMetricFamily, "bus_load", "Share of the last second in which it was busy.", "bus", status.bus_load),
        _labelled(GaugeMetricFamily, "message_rate_hertz", "Frames per second.", "message", status.message_rates_hz),
        _sha256(status.hashes),
    )


def _counter(name: str, text: str, value: float) -> Metric:
    return CounterMetricFamily(_PREFIX + name, text, value)


def _labelled(
    kind: type[CounterMetricFamily | GaugeMetricFamily], name: str, text: str, label: str, values: dict[str, Any]
) -> Metric:
    family = kind(_PREFIX + name, text, labels=[label])
    for entry, value in values.items():
        family.add_metric([entry], value)
    return family


def _bus_states(buses: dict[str, str]) -> Metric:
    family = GaugeMetricFamily(_PREFIX + "bus_state", "1 for the present state of our CAN controller.", labels=["bus", "state"])
    for network, present in buses.items():
        for state in BusState:
            family.add_metric([network, state.value], float(state.value == present))
    return family


def _sha256(hashes: dict[str, str]) -> Metric:
    family = GaugeMetricFamily(_PREFIX + "sha256", "1 for each thing that it works with.", labels=["name", "sha256"])
    for name, digest in hashes.items():
        family.add_metric([name, digest], 1.0)
    return family


def _histogram(name: str, text: str, histogram: Histogram) -> Metric:
    bounds = [*(f"{bound_ns * _S_PER_NS:g}" for bound_ns in BUCKETS_NS), "+Inf"]
    buckets = list(zip(bounds, accumulate(histogram.counts), strict=True))
    return HistogramMetricFamily(_PREFIX + name, text, buckets=buckets, sum_value=histogram.sum_ns * _S_PER_NS)


class _Handler(WSGIRequestHandler):
    def log_message(self, *_: object) -> None:
        """Nothing: requests are no events."""


class _Server(WSGIServer):
    allow_reuse_port = False  # a second gateway must not share it unseen
    _is_ending = False
    _request: socket.socket | None = None

    def process_request(self, *arguments: Any) -> None:  # noqa: ANN401 - of the standard library
        """Answer one request, and pause."""
        super().process_request(*arguments)
        time.sleep(_PAUSE_S)

    def finish_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Answer one request within its time, however slowly the other side reads and writes."""
        self._request = request
        limit = threading.Timer(_REQUEST_TIMEOUT_S, self._cut)
        limit.start()
        try:
            if not self._is_ending:
                super().finish_request(request, client_address)
        finally:
            limit.cancel()
            limit.join()
            self._request = None

    def handle_error(self, *arguments: Any) -> None:  # noqa: ANN401
        """Nothing where a client went away or was cut off; anything else is our bug."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(*arguments)

    def end(self) -> None:
        """End, without waiting for whoever is being answered."""
        self._is_ending = True
        self._cut()
        self.shutdown()

    def _cut(self) -> None:
        if (request := self._request) is not None:
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)


class MetricsServer:
    """Serves the metrics of one gateway from a thread of its own, one request at a time.

    Args:
        unsent: see `GatewayCollector`.

    Raises:
        MetricsError: the port is not free.
    """

    def __init__(self, port: int, pulse: Pulse, logs: LogThread, unsent: Unsent = MappingProxyType({})) -> None:
        registry = CollectorRegistry(auto_describe=False)
        registry.register(GatewayCollector(pulse, logs, unsent))
        try:
            self._server = make_server("127.0.0.1", port, make_wsgi_app(registry), _Server, _Handler)
        except OSError as error:
            raise MetricsError(f"metrics.port = {port}: {error.strerror or error}; allowed: a free port") from error
        self._thread = threading.Thread(target=self._server.serve_forever, args=(_POLL_S,), name="metrics", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.end()
        self._thread.join()
        self._server.server_close()
