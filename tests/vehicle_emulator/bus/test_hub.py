"""The hub over real sockets: slow, vanishing and malicious nodes, and whose channel it is."""

import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time

import can
import pytest

from vehicle_emulator.bus import hub as hub_module
from vehicle_emulator.bus.channel import BusError, is_served, socket_path
from vehicle_emulator.bus.hub import Hub, run
from vehicle_emulator.bus.interface import XilgateBus

PATIENCE_S = 20.0
HUB_PROCESS = "import sys, threading; from vehicle_emulator.bus.hub import run; run(sys.argv[1], threading.Event())"


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


def test_three_nodes_hear_each_other_in_order_and_not_themselves(hub):
    with XilgateBus("bus0") as a, XilgateBus("bus0") as b, XilgateBus("bus0") as c:
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
        assert statistics.lost > 0
        assert statistics.received + statistics.lost == count
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
        for number in range(10):
            leaves.send(frame(number))
        leaves.shutdown()
        assert numbers(stays, 10) == list(range(10))
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


def test_malformed_packets_are_counted_and_dropped(hub):
    with XilgateBus("bus0") as node, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.connect(str(socket_path("bus0")))
        stranger.send(b"rubbish")
        stranger.send(bytes(1000))
        assert eventually(lambda: hub.malformed == 2)
        assert node.recv(timeout=0) is None
        assert len(hub.core.nodes) == 2


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
    other = threading.Thread(target=run, args=("bus1", stop))
    other.start()
    try:
        assert eventually(lambda: is_served("bus1"))
        with XilgateBus("bus0") as a, XilgateBus("bus1") as b, XilgateBus("bus0") as c:
            a.send(frame(1))
            assert numbers(c, 1) == [1]
            assert b.recv(timeout=0.05) is None
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
