"""Which CAN bus a run uses: the user's `--bus`, checked against what this machine has."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

from dbc.errors import UserMistake
from vehicle_emulator.bus.channel import BusError, is_served, socket_path

CHOICES = "auto, emulated, socketcan:INTERFACE (for example socketcan:vcan0) or xilgate:CHANNEL"

DEFAULT_CHANNEL = "bus0"
_DEFAULT_INTERFACE = "vcan0"
_SYS_NET = Path("/sys/class/net")
# From Linux's if_arp.h and if.h.
_ARPHRD_CAN = 280
_IFF_UP = 0x1
# if.h: IFNAMSIZ is 16 with its terminator; the kernel refuses '/', ':' and white space.
_INTERFACE_NAME = re.compile(r"(?!\.{1,2}$)[^/:\s]{1,15}")


class BusChoiceError(UserMistake):
    """The bus that the user asked for cannot be used; one line that says what to do."""


@dataclass(frozen=True, slots=True)
class BusChoice:
    """The bus of one run.

    Args:
        name: bus for `dbc.link.CanLink`, as python-can names it.
        hub_channel: channel whose hub the runner has to start first; None where the bus is there already.
    """

    name: str
    hub_channel: str | None


def choose(bus: str) -> BusChoice:
    """Resolve the user's choice.

    Args:
        bus: one of `CHOICES`; `auto` is vcan0 where it is up, else the emulated bus.

    Raises:
        BusChoiceError: unknown choice, or a bus that is not there or not up.
    """
    interface, separator, channel = bus.partition(":")
    match interface, separator, channel:
        case "auto", "", "":
            return _emulated() if socketcan_problem(_DEFAULT_INTERFACE) else BusChoice(f"socketcan:{_DEFAULT_INTERFACE}", None)
        case "emulated", "", "":
            return _emulated()
        case "socketcan", ":", name if _INTERFACE_NAME.fullmatch(name):
            if problem := socketcan_problem(name):
                raise BusChoiceError(f"bus {bus!r}: {'; '.join(problem)}")
            return BusChoice(bus, None)
        case "xilgate", ":", name if name:
            return _running_hub(bus, name)
        case _:
            raise BusChoiceError(f"bus {bus!r}: expected {CHOICES}")


def socketcan_problem(interface: str) -> tuple[str, str] | None:
    """What keeps a SocketCAN interface from being used, and what to do about it; None when it is ready."""
    directory = _SYS_NET / interface
    is_virtual = interface.startswith("vcan")
    try:
        kind = int((directory / "type").read_text(encoding="ascii"))
        flags = int((directory / "flags").read_text(encoding="ascii"), base=16)
    except OSError:
        create = f"`sudo sh -c 'ip link add {interface} type vcan && ip link set {interface} up'` makes it"
        return f"there is no interface {interface}", create if is_virtual else "connect the adapter and load its driver"
    if kind != _ARPHRD_CAN:
        return f"{interface} is not a CAN interface", "`ip link show type can` lists those that are"
    if not flags & _IFF_UP:
        # A real interface does not come up before it has a bit rate.
        bit_rate = "" if is_virtual else " type can bitrate 500000"
        return f"{interface} is down", f"`sudo ip link set {interface} up{bit_rate}` brings it up"
    return None


def _emulated() -> BusChoice:
    # The name that people try first; but runs side by side must not share a bus.
    channel = f"run-{os.getpid()}" if is_served(DEFAULT_CHANNEL) else DEFAULT_CHANNEL
    return BusChoice(f"xilgate:{channel}", channel)


def _running_hub(bus: str, channel: str) -> BusChoice:
    try:
        path = socket_path(channel)
        if not is_served(channel):
            raise BusChoiceError(f"bus {bus!r}: no hub serves this channel ({path}); `xilgate bus` starts one")
    except BusError as error:
        raise BusChoiceError(f"bus {bus!r}: {error}") from error
    return BusChoice(bus, None)
