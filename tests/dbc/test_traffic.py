"""Load and rates, against a count of bits by hand."""

import pytest

from dbc.frame_length import INTERMISSION_BITS, classical_bits
from dbc.traffic import WINDOW_NS, Traffic, TrafficMeter

BITRATE_BPS = 500_000
CARE_NS = 50_000_000


def test_load_counts_every_bit_with_stuff_bits_and_intermission():
    meter = TrafficMeter(BITRATE_BPS)
    meter.tick(0)
    for _ in range(100):
        meter.add(0, b"")  # 44 bits without stuffing, of which 34 are dominant: a stuff bit after each fifth
    assert classical_bits(0, b"", 0) == 44 + 6
    meter.tick(WINDOW_NS)
    assert meter.traffic == Traffic(pytest.approx(100 * (50 + INTERMISSION_BITS) / BITRATE_BPS), {0: pytest.approx(100.0)})


def test_the_default_set_of_the_robots_gives_the_load_of_its_cycles():
    meter = TrafficMeter(BITRATE_BPS)
    bits = 0
    for t_ns in range(0, 3 * WINDOW_NS, CARE_NS):
        meter.tick(t_ns)
        for number in range(5):
            data = (t_ns + number).to_bytes(8, "little")
            meter.add(0x110, data)
            bits += classical_bits(0x110, data, 8) + INTERMISSION_BITS
    meter.tick(3 * WINDOW_NS)
    assert meter.traffic.rates_hz == {0x110: pytest.approx(100.0)}
    assert meter.traffic.load_norm == pytest.approx(bits / 3 / BITRATE_BPS, rel=0.02)


def test_a_window_stands_until_the_next_is_full_and_then_shows_the_next_alone():
    meter = TrafficMeter(BITRATE_BPS)
    assert meter.traffic == Traffic(0.0, {})
    meter.tick(0)
    meter.add(1, bytes(8))
    meter.tick(WINDOW_NS - 1)
    assert meter.traffic == Traffic(0.0, {})
    meter.tick(WINDOW_NS)
    assert set(meter.traffic.rates_hz) == {1}
    meter.add(2, bytes(8))
    meter.tick(2 * WINDOW_NS - 1)
    assert set(meter.traffic.rates_hz) == {1}
    meter.tick(2 * WINDOW_NS)
    assert set(meter.traffic.rates_hz) == {2}
    meter.tick(3 * WINDOW_NS)
    assert meter.traffic == Traffic(0.0, {})


def test_a_late_look_divides_by_the_time_that_has_passed():
    meter = TrafficMeter(BITRATE_BPS)
    meter.tick(0)
    for _ in range(40):
        meter.add(1, bytes(8))
    meter.tick(4 * WINDOW_NS)
    assert meter.traffic.rates_hz == {1: pytest.approx(10.0)}
