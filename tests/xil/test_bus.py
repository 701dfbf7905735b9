"""The user's `--bus`: what it becomes, and the one line when it cannot be."""

import os
import tempfile
from pathlib import Path

import pytest

from vehicle_emulator.bus.hub import Hub
from xil.bus import BusChoice, BusChoiceError, choose, socketcan_problem

CAN, ETHERNET, UP, DOWN = "280", "1", "0x40043", "0x40080"
EMULATED = BusChoice("xilgate:bus0", "bus0")


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
    with pytest.raises(BusChoiceError) as raised:
        choose(bus)
    text = str(raised.value)
    assert text.startswith(f"bus {bus!r}: ")
    assert "\n" not in text
    return text.removeprefix(f"bus {bus!r}: ")


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
    assert choose("auto") == BusChoice("socketcan:vcan0", None)


def test_emulated_is_emulated_even_with_vcan0(interfaces):
    interfaces("vcan0", CAN, UP)
    assert choose("emulated") == EMULATED


def test_a_second_run_gets_a_bus_of_its_own():
    with Hub("bus0"):
        channel = f"run-{os.getpid()}"
        assert choose("emulated") == BusChoice(f"xilgate:{channel}", channel)


def test_a_socketcan_interface_that_is_up(interfaces):
    interfaces("can1", CAN, UP)
    assert choose("socketcan:can1") == BusChoice("socketcan:can1", None)


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
        assert choose("xilgate:bus0") == BusChoice("xilgate:bus0", None)


def test_a_hub_that_is_not_there():
    assert refusal("xilgate:bus0").startswith("no hub serves this channel (/tmp/")


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
