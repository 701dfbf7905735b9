"""The processors that the library is built for, as data: who compiles, with which flags, and who can emulate it here."""

from dataclasses import dataclass
from enum import StrEnum

from dbc.build import ZIG, BuildError, Compiler, compiler_at


class TargetName(StrEnum):
    """What a library can be built for."""

    HOST = "host"
    AARCH64 = "aarch64"
    CORTEX_A15 = "cortex-a15"


@dataclass(frozen=True)
class Toolchain:
    """A compiler for a target.

    Args:
        command: how to call it.
        flags: that make it write for this target.
    """

    command: tuple[str, ...]
    flags: tuple[str, ...] = ()


@dataclass(frozen=True)
class Target:
    """A processor other than this machine's.

    Args:
        prefix: of the names of Debian's compiler and binary utilities.
        package: of that compiler, in Debian.
        toolchains: the first that is installed compiles.
        lanes: stages that the code evaluates at once there.
        emulator: runs a static program of the target here.
    """

    prefix: str
    package: str
    toolchains: tuple[Toolchain, ...]
    lanes: int
    emulator: tuple[str, ...]


_ZIG_FLAGS = ("-fno-sanitize=undefined", "-s")
"""Zig adds checks and debug information unless told otherwise."""

TARGETS = {
    TargetName.AARCH64: Target(
        prefix="aarch64-linux-gnu-",
        package="gcc-aarch64-linux-gnu",
        toolchains=(
            Toolchain(("aarch64-linux-gnu-gcc",)),
            Toolchain(ZIG, ("-target", "aarch64-linux-gnu", *_ZIG_FLAGS)),
        ),
        lanes=2,
        emulator=("qemu-aarch64-static",),
    ),
    # Its NEON has no vectors of doubles: one stage at a time.
    TargetName.CORTEX_A15: Target(
        prefix="arm-linux-gnueabihf-",
        package="gcc-arm-linux-gnueabihf",
        toolchains=(
            Toolchain(("arm-linux-gnueabihf-gcc",), ("-mcpu=cortex-a15", "-mfpu=neon-vfpv4", "-mfloat-abi=hard")),
            Toolchain(ZIG, ("-target", "arm-linux-gnueabihf", "-mcpu=cortex_a15", *_ZIG_FLAGS)),
        ),
        lanes=1,
        emulator=("qemu-arm-static", "-cpu", "cortex-a15"),
    ),
}
"""Every target but the host, whose compiler and flags `dbc.build` and `controller.riccati.build` find out."""


def find_toolchain(name: TargetName) -> tuple[Compiler, tuple[str, ...]]:
    """The first compiler for a target that is installed, and the flags that make it write for this target.

    Raises:
        BuildError: there is none; names the package to install.
    """
    target = TARGETS[name]
    for toolchain in target.toolchains:
        if compiler := compiler_at(toolchain.command):
            return compiler, toolchain.flags
    wanted = target.toolchains[0].command[0]
    raise BuildError(f"target {name}: no {wanted} found: install the Debian package {target.package}, or `pip install ziglang`")
