"""Error states through the kernel's own driver, with a simulated adapter: what no virtual interface has."""

import subprocess
import time

import pytest

from dbc.can_link import CanLink
from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.health import BusState, LinkHealth
from dbc.link import BusSet, bus_names
from tests.support.processes import wait_until

CATALOGUE = load()
SR_COMMAND, SR_STATUS = (CATALOGUE.by_name[name].arbitration_id for name in ("SR_Command", "SR_Status"))
IDS = frozenset(CATALOGUE.by_id)
PATIENCE_S = 20.0


def frame(number: int = 0) -> CanFrame:
    return CanFrame(SR_COMMAND, number.to_bytes(8, "little"), 0)


@pytest.fixture
def link(adapter):
    with CanLink(f"socketcan:{adapter.interface}", IDS) as link:
        yield link


def wait_for(link: CanLink, state: BusState):
    wait_until(lambda: link.receive() or link.health().state is state, PATIENCE_S, f"the state {state.value}")


def test_frames_go_out_to_the_adapter_and_come_in_from_it(adapter, link):
    link.send([frame(1), frame(2)])
    sent = []
    wait_until(lambda: sent.extend(adapter.sent()) or len(sent) == 2, PATIENCE_S, "both frames")
    assert sent == [(SR_COMMAND, frame(1).data), (SR_COMMAND, frame(2).data)]
    adapter.deliver(SR_STATUS, b"abc")
    adapter.deliver(0x7F0, b"stranger")
    adapter.deliver(SR_STATUS, b"def")
    heard = []
    wait_until(lambda: heard.extend(link.receive()) or len(heard) == 2, PATIENCE_S, "two frames")
    assert [one.data for one in heard] == [b"abc", b"def"]


@pytest.mark.req("F10")
def test_error_states_and_counters_are_those_of_the_controller(adapter, link):
    for letter, state, rx, tx in (
        ("w", BusState.ERROR_WARNING, 100, 97),
        ("p", BusState.ERROR_PASSIVE, 20, 135),
        ("a", BusState.ERROR_ACTIVE, 3, 0),
        ("p", BusState.ERROR_PASSIVE, 128, 0),
    ):
        adapter.enter(letter, rx, tx)
        wait_for(link, state)
        assert link.health() == LinkHealth(state, tx, rx)


def test_errors_on_the_wire_are_counted_and_lost_frames_too(adapter, link):
    for errors in ("a", "bc", "s"):
        adapter.report(errors)
    wait_until(lambda: link.receive() or link.bus_errors == 3, PATIENCE_S, "three reports")
    assert link.lost == 0
    adapter.report("o")
    wait_until(lambda: link.receive() or link.lost == 1, PATIENCE_S, "the report of lost frames")
    assert link.health().state is BusState.ERROR_ACTIVE


@pytest.mark.req("F10")
def test_bus_off_ends_sending_within_one_poll_and_a_restart_that_the_driver_refuses_is_named(adapter):
    with BusSet(bus_names(f"socketcan:{adapter.interface}"), CATALOGUE, "GW") as gateway:
        adapter.enter("b", 0, 256)
        wait_until(lambda: gateway.receive() or gateway.dead, PATIENCE_S, "bus-off")
        health = gateway.health()["robots"]
        assert (health.state, health.bus_offs) == (BusState.BUS_OFF, 1)
        gateway.send([frame()._replace(t_ns=time.monotonic_ns())])
        assert gateway.unsent == {"bus-off or down": 1}
        wait_until(lambda: gateway.receive() or gateway.refusals, PATIENCE_S, "the refusal")
        assert gateway.refusals == {"robots": "Operation not supported", "navigation": "Operation not supported"}
        # The kernel sends nothing even when the adapter is well again: that must not look like a healthy bus.
        adapter.enter("a", 0, 0)
        wait_until(lambda: gateway.receive() or gateway.health()["robots"].tx_error_count == 0, PATIENCE_S, "the adapter's report")
        assert gateway.health()["robots"].state is BusState.BUS_OFF
        assert adapter.sent() == []
        for state in ("down", "up"):
            subprocess.run(["ip", "link", "set", adapter.interface, state], check=True)
        wait_until(lambda: gateway.receive() or not gateway.dead, PATIENCE_S, "the interface to be up again")
        gateway.send([frame()._replace(t_ns=time.monotonic_ns())])
        wait_until(adapter.sent, PATIENCE_S, "the frame")


@pytest.mark.req("F10")
def test_a_controller_that_was_bus_off_before_we_came_is_found_so(adapter):
    adapter.enter("b", 0, 256)
    wait_until(lambda: "BUS-OFF" in subprocess.getoutput(f"ip -details link show {adapter.interface}"), PATIENCE_S, "bus-off")
    with CanLink(f"socketcan:{adapter.interface}", IDS) as link:
        link.receive()
        assert link.health().state is BusState.BUS_OFF


@pytest.mark.req("F10")
def test_an_adapter_that_takes_nothing_more_fills_the_queue_and_is_not_retried(adapter, link):
    with CanLink(f"socketcan:{adapter.interface}") as hasty:  # which heeds no confirmation
        for number in range(20_000):
            hasty.send([frame(number)])
            if hasty.unsent["refused"] == 50:
                break
        assert hasty.unsent == {"refused": 50}  # ENOBUFS
        assert hasty.health().state is BusState.ERROR_ACTIVE
    link.receive()
    wait_until(lambda: not adapter.sent(), PATIENCE_S, "the queue to empty")
    link.send([CanFrame(SR_COMMAND, b"after it", 0)])
    wait_until(lambda: (SR_COMMAND, b"after it") in adapter.sent(), PATIENCE_S, "a frame after it")


@pytest.mark.req("F10")
def test_an_adapter_that_is_pulled_out_and_put_in_again(plug_in):
    adapter = plug_in()
    with CanLink(f"socketcan:{adapter.interface}", IDS) as link:
        adapter.unplug()
        wait_for(link, BusState.DOWN)
        link.send([frame()])
        assert link.unsent == {"bus-off or down": 1}
        again = plug_in()
        assert again.interface == adapter.interface
        wait_for(link, BusState.ERROR_ACTIVE)
        link.send([frame(7)])
        wait_until(lambda: (SR_COMMAND, frame(7).data) in again.sent(), PATIENCE_S, "the frame")
        again.deliver(SR_STATUS, b"new")
        heard = []
        wait_until(lambda: heard.extend(link.receive()) or heard, PATIENCE_S, "a frame")
        assert heard[0].data == b"new"
