"""Error frames as the kernel lays them out, and the state that follows from them and from all else that tells of a bus."""

import errno
import random

import pytest

from dbc import error_frames
from dbc.bus_monitor import BusMonitor
from dbc.error_frames import ErrorReport
from dbc.health import WELL, BusState, LinkHealth

ACTIVE, WARNING, PASSIVE = BusState.ERROR_ACTIVE, BusState.ERROR_WARNING, BusState.ERROR_PASSIVE
OFF, DOWN = BusState.BUS_OFF, BusState.DOWN


def error_data(status: int = 0, tx: int = 0, rx: int = 0) -> bytes:
    return bytes((0, status, 0, 0, 0, 0, tx, rx))


@pytest.mark.parametrize(
    ("classes", "data", "report"),
    [
        # candump of a real controller that reached the warning limit, TEC 96.
        (0x004, bytes.fromhex("0008000000006000"), ErrorReport(WARNING, -1, -1, False, False)),
        (0x204, bytes.fromhex("0008000000006000"), ErrorReport(WARNING, 96, 0, False, False)),
        (0x204, error_data(0x04, 10, 100), ErrorReport(WARNING, 10, 100, False, False)),
        (0x204, error_data(0x20, 128, 0), ErrorReport(PASSIVE, 128, 0, False, False)),
        (0x204, error_data(0x10 | 0x08, 96, 128), ErrorReport(PASSIVE, 96, 128, False, False)),
        (0x204, error_data(0x40, 95, 0), ErrorReport(ACTIVE, 95, 0, False, False)),
        (0x004, error_data(0x01), ErrorReport(None, -1, -1, False, True)),
        (0x004, error_data(0x02), ErrorReport(None, -1, -1, False, True)),
        (0x040, error_data(), ErrorReport(OFF, -1, -1, False, False)),
        (0x240, error_data(0, 255, 0), ErrorReport(OFF, 255, 0, False, False)),
        (0x100, error_data(), ErrorReport(ACTIVE, -1, -1, False, False)),
        (0x088, error_data(), ErrorReport(None, -1, -1, True, False)),
        (0x0A0, error_data(), ErrorReport(None, -1, -1, True, False)),
        (0x010, error_data(), ErrorReport(None, -1, -1, True, False)),
        # Lost arbitration and a driver's time limit are no errors on the wire.
        (0x002, error_data(), ErrorReport(None, -1, -1, False, False)),
        (0x001, error_data(), ErrorReport(None, -1, -1, False, False)),
        # Of a single error the counters alone tell the state.
        (0x288, error_data(0, 95, 0), ErrorReport(ACTIVE, 95, 0, True, False)),
        (0x288, error_data(0, 96, 0), ErrorReport(WARNING, 96, 0, True, False)),
        (0x288, error_data(0, 0, 127), ErrorReport(WARNING, 0, 127, True, False)),
        (0x288, error_data(0, 0, 128), ErrorReport(PASSIVE, 0, 128, True, False)),
    ],
)
def test_an_error_frame_is_read(classes, data, report):
    assert error_frames.read(classes, data) == report


def test_a_short_error_frame_is_read_as_if_filled_with_zeros():
    assert error_frames.read(0x204, b"\x00\x08") == ErrorReport(WARNING, 0, 0, False, False)
    assert error_frames.read(0x040, b"") == ErrorReport(OFF, -1, -1, False, False)


def test_nothing_in_an_error_frame_raises():
    rng = random.Random(5)
    monitor = BusMonitor()
    for t_ns in range(20_000):
        monitor.error_frame(rng.getrandbits(29), rng.randbytes(rng.randrange(9)), t_ns)
        assert monitor.state is not DOWN
        assert -1 <= monitor.health(0, False).tx_error_count <= 255


@pytest.mark.req("F10")
def test_the_way_to_bus_off_and_back():
    monitor = BusMonitor()
    assert monitor.health(0, False) == WELL
    steps = [
        (0x204, error_data(0x08, 96, 0), LinkHealth(WARNING, 96, 0)),
        (0x204, error_data(0x20, 136, 0), LinkHealth(PASSIVE, 136, 0)),
        (0x240, error_data(0, 255, 0), LinkHealth(OFF, 255, 0, bus_offs=1, last_bus_off_ns=3)),
        (0x240, error_data(0, 255, 0), LinkHealth(OFF, 255, 0, bus_offs=1, last_bus_off_ns=3)),  # told again, not gone again
        (0x300, error_data(), LinkHealth(ACTIVE, 0, 0, bus_offs=1, last_bus_off_ns=3)),
        (0x040, error_data(), LinkHealth(OFF, 0, 0, bus_offs=2, last_bus_off_ns=6)),
    ]
    for t_ns, (classes, data, health) in enumerate(steps, start=1):
        monitor.error_frame(classes, data, t_ns)
        assert monitor.health(0, False) == health


def test_out_of_passive_lead_counters_and_out_of_bus_off_a_restart_alone():
    monitor = BusMonitor()
    monitor.error_frame(0x288, error_data(0, 130, 0), 1)
    assert monitor.state is PASSIVE
    monitor.error_frame(0x288, error_data(0, 40, 0), 2)
    assert monitor.state is ACTIVE
    monitor.error_frame(0x040, error_data(), 3)
    monitor.error_frame(0x288, error_data(0, 40, 0), 4)
    assert monitor.state is OFF
    monitor.error_frame(0x204, error_data(0x40, 0, 0), 5)
    assert monitor.state is OFF
    monitor.error_frame(0x100, error_data(), 6)
    assert monitor.state is ACTIVE


@pytest.mark.parametrize("number", [errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EPIPE, errno.ECONNRESET, errno.EIO])
def test_a_bus_that_is_gone_is_down_until_something_arrives(number):
    monitor = BusMonitor()
    monitor.error_frame(0x204, error_data(0x08, 96, 7), 0)
    monitor.refused(number, 1)
    assert monitor.health(5, False) == LinkHealth(DOWN, -1, -1, unconfirmed_ns=5)
    monitor.came_up(2)
    assert monitor.state is ACTIVE


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EAGAIN, errno.EINVAL, errno.ENOMEM])
def test_a_refusal_of_one_frame_says_nothing_of_the_bus(number):
    monitor = BusMonitor()
    monitor.refused(number, 1)
    assert monitor.state is ACTIVE


@pytest.mark.parametrize("classes", [0x040, 0x204])
def test_a_frame_that_arrives_ends_no_state_but_down(classes):
    monitor = BusMonitor()
    monitor.error_frame(classes, error_data(0x20, 128, 0), 0)
    before = monitor.state
    monitor.came_up(1)
    assert monitor.state is before is not ACTIVE


def test_what_the_driver_tells_is_taken():
    monitor = BusMonitor()
    monitor.told(PASSIVE, 130, 2, 1)
    assert monitor.health(0, False) == LinkHealth(PASSIVE, 130, 2)
    monitor.told(OFF, 255, 2, 9)
    assert monitor.health(0, False) == LinkHealth(OFF, 255, 2, bus_offs=1, last_bus_off_ns=9)
    monitor.told(OFF, -1, -1, 10)
    assert monitor.health(0, False) == LinkHealth(OFF, 255, 2, bus_offs=1, last_bus_off_ns=9)
    monitor.told(DOWN, -1, -1, 10)
    monitor.told(ACTIVE, 0, 0, 11)
    assert monitor.health(0, False) == LinkHealth(ACTIVE, 0, 0, bus_offs=1, last_bus_off_ns=9)


def test_a_link_that_has_given_up_is_bus_off_whatever_its_driver_does_unless_it_is_down():
    monitor = BusMonitor()
    assert monitor.health(0, True).state is OFF
    monitor.refused(errno.ENODEV, 1)
    assert monitor.health(0, True).state is DOWN


def test_errors_on_the_wire_and_losses_of_the_controller_are_counted():
    monitor = BusMonitor()
    for classes, status in ((0x088, 0), (0x0A0, 0), (0x004, 0x01), (0x004, 0x08)):
        monitor.error_frame(classes, error_data(status), 0)
    assert (monitor.bus_errors, monitor.overflows) == (2, 1)
