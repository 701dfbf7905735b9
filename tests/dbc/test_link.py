"""The link on every kind of bus: same frames, never an exception, and a dead bus that shows; and several links as one car's."""

import threading
from pathlib import Path
from types import SimpleNamespace

import can
import pytest

from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.health import BusState
from dbc.link import MAX_FRAMES_PER_RECEIVE, BusSet, CanLink, LinkError, bus_names
from tests.support.processes import wait_until
from xil.bus import socketcan_problem

PATIENCE_S = 20.0


@pytest.fixture(params=["virtual:link", "xilgate:bus0", "socketcan:vcan0"])
def bus_name(request, served):
    if request.param.startswith("socketcan") and (problem := socketcan_problem("vcan0")):
        pytest.skip("; ".join(problem))
    return request.param


def receive(link: CanLink, count: int) -> list[CanFrame]:
    """Poll until `count` frames have come."""
    frames: list[CanFrame] = []
    waiting = threading.Event()
    for _ in range(int(PATIENCE_S / 0.002)):
        frames += link.receive()
        if len(frames) >= count:
            return frames
        waiting.wait(0.002)
    raise AssertionError(f"only {len(frames)} of {count} frames")


def python_can_bus(name: str, **settings) -> can.BusABC:
    interface, _, channel = name.partition(":")
    return can.Bus(interface=interface, channel=channel, **settings)


def test_frames_arrive_in_order_and_not_at_their_sender(bus_name):
    frames = [CanFrame(identifier, bytes([identifier % 256] * length), 0) for identifier, length in ((0x7FF, 8), (0, 0), (0x110, 3))]
    with CanLink(bus_name) as a, CanLink(bus_name) as b:
        a.send(frames)
        received = receive(b, 3)
        assert [frame._replace(t_ns=0) for frame in received] == frames
        assert a.receive() == []
        b.send(frames[:1])
        assert receive(a, 1)[0].arbitration_id == 0x7FF
        assert (a.health().state, a.unsent, a.ignored, a.refused_polls) == (BusState.ERROR_ACTIVE, {}, {}, 0)


def test_frames_of_one_poll_carry_its_time_and_polls_go_forward(bus_name, monkeypatch):
    clock_ns = iter(range(1000, 10**9, 1000))
    monkeypatch.setattr("dbc.can_link.time", SimpleNamespace(monotonic_ns=lambda: next(clock_ns)))  # the bus keeps its own clock
    with CanLink(bus_name) as a, CanLink(bus_name) as b:
        a.send([CanFrame(1, b"", 0)])
        (first,) = receive(b, 1)
        a.send([CanFrame(2, b"", 0)])
        (second,) = receive(b, 1)
    assert 1000 <= first.t_ns < second.t_ns


def test_only_classical_data_frames_with_11_bits_pass(bus_name):
    strange = [
        can.Message(arbitration_id=0x110, is_extended_id=True, data=bytes(8)),
        can.Message(arbitration_id=0x110, is_extended_id=False, is_remote_frame=True, dlc=8),
    ]
    if not bus_name.startswith("socketcan"):  # whose kernel keeps CAN FD from a classical socket, and makes error frames itself
        strange.append(can.Message(arbitration_id=0x110, is_extended_id=False, is_fd=True, data=bytes(12)))
    if bus_name.startswith("virtual"):  # the emulated bus lets nobody but the bus itself make error frames either
        strange.append(can.Message(arbitration_id=0x080, is_extended_id=False, is_error_frame=True, data=bytes(8)))
    settings = {"fd": True} if bus_name.startswith("xilgate") else {}
    with CanLink(bus_name) as link, python_can_bus(bus_name, **settings) as other:
        for message in strange:
            other.send(message)
        other.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=b"ok"))
        assert [frame.data for frame in receive(link, 1)] == [b"ok"]
        assert link.ignored == {"no classical data frame": len([one for one in strange if not one.is_error_frame])}
        assert link.health().state is BusState.ERROR_ACTIVE


def test_a_flood_does_not_hold_the_poll():
    with CanLink("virtual:flood") as link, CanLink("virtual:flood") as other:
        other.send([CanFrame(1, b"", 0)] * (MAX_FRAMES_PER_RECEIVE + 10))
        assert len(link.receive()) == MAX_FRAMES_PER_RECEIVE
        assert len(link.receive()) == 10


def test_a_hub_that_goes_is_visible_and_never_raises(served):
    with CanLink("xilgate:bus0") as a, CanLink("xilgate:bus0") as b:
        a.send([CanFrame(1, b"", 0)])
        assert len(receive(b, 1)) == 1
        a.send([CanFrame(2, b"", 0)] * 3)
        receive(b, 3)
        served.stop()
        assert b.receive() == []
        assert b.health().state is BusState.DOWN
        assert a.health().state is BusState.ERROR_ACTIVE  # it has not looked yet
        a.send([CanFrame(3, b"", 0)] * 2)
        assert a.health().state is BusState.DOWN
        assert a.unsent == {"refused": 1, "bus-off or down": 1}


def test_frames_that_came_before_the_hub_went_are_still_delivered(served):
    with CanLink("xilgate:bus0") as a, CanLink("xilgate:bus0") as b, CanLink("xilgate:bus0") as witness:
        a.send([CanFrame(1, b"", 0), CanFrame(2, b"", 0)])
        receive(witness, 2)
        served.stop()
        assert [frame.arbitration_id for frame in b.receive()] == [1, 2]
        assert b.health().state is BusState.DOWN


@pytest.mark.parametrize("name", ["", "vcan0", "socketcan:", ":vcan0"])
def test_malformed_bus_name(name):
    with pytest.raises(LinkError, match=r"expected INTERFACE:CHANNEL, for example socketcan:vcan0$"):
        CanLink(name)


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("nosuch:0", "CAN interface 'nosuch' not supported"),
        ("xilgate:nobody", "no hub serves xilgate channel 'nobody'"),
        ("xilgate:a/b", "expected 1 to 32 letters"),
        ("socketcan:nosuch0", "Errno"),
    ],
)
def test_bus_that_does_not_open_is_one_line(served, name, cause):
    with pytest.raises(LinkError) as raised:
        CanLink(name)
    text = str(raised.value)
    assert text.startswith(f"bus {name!r} does not open: ")
    assert cause in text
    assert "\n" not in text


def test_the_users_python_can_configuration_changes_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    Path(tmp_path, "can.conf").write_text("[default]\nbitrate = rubbish\nreceive_own_messages = True\n", encoding="ascii")
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    with CanLink("virtual:configured") as link:
        link.send([CanFrame(1, b"", 0)])
        assert link.receive() == []


CATALOGUE = load()
SR_COMMAND, SR_STATUS, POS_LOCAL = (CATALOGUE.by_name[name].arbitration_id for name in ("SR_Command", "SR_Status", "PosLocal"))
UNKNOWN = 1
TWO_BUSES = bus_names("virtual:set robots", "virtual:set navigation")


def ids(frames: list[CanFrame]) -> list[int]:
    return [frame.arbitration_id for frame in frames]


def test_the_navigation_system_is_on_the_robots_bus_unless_told():
    assert bus_names("socketcan:can0") == {"robots": "socketcan:can0", "navigation": "socketcan:can0"}
    assert bus_names("socketcan:can0", "socketcan:can1") == {"robots": "socketcan:can0", "navigation": "socketcan:can1"}


def test_each_frame_travels_on_the_bus_of_its_message():
    frames = [CanFrame(arbitration_id, b"", 0) for arbitration_id in (SR_COMMAND, POS_LOCAL, UNKNOWN, SR_STATUS)]
    with (
        BusSet(TWO_BUSES, CATALOGUE) as car,
        BusSet(TWO_BUSES, CATALOGUE) as gateway,
        CanLink(TWO_BUSES["robots"]) as robots,
        CanLink(TWO_BUSES["navigation"]) as navigation,
    ):
        car.send(frames)
        assert ids(robots.receive()) == [SR_COMMAND, UNKNOWN, SR_STATUS]
        assert ids(navigation.receive()) == [POS_LOCAL]
        assert ids(gateway.receive()) == [SR_COMMAND, UNKNOWN, SR_STATUS, POS_LOCAL]
        assert car.receive() == []
        assert (gateway.dead, gateway.dropped, car.unsent) == ([], {}, {})


def test_a_message_on_the_wrong_bus_is_counted_and_not_heard():
    with (
        BusSet(TWO_BUSES, CATALOGUE) as gateway,
        CanLink(TWO_BUSES["robots"]) as robots,
        python_can_bus(TWO_BUSES["navigation"]) as navigation,
    ):
        robots.send([CanFrame(POS_LOCAL, bytes(8), 0), CanFrame(SR_STATUS, bytes(8), 0)])
        for arbitration_id in (SR_STATUS, SR_COMMAND, UNKNOWN, POS_LOCAL):
            navigation.send(can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=bytes(8)))
        navigation.send(can.Message(arbitration_id=POS_LOCAL, is_extended_id=True))
        assert ids(gateway.receive()) == [SR_STATUS, UNKNOWN, POS_LOCAL]
        assert gateway.misplaced_frames == 3
        assert gateway.dropped == {"wrong bus": 3, "no classical data frame": 1}


def test_on_one_bus_no_message_is_out_of_place():
    both = bus_names("virtual:set one")
    with BusSet(both, CATALOGUE) as gateway, BusSet(both, CATALOGUE) as car:
        car.send([CanFrame(POS_LOCAL, b"", 0), CanFrame(SR_STATUS, b"", 0)])
        assert ids(gateway.receive()) == [POS_LOCAL, SR_STATUS]
        gateway.send([CanFrame(SR_COMMAND, b"", 0)])
        assert ids(car.receive()) == [SR_COMMAND]
        assert gateway.receive() == []
        assert gateway.dropped == {}


def test_a_bus_that_dies_takes_no_other_with_it(served):
    buses = bus_names("virtual:set alive", "xilgate:bus0")
    with BusSet(buses, CATALOGUE) as gateway, CanLink("virtual:set alive") as robots:
        served.stop()
        robots.send([CanFrame(SR_STATUS, b"", 0)])
        assert ids(gateway.receive()) == [SR_STATUS]
        assert gateway.dead == ["navigation"]
        gateway.send([CanFrame(SR_COMMAND, b"", 0), CanFrame(POS_LOCAL, b"", 0)])
        assert ids(robots.receive()) == [SR_COMMAND]


@pytest.mark.parametrize("missing", ["robots", "navigation"])
def test_a_bus_that_does_not_open_is_named_and_leaves_none_open(served, missing):
    buses = bus_names("xilgate:bus0", "xilgate:bus0") | {missing: "xilgate:nobody"}
    with pytest.raises(LinkError, match=rf"^{missing}: bus 'xilgate:nobody' does not open: no hub"):
        BusSet(buses, CATALOGUE)
    with CanLink("xilgate:bus0"):
        wait_until(lambda: len(served.hub.core.nodes) == 1, PATIENCE_S, "only this link on the bus")


@pytest.mark.parametrize(("buses", "is_possible"), [(bus_names("xilgate:bus0"), True), (TWO_BUSES, False)])
@pytest.mark.parametrize("disturbed", [None, SR_STATUS])
def test_an_emulated_bus_can_be_disturbed_and_no_other(served, buses, is_possible, disturbed):
    with BusSet(buses, CATALOGUE) as car, BusSet(buses, CATALOGUE) as gateway:
        assert car.disturb(disturbed, 1) is is_possible
        car.send([CanFrame(SR_STATUS, bytes(8), 0)])
        received: list[CanFrame] = []
        wait_until(lambda: received.extend(gateway.receive()) or received, PATIENCE_S, "the frame, repeated")
        assert ids(received) == [SR_STATUS]
        assert (car.dead, gateway.dead) == ([], [])
        if is_possible:
            assert sum(node.errors for node in served.hub.core.nodes.values()) == 2  # one for its sender, one for its receiver
