"""The bus record: candump's format, a channel for each bus."""

import os
import re
from pathlib import Path

import can
import pytest

from dbc.frame import CanFrame
from dbc.link import CanLink
from tests.support.processes import wait_until
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.frame import BusFrame
from xil.buslog import BusListener, BusLog, recorded_load


def test_a_line_is_candumps(tmp_path):
    with BusLog(tmp_path / "bus.log") as log:
        log.write("robots", CanFrame(0x11, b"\x01\xab", 12_000_345_678))
        log.write("can1", CanFrame(0x7FF, b"", 12_999_999_999))
    assert (tmp_path / "bus.log").read_text() == "(12.000345) robots 011#01AB\n(12.999999) can1 7FF#\n"
    read = list(can.CanutilsLogReader(tmp_path / "bus.log"))
    assert [(m.timestamp, m.channel, m.arbitration_id, bytes(m.data)) for m in read] == [
        (pytest.approx(12.000345), "robots", 0x11, b"\x01\xab"),
        (pytest.approx(12.999999), "can1", 0x7FF, b""),
    ]


def test_every_bus_is_recorded_once_under_its_channel(tmp_path):
    robots, navigation = (f"log {name} {os.getpid()}" for name in ("robots", "navigation"))
    names = [f"virtual:{robots}", f"virtual:{navigation}"]
    with BusListener([*names, names[0]], tmp_path / "bus.log") as listener, CanLink(names[0]) as a, CanLink(names[1]) as b:
        a.send([CanFrame(0x11, b"\x01", 0)] * 2)
        b.send([CanFrame(0x22, b"\x02", 0)])
        wait_until(lambda: listener.frames == 3, 10, "three frames")
    lines = [re.sub(r"^\(\d+\.\d{6}\) ", "", line) for line in (tmp_path / "bus.log").read_text().splitlines()]
    assert sorted(lines) == [f"{navigation} 022#02", f"{robots} 011#01", f"{robots} 011#01"]


def test_a_bus_that_is_not_there_is_not_recorded(tmp_path):
    with pytest.raises(can.CanInterfaceNotImplementedError):
        BusListener([f"virtual:log gone {os.getpid()}", "nosuch:0"], tmp_path / "bus.log")


def test_load_is_bits_over_time(tmp_path):
    path = tmp_path / "bus.log"
    frames = [("robots", 0.0), ("navigation", 0.25), ("robots", 0.5), ("navigation", 1.0)]
    path.write_text("".join(f"({10 + t_s:.6f}) {channel} 555#5555555555555555\n" for channel, t_s in frames))
    # Bits that alternate need no stuffing: 1 + 12 + 6 + 64 + 15 + 10 bits, and 3 between frames; its CRC is stuffed by chance.
    bits, _ = frame_bits(BusFrame(0x555, b"\x55" * 8, 0, 8))
    assert 108 <= bits <= 112
    load = 2 * (bits + 3) / 500_000
    expected = {"robots": load, "navigation": load / 2, "vcan0": 0.0}
    assert recorded_load(path, {"robots": 500_000, "navigation": 1_000_000, "vcan0": 500_000}) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "(10.000000) robots 123#\n"])
def test_a_record_without_duration_has_no_load(tmp_path, text):
    path = tmp_path / "bus.log"
    path.write_text(text)
    assert recorded_load(path, {"robots": 500_000}) == {}


def test_what_was_heard_outlives_its_runner(tmp_path):
    name = f"virtual:flush {os.getpid()}"
    with BusListener([name], tmp_path / "bus.log"), CanLink(name) as node:
        node.send([CanFrame(0x11, b"\x01", 0)])
        # Long before the listener is closed, and far from a full buffer.
        wait_until(lambda: (tmp_path / "bus.log").read_text().endswith(" 011#01\n"), 10, "the frame in the file")


def test_a_full_disk_ends_the_record_and_is_told():
    name = f"virtual:full {os.getpid()}"
    with BusListener([name], Path("/dev/full")) as listener, CanLink(name) as node:
        node.send([CanFrame(0x11, b"\x01", 0)])
        wait_until(lambda: listener.problem, 10, "the refusal")
    assert listener.problem == "the bus record ends early: No space left on device"
