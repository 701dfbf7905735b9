"""A bus that fails in every way and at every place: the link never raises, never turns in a circle, and says what became of the bus."""

import errno
import itertools
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import can
import pytest

from dbc.can_io import ERROR_FLAG, MAX_FRAMES_PER_RECEIVE
from dbc.can_link import CARE_NS, CanLink
from dbc.catalogue import load
from dbc.frame import CanFrame
from dbc.health import WELL, BusState
from dbc.link import BusSet
from dbc.recovery import BUS_OFF_DELAYS_NS, REOPENING_DELAYS_NS
from dbc.rtnetlink import Controller
from tests.support.processes import wait_until

CATALOGUE = load()
SR_COMMAND, SR_STATUS, POS_LOCAL = (CATALOGUE.by_name[name].arbitration_id for name in ("SR_Command", "SR_Status", "PosLocal"))
IDS = frozenset(CATALOGUE.by_id)
POLLS = 200
ERRORS = {
    "ENOBUFS": OSError(errno.ENOBUFS, "No buffer space available"),
    "ENETDOWN": OSError(errno.ENETDOWN, "Network is down"),
    "ENODEV": OSError(errno.ENODEV, "No such device"),
    "EAGAIN": BlockingIOError(errno.EAGAIN, "Try again"),
    "bare OSError": OSError("serial port gone"),
    "CanOperationError": can.CanOperationError("Failed"),
    "CanOperationError ENOBUFS": can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
    "CanTimeoutError": can.exceptions.CanTimeoutError("too slow"),
    "CanInterfaceNotImplementedError": can.CanInterfaceNotImplementedError("no"),
    "ValueError": ValueError("file descriptor cannot be a negative integer (-1)"),
}


class FakeBus:
    """Looks like a bus of python-can; fails where it is told to."""

    def __init__(self):
        self.errors = {}
        self.arriving = []
        self.calls = 0
        self.sent = []
        self.restarts = 0

    def _do(self, place):
        self.calls += 1
        if (error := self.errors.get(place)) is not None:
            raise error

    def recv(self, timeout):
        assert timeout == 0  # it is never waited for
        self._do("recv")
        return self.arriving.pop(0) if self.arriving else None

    def send(self, message):
        self._do("send")
        self.sent.append(message.arbitration_id)

    def restart(self):
        self.restarts += 1
        self._do("restart")

    def disturb(self, arbitration_id, count):
        self._do("disturb")

    def shutdown(self):
        self._do("shutdown")

    def error_frame(self, classes):
        self.arriving.append(can.Message(arbitration_id=classes, is_error_frame=True, is_extended_id=False, data=bytes(8)))

    def own_frames(self):
        for arbitration_id in self.sent:
            self.arriving.append(can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=bytes(8), is_rx=False))
        self.sent.clear()


class Clock:
    """Monotonic time that the test sets."""

    def __init__(self, monkeypatch):
        self.now_ns = 10**12
        for module in ("dbc.can_link.time", "dbc.link.time"):
            monkeypatch.setattr(module, SimpleNamespace(monotonic_ns=lambda: self.now_ns))

    def tick(self, duration_ns=10_000_000):
        self.now_ns += duration_ns


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


@pytest.fixture
def opened(monkeypatch):
    """The buses that are opened, in turn; what is put into `failures` is raised instead."""
    buses, failures = [], []

    def open_bus(**_settings):
        if failures:
            raise failures[0]
        buses.append(FakeBus())
        return buses[-1]

    monkeypatch.setattr("dbc.can_io.can.Bus", open_bus)
    yield SimpleNamespace(buses=buses, failures=failures)
    for thread in threading.enumerate():
        if thread.name == "xilgate-bus":  # it may be about to open the bus of a link that is closed by now
            thread.join(5.0)


def frame(arbitration_id=SR_COMMAND, t_ns=0):
    return CanFrame(arbitration_id, bytes(8), t_ns)


@pytest.mark.req("F10")
@pytest.mark.parametrize("ids", [None, IDS], ids=["any node", "our node"])
@pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
@pytest.mark.parametrize("place", ["recv", "send", "disturb", "everything"])
def test_no_error_is_raised_and_none_makes_work(clock, opened, place, error, ids):
    link = CanLink("fake:0", ids)
    opened.failures.append(error)  # it does not open again either
    (bus,) = opened.buses
    bus.errors = dict.fromkeys(["recv", "send", "disturb", "restart", "shutdown"] if place == "everything" else [place], error)
    for _ in range(POLLS):
        clock.tick()
        before = bus.calls
        assert link.receive() == []
        link.send([frame()])
        link.disturb(SR_COMMAND, 1)
        assert bus.calls - before <= 4  # a second look for frames behind the error, one frame to send, one disturbance
        assert link.health().state in BusState
        bus.own_frames()
    assert link.refused_polls == (POLLS if place in {"recv", "everything"} else 0)
    assert threading.active_count() < 20
    link.close()


@pytest.mark.req("F10")
@pytest.mark.parametrize("error", ["ENOBUFS", "CanOperationError ENOBUFS", "EAGAIN"])
def test_ten_thousand_refusals_in_a_row_are_counted_and_forgotten_with_the_first_frame_that_is_taken(clock, opened, error):
    with CanLink("fake:0", IDS) as link:
        (bus,) = opened.buses
        bus.errors["send"] = ERRORS[error]
        for _ in range(10_000):
            clock.tick()
            link.send([frame()])
        assert link.unsent == {"refused": 10_000}
        clock.tick()
        assert link.health() == replace(WELL, unconfirmed_ns=10_000 * 10_000_000)  # a queue that others keep full blocks us
        bus.errors.clear()
        link.send([frame()])
        assert (bus.sent, link.unsent["refused"]) == ([SR_COMMAND], 10_000)
        assert link.health() == WELL


@pytest.mark.req("F10")
def test_an_operator_who_lets_a_bus_recover_forgets_what_did_not_get_through(clock, opened):
    with CanLink("virtual:0", IDS) as link:
        link.send([frame()])  # nobody acknowledges it
        clock.tick()
        assert link.health() == replace(WELL, unconfirmed_ns=10_000_000)
        link.recover()
        assert link.health() == WELL
        opened.buses[0].errors["send"] = ERRORS["ENOBUFS"]
        link.send([frame()])
        clock.tick()
        assert link.health() == replace(WELL, unconfirmed_ns=10_000_000)
        link.recover()
        assert link.health() == WELL


@pytest.mark.req("F10")
def test_an_operator_lets_every_bus_recover(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:1"}, CATALOGUE, "GW") as buses:
        for bus in opened.buses:
            bus.errors["send"] = ERRORS["ENOBUFS"]
        buses.send([frame(t_ns=clock.now_ns), frame(POS_LOCAL)])
        clock.tick()
        assert WELL not in buses.health().values()
        buses.recover()
        assert buses.health() == {"robots": WELL, "navigation": WELL}


@pytest.mark.req("F10")
@pytest.mark.parametrize("error", ["bare OSError", "CanOperationError", "ValueError"])
def test_an_error_without_a_number_is_a_bus_that_has_gone_when_it_is_read_and_a_full_queue_when_it_is_sent_to(clock, opened, error):
    with CanLink("fake:0", IDS) as link:
        (bus,) = opened.buses
        bus.errors["send"] = ERRORS[error]
        link.send([frame()])
        assert (link.health().state, link.unsent) == (BusState.ERROR_ACTIVE, {"refused": 1})
        opened.failures.append(ERRORS[error])
        bus.errors["recv"] = ERRORS[error]
        link.receive()
        assert link.health().state is BusState.DOWN


@pytest.mark.req("F11")
def test_a_flood_is_taken_in_bounded_portions(clock, opened):
    with CanLink("fake:0", IDS) as link:
        (bus,) = opened.buses
        bus.arriving = [can.Message(arbitration_id=SR_STATUS, is_extended_id=False, data=bytes(8))] * (2 * MAX_FRAMES_PER_RECEIVE + 3)
        assert [len(link.receive()) for _ in range(4)] == [MAX_FRAMES_PER_RECEIVE, MAX_FRAMES_PER_RECEIVE, 3, 0]


@pytest.mark.req("F11")
def test_a_flood_of_error_frames_is_bounded_too(clock, opened):
    with CanLink("fake:0", IDS) as link:
        (bus,) = opened.buses
        for _ in range(3 * MAX_FRAMES_PER_RECEIVE):
            bus.error_frame(0x088)
        bus.calls = 0
        assert link.receive() == []
        assert bus.calls == MAX_FRAMES_PER_RECEIVE


def test_an_error_ahead_of_old_frames_hides_neither(clock, opened):
    with CanLink("fake:0", IDS) as link:
        (bus,) = opened.buses
        bus.arriving = [can.Message(arbitration_id=SR_STATUS, is_extended_id=False, data=bytes(8))]
        errors = [ERRORS["ENODEV"], None, None]
        deliver = bus.recv

        def recv(timeout):
            bus.errors["recv"] = errors.pop(0)
            return deliver(timeout)

        bus.recv = recv
        assert [one.arbitration_id for one in link.receive()] == [SR_STATUS]
        assert (link.health().state, link.refused_polls) == (BusState.DOWN, 1)


@pytest.mark.req("F10")
def test_nothing_is_sent_while_the_bus_is_down_and_silence_does_not_bring_it_up(clock, opened):
    with CanLink("fake:0", IDS) as link:
        (bus,) = opened.buses
        opened.failures.append(ERRORS["ENODEV"])
        bus.errors["send"] = ERRORS["ENETDOWN"]
        link.send([frame(), frame()])
        assert link.unsent == {"refused": 1, "bus-off or down": 1}
        bus.errors.clear()
        link.receive()
        link.send([frame()])
        assert (bus.sent, link.health().state) == ([], BusState.DOWN)
        bus.arriving = [can.Message(arbitration_id=SR_STATUS, is_extended_id=False, data=bytes(8))]
        assert len(link.receive()) == 1
        link.send([frame()])
        assert (bus.sent, link.health().state) == ([SR_COMMAND], BusState.ERROR_ACTIVE)


@pytest.mark.req("F10")
def test_a_bus_that_is_down_is_opened_again_and_gone_on_with(clock, opened):
    with CanLink("fake:0", IDS) as link:
        opened.buses[0].errors = dict.fromkeys(["recv", "send", "shutdown"], ERRORS["ENODEV"])
        opened.failures.append(ERRORS["ENODEV"])
        for _ in range(1_000):
            clock.tick()
            link.receive()
        assert len(opened.buses) == 1
        assert link.health().state is BusState.DOWN
        opened.failures.clear()

        def is_up():
            clock.tick(CARE_NS)
            link.receive()
            return link.health().state is BusState.ERROR_ACTIVE

        wait_until(is_up, 20.0, "the bus to be opened again")
        link.send([frame()])
        assert opened.buses[-1].sent == [SR_COMMAND]


@pytest.mark.parametrize("error", [ERRORS["ENODEV"], RuntimeError("of a driver")], ids=repr)
def test_no_thread_is_started_after_the_set_up_and_none_is_left(clock, opened, monkeypatch, error):
    before = threading.active_count()
    with CanLink("fake:0", IDS) as link:
        monkeypatch.setattr(threading.Thread, "start", lambda _: pytest.fail("a thread was started"))
        opened.buses[0].errors = dict.fromkeys(["recv", "send"], ERRORS["ENODEV"])
        opened.failures.append(error)
        for _ in range(500):
            clock.tick()
            link.receive()
            time.sleep(0.001)
        opened.failures.clear()

        def is_up():
            clock.tick(CARE_NS)
            link.receive()
            return link.health().state is BusState.ERROR_ACTIVE

        wait_until(is_up, 20.0, "the bus to be opened again")
    wait_until(lambda: threading.active_count() <= before, 5.0, "the end of the thread")


def test_a_link_that_is_closed_while_it_opens_its_bus_again_leaves_none_open(clock, monkeypatch):
    proceed, has_begun, closed = threading.Event(), threading.Event(), threading.Event()
    first = FakeBus()
    first.errors["recv"] = ERRORS["ENODEV"]
    monkeypatch.setattr("dbc.can_io.can.Bus", lambda **_: first)
    link = CanLink("fake:0", IDS)

    def open_slowly(**_settings):
        has_begun.set()
        proceed.wait(20.0)
        bus = FakeBus()
        bus.shutdown = closed.set
        return bus

    monkeypatch.setattr("dbc.can_io.can.Bus", open_slowly)
    while not has_begun.is_set():
        clock.tick(CARE_NS)
        link.receive()  # goes on while the driver takes its time
    link.close()
    proceed.set()
    assert closed.wait(20.0)


@pytest.mark.req("F10")
def test_after_bus_off_three_attempts_then_none_before_the_operator(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        (bus,) = opened.buses
        for attempt in itertools.count(1):
            bus.error_frame(0x040)
            buses.receive()
            assert buses.health()["robots"].state is BusState.BUS_OFF
            buses.send([frame(t_ns=clock.now_ns)])
            assert bus.sent == []
            waited_ns = 0
            while bus.restarts < attempt and waited_ns < 30 * 10**9:
                clock.tick()
                waited_ns += 10_000_000
                buses.receive()
            if bus.restarts < attempt:
                break
            assert 0 <= waited_ns - BUS_OFF_DELAYS_NS[attempt - 1] <= 100_000_000
            bus.error_frame(0x100)
            buses.receive()
            assert buses.health()["robots"].state is BusState.ERROR_ACTIVE
        assert bus.restarts == len(BUS_OFF_DELAYS_NS) == 3
        # The driver may say what it likes.
        bus.error_frame(0x100)
        buses.receive()
        buses.send([frame(t_ns=clock.now_ns)])
        assert (buses.health()["robots"].state, bus.sent) == (BusState.BUS_OFF, [])
        buses.recover()
        buses.send([frame(t_ns=clock.now_ns)])
        assert (buses.health()["robots"].state, bus.sent) == (BusState.ERROR_ACTIVE, [SR_COMMAND])
        assert buses.unsent == {"bus-off or down": 5}


def test_a_refused_recovery_is_named_and_the_operator_may_try_again(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        (bus,) = opened.buses
        bus.errors["restart"] = OSError(errno.EPERM, "Operation not permitted")
        bus.error_frame(0x040)
        for _ in range(1_000):
            clock.tick()
            buses.receive()
        assert bus.restarts == 3
        assert "Operation not permitted" in buses.refusals["robots"]
        bus.error_frame(0x100)  # restarted by somebody else
        buses.receive()
        assert (buses.health()["robots"].state, buses.refusals) == (BusState.ERROR_ACTIVE, {})
        bus.error_frame(0x040)
        buses.receive()
        buses.recover()
        for _ in range(1_000):
            clock.tick()
            buses.receive()
        assert bus.restarts == 6


def test_an_interface_that_cannot_leave_bus_off_says_so(clock, monkeypatch):
    bus = FakeBus()
    without_restart = SimpleNamespace(recv=bus.recv, send=bus.send, shutdown=bus.shutdown)
    monkeypatch.setattr("dbc.can_io.can.Bus", lambda **_: without_restart)
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        bus.error_frame(0x040)
        for _ in range(20):
            buses.receive()
            clock.tick()
        assert buses.refusals == dict.fromkeys(["robots", "navigation"], "this interface cannot")


@pytest.mark.req("F10", "F11")
def test_own_frames_that_are_not_seen_on_the_bus_age_and_are_not_piled_up(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        (bus,) = opened.buses
        for tick in range(1, 20):
            assert buses.receive() == []
            buses.send([frame(t_ns=clock.now_ns)])
            clock.tick()
            assert buses.health()["robots"].unconfirmed_ns == tick * 10_000_000
        assert bus.sent == [SR_COMMAND] * 2
        assert buses.unsent == {"earlier ones still on their way": 17}
        bus.own_frames()
        assert buses.receive() == []
        assert buses.health()["robots"].unconfirmed_ns == 0
        buses.send([frame(t_ns=clock.now_ns)])
        assert bus.sent == [SR_COMMAND]


@pytest.mark.req("F13")
def test_frames_from_before_a_stall_are_not_sent_after_it(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        (bus,) = opened.buses
        cycle_ns = CATALOGUE.by_name["SR_Command"].cycle_time_ns
        made_ns = clock.now_ns
        clock.tick(cycle_ns)
        buses.send([frame(t_ns=made_ns)])
        assert bus.sent == [SR_COMMAND]
        clock.tick(1)
        buses.send([frame(t_ns=made_ns), frame(SR_STATUS, made_ns)])  # of another node's messages it knows no age limit
        assert bus.sent == [SR_COMMAND, SR_STATUS]
        assert buses.unsent == {"older than a cycle": 1}


def test_a_stand_in_for_several_nodes_has_no_age_limit_and_recovers_as_its_interface_does(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE) as buses:
        (bus,) = opened.buses
        for _ in range(6):
            bus.error_frame(0x040)
            buses.receive()
            assert buses.dead == ["robots", "navigation"]
            for _ in range(1_000):
                clock.tick()
                buses.receive()
            bus.error_frame(0x100)
            buses.receive()
            buses.send([frame(t_ns=0)])
        assert (bus.restarts, bus.sent, buses.dead) == (0, [SR_COMMAND] * 6, [])


def test_error_frames_of_an_interface_with_a_layout_of_its_own_change_no_state(clock, opened):
    with CanLink("pcan:PCAN_USBBUS1", IDS) as link:
        opened.buses[0].error_frame(0x040)
        assert link.receive() == []
        assert link.health().state is BusState.ERROR_ACTIVE


def test_on_an_interface_that_does_not_show_own_frames_nothing_is_awaited(clock, opened):
    with CanLink("pcan:PCAN_USBBUS1", IDS) as link:
        for _ in range(20):
            clock.tick()
            link.receive()
            link.send([frame()])
        assert len(opened.buses[0].sent) == 20
        assert (link.health().unconfirmed_ns, link.unsent) == (0, {})


def test_load_counts_what_is_seen_and_own_frames_once(clock, opened):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        (bus,) = opened.buses
        for _ in range(121):
            bus.own_frames()
            bus.arriving.append(can.Message(arbitration_id=SR_STATUS, is_extended_id=False, data=bytes(8)))
            buses.receive()
            buses.send([frame(t_ns=clock.now_ns)])
            clock.tick()
        traffic = buses.traffic()["robots"]
        assert traffic.rates_hz == {SR_COMMAND: pytest.approx(100, abs=6), SR_STATUS: pytest.approx(100, abs=6)}
        assert 200 * 111 / 500_000 * 0.9 < traffic.load_norm < 200 * 135 / 500_000 * 1.1


# What only the kernel tells: the state that a driver reports, and how many frames were lost.


class FakePort:
    """A port as SocketCAN's is."""

    has_echo = True
    refusal = ""

    def __init__(self, descriptor):
        self.descriptor = descriptor
        self.arriving, self.sent = [], []
        self.error = 0
        self.told = None
        self.losses = 0
        self.is_closed = False

    def receive(self):
        arrived, self.arriving = self.arriving, []
        return arrived, self.error

    def send(self, arbitration_id, data):
        self.sent.append(arbitration_id)
        return 0

    def controller(self):
        told, self.told = self.told, None
        return told

    def restart(self):
        pass

    def lost(self):
        return self.losses

    def fileno(self):
        return self.descriptor

    def close(self):
        self.is_closed = True


@pytest.fixture
def ports(monkeypatch):
    """The ports that are opened, in turn; their descriptors count from 10."""
    ports = []

    def open_port(*_target):
        ports.append(FakePort(10 + len(ports)))
        return ports[-1]

    monkeypatch.setattr("dbc.can_link.open_port", open_port)
    return ports


@pytest.mark.req("F10")
def test_what_the_driver_tells_of_its_controller_counts(clock, ports):
    with CanLink("fake:0", IDS) as link:
        for controller, sent in ((Controller(BusState.BUS_OFF, 248, 3), 0), (Controller(BusState.ERROR_ACTIVE, 0, 1), 1)):
            ports[0].told = controller
            clock.tick(CARE_NS)
            link.receive()
            health = link.health()
            assert (health.state, health.tx_error_count, health.rx_error_count) == controller
            link.send([frame()])
            assert len(ports[0].sent) == sent


def test_frames_lost_in_the_kernel_and_in_the_controller_are_counted_and_own_ones_may_be_among_them(clock, ports):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:0"}, CATALOGUE, "GW") as buses:
        buses.send([frame(t_ns=clock.now_ns)])
        clock.tick(CARE_NS)
        buses.receive()
        assert buses.health()["robots"].unconfirmed_ns == CARE_NS
        ports[0].losses = 3
        clock.tick(CARE_NS)
        buses.receive()
        assert buses.health()["robots"] == WELL
        ports[0].arriving.append((ERROR_FLAG | 0x004, bytes([0, 0x01, 0, 0, 0, 0, 0, 0]), False))  # the controller's queue was full
        buses.send([frame(t_ns=clock.now_ns)])
        clock.tick(CARE_NS)
        buses.receive()
        assert buses.dropped == {"not read in time": 4}
        assert buses.health()["robots"].unconfirmed_ns == CARE_NS  # lost frames do not excuse later ones


def test_frames_that_were_destroyed_or_not_acknowledged_are_counted_bus_by_bus(clock, ports):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:1"}, CATALOGUE, "GW") as buses:
        ports[1].arriving = [(ERROR_FLAG | 0x088, bytes(8), False), (ERROR_FLAG | 0x020, bytes(8), False)]
        buses.receive()
        assert buses.bus_errors == {"robots": 0, "navigation": 2}


def is_up(clock, link):
    clock.tick(CARE_NS)
    link.receive()
    return link.health().state is BusState.ERROR_ACTIVE


def test_a_port_that_takes_the_place_of_another_goes_on_counting_and_leaves_none_open(clock, ports):
    with CanLink("fake:0", IDS) as link:
        ports[0].losses = 3
        ports[0].error = errno.ENODEV
        link.receive()
        assert link.health().state is BusState.DOWN
        wait_until(lambda: is_up(clock, link), 20.0, "the bus to be opened again")
        assert [port.is_closed for port in ports] == [True, False]
        ports[1].losses = 2
        clock.tick(CARE_NS)
        link.receive()
        assert link.lost == 5
    assert ports[1].is_closed


def await_new_port(link, clock):
    """Until the bus has been opened again, and nobody has taken the port yet."""
    while not link._is_opening:
        clock.tick(CARE_NS)
        link.receive()
    wait_until(lambda: not link._opener.answers.empty(), 20.0, "the new port")


@pytest.mark.req("F10")
def test_a_bus_that_comes_up_by_itself_while_it_is_opened_again_keeps_its_port(clock, ports):
    with CanLink("fake:0", IDS) as link:
        ports[0].error = errno.ENODEV
        await_new_port(link, clock)
        ports[0].error = 0
        ports[0].arriving.append((SR_STATUS, bytes(8), False))
        assert len(link.receive()) == 1
        link.send([frame(), frame()])
        clock.tick(CARE_NS)
        ports[0].arriving += [(SR_COMMAND, bytes(8), True)] * 2
        link.receive()
        assert link.health() == WELL
        link.send([frame()])
        assert ports[0].sent == [SR_COMMAND] * 3
        assert [port.is_closed for port in ports] == [False, True]


def test_a_port_that_nobody_has_taken_yet_is_closed_with_the_link(clock, ports):
    with CanLink("fake:0", IDS) as link:
        ports[0].error = errno.ENODEV
        await_new_port(link, clock)
    assert [port.is_closed for port in ports] == [True, True]


@pytest.mark.req("F10")
def test_the_operator_need_not_wait_for_a_bus_that_has_been_down_for_long(clock, opened):
    with CanLink("fake:0", IDS) as link:
        opened.buses[0].errors["recv"] = ERRORS["ENODEV"]
        opened.failures.append(ERRORS["ENODEV"])
        for _ in range(1_000):
            clock.tick(CARE_NS)
            link.receive()
            wait_until(lambda: not link._opener.answers.empty() or not link._is_opening, 20.0, "the attempt")
        opened.failures.clear()
        link.recover()
        end_ns = clock.now_ns + REOPENING_DELAYS_NS[0] + 2 * CARE_NS
        while len(opened.buses) < 2 and clock.now_ns < end_ns:
            clock.tick(CARE_NS)
            link.receive()
            wait_until(lambda: not link._opener.answers.empty() or not link._is_opening, 20.0, "the attempt")
        assert len(opened.buses) == 2


def test_each_network_is_waited_for_on_its_own_bus(ports):
    with BusSet({"robots": "virtual:0", "navigation": "virtual:1"}, CATALOGUE, "GW") as buses:
        assert (buses.filenos("robots"), buses.filenos("navigation")) == ([10], [11])
        ports[1].descriptor = -1  # some interfaces of python-can have none
        assert (buses.filenos("robots"), buses.filenos("navigation")) == ([10], [])
