"""Telemetry over real Zenoh sessions on loopback."""

import subprocess
import sys
import time

import pytest

from gateway.telemetry import TOPICS, Publisher, Source, Subscriber, TelemetryError, WorldSample, decode, port_of, topic_of
from tests.support.processes import free_base_port, wait_until

WORLD = WorldSample(
    t_ns=1, seq=2, x_m=1.5, y_m=-2.5, yaw_rad=0.1, vx_mps=22.2, vy_mps=0.0, yaw_rate_radps=0.0, ax_mps2=0.0, ay_mps2=0.0, sr_angle_rad=0.2,
    ar_position_norm=0.1, br_position_norm=0.0, robots_engaged=True,
)


def test_every_source_has_a_port_and_every_topic_a_type():
    assert len({port_of(source, 7000) for source in Source}) == len(Source)
    assert {source for source, _ in TOPICS.values()} == set(Source)
    assert topic_of(WORLD) == "world"


def test_sample_arrives_whole_whoever_starts_first():
    base = free_base_port()
    received = []
    with Subscriber(lambda topic, payload: received.append(decode(topic, payload)), ["world", "state"], base):
        time.sleep(0.2)  # the reader is there before the publisher
        with Publisher(Source.EMULATOR, base) as publisher:

            def has_arrived():
                publisher.post(WORLD)
                return bool(received)

            wait_until(has_arrived, 10, "a sample")
    assert received[0] == WORLD


def test_busy_port_is_one_line_that_names_it():
    base = free_base_port()
    with Publisher(Source.GATEWAY, base), pytest.raises(TelemetryError, match=str(base)) as caught:
        Publisher(Source.GATEWAY, base)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("payload", [b"", b"junk", b"{}", b'{"t_ns": "now"}', b"[1, 2]"])
def test_junk_is_no_sample(payload):
    assert decode("world", payload) is None
    assert decode("nowhere", payload) is None


def test_posting_never_blocks_and_loses_the_oldest():
    with Publisher(Source.EMULATOR, free_base_port()) as publisher:
        start_s = time.monotonic()
        for _ in range(20_000):
            publisher.post(WORLD)
        assert time.monotonic() - start_s < 5.0


def test_process_with_an_open_reader_exits():
    code = (
        "from gateway.telemetry import Subscriber\n"
        f"reader = Subscriber(lambda topic, payload: None, ['state'], {free_base_port()})\n"
        "raise SystemExit(7)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=30, check=False).returncode == 7
