"""Metrics: what the gateway knows, in the text that Prometheus reads, on the loopback interface alone."""

import contextlib
import io
import socket
import threading
import time
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from dbc.realtime import Grant
from gateway.housekeeping import Pulse
from gateway.logs import LogThread, PlainFormatter
from gateway.loop import BUCKETS_NS
from gateway.metrics import MetricsError, MetricsServer
from tests.support.cycle import CycleBench
from tests.support.processes import free_base_port


@pytest.fixture
def logs():
    return LogThread(PlainFormatter(), io.StringIO())


def read(port, path="/metrics"):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10) as answer:
        return answer.read().decode()


def samples(text):
    return {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_a_gateway_that_drives(logs):
    bench = CycleBench()
    bench.pulse.realtime = {"priority": Grant("SCHED_FIFO 60"), "memory": Grant("memory locked", "Cannot allocate memory")}
    bench.engage().tick(20)
    bench.pulse.lateness.observe(150_000)
    bench.pulse.lateness.observe(10**9)
    logs.dropped = 3
    port = free_base_port()
    with MetricsServer(port, bench.pulse, logs, {"operator": lambda: 2}):
        found = samples(read(port))
    prefix = "xilgate_gateway_"
    assert found[prefix + "mode", "ENGAGED"] == 1.0
    assert found[prefix + "mode", "SILENT"] == 0.0
    assert found[prefix + "messages_unsent_total", "operator"] == 2.0
    assert found[(prefix + "ticks_total",)] == bench.pulse.ticks
    assert found[(prefix + "frames_received_total",)] == bench.pulse.status.frames_received > 0
    assert found[prefix + "bus_state", "error-active", "robots"] == 1.0
    assert found[prefix + "bus_state", "bus-off", "robots"] == 0.0
    assert found[prefix + "bus_errors_total", "robots"] == 0.0
    assert (found[prefix + "realtime_granted", "priority"], found[prefix + "realtime_granted", "memory"]) == (1.0, 0.0)
    assert found[(prefix + "log_records_dropped_total",)] == 3.0
    assert found[(prefix + "step_cpu_seconds_count",)] == bench.pulse.ticks
    assert found[(prefix + "step_cpu_seconds_sum",)] > 0.0
    late = {name[1]: value for name, value in found.items() if name[0] == prefix + "tick_lateness_seconds_bucket"}
    assert len(late) == len(BUCKETS_NS) + 1
    ticks = bench.pulse.ticks
    assert (late["0.0001"], late["0.0002"], late["0.1"], late["+Inf"]) == (ticks, ticks + 1.0, ticks + 1.0, ticks + 2.0)
    limits = bench.preparation.hashes["limits"]
    assert found[(prefix + "sha256", *sorted(["limits", limits]))] == 1.0


def test_before_the_first_status_there_are_counters_already(logs):
    port = free_base_port()
    with MetricsServer(port, Pulse(), logs):
        found = samples(read(port))
    assert found[("xilgate_gateway_ticks_total",)] == 0.0


@pytest.mark.req("S1")
def test_only_the_loopback_interface_is_served(logs):
    port = free_base_port()
    with MetricsServer(port, Pulse(), logs), socket.socket() as probe:
        probe.bind(("127.0.0.2", port))  # free: nothing listens on all addresses


def test_a_port_that_is_taken_is_one_line(logs):
    port = free_base_port()
    with MetricsServer(port, Pulse(), logs), pytest.raises(MetricsError, match=f"metrics.port = {port}: Address already in use") as caught:
        MetricsServer(port, Pulse(), logs)
    assert "\n" not in str(caught.value)


def test_whoever_asks_in_a_loop_or_says_nothing_holds_nobody_up(logs):
    port = free_base_port()
    with MetricsServer(port, Pulse(), logs):
        start_s = time.monotonic()
        for _ in range(4):
            read(port)
        assert time.monotonic() - start_s > 0.12  # a pause after each
        with socket.create_connection(("127.0.0.1", port)):
            assert "ticks_total" in read(port)


@contextlib.contextmanager
def dripping(port):
    """A client that never comes to the end of its request."""
    with socket.create_connection(("127.0.0.1", port)) as client:
        ends = threading.Event()

        def drip():
            with contextlib.suppress(OSError):
                client.sendall(b"GET /metrics HTTP/1.1\r\nX: ")
                while not ends.wait(0.1):
                    client.sendall(b"x")

        thread = threading.Thread(target=drip)
        thread.start()
        yield
        ends.set()
        thread.join()


def test_a_slow_client_holds_others_up_for_its_time_only(logs, capsys):
    port = free_base_port()
    with MetricsServer(port, Pulse(), logs), dripping(port):
        time.sleep(0.3)
        start_s = time.monotonic()
        assert "ticks_total" in read(port)
        assert 1.0 < time.monotonic() - start_s < 5.0
    assert capsys.readouterr().err == ""


def test_a_slow_client_does_not_hold_up_the_end(logs):
    port = free_base_port()
    with contextlib.ExitStack() as client:
        with MetricsServer(port, Pulse(), logs):
            client.enter_context(dripping(port))
            time.sleep(0.3)
            start_s = time.monotonic()
        assert time.monotonic() - start_s < 1.0


def test_the_port_is_free_after_the_end(logs):
    port = free_base_port()
    for _ in range(2):
        with MetricsServer(port, Pulse(), logs):
            read(port)
