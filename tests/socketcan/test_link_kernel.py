"""The link of a node against the kernel: filters, own frames, lost frames, interfaces that go and come, and a bus that is full."""

import socket
import struct
import subprocess
import threading

import pytest

from dbc.can_io import SocketCanPort
from dbc.can_link import CanLink
from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.health import WELL, BusState
from dbc.link import BusSet, bus_names
from tests.socketcan.conftest import ip
from tests.support.processes import wait_until

CATALOGUE = load()
SR_COMMAND, SR_STATUS, GW_SAFETY = (CATALOGUE.by_name[name].arbitration_id for name in ("SR_Command", "SR_Status", "GW_SafetyCommand"))
IDS = frozenset(CATALOGUE.by_id)
STRANGERS = sorted(set(range(0x800)) - IDS)
PATIENCE_S = 20.0
EXTENDED, REMOTE = 0x8000_0000, 0x4000_0000


def frame(arbitration_id=SR_COMMAND, data=bytes(8)) -> CanFrame:
    return CanFrame(arbitration_id, data, 0)


def raw_socket(interface: str) -> socket.socket:
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.bind((interface,))
    return raw


def raw_frame(identifier: int, data: bytes = bytes(8)) -> bytes:
    return struct.pack("=IB3x8s", identifier, len(data), data)


def wait_for(link: CanLink, state: BusState):
    wait_until(lambda: link.receive() or link.health().state is state, PATIENCE_S, f"the state {state.value}")


def hear(link: CanLink | BusSet, count: int) -> list[CanFrame]:
    """Frames until there are so many; the kernel delivers in its own time, if only microseconds later."""
    frames = []
    wait_until(lambda: frames.extend(link.receive()) or len(frames) >= count, PATIENCE_S, f"{count} frames")
    return frames


@pytest.mark.req("F11")
def test_the_kernel_keeps_strangers_from_us(interface):
    # A port filters nothing itself: what it does not deliver, the kernel has kept.
    port, everything = SocketCanPort(interface, IDS), SocketCanPort(interface, None)
    with raw_socket(interface) as other:
        strange = [*STRANGERS[::8], *(one | EXTENDED for one in sorted(IDS)), *(one | REMOTE for one in sorted(IDS))]
        for identifier in strange:
            other.send(raw_frame(identifier))
        for identifier in sorted(IDS):
            other.send(raw_frame(identifier))
    heard = []
    wait_until(lambda: heard.extend(everything.receive()[0]) or len(heard) == len(strange) + len(IDS), PATIENCE_S, "all frames")
    assert [identifier for identifier, _, _ in heard] == [*strange, *sorted(IDS)]
    assert port.receive() == ([(identifier, bytes(8), False) for identifier in sorted(IDS)], 0)
    port.close()
    everything.close()


def test_every_length_arrives_as_it_was_sent_and_in_order(interface):
    sent = [frame(SR_STATUS, bytes(range(length))) for length in range(9)] * 20  # more than one batch
    with CanLink(f"socketcan:{interface}", IDS) as link, CanLink(f"socketcan:{interface}") as other:
        other.send(sent)
        assert [one._replace(t_ns=0) for one in hear(link, len(sent))] == sent


def test_own_frames_confirm_and_another_programs_with_our_identifier_are_handed_on(interface):
    # Another program on this machine: its frames are local as well, which is all that python-can could tell.
    with CanLink(f"socketcan:{interface}", IDS) as link, raw_socket(interface) as other:
        link.send([frame(GW_SAFETY, b"ours")])
        assert link.health().unconfirmed_ns > 0
        other.send(raw_frame(GW_SAFETY, b"theirs"))
        assert [one.data for one in hear(link, 1)] == [b"theirs"]
        assert link.health() == WELL


def test_a_second_sender_with_cansend_is_seen(interface):
    with BusSet(bus_names(f"socketcan:{interface}"), CATALOGUE, "GW") as gateway:
        subprocess.run(["cansend", interface, f"{SR_COMMAND:03X}#0011223344556677"], check=True)
        assert [(one.arbitration_id, one.data.hex()) for one in hear(gateway, 1)] == [(SR_COMMAND, "0011223344556677")]


def test_frames_that_were_not_read_in_time_are_counted(interface):
    with CanLink(f"socketcan:{interface}", IDS) as link, raw_socket(interface) as other:
        link.send([frame()])
        for _ in range(2_000):
            other.send(raw_frame(SR_STATUS))
        heard = []
        wait_until(lambda: heard.extend(link.receive()) or len(heard) + link.lost == 2_000, PATIENCE_S, "every frame to be accounted for")
        assert 400 < len(heard) < 1_000  # half a second of a car's frames, no more: who sleeps for longer is better served with gaps
        assert link.health().unconfirmed_ns == 0


@pytest.mark.req("F10")
@pytest.mark.parametrize("ids", [None, IDS], ids=["any node", "our node"])
def test_an_interface_that_goes_down_and_up_again(interface, ids):
    with CanLink(f"socketcan:{interface}", ids) as link, CanLink(f"socketcan:{interface}") as other:
        other.send([frame(SR_STATUS)])
        ip("link", "set", interface, "down")
        assert [one.arbitration_id for one in link.receive()] == [SR_STATUS]  # came before it
        assert link.health().state is BusState.DOWN
        link.send([frame()])
        assert link.unsent == {"bus-off or down": 1}
        for _ in range(3):
            link.receive()
        assert link.health().state is BusState.DOWN
        ip("link", "set", interface, "up")
        wait_for(link, BusState.ERROR_ACTIVE)  # though nobody says anything
        wait_for(other, BusState.ERROR_ACTIVE)
        link.send([frame()])
        wait_until(other.receive, PATIENCE_S, "the frame")
        other.send([frame(SR_STATUS)])
        wait_until(link.receive, PATIENCE_S, "the frame")


@pytest.mark.req("F10")
def test_an_interface_that_is_removed_and_comes_back_filtered_as_before(interface):
    with CanLink(f"socketcan:{interface}", IDS) as link:
        ip("link", "delete", interface)
        wait_for(link, BusState.DOWN)
        for _ in range(5):
            link.send([frame()])
            link.receive()
        assert link.unsent == {"bus-off or down": 5}
        ip("link", "add", interface, "type", "vcan")
        ip("link", "set", interface, "up")
        wait_for(link, BusState.ERROR_ACTIVE)
        with raw_socket(interface) as other:
            other.send(raw_frame(STRANGERS[0]))
            other.send(raw_frame(SR_STATUS))
            assert [one.arbitration_id for one in hear(link, 1)] == [SR_STATUS]
            link.send([frame()])
            assert other.recv(16)[:4] == struct.pack("=I", SR_COMMAND)


@pytest.mark.req("F10")
def test_one_of_two_buses_goes_down(interface):
    buses = bus_names(f"socketcan:{interface}", "socketcan:vcan0")
    with BusSet(buses, CATALOGUE, "GW") as gateway, CanLink("socketcan:vcan0") as navigation:
        ip("link", "set", interface, "down")
        gateway.receive()
        assert {network: health.state for network, health in gateway.health().items()} == {
            "robots": BusState.DOWN,
            "navigation": BusState.ERROR_ACTIVE,
        }
        navigation.send([frame(CATALOGUE.by_name["PosLocal"].arbitration_id)])
        wait_until(gateway.receive, PATIENCE_S, "the navigation frame")


def test_a_restart_that_an_interface_does_not_have_is_refused_by_name(interface):
    port = SocketCanPort(interface, IDS)
    assert port.refusal == ""
    port.restart()
    wait_until(lambda: port.controller() or port.refusal, PATIENCE_S, "the refusal")
    assert port.refusal == "Operation not supported"
    port.close()


def test_a_flood_holds_no_poll_and_no_memory(interface):
    stop = threading.Event()

    def flood():
        with raw_socket(interface) as other:
            while not stop.is_set():
                other.send(raw_frame(SR_STATUS))

    thread = threading.Thread(target=flood)
    with CanLink(f"socketcan:{interface}", IDS) as link:
        thread.start()
        try:
            counts = []
            wait_until(lambda: counts.append(len(link.receive())) or sum(counts) > 5_000, PATIENCE_S, "5,000 frames")
        finally:
            stop.set()
            thread.join()
        assert max(counts) <= 576  # a batch more than the limit, when the last one begins just below it
