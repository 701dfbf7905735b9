"""What a run was measured on and with: machine, compiled libraries, their memory."""

import ctypes
import json
import os
import platform
import struct
from pathlib import Path
from typing import Any

from controller.build import METADATA_NAME
from dbc.build import Build

_LOAD = 1  # PT_LOAD of an ELF program header
_POINTER_BYTES = ctypes.sizeof(ctypes.c_void_p)


def describe_machine() -> str:
    """Processor, cores, system and Python."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []:
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{model}, {os.cpu_count()} cores, {platform.system()} {platform.release()}, Python {platform.python_version()}"


def describe_library(solver: str, build: Build) -> dict[str, Any]:
    """Compiler, flags, lanes and static memory of a solver's library."""
    library = ctypes.CDLL(str(build.library))
    metadata = json.loads(build.library.with_name(METADATA_NAME).read_text(encoding="utf-8"))
    loaded, work = loadable_bytes(build.library), work_bytes(library)
    return {
        "solver": solver,
        "compiler": build.compiler,
        "flags": " ".join(metadata["flags"]),
        "lanes": int(library.nmpc_lanes()) if hasattr(library, "nmpc_lanes") else 1,
        "library_bytes": loaded,
        "work_bytes": work,
        "memory_bytes": loaded + work,
    }


def work_bytes(library: ctypes.CDLL) -> int:
    """Memory that a caller gives to one solver: the struct of `riccati`, or the work vectors of CasADi's functions."""
    if hasattr(library, "nmpc_solver_bytes"):
        library.nmpc_solver_bytes.restype = ctypes.c_size_t
        return int(library.nmpc_solver_bytes())
    total = 0
    for name in ("nmpc", "kkt", "advance"):
        sizes = [ctypes.c_longlong() for _ in range(4)]
        library[f"{name}_work"](*map(ctypes.byref, sizes))
        arguments, results, integers, reals = (size.value for size in sizes)
        total += _POINTER_BYTES * (arguments + results) + 8 * (integers + reals)
    return total


def loadable_bytes(path: Path) -> int:
    """Memory that the segments of a 64-bit ELF library take when it is loaded; the file's size for another format."""
    content = path.read_bytes()
    if content[:5] != b"\x7fELF\x02":
        return len(content)
    order = "<" if content[5] == 1 else ">"
    (first,) = struct.unpack_from(order + "Q", content, 32)
    size, count = struct.unpack_from(order + "HH", content, 54)
    segments = [struct.unpack_from(order + "IIQQQQQQ", content, first + n * size) for n in range(count)]
    return sum(memory for kind, _, _, _, _, _, memory, _ in segments if kind == _LOAD)
