"""`xilgate bus` and `xilgate bench bus` as their user meets them."""

import signal
import tempfile
from itertools import pairwise
from pathlib import Path

import can
import pytest

from tests.support.processes import free_base_port, start_xilgate, wait_until, xilgate
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.channel import is_served
from vehicle_emulator.bus.frame import BusFrame
from vehicle_emulator.bus.hub import Hub, HubOptions
from xil.bench_bus import LISTENERS, bench_bus, to_table
from xil.bus import BusChoiceError, choose

PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def runtime_directory(monkeypatch):
    # Not tmp_path: a socket name has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        yield Path(directory)


def refusal(*arguments: str) -> tuple[int, str]:
    done = xilgate(*arguments)
    return done.returncode, done.stderr


def test_every_channel_has_its_bit_rate_and_its_port():
    port = free_base_port()
    process = start_xilgate("bus", "slow", "fast", "--bitrate", "125000", "--bitrate", "1000000", "--tcp", str(port))
    try:
        wait_until(lambda: is_served("fast"), PATIENCE_S, "the hub")
        for name, number, bit_s in (("slow", port, 8e-6), ("fast", port + 1, 1e-6)):
            with can.Bus(interface="xilgate", channel=f"tcp://127.0.0.1:{number}") as a, can.Bus(interface="xilgate", channel=name) as b:
                message = can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8))
                for _ in range(3):
                    a.send(message)
                stamps_s = [b.recv(timeout=PATIENCE_S).timestamp for _ in range(3)]
                bits = frame_bits(BusFrame(1, bytes(8), 0, 8))[0] + 3
                assert min(later - earlier for earlier, later in pairwise(stamps_s)) >= bits * bit_s - 1e-6
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


def test_bit_rates_have_to_fit_the_channels():
    arguments = ("bus", "a", "b", "c", "--bitrate", "125000", "--bitrate", "500000")
    assert refusal(*arguments) == (2, "xilgate: --bitrate: 2 values for 3 channels, expected 1 or 3\n")


def test_a_served_channel_is_one_line():
    with Hub("taken"):
        code, text = refusal("bus", "free", "taken")
    assert code == 3
    assert text.startswith("xilgate: channel 'taken' is already served by another hub (")
    assert not is_served("free")


def test_a_run_may_use_a_bus_on_a_port():
    with Hub("bus0", HubOptions(tcp_port=0)) as hub:
        port = hub.tcp_port
        bus = f"xilgate:tcp://127.0.0.1:{port}"
        assert choose(bus).names["robots"] == bus
    with pytest.raises(BusChoiceError, match=rf"no hub serves this port; `xilgate bus --tcp {port}`"):
        choose(bus)


def test_the_bench_measures_and_no_frame_is_early():
    result = bench_bus(0.5, lambda _: None)
    rows = {row["name"]: row for row in result["rows"]}
    assert result["nodes"] == LISTENERS + 1
    assert rows["beyond_wire_least_us"]["measured"] > 0.0
    assert rows["one_way_p50_us"]["measured"] > rows["wire_p50_us"]["measured"] > 100.0
    assert 0.0 < rows["bus_load"]["measured"] <= 1.001
    assert rows["frames_per_s"]["target"] == 5000
    assert rows["frames_per_s"]["met"] == (rows["frames_per_s"]["measured"] >= 5000)
    assert rows["hub_cpu_share"]["met"] is None
    assert to_table(result).row_count == len(rows)
