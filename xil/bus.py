"""Which CAN buses a run uses: the user's `--bus` and `--navigation-bus`, checked against what this machine has."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dbc.catalogue import NAVIGATION, ROBOTS
from dbc.errors import UserMistake
from dbc.link import bus_names
from vehicle_emulator.bus.channel import BusError, address_of, is_served

CHOICES = "auto, emulated, socketcan:INTERFACE (for example socketcan:vcan0) or xilgate:CHANNEL"

_AUTO_INTERFACES = {ROBOTS: "vcan0", NAVIGATION: "vcan1"}
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
    """The buses of one run.

    Args:
        names: bus of every network for `dbc.link.BusSet`, as python-can names it.
        hub_channels: of the networks whose hub the runner has to start first; the other buses are there already.
    """

    names: Mapping[str, str]
    hub_channels: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class _Bus:
    """One bus, and the channel whose hub has to be started for it, if any."""

    name: str
    hub_channel: str | None = None


def choose(bus: str, navigation_bus: str | None = None) -> BusChoice:
    """Resolve the user's choice.

    Args:
        bus: one of `CHOICES`; `auto` is vcan0 where it is up, else an emulated bus.
        navigation_bus: the same for the navigation system, with vcan1 for `auto`. None goes with `bus`: a second emulated bus beside
            an emulated one, vcan1 where `auto` found both, else `bus` itself.

    Raises:
        BusChoiceError: unknown choice, or a bus that is not there or not up; the text names the option.
    """
    robots = _resolve("--bus", bus, ROBOTS)
    if navigation_bus is not None:
        navigation = _resolve("--navigation-bus", navigation_bus, NAVIGATION)
    else:
        navigation = _beside(robots, is_auto=bus == "auto")
    channels = {ROBOTS: robots.hub_channel, NAVIGATION: navigation.hub_channel}
    return BusChoice(
        bus_names(robots.name, navigation.name), {network: channel for network, channel in channels.items() if channel is not None}
    )


def _beside(robots: _Bus, is_auto: bool) -> _Bus:
    """The bus of the navigation system, where only that of the robots was asked for."""
    if robots.hub_channel is not None:
        return _emulated(NAVIGATION)
    return (_auto(NAVIGATION) if is_auto else None) or robots


def _resolve(option: str, bus: str, network: str) -> _Bus:
    interface, separator, channel = bus.partition(":")
    match interface, separator, channel:
        case "auto", "", "":
            return _auto(network) or _emulated(network)
        case "emulated", "", "":
            return _emulated(network)
        case "socketcan", ":", name if _INTERFACE_NAME.fullmatch(name):
            if problem := socketcan_problem(name):
                raise BusChoiceError(f"{option} {bus!r}: {'; '.join(problem)}")
            return _Bus(bus)
        case "xilgate", ":", name if name:
            return _running_hub(option, bus, name)
        case _:
            raise BusChoiceError(f"{option} {bus!r}: expected {CHOICES}")


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


def _auto(network: str) -> _Bus | None:
    interface = _AUTO_INTERFACES[network]
    return None if socketcan_problem(interface) else _Bus(f"socketcan:{interface}")


def _emulated(network: str) -> _Bus:
    # The name that people try first; but runs side by side must not share a bus.
    channel = f"run-{os.getpid()}-{network}" if is_served(network) else network
    return _Bus(f"xilgate:{channel}", channel)


def _running_hub(option: str, bus: str, channel: str) -> _Bus:
    try:
        address = address_of(channel)
        if not is_served(channel):
            what, start = (f"this channel ({address})", channel) if isinstance(address, Path) else ("this port", f"--tcp {address[1]}")
            raise BusChoiceError(f"{option} {bus!r}: no hub serves {what}; `xilgate bus {start}` starts one")
    except BusError as error:
        raise BusChoiceError(f"{option} {bus!r}: {error}") from error
    return _Bus(bus)
