"""The python-can interface: every kind of frame, filters, time stamps, and what its user sees when something is wrong."""

import asyncio
import threading
import time

import can
import pytest

from vehicle_emulator.bus.interface import XilgateBus

PATIENCE_S = 20.0

MESSAGES = {
    "standard": can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"\x01\x02\x03"),
    "empty": can.Message(arbitration_id=0, is_extended_id=False),
    "extended": can.Message(arbitration_id=0x1FFFFFFF, data=bytes(range(8))),
    "remote": can.Message(arbitration_id=0x100, is_extended_id=False, is_remote_frame=True, dlc=5),
    "error": can.Message(arbitration_id=0x40, is_extended_id=False, is_error_frame=True, data=bytes(8)),
    "fd": can.Message(arbitration_id=0x200, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(range(64))),
    "fd passive": can.Message(arbitration_id=0x201, is_fd=True, error_state_indicator=True, data=bytes(12)),
}


@pytest.fixture
def pair(hub):
    with can.Bus(interface="xilgate", channel="bus0", fd=True) as a, can.Bus(interface="xilgate", channel="bus0") as b:
        yield a, b


def test_entry_point_gives_this_class(pair):
    assert all(type(bus) is XilgateBus for bus in pair)
    assert str(pair[0]) == "xilgate channel 'bus0'"
    assert pair[0].protocol is can.CanProtocol.CAN_FD
    assert pair[1].protocol is can.CanProtocol.CAN_20


@pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES.keys())
def test_every_kind_of_frame_arrives_as_sent(pair, message):
    a, b = pair
    before_s = time.time()
    a.send(message)
    received = b.recv(timeout=PATIENCE_S)
    assert received.equals(message, timestamp_delta=None, check_channel=False)
    assert received.channel == "bus0"
    assert received.is_rx
    # Wide, because the wall clock may be set while the test runs.
    assert before_s - 1.0 < received.timestamp < time.time() + 1.0


@pytest.mark.parametrize(
    ("message", "cause"),
    [
        (can.Message(arbitration_id=0x800, is_extended_id=False), "0x800 outside"),
        (can.Message(arbitration_id=1, is_extended_id=False, data=bytes(9)), "CAN frame of 9 bytes"),
        (can.Message(arbitration_id=1, is_extended_id=False, data=bytes(4), dlc=2), "4 bytes of data in a frame of length 2"),
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


def test_filters(pair):
    a, b = pair
    b.set_filters([{"can_id": 0x100, "can_mask": 0x7F0, "extended": False}])
    for arbitration_id in (0x0FF, 0x105, 0x110):
        a.send(can.Message(arbitration_id=arbitration_id, is_extended_id=False))
    a.send(can.Message(arbitration_id=0x100, is_extended_id=True))
    a.send(can.Message(arbitration_id=0x10F, is_extended_id=False))
    assert [b.recv(timeout=PATIENCE_S).arbitration_id for _ in range(2)] == [0x105, 0x10F]
    assert b.recv(timeout=0.05) is None


def test_timestamps_do_not_decrease(pair):
    a, b = pair
    for _ in range(100):
        a.send(MESSAGES["standard"])
    stamps = [b.recv(timeout=PATIENCE_S).timestamp for _ in range(100)]
    assert stamps == sorted(stamps)


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

    async def receive():
        reader = can.AsyncBufferedReader()
        with can.Notifier(b, [reader], loop=asyncio.get_running_loop()):
            a.send(MESSAGES["extended"])
            return await asyncio.wait_for(reader.get_message(), PATIENCE_S)

    assert asyncio.run(receive()).arbitration_id == MESSAGES["extended"].arbitration_id


def test_periodic_sending(pair):
    a, b = pair
    task = a.send_periodic(MESSAGES["standard"], 0.005)
    assert all(b.recv(timeout=PATIENCE_S) is not None for _ in range(5))
    task.stop()


def test_no_hub_is_one_clear_line():
    text = r"^no hub serves xilgate channel 'bus7' \(/tmp/.*/bus7\.sock\); `xilgate bus` starts one$"
    with pytest.raises(can.CanInitializationError, match=text):
        can.Bus(interface="xilgate", channel="bus7")


def test_bad_channel_name_is_one_clear_line():
    with pytest.raises(can.CanInitializationError, match=r"^channel '\.\./x': expected 1 to 32 letters, digits, - or _$"):
        can.Bus(interface="xilgate", channel="../x")


def test_own_messages_are_not_promised(hub):
    with pytest.raises(can.CanInitializationError, match="cannot receive its own messages"):
        can.Bus(interface="xilgate", channel="bus0", receive_own_messages=True)


def test_a_long_stream_passes_without_loss(hub):
    count = 25_000
    received = []

    def read(bus):
        while len(received) < count and (message := bus.recv(timeout=PATIENCE_S)):
            received.append(int.from_bytes(message.data, "little"))

    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        thread = threading.Thread(target=read, args=(b,))
        thread.start()
        for number in range(count):
            # Paced by the reader, as a real bus is by its bit rate: at most 200 frames ahead of it.
            while number - len(received) > 200:
                time.sleep(0.0005)
            a.send(can.Message(arbitration_id=1, is_extended_id=False, data=number.to_bytes(8, "little")), timeout=PATIENCE_S)
        thread.join(PATIENCE_S)
    assert received == list(range(count))
