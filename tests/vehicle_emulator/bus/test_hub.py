"""The hub over real sockets: slow, vanishing and malicious nodes, and whose channel it is."""

import contextlib
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import can
import pytest

from vehicle_emulator.bus import hub as hub_module
from vehicle_emulator.bus import wire
from vehicle_emulator.bus.channel import BusError, is_served, open_socket, socket_path
from vehicle_emulator.bus.connection import connection_of
from vehicle_emulator.bus.frame import EXTENDED, BusFrame
from vehicle_emulator.bus.hub import Hub, HubOptions, run
from vehicle_emulator.bus.interface import XilgateBus
from vehicle_emulator.bus.peer import MAX_PACKETS_PER_TURN
from vehicle_emulator.bus.wire import Disturb, Hello, Settings, pack, pack_control, unpack

PATIENCE_S = 20.0
HUB_PROCESS = """
import sys, threading
from vehicle_emulator.bus.hub import HubOptions, run
run({sys.argv[1]: HubOptions()}, threading.Event())
"""


def eventually(condition) -> bool:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.005)
    return True


def frame(number: int) -> can.Message:
    return can.Message(arbitration_id=0x123, is_extended_id=False, data=number.to_bytes(4, "little"))


def numbers(bus: XilgateBus, count: int) -> list[int]:
    messages = (bus.recv(timeout=PATIENCE_S) for _ in range(count))
    return [int.from_bytes(message.data, "little") for message in messages]


def hub_process(name: str) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", HUB_PROCESS, name])
    assert eventually(lambda: is_served(name))
    return process


def test_three_nodes_hear_each_other_in_order_and_not_themselves(channel):
    with XilgateBus("bus0") as a, XilgateBus(channel) as b, XilgateBus(channel) as c:
        for number in range(50):
            a.send(frame(number))
        assert numbers(b, 50) == numbers(c, 50) == list(range(50))
        b.send(frame(99))
        assert numbers(a, 1) == numbers(c, 1) == [99]
        assert a.recv(timeout=0) is b.recv(timeout=0) is c.recv(timeout=0) is None


def test_a_slow_node_loses_frames_and_holds_nobody_up(hub):
    count, batch = 3000, 100
    with XilgateBus("bus0") as slow, XilgateBus("bus0") as sender, XilgateBus("bus0") as fast:
        for first in range(0, count, batch):
            for number in range(first, first + batch):
                sender.send(frame(number), timeout=PATIENCE_S)
            assert numbers(fast, batch) == list(range(first, first + batch))
        statistics = hub.core.nodes[1]
        assert eventually(lambda: statistics.received + statistics.lost == count)
        assert statistics.lost > 0
        kept = statistics.received
        assert numbers(slow, kept) == list(range(kept))
        assert slow.recv(timeout=0) is None
        sender.send(frame(count))
        assert numbers(slow, 1) == [count]


def test_a_slow_node_is_reported_when_it_leaves(hub, caplog):
    with XilgateBus("bus0"), XilgateBus("bus0") as sender:
        for number in range(2000):
            sender.send(frame(number), timeout=PATIENCE_S)
        assert eventually(lambda: hub.core.nodes[2].transmitted == 2000)
    assert eventually(lambda: caplog.messages)
    assert [message.split(" frames lost")[0].rstrip("0123456789") for message in caplog.messages] == ["bus bus0: node 1 was too slow: "]


def test_frames_sent_just_before_leaving_arrive(hub):
    with XilgateBus("bus0") as stays:
        leaves = XilgateBus("bus0")
        stays.send(frame(7))
        # Leaving with frames unread resets the connection, which must not cost the frames in the other direction.
        assert eventually(lambda: hub.core.nodes[1].transmitted == 1)
        for number in range(200):
            leaves.send(frame(number))
        leaves.shutdown()
        assert numbers(stays, 200) == list(range(200))
        assert eventually(lambda: list(hub.core.nodes) == [1])


def test_a_killed_node_is_removed_and_the_others_go_on(hub):
    program = "import can; bus = can.Bus(interface='xilgate', channel='bus0'); print('joined', flush=True); bus.recv()"
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
        assert process.stdout.readline() == b"joined\n"
        assert list(hub.core.nodes) == [1, 2, 3]
        process.kill()
        process.communicate()
        assert eventually(lambda: list(hub.core.nodes) == [1, 2])
        a.send(frame(5))
        assert numbers(b, 1) == [5]


def stranger(hub, channel):
    """A connection of its own making."""
    address = ("127.0.0.1", hub.tcp_port) if channel.startswith("tcp") else str(socket_path("bus0"))
    connected = open_socket(address if isinstance(address, tuple) else socket_path("bus0"))
    connected.settimeout(PATIENCE_S)
    connected.connect(address)
    return connected


def joined(hub, channel):
    """A node that speaks the packets itself."""
    connection = connection_of(stranger(hub, channel))
    connection.send(pack_control(Hello(wire.VERSION)))
    answers = []
    assert eventually(lambda: answers or _read(connection, answers))
    assert unpack(answers[0]) == Hello(wire.VERSION)
    return connection


def _read(connection, packets):
    try:
        packets.append(connection.receive())
    except BlockingIOError:
        return False
    return True


def has_gone(connected: socket.socket) -> bool:
    try:
        return connected.recv(100) == b""
    except ConnectionResetError:
        return True


FRAME_PACKET = pack(BusFrame(1, b"", 0, 0), 0)


@pytest.mark.parametrize(
    "rubbish",
    [b"GET / HTTP/1.1\r\n\r\n", b"\x00\x00", b"\xff\xff", b"\x03\x00abc", b"\x10\x00" + FRAME_PACKET, FRAME_PACKET, bytes(9000)],
    ids=["http", "length 0", "length 65535", "no packet", "framed frame", "frame", "long"],
)
def test_who_does_not_say_hello_is_shown_the_door(hub, channel, rubbish, monkeypatch):
    monkeypatch.setattr("vehicle_emulator.bus.peer.PATIENCE_NS", 10**12)
    with XilgateBus("bus0") as node, stranger(hub, channel) as caller:
        caller.sendall(rubbish)
        assert has_gone(caller)
        assert hub.malformed == 1
        assert node.recv(timeout=0) is None
        assert list(hub.core.nodes) == [1]


def test_another_version_is_refused(hub, channel):
    caller = connection_of(stranger(hub, channel))
    caller.send(pack_control(Hello(wire.VERSION + 1)))
    answers = []
    assert eventually(lambda: _read(caller, answers))
    assert answers == [b""]
    caller.close()


def test_who_says_nothing_is_no_node_and_is_parted_with(hub, channel, monkeypatch):
    monkeypatch.setattr("vehicle_emulator.bus.peer.PATIENCE_NS", 50_000_000)
    with stranger(hub, channel) as caller:
        assert has_gone(caller)
        assert hub.core.nodes == {}
        assert hub.malformed == 0


def test_malformed_packets_of_a_node_are_counted_and_dropped(hub, channel):
    with XilgateBus("bus0") as node:
        rogue = joined(hub, channel)
        packets = [
            b"rubbish",
            bytes(1000),
            FRAME_PACKET + b"x",
            pack(BusFrame(0x3, bytes(8), 0x08, 8), 0),
            pack(BusFrame(1, b"", 0x80, 0), 0),
            pack_control(Hello(wire.VERSION)),
            b"\x02" + b"\xc1" * 50,
        ]
        for packet in packets:
            rogue.send(packet)
        rogue.send(FRAME_PACKET)
        assert node.recv(timeout=PATIENCE_S).arbitration_id == 1
        assert hub.malformed == len(packets)
        assert node.recv(timeout=0) is None
        assert list(hub.core.nodes) == [1, 2]
        rogue.close()
        assert eventually(lambda: list(hub.core.nodes) == [1])


def test_a_length_that_no_packet_has_ends_a_tcp_node(hub):
    address = ("127.0.0.1", hub.tcp_port)
    with XilgateBus("bus0") as node, open_socket(address) as rogue:
        rogue.connect(address)
        hello = pack_control(Hello(wire.VERSION))
        rogue.sendall(len(hello).to_bytes(2, "little") + hello + b"\xff\xff")
        assert eventually(lambda: list(hub.core.nodes) == [1] and hub.malformed >= 1)
        assert node.recv(timeout=0) is None


def test_a_packet_in_pieces_is_one_packet(hub):
    address = ("127.0.0.1", hub.tcp_port)
    with XilgateBus("bus0") as node, open_socket(address) as slow:
        slow.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        slow.connect(address)
        hello, sent = pack_control(Hello(wire.VERSION)), pack(BusFrame(0x77, b"abc", 0, 3), 0)
        for byte in b"".join(len(packet).to_bytes(2, "little") + packet for packet in (hello, sent)):
            slow.sendall(bytes([byte]))
            time.sleep(0.001)
        assert node.recv(timeout=PATIENCE_S).data == b"abc"
        assert hub.malformed == 0


def test_a_node_that_floods_is_held_back_and_others_get_through(hub, channel):
    flood = joined(hub, channel)
    with XilgateBus("bus0") as a, XilgateBus("bus0", can_filters=[{"can_id": 0x123, "can_mask": 0x7FF}]) as b:
        packet = pack(BusFrame(0x400, bytes(8), 0, 8), 0)
        assert not all(_is_taken(flood, packet) for _ in range(200_000))
        a.send(frame(7))
        assert numbers(b, 1) == [7]
        assert hub.core.room(1) >= 0
        assert hub.core.nodes[1].refused == 0
        flood.close()


def _is_taken(connection, packet):
    try:
        connection.send(packet)
    except BlockingIOError:
        return False
    return True


def test_a_flood_of_control_packets_holds_nobody_up(hub, channel):
    flood = joined(hub, channel)
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        packet = pack_control(Disturb(0x555, 1))
        for number in range(4 * MAX_PACKETS_PER_TURN):
            with contextlib.suppress(BlockingIOError):
                flood.send(packet if number % 2 else pack_control(Settings()))
        a.send(frame(1))
        assert numbers(b, 1) == [1]
        flood.close()


def test_disturbed_identifiers_are_bounded(hub, monkeypatch):
    monkeypatch.setattr(hub_module, "_MAX_DISTURBED_IDS", 3)
    with XilgateBus("bus0") as node:
        for arbitration_id in range(5):
            node.disturb(arbitration_id, 1)
        assert eventually(lambda: hub.malformed == 2)
        assert hub.core.disturbed_ids == 3
        for arbitration_id in range(3):
            node.disturb(arbitration_id, 0)
        assert eventually(lambda: hub.core.disturbed_ids == 0)
        assert hub.malformed == 2


def _shorten(connection):
    """A receive buffer as small as the kernel allows, so that it is full soon."""
    connection._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)


def test_a_node_that_never_reads_holds_nobody_up(hub, channel):
    deaf = joined(hub, channel)
    _shorten(deaf)
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        count = 0
        while not hub.core.nodes[1].lost:
            for number in range(200):
                a.send(frame(number), timeout=PATIENCE_S)
            assert numbers(b, 200) == list(range(200))
            count += 200
            assert count < 100_000
        deaf.close()
        assert eventually(lambda: list(hub.core.nodes) == [2, 3])


def test_filters_keep_a_node_asleep(hub, channel):
    listener = joined(hub, channel)
    listener.send(pack_control(Settings((wire.Filter(0x100, 0x7F0, False), wire.Filter(0x1ABCDE, 0x1FFFFFFF, True)))))
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        # Control packets are obeyed in the turn in which they come; wait until it is over.
        assert eventually(lambda: hub.core.nodes[1].received == 0 and _filters(hub))
        for arbitration_id, flags in ((0x0FF, 0), (0x105, 0), (0x110, 0), (0x105, EXTENDED), (0x1ABCDE, EXTENDED), (0x10F, 0)):
            a.send(can.Message(arbitration_id=arbitration_id, is_extended_id=bool(flags)))
            b.recv(timeout=PATIENCE_S)
        packets = []
        assert eventually(lambda: _read(listener, packets) and len(packets) == 3)
        assert [unpack(packet)[0].arbitration_id for packet in packets] == [0x105, 0x1ABCDE, 0x10F]
        assert not _read(listener, packets)
        listener.close()


def _filters(hub):
    return hub._nodes[1].settings.filters is not None


def test_requests_that_wait_for_a_late_hub_keep_their_time_and_order():
    with Hub("bus0") as hub:
        nodes = [connection_of(stranger(hub, "bus0")) for _ in range(3)]
        for node in nodes:
            node.send(pack_control(Hello(wire.VERSION)))
        for _ in range(8):
            hub.turn(0.0)
        assert [unpack(node.receive()) for node in nodes] == [Hello(wire.VERSION)] * 3
        joined_ns = hub.core.now_ns
        sent = BusFrame(0x100, b"", 0, 0)
        # The later request is of the node that the hub reads first.
        nodes[0].send(pack(sent, joined_ns + 2_000_000))
        nodes[1].send(pack(sent, joined_ns + 1_000_000))
        while time.monotonic_ns() < joined_ns + 10_000_000:
            time.sleep(0.001)
        hub.turn(0.0)
        stamps_ns = [unpack(nodes[2].receive())[1] for _ in range(2)]
        assert stamps_ns[1] - stamps_ns[0] == 1_000_000
        assert unpack(nodes[0].receive())[1] == stamps_ns[0]
        for node in nodes:
            node.close()


def test_a_time_that_cannot_be_is_taken_for_now(hub):
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        for t_ns in (2**62, -5):
            before_s = time.time()
            a._connection.send(pack(BusFrame(0x100, b"", 0, 0), t_ns))
            stamp = b.recv(timeout=PATIENCE_S).timestamp
            assert before_s - 0.5 < stamp < time.time() + 0.5


class Kernel:
    """A clock, and a timer that rings late."""

    def __init__(self, late_ns):
        self.now_ns, self.late_ns = 1_000_000, late_ns

    def monotonic_ns(self):
        return self.now_ns

    def select(self, reading, writing, failing, timeout_s):
        self.now_ns += round(timeout_s * 1e9) + (self.late_ns if timeout_s else 0)
        return [], writing, failing


@dataclass
class Waiting:
    due_ns: int


def test_the_alarm_is_set_ahead_by_what_the_kernel_is_late(monkeypatch):
    kernel = Kernel(late_ns=40_000)
    monkeypatch.setattr(hub_module, "time", kernel)
    monkeypatch.setattr(hub_module, "select", kernel)
    alarm, late_ns = hub_module.Alarm(), []
    for _ in range(300):
        due = Waiting(kernel.now_ns + 250_000)
        served = alarm.wait([due, Waiting(2**62)], 0.1)
        if served:
            assert served == [due]
            late_ns.append(kernel.now_ns - due.due_ns)
    assert late_ns[0] == 40_000
    assert 0 <= late_ns[-1] < 2_000
    assert min(late_ns) >= 0
    # A kernel that has become quicker is not trusted to be late: rather twice woken up than early.
    kernel.late_ns = 5_000
    due = Waiting(kernel.now_ns + 250_000)
    assert alarm.wait([due], 0.1) == []
    assert kernel.now_ns < due.due_ns
    while not alarm.wait([due], 0.1):
        pass
    assert kernel.now_ns >= due.due_ns


def test_the_alarm_rings_at_its_timeout(monkeypatch):
    kernel = Kernel(late_ns=0)
    monkeypatch.setattr(hub_module, "time", kernel)
    monkeypatch.setattr(hub_module, "select", kernel)
    assert hub_module.Alarm().wait([Waiting(2**62)], 0.1) == []
    assert kernel.now_ns == 101_000_000


def test_what_a_lonely_node_has_not_sent_is_forgotten_when_it_goes(hub, channel):
    lonely = XilgateBus(channel)
    for number in range(300):
        lonely.send(frame(number), timeout=PATIENCE_S if number < 60 else 0.0)
    assert eventually(lambda: hub.core.room(1) == 0)
    lonely.shutdown()
    assert eventually(lambda: not hub.core.nodes)
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        a.send(frame(1))
        assert numbers(b, 1) == [1]


def test_the_transmit_buffer_of_a_lonely_node_fills(hub, channel):
    def fill(bus):
        for number in range(500_000):
            bus.send(frame(number % 1000))

    with XilgateBus(channel) as lonely:
        with pytest.raises(can.CanOperationError, match="transmit buffer full"):
            fill(lonely)
        with XilgateBus("bus0") as other:
            assert numbers(other, 100) == list(range(100))
        # Somebody acknowledges, so there is room again.


def test_a_full_bus_refuses_further_nodes(hub, monkeypatch):
    monkeypatch.setattr(hub_module, "MAX_NODES", 1)
    with XilgateBus("bus0"):
        with pytest.raises(can.CanInitializationError, match="refuses: full"):
            XilgateBus("bus0")
        assert len(hub.core.nodes) == 1


def test_a_served_channel_is_refused_to_a_second_hub_and_stays_usable(hub):
    with pytest.raises(BusError, match=r"^channel 'bus0' is already served by another hub \(.*/bus0\.sock\)$"):
        Hub("bus0")
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b:
        a.send(frame(1))
        assert numbers(b, 1) == [1]


def test_hubs_of_two_channels_do_not_hear_each_other(hub):
    stop = threading.Event()
    other = threading.Thread(target=run, args=({"bus1": HubOptions(), "bus2": HubOptions()}, stop))
    other.start()
    try:
        assert eventually(lambda: is_served("bus1"))
        with XilgateBus("bus0") as a, XilgateBus("bus1") as b, XilgateBus("bus0") as c, XilgateBus("bus1") as d, XilgateBus("bus2") as e:
            a.send(frame(1))
            b.send(frame(2))
            assert numbers(c, 1) == [1]
            assert numbers(d, 1) == [2]
            assert b.recv(timeout=0.05) is e.recv(timeout=0) is None
    finally:
        stop.set()
        other.join(PATIENCE_S)
    assert not other.is_alive()
    assert not socket_path("bus1").exists()


def test_a_killed_hub_is_noticed_and_its_socket_taken_over():
    process = hub_process("bus0")
    node = XilgateBus("bus0")
    process.kill()
    process.wait()
    with pytest.raises(can.CanOperationError, match="the hub has gone"):
        node.recv(timeout=PATIENCE_S)
    with pytest.raises(can.CanOperationError, match="the hub has gone"):
        node.send(frame(1))
    node.shutdown()
    assert socket_path("bus0").exists()
    assert not is_served("bus0")
    with Hub("bus0"):
        assert is_served("bus0")
    assert not socket_path("bus0").exists()


def test_a_stopped_hub_makes_send_fail_instead_of_block(monkeypatch):
    process = hub_process("bus0")
    try:
        node = XilgateBus("bus0")
        process.send_signal(signal.SIGSTOP)

        def fill():
            for number in range(100_000):
                node.send(frame(number))

        with pytest.raises(can.CanOperationError, match="transmit buffer full"):
            fill()
        node.shutdown()
        monkeypatch.setattr("vehicle_emulator.bus.interface._JOIN_TIMEOUT_S", 0.05)
        with pytest.raises(can.CanInitializationError, match="does not answer"):
            XilgateBus("bus0")
    finally:
        process.kill()
        process.wait()


def test_a_port_that_is_taken_is_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(BusError, match=rf"^127\.0\.0\.1:{port}: Address already in use$"):
            Hub("bus0", HubOptions(tcp_port=port))
    assert not socket_path("bus0").exists()


def test_the_port_is_on_loopback_alone(hub):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, socket.socket() as caller:
        probe.connect(("192.0.2.1", 9))  # sends nothing; tells by which of our addresses it would
        outside = probe.getsockname()[0]
        if outside.startswith("127."):
            pytest.skip("this machine has no address but loopback")
        with pytest.raises(ConnectionRefusedError):
            caller.connect((outside, hub.tcp_port))


@pytest.mark.parametrize("name", ["tcp://127.0.0.1", "tcp://127.0.0.1:0", "tcp://127.0.0.1:65536", "tcp://192.168.0.1:5000", "tcp:5000"])
def test_tcp_channels_are_checked(name):
    with pytest.raises(BusError, match=r"expected tcp://127\.0\.0\.1:PORT, port 1 to 65535; the bus is on loopback alone$"):
        is_served(name)


def test_whether_a_port_is_served(hub):
    assert is_served(f"tcp://127.0.0.1:{hub.tcp_port}")
    assert is_served(f"tcp://localhost:{hub.tcp_port}")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        assert not is_served(f"tcp://127.0.0.1:{free.getsockname()[1]}")


def test_looking_whether_it_is_served_makes_no_node(hub):
    for _ in range(20):
        assert is_served("bus0")
    with XilgateBus("bus0"):
        assert list(hub.core.nodes) == [1]


def test_directory_is_private_and_another_mode_is_refused(runtime_directory):
    directory = socket_path("bus0").parent
    assert directory == runtime_directory / "xilgate"
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    directory.chmod(0o755)
    with pytest.raises(BusError, match=r"expected a directory of user \d+ with mode 0700$"):
        Hub("bus0")


def test_without_a_runtime_directory_the_socket_is_in_tmp(monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/nonexistent")
    assert str(socket_path("bus0")) == f"/tmp/xilgate-{os.getuid()}/bus0.sock"


def test_path_that_no_socket_can_have_is_refused(runtime_directory, monkeypatch):
    long = runtime_directory / ("x" * 100)
    long.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(long))
    with pytest.raises(BusError, match="set XDG_RUNTIME_DIR to a shorter path"):
        Hub("bus0")


@pytest.mark.parametrize("name", ["", "a/b", "..", "a b", "x" * 33, "bus0\n"])
def test_channel_names_are_checked(name):
    with pytest.raises(BusError, match="expected 1 to 32 letters, digits, - or _"):
        socket_path(name)


def test_a_name_that_cannot_be_bound_is_one_line():
    socket_path("bus0").mkdir()
    with pytest.raises(BusError, match=r"^/tmp/.*/bus0\.sock: Is a directory$"):
        Hub("bus0")
    assert socket_path("bus0").is_dir()
