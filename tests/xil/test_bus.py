"""The user's `--bus` and `--navigation-bus`: what they become, and the one line when they cannot be."""

import os
import tempfile
from pathlib import Path

import pytest

from dbc.link import bus_names
from vehicle_emulator.bus.hub import Hub, HubOptions
from xil.bus import BusChoice, BusChoiceError, choose, socketcan_problem

CAN, ETHERNET, UP, DOWN = "280", "1", "0x40043", "0x40080"
EMULATED = BusChoice(bus_names("xilgate:robots", "xilgate:navigation"), {"robots": "robots", "navigation": "navigation"})


def existing(robots: str, navigation: str | None = None) -> BusChoice:
    return BusChoice(bus_names(robots, navigation), {})


@pytest.fixture(autouse=True)
def interfaces(monkeypatch, tmp_path):
    """A machine without CAN interfaces, and a way to plug some in."""

    def plug(name, kind, flags):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n", encoding="ascii")
        (tmp_path / name / "flags").write_text(f"{flags}\n", encoding="ascii")

    monkeypatch.setattr("xil.bus._SYS_NET", tmp_path)
    return plug


@pytest.fixture(autouse=True)
def runtime_directory(monkeypatch):
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        yield Path(directory)


def refusal(bus: str) -> str:
    """The line that refuses a bus, the same for either option."""
    texts = []
    for option, words in (("--bus", (bus,)), ("--navigation-bus", ("emulated", bus))):
        with pytest.raises(BusChoiceError) as raised:
            choose(*words)
        text = str(raised.value)
        assert text.startswith(f"{option} {bus!r}: ")
        assert "\n" not in text
        texts.append(text.removeprefix(f"{option} {bus!r}: "))
    assert texts[0] == texts[1]
    return texts[0]


def test_auto_is_emulated_without_vcan0():
    assert choose("auto") == EMULATED


@pytest.mark.parametrize(("kind", "flags"), [(CAN, DOWN), (ETHERNET, UP)])
def test_auto_is_emulated_when_vcan0_is_of_no_use(interfaces, kind, flags):
    interfaces("vcan0", kind, flags)
    assert choose("auto") == EMULATED


def test_auto_takes_vcan0_when_it_is_up_and_nothing_else(interfaces):
    interfaces("can0", CAN, UP)
    assert choose("auto") == EMULATED
    interfaces("vcan0", CAN, UP)
    assert choose("auto") == existing("socketcan:vcan0")


def test_auto_takes_vcan1_for_the_navigation_system_when_both_are_up(interfaces):
    interfaces("vcan1", CAN, UP)
    assert choose("auto") == EMULATED
    interfaces("vcan0", CAN, UP)
    assert choose("auto") == existing("socketcan:vcan0", "socketcan:vcan1")
    assert choose("socketcan:vcan0") == existing("socketcan:vcan0")


def test_each_network_can_be_told_its_bus(interfaces):
    interfaces("can0", CAN, UP)
    interfaces("can1", CAN, UP)
    assert choose("socketcan:can0", "socketcan:can1") == existing("socketcan:can0", "socketcan:can1")
    assert choose("emulated", "emulated") == EMULATED
    assert choose("auto", "auto") == EMULATED
    assert choose("emulated", "socketcan:can1") == BusChoice(bus_names("xilgate:robots", "socketcan:can1"), {"robots": "robots"})
    for navigation in ("emulated", "auto"):
        own = BusChoice(bus_names("socketcan:can0", "xilgate:navigation"), {"navigation": "navigation"})
        assert choose("socketcan:can0", navigation) == own
    interfaces("vcan1", CAN, UP)
    assert choose("socketcan:can0", "auto") == existing("socketcan:can0", "socketcan:vcan1")


def test_emulated_is_emulated_even_with_vcan0(interfaces):
    interfaces("vcan0", CAN, UP)
    assert choose("emulated") == EMULATED


def test_a_second_run_gets_buses_of_its_own():
    with Hub("robots"), Hub("navigation"):
        channels = {network: f"run-{os.getpid()}-{network}" for network in ("robots", "navigation")}
        assert choose("emulated") == BusChoice(bus_names(*(f"xilgate:{channel}" for channel in channels.values())), channels)


def test_a_socketcan_interface_that_is_up(interfaces):
    interfaces("can1", CAN, UP)
    assert choose("socketcan:can1") == existing("socketcan:can1")


def test_a_missing_virtual_interface_is_to_be_made():
    assert refusal("socketcan:vcan7") == (
        "there is no interface vcan7; `sudo sh -c 'ip link add vcan7 type vcan && ip link set vcan7 up'` makes it"
    )


def test_a_missing_real_interface_is_to_be_connected():
    assert refusal("socketcan:can0") == "there is no interface can0; connect the adapter and load its driver"


def test_an_interface_that_is_down_is_to_be_brought_up(interfaces):
    interfaces("vcan0", CAN, DOWN)
    assert refusal("socketcan:vcan0") == "vcan0 is down; `sudo ip link set vcan0 up` brings it up"
    interfaces("can0", CAN, DOWN)
    assert refusal("socketcan:can0") == "can0 is down; `sudo ip link set can0 up type can bitrate 500000` brings it up"


def test_an_interface_that_is_no_can_interface(interfaces):
    interfaces("eth0", ETHERNET, UP)
    assert refusal("socketcan:eth0").startswith("eth0 is not a CAN interface; ")


def test_a_running_hub_is_used_and_not_started():
    with Hub("bus0"):
        assert choose("xilgate:bus0") == existing("xilgate:bus0")


def test_a_hub_that_is_not_there():
    text = refusal("xilgate:bus0")
    assert text.startswith("no hub serves this channel (/tmp/")
    assert text.endswith("`xilgate bus bus0` starts one")


def test_a_hub_on_a_port():
    with Hub("bus0", HubOptions(tcp_port=0)) as hub:
        assert choose(f"xilgate:tcp://127.0.0.1:{hub.tcp_port}") == existing(f"xilgate:tcp://127.0.0.1:{hub.tcp_port}")
        port = hub.tcp_port
    assert refusal(f"xilgate:tcp://127.0.0.1:{port}") == f"no hub serves this port; `xilgate bus --tcp {port}` starts one"


def test_a_bad_channel_name():
    assert refusal("xilgate:a/b") == "channel 'a/b': expected 1 to 32 letters, digits, - or _"


@pytest.mark.parametrize(
    "bus",
    [
        *("", "vcan0", "AUTO", "auto:", "emulated:x", "kvaser:0", "xilgate:"),
        *("socketcan", "socketcan:", "socketcan:..", "socketcan:../vcan0", "socketcan:" + "x" * 16),
    ],
)
def test_anything_else_lists_the_choices(bus):
    assert refusal(bus) == "expected auto, emulated, socketcan:INTERFACE (for example socketcan:vcan0) or xilgate:CHANNEL"


def test_a_file_beside_the_interfaces_is_no_interface(tmp_path):
    (tmp_path / "bonding_masters").write_text("", encoding="ascii")
    assert socketcan_problem("bonding_masters") == ("there is no interface bonding_masters", "connect the adapter and load its driver")
