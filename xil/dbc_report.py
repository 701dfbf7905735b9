"""What `xilgate dbc` shows: loads and worst-case response times from the DBC alone, and its tables."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from dbc.catalogue import read_files, spec_of
from dbc.database import DbcFile, attributes_of, bitrates
from dbc.difference import Change
from dbc.lint import BusTiming, Finding, Severity, lint
from dbc.packing import value_range
from gateway.codec import COMMAND_MESSAGES, NEEDED_MESSAGES
from vehicle_emulator.bus.analysis import MessageTiming, bus_load, response_times

ACTED_ON = frozenset((*NEEDED_MESSAGES, *COMMAND_MESSAGES))
"""Messages that the gateway or a robot acts on; all others are for people and monitors."""

_NS_PER_MS = 1_000_000
_STYLE = {Severity.ERROR: "red", Severity.WARNING: "yellow"}


def check(paths: Sequence[Path], mapping: Path | None, max_load: float) -> list[Finding]:
    """All findings on these files; `max_load` is a share of a bus."""
    files = read_files(paths, mapping, is_strict=False)
    return lint(files, ACTED_ON, timings(files), max_load)


def timings(files: Sequence[DbcFile]) -> list[BusTiming]:
    """Load and worst-case response times of every bus that the files are about: no errors on the bus, no jitter."""
    analysed = []
    rates_bps = bitrates(files)
    for network in dict.fromkeys(file.network for file in files):
        bitrate_bps = rates_bps[network]
        cyclic = [timing for file in files if file.network == network for timing in _cyclic(file)]
        bounds_ns = {response.message.name: response.bound_ns for response in response_times(cyclic, bitrate_bps)}
        analysed.append(BusTiming(network, bus_load(cyclic, bitrate_bps)[1], bounds_ns))
    return analysed


def _cyclic(file: DbcFile) -> list[MessageTiming]:
    cycles_ms = [(message, attributes_of(message).get("GenMsgCycleTime")) for message in file.messages]
    return [
        MessageTiming(message.name, message.frame_id, message.length, cycle_ms * _NS_PER_MS, is_extended=message.is_extended_frame)
        for message, cycle_ms in cycles_ms
        if isinstance(cycle_ms, int) and cycle_ms > 0
    ]


def messages(files: Sequence[DbcFile]) -> list[dict[str, Any]]:
    """One row for each message, by bus and identifier; times in ms, the load as a share of its bus."""
    bounds_ns = {name: bound_ns for timing in timings(files) for name, bound_ns in timing.bounds_ns.items()}
    rates_bps = bitrates(files)
    loads = {one.name: bus_load([one], rates_bps[file.network])[1] for file in files for one in _cyclic(file)}
    rows = []
    for file in files:
        for message in file.messages:
            spec, bound_ns = spec_of(message, file.network), bounds_ns.get(message.name)
            rows.append({
                "id": spec.arbitration_id,
                "name": spec.name,
                "sender": spec.sender,
                "network": spec.network,
                "length_bytes": spec.length_bytes,
                "cycle_ms": spec.cycle_time_ns / _NS_PER_MS,
                "timeout_ms": spec.timeout_ns / _NS_PER_MS,
                "e2e_data_id": spec.e2e_data_id,
                "load": loads.get(spec.name, 0.0),
                "worst_response_ms": None if bound_ns is None else bound_ns / _NS_PER_MS,
                "file": file.path.name,
            })  # fmt: skip
    return sorted(rows, key=lambda row: (row["network"] != files[0].network, row["id"]))


def signals(files: Sequence[DbcFile]) -> list[dict[str, Any]]:
    """One row for each signal, in the order of the files."""
    return [
        {
            "message": message.name,
            "name": signal.name,
            "start": signal.start,
            "length": signal.length,
            "byte_order": signal.byte_order,
            "is_signed": signal.is_signed,
            "scale": signal.scale,
            "offset": signal.offset,
            "minimum": value_range(signal)[0] if signal.minimum is None else signal.minimum,
            "maximum": value_range(signal)[1] if signal.maximum is None else signal.maximum,
            "unit": signal.unit or "",
            "pages": signal.multiplexer_ids or [],
            "values": {str(entry): raw for raw, entry in (signal.choices or {}).items()},
            "receivers": signal.receivers,
        }
        for file in files
        for message in file.messages
        for signal in message.signals
    ]


def findings_table(findings: Sequence[Finding]) -> Table:
    """Findings for people."""
    errors = sum(finding.severity is Severity.ERROR for finding in findings)
    title = f"{errors} errors, {len(findings) - errors} warnings"
    table = Table("", "file", "message", "signal", "finding", "value", "allowed", title=title)
    for finding in findings:
        where = (finding.file, finding.message, finding.signal)
        table.add_row(finding.severity.value, *where, finding.text, finding.value, finding.limit, style=_STYLE[finding.severity])
    return table


def findings_data(findings: Sequence[Finding]) -> dict[str, Any]:
    """Findings for programs."""
    return {
        "errors": sum(finding.severity is Severity.ERROR for finding in findings),
        "findings": [asdict(finding) | {"severity": finding.severity.value} for finding in findings],
    }


def changes_table(changes: Sequence[Change]) -> Table:
    """Differences for people."""
    breaking = sum(change.is_breaking for change in changes)
    table = Table("", "message", "signal", "what", "old", "new", title=f"{breaking} that break, {len(changes) - breaking} compatible")
    for change in changes:
        verdict, style = ("breaks", "red") if change.is_breaking else ("compatible", None)
        table.add_row(verdict, change.message, change.signal, change.what, change.old, change.new, style=style)
    return table


def changes_data(changes: Sequence[Change]) -> dict[str, Any]:
    """Differences for programs."""
    return {"breaking": sum(change.is_breaking for change in changes), "changes": [asdict(change) for change in changes]}


def messages_table(rows: Sequence[Mapping[str, Any]], loads: Mapping[str, float]) -> Table:
    """Messages for people.

    Args:
        loads: of every bus, as shares.
    """
    caption = ", ".join(f"{network} {load:.1%}" for network, load in loads.items())
    table = Table(title="Messages", caption=f"load with the most stuff bits: {caption}; response: worst case, without errors on the bus")
    for column in ("id", "name", "sender", "network", "bytes", "cycle", "timeout", "E2E", "load", "response"):
        table.add_column(column, justify="left" if column in ("name", "sender", "network") else "right")
    for row in rows:
        table.add_row(
            f"0x{row['id']:03X}",
            *(row["name"], row["sender"], row["network"], str(row["length_bytes"])),
            *(f"{row[key]:g} ms" if row[key] else "" for key in ("cycle_ms", "timeout_ms")),
            "" if row["e2e_data_id"] is None else str(row["e2e_data_id"]),
            f"{row['load']:.2%}" if row["load"] else "",
            f"{row['worst_response_ms']:.2f} ms" if row["worst_response_ms"] is not None else ("none" if row["load"] else ""),
        )
    return table


def signals_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Signals for people."""
    table = Table("message", "signal", "bits", "factor", "offset", "range", "unit", "values", "receivers", title="Signals")
    for row in rows:
        order, sign = 1 if row["byte_order"] == "little_endian" else 0, "-" if row["is_signed"] else "+"
        values = ", ".join(f"{raw} {entry}" for entry, raw in sorted(row["values"].items(), key=lambda item: item[1]))
        table.add_row(
            *(row["message"], row["name"], f"{row['start']}|{row['length']}@{order}{sign}"),
            *(f"{row['scale']:g}", f"{row['offset']:g}", f"{row['minimum']:g} to {row['maximum']:g}"),
            *(row["unit"], values, ", ".join(row["receivers"])),
        )
    return table
