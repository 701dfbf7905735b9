"""The link of a node on the emulated bus, where errors on the wire, fault confinement and recovery are real."""

import time

import pytest

from dbc import recovery
from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.health import BusState, LinkHealth
from dbc.link import BusSet, CanLink, bus_names
from tests.support.processes import wait_until

CATALOGUE = load()
SR_COMMAND, SR_STATUS, GW_SAFETY = (CATALOGUE.by_name[name].arbitration_id for name in ("SR_Command", "SR_Status", "GW_SafetyCommand"))
IDS = frozenset(CATALOGUE.by_id)
STRANGER = 0x7F0
BUS = "xilgate:bus0"
PATIENCE_S = 20.0


@pytest.fixture
def node(served):
    """A link of a node, and one that acknowledges what it sends."""
    with CanLink(BUS, IDS) as link, CanLink(BUS) as other:
        yield link, other


@pytest.fixture
def fast_recovery(monkeypatch):
    monkeypatch.setattr("dbc.recovery.BUS_OFF_DELAYS_NS", (50_000_000, 60_000_000, 70_000_000))


def frame(arbitration_id=SR_COMMAND, data=bytes(8)) -> CanFrame:
    return CanFrame(arbitration_id, data, 0)


def wait_for(link: CanLink, state: BusState, heard=None):
    heard = [] if heard is None else heard
    wait_until(lambda: heard.extend(link.receive()) or link.health().state is state, PATIENCE_S, f"the state {state.value}")


def hear(link: CanLink, count: int) -> list[CanFrame]:
    frames = []
    wait_until(lambda: frames.extend(link.receive()) or len(frames) >= count, PATIENCE_S, f"{count} frames")
    return frames


def test_own_frames_confirm_and_are_not_handed_on(node):
    link, other = node
    sent = [frame(data=bytes([number] * 8)) for number in range(2)]
    link.send(sent)
    assert link.health().unconfirmed_ns > 0
    heard = []
    wait_until(lambda: heard.extend(link.receive()) or link.health().unconfirmed_ns == 0, PATIENCE_S, "the frames to be seen")
    assert heard == []
    assert [one.data for one in hear(other, 2)] == [one.data for one in sent]


@pytest.mark.req("F5")
def test_a_second_sender_of_an_own_identifier_is_handed_on(node):
    link, other = node
    link.send([frame(GW_SAFETY, b"ours 123")])
    other.send([frame(GW_SAFETY, b"theirs 1"), frame(SR_STATUS)])
    heard = hear(link, 2)
    assert [(one.arbitration_id, one.data) for one in heard] == [(GW_SAFETY, b"theirs 1"), (SR_STATUS, bytes(8))]


@pytest.mark.req("F11")
def test_strangers_are_kept_out(node):
    link, other = node
    other.send([frame(STRANGER)] * 20 + [frame(SR_STATUS)])
    assert [one.arbitration_id for one in hear(link, 1)] == [SR_STATUS]
    assert (link.ignored, link.unsent) == ({}, {})


def test_the_error_counters_are_those_of_the_bus(node, served):
    link, _ = node
    link.disturb(SR_COMMAND, 14)  # 8 for each, and 1 less for the attempt that succeeds: enough to stay above 96
    link.send([frame()])
    wait_for(link, BusState.ERROR_WARNING)
    assert link.health() == LinkHealth(BusState.ERROR_WARNING, 96, 0, link.health().unconfirmed_ns)


@pytest.mark.req("F10")
def test_bus_off_ends_sending_and_recovery_is_our_own_and_limited(node, fast_recovery):
    link, other = node
    heard = []
    for bus_offs in (1, 2, 3, 4):
        link.disturb(SR_COMMAND, 32)
        link.send([frame()])
        wait_for(link, BusState.BUS_OFF, heard)
        assert (link.health().bus_offs, link.health().tx_error_count) == (bus_offs, 255)
        link.send([frame()])
        assert link.unsent["bus-off or down"] == bus_offs
        assert link.health().unconfirmed_ns == 0
        if bus_offs < 4:
            wait_for(link, BusState.ERROR_ACTIVE, heard)
    end_ns = time.monotonic_ns() + 10 * max(recovery.BUS_OFF_DELAYS_NS)
    while time.monotonic_ns() < end_ns:
        assert link.receive() == []
        assert link.health().state is BusState.BUS_OFF
        time.sleep(0.01)
    link.recover()
    wait_for(link, BusState.ERROR_ACTIVE, heard)
    link.send([frame()])
    assert [one.arbitration_id for one in hear(other, 1)] == [SR_COMMAND]
    assert heard == []


@pytest.mark.req("F10")
def test_nobody_but_the_link_of_a_node_ends_its_bus_off(served, monkeypatch):
    monkeypatch.setattr("dbc.recovery.BUS_OFF_DELAYS_NS", (60 * 10**9,))
    with CanLink(BUS, IDS) as ours, CanLink(BUS) as stand_in:
        for link in (ours, stand_in):
            link.disturb(SR_COMMAND, 32)
            link.send([frame()])
            wait_for(link, BusState.BUS_OFF)
        wait_for(stand_in, BusState.ERROR_ACTIVE)  # by the hub, as any control unit of a car does by itself
        ours.receive()
        assert ours.health().state is BusState.BUS_OFF  # for longer already


@pytest.mark.req("F10")
def test_a_node_that_nobody_acknowledges_becomes_passive_and_piles_nothing_up(served):
    with CanLink(BUS, IDS) as link:
        for number in range(10):
            link.send([frame(data=bytes([number] * 8))])
        wait_for(link, BusState.ERROR_PASSIVE)
        assert link.health().unconfirmed_ns > 0
        assert link.unsent == {"earlier ones still on their way": 8}
        with CanLink(BUS) as other:
            assert [one.data[0] for one in hear(other, 2)] == [0, 1]
            wait_until(lambda: link.receive() or link.health().unconfirmed_ns == 0, PATIENCE_S, "the frames to be seen")


@pytest.mark.req("F10")
@pytest.mark.parametrize("ids", [None, IDS], ids=["any node", "our node"])
def test_a_hub_that_comes_back_is_joined_again(served, ids):
    with CanLink(BUS, ids) as link:
        served.stop()
        wait_for(link, BusState.DOWN)
        link.send([frame()])
        served.start()
        wait_for(link, BusState.ERROR_ACTIVE)
        with CanLink(BUS) as other:
            link.send([frame(data=b"new")])
            assert [one.data for one in hear(other, 1)] == [b"new"]
            other.send([frame(SR_STATUS), frame(STRANGER)])
            expected = [SR_STATUS, STRANGER] if ids is None else [SR_STATUS]
            assert [one.arbitration_id for one in hear(link, len(expected))] == expected


def test_of_two_buses_each_has_its_own_health_and_traffic(served):
    with BusSet(bus_names(BUS, "virtual:emulated beside"), CATALOGUE, "GW") as gateway, CanLink("virtual:emulated beside") as navigation:
        served.stop()
        navigation.send([frame(CATALOGUE.by_name["PosLocal"].arbitration_id)])
        assert [one.arbitration_id for one in gateway.receive()] == [CATALOGUE.by_name["PosLocal"].arbitration_id]
        states = {network: health.state for network, health in gateway.health().items()}
        assert states == {"robots": BusState.DOWN, "navigation": BusState.ERROR_ACTIVE}
        assert gateway.dead == ["robots"]
        assert set(gateway.traffic()) == {"robots", "navigation"}
