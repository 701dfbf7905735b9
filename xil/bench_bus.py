"""`xilgate bench bus`: throughput and latency of the emulated bus through its real hub process, and what a frame costs in the core."""

import multiprocessing
import os
import random
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from dbc.realtime import EMULATOR_PRIORITY, become_realtime
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.channel import is_served
from vehicle_emulator.bus.core import BusCore
from vehicle_emulator.bus.frame import BusFrame
from vehicle_emulator.bus.interface import XilgateBus
from xil.processes import Processes
from xil.summary import machine

BITRATE_BPS = 1_000_000
"""5,000 frames of 8 bytes a second do not fit on a bus of 500 kbit/s."""
LISTENERS = 2
PING_PERIOD_S = 0.001

_PATIENCE_S = 20.0
_CORE_FRAMES = 20_000
_TARGETS = {"frames_per_s": (">=", 5_000.0), "one_way_p50_us": ("<=", 300.0), "lost": ("<=", 0.0)}


@dataclass(frozen=True, slots=True)
class Heard:
    """What a listener reports.

    Args:
        frames: number of frames.
        span_s: from the first to the last, by their time stamps [s].
        one_way_us: from the call of `send` to the return of `recv` [us]; without stamps in the data empty.
        wire_us: of this the frame's own time on the wire [us].
    """

    frames: int
    span_s: float
    one_way_us: list[float]
    wire_us: list[float]


def bench_bus(seconds: float, progress: Callable[[str], None]) -> dict[str, Any]:
    """Measure with three nodes, one of which sends.

    Args:
        seconds: duration of each of the two measurements on the hub [s].
        progress: told what is being measured.
    """
    channel = f"bench-{os.getpid()}"
    with tempfile.TemporaryDirectory() as logs, Processes(Path(logs)) as processes:
        processes.start("bus", ["bus", channel, "--bitrate", str(BITRATE_BPS)])
        deadline_s = time.monotonic() + _PATIENCE_S
        while not is_served(channel) and time.monotonic() < deadline_s:
            time.sleep(0.01)
        progress("throughput")
        flood = _measure(channel, processes.pid("bus"), lambda bus: _flood(bus, seconds))
        progress("latency")
        ping = _measure(channel, processes.pid("bus"), lambda bus: _ping(bus, seconds))
    progress("core")
    one_way_us = np.array([value for heard in ping.heard for value in heard.one_way_us])
    wire_us = np.array([value for heard in ping.heard for value in heard.wire_us])
    span_s = max(heard.span_s for heard in flood.heard)
    figures = {
        "frames_per_s": flood.sent / span_s,
        "bus_load": flood.bits / BITRATE_BPS / span_s,
        "lost": float(sum(measured.sent - heard.frames for measured in (flood, ping) for heard in measured.heard)),
        "hub_cpu_share": flood.hub_cpu_s / span_s,
        "hub_cpu_us_per_frame": 1e6 * flood.hub_cpu_s / flood.sent,
        "one_way_p50_us": float(np.percentile(one_way_us, 50)),
        "one_way_p99_us": float(np.percentile(one_way_us, 99)),
        "wire_p50_us": float(np.percentile(wire_us, 50)),
        "beyond_wire_p50_us": float(np.percentile(one_way_us - wire_us, 50)),
        "beyond_wire_p99_us": float(np.percentile(one_way_us - wire_us, 99)),
        "beyond_wire_least_us": float((one_way_us - wire_us).min()),
        "core_us_per_frame": min(_core_us_per_frame() for _ in range(3)),
    }
    facts = machine()
    return {
        "machine": f"{facts['cpu']}, {facts['cores']} cores, {facts['system']}",
        "bitrate_bps": BITRATE_BPS,
        "nodes": LISTENERS + 1,
        "frames": flood.sent,
        "pings": ping.sent,
        "rows": [_row(name, value) for name, value in figures.items()],
    }


def to_table(result: dict[str, Any]) -> Table:
    """The result for people."""
    caption = f"{result['frames']} frames as fast as they go, {result['pings']} at 1 kHz, {result['machine']}"
    title = f"Emulated bus, {result['nodes']} nodes, {result['bitrate_bps'] // 1000} kbit/s, 8 bytes"
    table = Table(title=title, caption=caption, width=100)
    for column in ("figure", "target", "measured", ""):
        table.add_column(column, justify="left" if column == "figure" else "right")
    for row in result["rows"]:
        target = "" if row["target"] is None else f"{row['relation']} {row['target']:g}"
        verdict = "" if row["met"] is None else ("met" if row["met"] else "missed")
        table.add_row(row["name"].replace("_", " "), target, f"{row['measured']:.4g}", verdict)
    return table


def _row(name: str, measured: float) -> dict[str, Any]:
    relation, target = _TARGETS.get(name, (None, None))
    met = None if target is None else (measured >= target if relation == ">=" else measured <= target)
    return {"name": name, "relation": relation, "target": target, "measured": measured, "met": met}


@dataclass(frozen=True, slots=True)
class _Measured:
    """One sender's run: frames and bits it has sent, what was heard of it, and the processor time of the hub [s]."""

    sent: int
    bits: int
    heard: list[Heard]
    hub_cpu_s: float


def _measure(channel: str, hub_pid: int, send: Callable[[XilgateBus], tuple[int, int]]) -> _Measured:
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe() for _ in range(LISTENERS)]
    listeners = [context.Process(target=_listen, args=(channel, theirs), daemon=True) for _, theirs in pipes]
    for listener in listeners:
        listener.start()
    for ours, _ in pipes:
        ours.recv()
    with XilgateBus(channel) as bus:
        before_s = _cpu_s(hub_pid)
        sent, bits = send(bus)
        heard = []
        for ours, _ in pipes:
            ours.send(sent)
            heard.append(ours.recv())
        hub_cpu_s = _cpu_s(hub_pid) - before_s
    for listener in listeners:
        listener.join()
    return _Measured(sent, bits, heard, hub_cpu_s)


def _flood(bus: XilgateBus, seconds: float) -> tuple[int, int]:
    """Send as fast as the bus takes it; number of frames and of their bits."""
    return _send(bus, seconds, period_s=0.0)


def _ping(bus: XilgateBus, seconds: float) -> tuple[int, int]:
    return _send(bus, seconds, PING_PERIOD_S)


def _send(bus: XilgateBus, seconds: float, period_s: float) -> tuple[int, int]:
    import can  # noqa: PLC0415

    payloads = []
    start_s = next_s = time.monotonic()
    while next_s < start_s + seconds:
        next_s = max(next_s + period_s, time.monotonic())
        if period_s:
            time.sleep(max(0.0, next_s - time.monotonic()))
        payloads.append(time.monotonic_ns().to_bytes(8, "little"))
        bus.send(can.Message(arbitration_id=1, is_extended_id=False, data=payloads[-1]), timeout=_PATIENCE_S)
    return len(payloads), sum(_bits(data) + 3 for data in payloads)


def _bits(data: bytes) -> int:
    return frame_bits(BusFrame(1, data, 0, len(data)))[0]


def _listen(channel: str, pipe: Connection) -> None:
    """Process of a listener: count frames, and look at the time in each, until all have come or nothing comes any more."""
    heard: list[tuple[float, int, bytes]] = []
    with XilgateBus(channel) as bus:
        become_realtime(EMULATOR_PRIORITY)  # as gateway and emulated car do
        pipe.send("ready")
        expected: int | None = None
        while expected is None or len(heard) < expected:
            message = bus.recv(timeout=0.5)
            if message is not None:
                heard.append((message.timestamp, time.monotonic_ns(), bytes(message.data)))
            elif expected is not None:
                break
            elif pipe.poll():
                expected = pipe.recv()
    one_way_us = [1e-3 * (now_ns - int.from_bytes(data, "little")) for _, now_ns, data in heard]
    wire_us = [1e6 / BITRATE_BPS * _bits(data) for _, _, data in heard]
    pipe.send(Heard(len(heard), heard[-1][0] - heard[0][0] if heard else 0.0, one_way_us, wire_us))


def _cpu_s(pid: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _core_us_per_frame() -> float:
    """Processor time of a frame in the core alone: three nodes, two frames a millisecond, random data [us]."""
    core, numbers = BusCore(), random.Random(1)
    for node in range(3):
        core.join(node)
    frames = [(index % 3, BusFrame(numbers.randrange(680) * 3 + index % 3, numbers.randbytes(8), 0, 8)) for index in range(_CORE_FRAMES)]
    now_ns = 0
    start_ns = time.thread_time_ns()
    for index, (node, frame) in enumerate(frames):
        core.transmit(node, frame, now_ns)
        if index % 2:
            now_ns += 1_000_000
            core.advance(now_ns)
    return (time.thread_time_ns() - start_ns) * 1e-3 / _CORE_FRAMES
