"""The python-can interface: every kind of frame, filters, time stamps, and what its user sees when something is wrong."""

import asyncio
import select
import threading
import time
from itertools import pairwise

import can
import pytest

from dbc.can_io import EXTENDED_FLAG, Direct
from tests.support.processes import wait_until
from tests.vehicle_emulator.bus.conftest import serving
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.frame import BusFrame
from vehicle_emulator.bus.hub import HubOptions
from vehicle_emulator.bus.interface import XilgateBus

PATIENCE_S = 20.0

MESSAGES = {
    "standard": can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"\x01\x02\x03"),
    "empty": can.Message(arbitration_id=0, is_extended_id=False),
    "extended": can.Message(arbitration_id=0x1FFFFFFF, data=bytes(range(8))),
    "remote": can.Message(arbitration_id=0x100, is_extended_id=False, is_remote_frame=True, dlc=5),
    "fd": can.Message(arbitration_id=0x200, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(range(64))),
    "fd passive": can.Message(arbitration_id=0x201, is_fd=True, error_state_indicator=True, data=bytes(12)),
}


@pytest.fixture
def pair(channel):
    with can.Bus(interface="xilgate", channel=channel, fd=True) as a, can.Bus(interface="xilgate", channel=channel) as b:
        yield a, b


def standard(arbitration_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data)


def receive(bus: can.BusABC) -> can.Message:
    message = bus.recv(timeout=PATIENCE_S)
    assert message is not None
    return message


def test_entry_point_gives_this_class(pair, channel):
    assert all(type(bus) is XilgateBus for bus in pair)
    assert str(pair[0]) == f"xilgate channel '{channel}'"
    assert pair[0].protocol is can.CanProtocol.CAN_FD
    assert pair[1].protocol is can.CanProtocol.CAN_20


@pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES.keys())
def test_every_kind_of_frame_arrives_as_sent(pair, channel, message):
    a, b = pair
    before_s = time.time()
    a.send(message)
    received = receive(b)
    assert received.equals(message, timestamp_delta=None, check_channel=False)
    assert received.channel == channel
    assert received.is_rx
    # Wide, because the wall clock may be set while the test runs.
    assert before_s - 1.0 < received.timestamp < time.time() + 1.0


@pytest.mark.parametrize(
    ("message", "cause"),
    [
        (can.Message(arbitration_id=0x800, is_extended_id=False), "0x800 outside"),
        (can.Message(arbitration_id=1, is_extended_id=False, data=bytes(9)), "CAN frame of 9 bytes"),
        (can.Message(arbitration_id=1, is_extended_id=False, data=bytes(4), dlc=2), "4 bytes of data in a frame of length 2"),
        (can.Message(arbitration_id=4, is_error_frame=True, data=bytes(8)), "an error frame cannot be sent; `disturb` makes errors"),
    ],
)
def test_impossible_frames_are_refused_before_they_are_sent(pair, message, cause):
    a, b = pair
    with pytest.raises(can.CanOperationError, match=cause):
        a.send(message)
    assert b.recv(timeout=0.05) is None


def test_fd_frame_needs_a_bus_opened_for_it(pair):
    with pytest.raises(can.CanOperationError, match="opened without fd=True"):
        pair[1].send(MESSAGES["fd"])


def test_arrivals_are_what_recv_says(pair, channel):
    a, b = pair
    with can.Bus(interface="xilgate", channel=channel, receive_own_messages=True) as c:
        for message in MESSAGES.values():
            a.send(message)
        c.send(standard(0x300, b"own"))
        said, heard = [receive(b) for _ in range(len(MESSAGES) + 1)], []
        assert isinstance(c, Direct)
        wait_until(lambda: heard.extend(c.arrivals()) or len(heard) == len(said), PATIENCE_S, "all frames")
    unlike = {one.arbitration_id for one in said if one.is_extended_id or one.is_remote_frame or one.is_fd}
    expected = [(one.arbitration_id | EXTENDED_FLAG * (one.arbitration_id in unlike), bytes(one.data)) for one in said]
    assert [one[:2] for one in heard] == expected
    assert [identifier for identifier, _, is_own in heard if is_own] == [0x300]


def test_arrivals_pass_filters(hub, channel):
    filters = [{"can_id": 0x100, "can_mask": 0x700, "extended": False}]
    with can.Bus(interface="xilgate", channel=channel) as a, can.Bus(interface="xilgate", channel=channel, can_filters=filters) as b:
        for arbitration_id in (0x100, 0x200, 0x1FF):
            a.send(standard(arbitration_id))
        heard = []
        wait_until(lambda: heard.extend(b.arrivals()) or len(heard) == 2, PATIENCE_S, "two frames")
    assert [identifier for identifier, _, _ in heard] == [0x100, 0x1FF]


def test_what_came_before_the_hub_went_arrives():
    with serving("bus1"), XilgateBus("bus1") as a:
        b = XilgateBus("bus1")
        a.send(standard(0x100))
        select.select([b.fileno()], [], [], PATIENCE_S)
    with b:
        arrivals = b.arrivals()
        assert next(arrivals) == (0x100, b"", False)
        with pytest.raises(can.CanOperationError, match="the hub has gone"):
            next(arrivals)


def test_filters(pair):
    a, b = pair
    b.set_filters([{"can_id": 0x100, "can_mask": 0x7F0, "extended": False}])
    for arbitration_id in (0x0FF, 0x105, 0x110):
        a.send(standard(arbitration_id))
    a.send(can.Message(arbitration_id=0x100, is_extended_id=True))
    a.send(standard(0x10F))
    assert [receive(b).arbitration_id for _ in range(2)] == [0x105, 0x10F]
    assert b.recv(timeout=0.05) is None
    b.set_filters()
    a.send(standard(0x0FF))
    assert receive(b).arbitration_id == 0x0FF


def test_filters_without_a_format_pass_both(pair):
    a, b = pair
    b.set_filters([{"can_id": 0x100, "can_mask": 0x1FFFFFFF}, {"can_id": 0x200, "can_mask": 0x1FFFFFFF, "extended": True}])
    for is_extended in (False, True):
        a.send(can.Message(arbitration_id=0x200, is_extended_id=is_extended))
        a.send(can.Message(arbitration_id=0x100, is_extended_id=is_extended))
    heard = [receive(b) for _ in range(3)]
    # In any order: some of them meet in arbitration.
    assert {(message.arbitration_id, message.is_extended_id) for message in heard} == {(0x100, False), (0x200, True), (0x100, True)}
    assert b.recv(timeout=0.05) is None


def test_more_filters_than_the_hub_takes_work_as_well(pair):
    a, b = pair
    b.set_filters([{"can_id": 0x100 + number, "can_mask": 0x7FF} for number in range(200)])
    for arbitration_id in (0x0FF, 0x100 + 199, 0x100 + 200):
        a.send(standard(arbitration_id))
    assert receive(b).arbitration_id == 0x100 + 199
    assert b.recv(timeout=0.05) is None


def test_filters_from_the_start(hub, channel):
    with XilgateBus("bus0") as a, XilgateBus(channel, can_filters=[{"can_id": 5, "can_mask": 0x7FF}]) as b:
        for arbitration_id in (4, 5, 6):
            a.send(standard(arbitration_id))
        assert receive(b).arbitration_id == 5
        assert b.recv(timeout=0.05) is None


def test_own_messages_come_back_when_they_are_through(hub, channel):
    with XilgateBus(channel, receive_own_messages=True) as a, XilgateBus("bus0") as b:
        a.send(standard(3, b"abc"))
        own, other = receive(a), receive(b)
        assert not own.is_rx
        assert other.is_rx
        assert own.equals(other, check_direction=False, check_channel=False, timestamp_delta=0)
        b.send(standard(4))
        assert receive(a).is_rx
        assert b.recv(timeout=0.05) is None


def test_time_stamps_are_ends_of_frames(pair):
    a, b = pair
    for number in range(100):
        a.send(standard(0x100, bytes([number])))
    stamps = [(receive(b).timestamp, frame_bits(BusFrame(0x100, bytes([number]), 0, 1))[0]) for number in range(100)]
    for (earlier_s, _), (later_s, bits) in pairwise(stamps):
        # At 1 Mbit/s; the resolution of such a number of seconds since the epoch is 0.24 us.
        assert later_s - earlier_s > (3 + bits) * 1e-6 - 1e-6


def test_recv_times_out(pair):
    started_s = time.monotonic()
    assert pair[0].recv(timeout=0.05) is None
    assert time.monotonic() - started_s >= 0.05


def test_recv_without_timeout_waits_for_a_frame(pair):
    a, b = pair
    received = []
    thread = threading.Thread(target=lambda: received.append(a.recv()))
    thread.start()
    time.sleep(0.05)
    assert not received
    b.send(MESSAGES["standard"])
    thread.join(PATIENCE_S)
    assert received[0].arbitration_id == MESSAGES["standard"].arbitration_id


def test_shutdown_wakes_a_waiting_thread(pair):
    outcome = []

    def wait():
        try:
            pair[0].recv()
        except can.CanOperationError as error:
            outcome.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    time.sleep(0.05)
    pair[0].shutdown()
    thread.join(PATIENCE_S)
    assert len(outcome) == 1
    pair[0].shutdown()
    with pytest.raises(can.CanOperationError):
        pair[0].send(MESSAGES["standard"])


def test_fileno_serves_an_event_loop(pair):
    a, b = pair

    async def receive_all(count):
        reader = can.AsyncBufferedReader()
        with can.Notifier(b, [reader], loop=asyncio.get_running_loop()):
            for number in range(count):
                a.send(standard(number))
            return [(await asyncio.wait_for(reader.get_message(), PATIENCE_S)).arbitration_id for _ in range(count)]

    assert asyncio.run(receive_all(20)) == list(range(20))


def test_periodic_sending(pair):
    a, b = pair
    task = a.send_periodic(MESSAGES["standard"], 0.005)
    assert all(b.recv(timeout=PATIENCE_S) is not None for _ in range(5))
    task.stop()


def test_no_hub_is_one_clear_line():
    text = r"^no hub serves xilgate channel 'bus7' \(/tmp/.*/bus7\.sock\); `xilgate bus` starts one$"
    with pytest.raises(can.CanInitializationError, match=text):
        can.Bus(interface="xilgate", channel="bus7")


def test_no_hub_on_a_port_is_one_clear_line(hub):
    port = hub.tcp_port
    hub._listeners.popitem()[1].close()
    text = rf"^no hub serves xilgate channel 'tcp://127\.0\.0\.1:{port}' \(port {port}\); `xilgate bus` starts one$"
    with pytest.raises(can.CanInitializationError, match=text):
        XilgateBus(f"tcp://127.0.0.1:{port}")


def test_bad_channel_name_is_one_clear_line():
    with pytest.raises(can.CanInitializationError, match=r"^channel '\.\./x': expected 1 to 32 letters, digits, - or _$"):
        can.Bus(interface="xilgate", channel="../x")


def errors_of(bus: can.BusABC, count: int) -> list[tuple[int, bytes, can.BusState]]:
    """Error frames as python-can shows them, each with the state that the bus then tells."""
    frames = []
    for _ in range(count):
        message = receive(bus)
        assert message.is_error_frame
        assert not message.is_extended_id
        frames.append((message.arbitration_id, bytes(message.data), bus.state))
    return frames


ACTIVE, PASSIVE, ERROR = can.BusState.ACTIVE, can.BusState.PASSIVE, can.BusState.ERROR
BUS_OFF_STORY = [
    (0x204, bytes([0, 0x08, 0, 0, 0, 0, 96, 0]), ACTIVE),
    (0x204, bytes([0, 0x20, 0, 0, 0, 0, 128, 0]), PASSIVE),
    (0x240, bytes([0, 0, 0, 0, 0, 0, 255, 0]), ERROR),
]
RESTARTED = (0x300, bytes(8), ACTIVE)


def test_bus_off_and_the_way_back(hub, channel):
    with XilgateBus(channel, restart_ms=0) as a, XilgateBus("bus0", can_filters=[{"can_id": 0x123, "can_mask": 0x7FF}]) as b:
        assert a.state is ACTIVE
        a.disturb(0x123, 32)
        a.send(standard(0x123))
        assert errors_of(a, 3) == BUS_OFF_STORY
        with pytest.raises(can.CanOperationError, match="bus-off"):
            a.send(standard(0x123))
        assert a.recv(timeout=0.05) is None
        a.restart()
        assert errors_of(a, 1) == [RESTARTED]
        a.send(standard(0x123, b"again"))
        assert bytes(receive(b).data) == b"again"
        assert b.state is ACTIVE


def test_bus_off_ends_by_itself_where_it_is_set_to(hub, channel):
    with XilgateBus(channel, restart_ms=1) as a, XilgateBus("bus0"):
        a.disturb(None, 32)
        a.send(standard(1))
        assert errors_of(a, 4) == [*BUS_OFF_STORY, RESTARTED]


def test_the_hub_says_what_restarts_by_itself():
    with serving("bus1", HubOptions(restart_ms=0)) as quiet, XilgateBus("bus1") as a, XilgateBus("bus1"):
        a.disturb(None, 32)
        a.send(standard(1))
        assert errors_of(a, 3) == BUS_OFF_STORY
        assert quiet.core.next_event_ns() is None
        assert a.recv(timeout=0.05) is None


def test_error_frames_pass_filters(hub):
    with XilgateBus("bus0", can_filters=[{"can_id": 0x7FF, "can_mask": 0x7FF}]) as a, XilgateBus("bus0"):
        a.disturb(None, 12)
        a.send(standard(1))
        assert errors_of(a, 1) == BUS_OFF_STORY[:1]


def test_every_error_is_told_to_who_asks(hub, channel):
    with XilgateBus(channel, berr_reporting=True) as a, XilgateBus("bus0") as b:
        a.disturb(1, 2)
        a.send(standard(1))
        reports = errors_of(a, 2)
        assert [(identifier, data) for identifier, data, _ in reports] == [
            (0x288, bytes([0, 0, 0x81, 0x08, 0, 0, 8, 0])),
            (0x288, bytes([0, 0, 0x81, 0x08, 0, 0, 16, 0])),
        ]
        assert receive(b).arbitration_id == 1


def test_a_lonely_node_is_told_that_nobody_acknowledges(hub, channel):
    with XilgateBus(channel, berr_reporting=True) as lonely:
        lonely.send(standard(1))
        identifier, data, _ = errors_of(lonely, 1)[0]
        assert (identifier, data) == (0x2A0, bytes([0, 0, 0, 0x19, 0, 0, 8, 0]))
    with XilgateBus(channel) as lonely:
        lonely.send(standard(1))
        assert errors_of(lonely, 2) == BUS_OFF_STORY[:2]
        assert lonely.recv(timeout=0.05) is None


def test_the_state_cannot_be_set(hub):
    with XilgateBus("bus0") as bus, pytest.raises(NotImplementedError, match="`restart` leaves bus-off"):
        bus.state = ERROR


def test_a_long_stream_passes_without_loss(hub, channel):
    count = 10_000
    received = []

    def read(bus):
        while len(received) < count and (message := bus.recv(timeout=PATIENCE_S)):
            received.append(int.from_bytes(message.data, "little"))

    with XilgateBus("bus0") as a, XilgateBus(channel) as b:
        thread = threading.Thread(target=read, args=(b,))
        thread.start()
        for number in range(count):
            while number - len(received) > 200:
                time.sleep(0.0005)
            a.send(standard(1, number.to_bytes(2, "little")), timeout=PATIENCE_S)
        thread.join(PATIENCE_S)
    assert received == list(range(count))
