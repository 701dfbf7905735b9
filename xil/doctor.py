"""What this machine can do for xilgate, and what to do about each gap."""

import os
import resource
import shutil
import socket
import threading
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

from dbc.build import BuildError, find_compiler
from dbc.realtime import GATEWAY_PRIORITY, take_priority
from xil.bus import socketcan_problem

_CAN_INTERFACES = ("vcan0", "vcan1", "can0", "can1")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox")
_PROC_STATUS = Path("/proc/self/status")
_SYS_REALTIME = Path("/sys/kernel/realtime")
_SYS_ISOLATED = Path("/sys/devices/system/cpu/isolated")
# From Linux's capability.h.
_CAP_IPC_LOCK = 14
# Plant, gateway and controller each want a core in a real-time run; two do, with the plant beside one of them.
_MIN_CORES = 2


@dataclass(frozen=True, slots=True)
class Check:
    """One ability of this machine.

    Args:
        name: the ability.
        is_ok: whether it is there.
        found: what was found.
        advice: what to do about the gap, and what it limits; empty when it is there.
        is_required: whether the emulated drive needs it; the rest serves real buses and real time.
    """

    name: str
    is_ok: bool
    found: str
    advice: str
    is_required: bool = False


def checks() -> list[Check]:
    """Examine this machine, changing nothing."""
    return [
        _compiler(),
        _cores(),
        _socketcan(),
        *(_can_interface(interface) for interface in _CAN_INTERFACES),
        _realtime_priority(),
        _memory_locking(),
        _control_processor(),
        _preempt_rt(),
        _browser(),
    ]


def as_data(results: list[Check]) -> list[dict[str, str | bool]]:
    """The checks as plain data, for JSON."""
    return [asdict(check) for check in results]


def as_table(results: list[Check]) -> Table:
    """The checks as a table for people."""
    table = Table(title="xilgate doctor", title_justify="left")
    for heading in ("", "check", "found", "what to do"):
        table.add_column(heading, overflow="fold")
    for check in results:
        mark = "[green]ok[/]" if check.is_ok else "[red]missing[/]" if check.is_required else "[yellow]limited[/]"
        table.add_row(mark, check.name, _plain(check.found), _plain(check.advice))
    return table


def _plain(text: str) -> str:
    """Text in which rich sees no markup."""
    return text.replace("[", r"\[")


def _check(name: str, is_ok: bool, found: str, advice: str, is_required: bool = False) -> Check:
    return Check(name, is_ok, found, "" if is_ok else advice, is_required)


def _compiler() -> Check:
    try:
        return Check("C compiler", True, str(find_compiler()), "", is_required=True)
    except BuildError as error:
        return Check("C compiler", False, "none", f"{error}; only stage mil does without", is_required=True)


def _cores() -> Check:
    cores = len(os.sched_getaffinity(0))
    return _check("processor cores", cores >= _MIN_CORES, str(cores), f"stages hil and vehil want at least {_MIN_CORES}")


def _socketcan() -> Check:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        advice = "`sudo modprobe can-raw`, or a kernel with CAN; until then the emulated bus serves"
        return Check("SocketCAN", False, error.strerror or str(error), advice)
    return Check("SocketCAN", True, "AF_CAN sockets open", "")


def _can_interface(interface: str) -> Check:
    problem, advice = socketcan_problem(interface) or ("", "")
    return Check(f"interface {interface}", not problem, problem or "up", advice)


def _realtime_priority() -> Check:
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    is_permitted = _may_use_fifo()
    limit = "unlimited" if soft == resource.RLIM_INFINITY else str(soft)
    return _check(
        "real-time priority",
        is_permitted,
        f"SCHED_FIFO {GATEWAY_PRIORITY} permitted" if is_permitted else f"SCHED_FIFO {GATEWAY_PRIORITY} refused, rtprio limit {limit}",
        f"rtprio {GATEWAY_PRIORITY} for your user in /etc/security/limits.conf, or LimitRTPRIO={GATEWAY_PRIORITY} in the service unit; "
        "then log in again",
    )


def _may_use_fifo() -> bool:
    """Whether a thread may have the gateway's priority: tried in one that ends at once, since limits and capabilities do not tell all."""
    outcome: list[bool] = []
    thread = threading.Thread(target=lambda: outcome.append(not take_priority(GATEWAY_PRIORITY).refusal))
    thread.start()
    thread.join()
    return outcome[0]


def _memory_locking() -> Check:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    is_unlimited = soft == resource.RLIM_INFINITY or bool(_effective_capabilities() >> _CAP_IPC_LOCK & 1)
    return _check(
        "memory locking",
        is_unlimited,
        "unlimited" if is_unlimited else f"limit {soft // 1024} KiB",
        "memlock unlimited for your user in /etc/security/limits.conf, or LimitMEMLOCK=infinity in the service unit",
    )


def _effective_capabilities() -> int:
    for line in _PROC_STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], base=16)
    return 0


def _control_processor() -> Check:
    try:
        isolated = _SYS_ISOLATED.read_text(encoding="ascii").strip()
    except OSError:
        isolated = ""
    return _check(
        "processor for control",
        bool(isolated),
        f"isolated: {isolated}" if isolated else "none isolated",
        "on the target: isolcpus=1 on the kernel command line, and cpus = [1] in the rig file; without it others run there as well",
    )


def _preempt_rt() -> Check:
    kernel = os.uname()
    is_realtime = "PREEMPT_RT" in kernel.version or (_SYS_REALTIME.exists() and _SYS_REALTIME.read_text(encoding="ascii").strip() == "1")
    return _check(
        "real-time kernel",
        is_realtime,
        f"{kernel.release}{' PREEMPT_RT' if is_realtime else ''}",
        "`apt-get install linux-image-rt-amd64` on the target; without it deadlines are missed by milliseconds under load",
    )


def _browser() -> Check:
    path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    return _check("browser", path is not None, path or "none", "only to look at the view on this machine; any machine's browser will do")
