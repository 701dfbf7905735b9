"""The sockets of the control path: who gets through, who does not, and what a flood may do."""

import contextlib
import os
import socket
import stat
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from dbc import runtime_directory as runtime
from dbc.errors import SetupFailure
from gateway.channel import (
    MAX_DATAGRAMS_PER_POLL,
    Channel,
    ChannelError,
    OperatorClient,
    OperatorServer,
    control_path,
    operator_client,
)
from gateway.keys import KeyMistake, make_key
from gateway.messages import (
    HORIZON_STEPS,
    MAX_DATAGRAM_BYTES,
    CommandStatus,
    ControlCommand,
    Mode,
    Operation,
    OperatorReply,
    OperatorRequest,
    VehicleState,
    pack,
)

KEY = bytes(range(32))
OTHER_KEY = bytes(32)
STATE = VehicleState(1, 2, 3, Mode.READY, True, *[1.0] * 9)
COMMAND = ControlCommand(1, 2, 3, 4, CommandStatus.OK, 5, *[0.1] * 4, (0.1,) * HORIZON_STEPS, (0.2,) * HORIZON_STEPS)


@pytest.fixture
def ends(tmp_path):
    """The gateway's end and the controller's."""
    paths = tmp_path / "gateway", tmp_path / "controller"
    with Channel(paths[0], paths[1], KEY) as gateway, Channel(paths[1], paths[0], KEY) as controller:
        yield gateway, controller


@pytest.fixture
def stranger():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as unknown:
        unknown.setblocking(False)
        yield unknown


@pytest.fixture
def server(tmp_path):
    with OperatorServer(tmp_path / "operator", KEY) as server:
        yield server


@contextlib.contextmanager
def serving(server, refusals=()):
    """A gateway that answers every request, on a thread of its own."""
    stop, seen = threading.Event(), []

    def run():
        while not stop.is_set():
            if (request := server.next_request()) is not None:
                seen.append(request)
                server.reply(OperatorReply(request.boot_id, request.seq, request.operation, Mode.READY, refusals))
            time.sleep(0.002)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield seen
    finally:
        stop.set()
        thread.join()


def test_the_newest_wins_in_both_directions(ends):
    gateway, controller = ends
    for seq in range(3):
        gateway.send(replace(STATE, seq=seq))
        controller.send(replace(COMMAND, seq=seq))
    assert controller.newest(VehicleState) == replace(STATE, seq=2)
    assert gateway.newest(ControlCommand) == replace(COMMAND, seq=2)
    assert gateway.newest(ControlCommand) is None
    assert (gateway.rejected, gateway.unsent, controller.rejected, controller.unsent) == (0, 0, 0, 0)


def test_a_peer_that_does_not_keep_up_is_counted_and_heard_again(ends):
    gateway, controller = ends
    for seq in range(2000):
        gateway.send(replace(STATE, seq=seq))
    assert gateway.unsent > 0
    lost = gateway.unsent
    assert controller.newest(VehicleState) is not None
    gateway.send(replace(STATE, seq=5000))
    assert gateway.unsent == lost
    assert controller.newest(VehicleState).seq == 5000


def test_a_controller_may_come_late_and_come_again(tmp_path):
    """Each end finds the other again by itself, and what a dead one left behind is no hindrance."""
    paths = tmp_path / "gateway", tmp_path / "controller"
    with Channel(paths[0], paths[1], KEY) as gateway:
        gateway.send(STATE)
        assert gateway.unsent == 1
        for boot_id in (7, 8):
            controller = Channel(paths[1], paths[0], KEY)
            for _ in range(3):  # a tick or two until the new one is found
                gateway.send(STATE)
                controller.send(replace(COMMAND, boot_id=boot_id))
            assert controller.newest(VehicleState) == STATE
            assert gateway.newest(ControlCommand).boot_id == boot_id
            controller._socket.close()  # as kill -9 does: its name stays
            assert paths[1].exists()
        assert gateway.rejected == 0


def test_a_gateway_may_come_again_while_the_controller_waits(tmp_path, monkeypatch):
    """Its systemd unit restarts it; a controller that has nothing to answer sends nothing that could tell it so."""
    ticks_ns = iter(range(0, 10**9, 10_000_000))
    monkeypatch.setattr("gateway.channel.time", SimpleNamespace(monotonic_ns=lambda: next(ticks_ns)))
    paths = tmp_path / "gateway", tmp_path / "controller"
    with Channel(paths[1], paths[0], KEY) as controller:
        for boot_id in (7, 8, 9):
            gateway = Channel(*paths, KEY)
            found = []
            for _ in range(4):
                gateway.send(replace(STATE, boot_id=boot_id))
                found.append(controller.newest(VehicleState))
            assert found[-1].boot_id == boot_id
            assert controller.newest(VehicleState) is None  # from here on the kernel lets in this gateway alone
            gateway._socket.close()


@pytest.mark.req("S2", "F5")
def test_another_key_counts_as_junk(tmp_path):
    paths = tmp_path / "gateway", tmp_path / "controller"
    with Channel(paths[0], paths[1], KEY) as gateway, Channel(paths[1], paths[0], OTHER_KEY) as controller:
        controller.send(COMMAND)
        assert gateway.newest(ControlCommand) is None
        assert gateway.rejected == 1


def test_a_command_behind_a_broken_connection_is_found_in_the_same_poll(ends, tmp_path, stranger):
    gateway, controller = ends
    assert gateway.newest(ControlCommand) is None
    stranger.bind(str(tmp_path / "elsewhere"))
    gateway.send(STATE)  # the kernel tells the gateway once that nobody will read this
    controller._socket.connect(str(tmp_path / "elsewhere"))
    controller._connect()
    controller.send(replace(COMMAND, seq=9))
    assert gateway.newest(ControlCommand) == replace(COMMAND, seq=9)


@pytest.mark.req("S2")
def test_a_request_is_no_business_of_the_controllers_socket(ends):
    gateway, controller = ends
    assert gateway.newest(ControlCommand) is None
    controller._socket.send(pack(OperatorRequest(1, 2, Operation.ENGAGE, 3), KEY))
    assert gateway.newest(ControlCommand) is None
    assert gateway.rejected == 1


@pytest.mark.req("S2", "F17")
def test_the_kernel_refuses_whoever_is_not_the_peer(ends, stranger, tmp_path):
    gateway, controller = ends
    gateway.send(STATE)
    controller.send(COMMAND)
    for path in ("gateway", "controller"):
        with pytest.raises(PermissionError):
            stranger.sendto(pack(COMMAND, KEY), str(tmp_path / path))
        with pytest.raises(PermissionError):
            stranger.connect(str(tmp_path / path))
    assert gateway.newest(ControlCommand) == COMMAND
    assert gateway.rejected == 0


@pytest.mark.req("F17")
def test_junk_before_the_controller_is_there_is_bounded_counted_and_gone(tmp_path, stranger):
    paths = tmp_path / "gateway", tmp_path / "controller"
    with Channel(paths[0], paths[1], KEY) as gateway:
        sent = 0
        with contextlib.suppress(BlockingIOError):
            for k in range(100_000):
                stranger.sendto(bytes([k % 256]) * (4000 if k % 2 else 100), str(paths[0]))
                sent += 1
        assert 0 < sent < 100_000  # the kernel's queue is what bounds it
        for _ in range(1 + sent // MAX_DATAGRAMS_PER_POLL):
            assert gateway.newest(ControlCommand) is None
        assert gateway.rejected == sent
        with Channel(paths[1], paths[0], KEY) as controller:
            gateway.send(STATE)
            controller.send(COMMAND)
            assert gateway.newest(ControlCommand) == COMMAND


class Endless:
    """A socket on which there is always another datagram."""

    def __init__(self, datagram):
        self.calls = []
        self._datagram = datagram

    def recv(self, size):
        assert len(self.calls) < 10_000, "it never ends"
        self.calls.append(size)
        return self._datagram

    def recvfrom(self, size):
        return self.recv(size), None


@pytest.mark.req("F17", "S3")
def test_one_poll_is_bounded(ends, server, monkeypatch):
    """However fast somebody sends, with the key or without, a tick looks at so many datagrams: docs/security.md has the numbers."""
    gateway, _ = ends
    assert gateway.newest(ControlCommand) is None
    commands, junk = Endless(pack(COMMAND, KEY)), Endless(b"junk")
    with monkeypatch.context() as patched:
        patched.setattr(gateway, "_socket", commands)
        patched.setattr(server, "_socket", junk)
        assert gateway.newest(ControlCommand) == COMMAND
        assert server.next_request() is None
    assert commands.calls == junk.calls == [MAX_DATAGRAM_BYTES] * MAX_DATAGRAMS_PER_POLL == [2048] * 256


def flood(path, stop):
    """Junk of all sizes, as fast as the receiver's queue takes it."""
    sizes, sent = [1, 16, 569, MAX_DATAGRAM_BYTES + 1, 60_000], 0
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as junk:
        junk.setblocking(False)
        while not stop.is_set():
            try:
                junk.sendto(b"j" * sizes[sent % len(sizes)], str(path))
                sent += 1
            except OSError:
                time.sleep(0.0001)
    return sent


@pytest.mark.req("F17")
def test_commands_get_through_a_flood_on_every_socket(ends, server, tmp_path):
    gateway, controller = ends
    assert gateway.newest(ControlCommand) is None  # a tick later the gateway has found its controller
    stop = threading.Event()
    floods = [threading.Thread(target=flood, args=(tmp_path / name, stop)) for name in ("gateway", "controller", "operator")]
    for thread in floods:
        thread.start()
    received = []
    try:
        for seq in range(100):
            gateway.send(replace(STATE, seq=seq))
            assert controller.newest(VehicleState).seq == seq
            controller.send(replace(COMMAND, seq=seq))
            received.append(gateway.newest(ControlCommand))
            server.next_request()
            time.sleep(0.002)
    finally:
        stop.set()
        for thread in floods:
            thread.join()
    assert [command and command.seq for command in received] == list(range(100))
    assert (gateway.unsent, gateway.rejected, controller.unsent, controller.rejected) == (0, 0, 0, 0)
    assert server.rejected > 100


@pytest.mark.req("F17")
def test_an_operator_gets_through_a_flood(server, tmp_path):
    stop = threading.Event()
    thread = threading.Thread(target=flood, args=(tmp_path / "operator", stop))
    thread.start()
    try:
        with serving(server), OperatorClient(tmp_path / "operator", KEY) as client:
            for _ in range(5):
                assert client.ask(Operation.STOP, timeout_s=10.0).operation is Operation.STOP
    finally:
        stop.set()
        thread.join()
    assert server.rejected > 0


def test_each_operator_gets_his_own_answer(server, tmp_path):
    path = tmp_path / "operator"
    with serving(server, ("no command", "bus-off")) as seen, OperatorClient(path, KEY) as ann, OperatorClient(path, KEY) as bob:
        assert ann.ask(Operation.ARM).refusals == ("no command", "bus-off")
        assert bob.ask(Operation.ENGAGE).operation is Operation.ENGAGE
        assert ann.ask(Operation.RESET).operation is Operation.RESET
        assert ann._socket.gettimeout() == 0.0  # who does not ask does not wait
        assert (ann.reply(), bob.reply()) == (None, None)
    assert [(request.seq, request.operation) for request in seen] == [(1, Operation.ARM), (1, Operation.ENGAGE), (2, Operation.RESET)]
    assert seen[0].boot_id == seen[2].boot_id != seen[1].boot_id
    assert all(0 <= time.monotonic_ns() - request.t_ns < 60e9 for request in seen)


def test_requests_wait_for_their_turn_and_none_is_lost(server, tmp_path):
    with OperatorClient(tmp_path / "operator", KEY) as client:
        for operation in (Operation.ENGAGE, Operation.STOP):
            client.send(operation)
        assert server.next_request().operation is Operation.ENGAGE
        server.reply(OperatorReply(1, 1, Operation.ENGAGE, Mode.STANDBY, ()))
        assert server.next_request().operation is Operation.STOP
        assert server.next_request() is None
        assert client.reply().operation is Operation.ENGAGE
        assert client.reply() is None


def test_answers_that_nobody_takes_are_counted(server, tmp_path, stranger):
    with OperatorClient(tmp_path / "operator", KEY) as client:
        client.send(Operation.STOP)
        request = server.next_request()
    server.reply(OperatorReply(1, 1, Operation.STOP, Mode.STANDBY, ()))
    assert server.unsent == 1
    stranger.sendto(pack(request, KEY), str(tmp_path / "operator"))  # has no name to answer to
    assert server.next_request() == request
    server.reply(OperatorReply(1, 1, Operation.STOP, Mode.STANDBY, ()))
    assert server.unsent == 2


def test_requests_that_nobody_takes_are_counted(tmp_path):
    with OperatorServer(tmp_path / "operator", KEY):
        client = OperatorClient(tmp_path / "operator", KEY)
    with client:
        client.send(Operation.STOP)
        assert client.unsent == 1


@pytest.mark.req("S2")
def test_requests_without_the_key_and_other_kinds_are_no_requests(server, tmp_path, stranger):
    with OperatorClient(tmp_path / "operator", OTHER_KEY) as client:
        client.send(Operation.ARM)
        stranger.sendto(pack(COMMAND, KEY), str(tmp_path / "operator"))
        assert server.next_request() is None
        assert server.rejected == 2
        with pytest.raises(ChannelError, match="the gateway hangs, or has another key"):
            client.ask(Operation.ARM, timeout_s=0.05)


@pytest.mark.req("S2")
def test_an_answer_without_the_key_or_to_somebody_else_is_none(server, tmp_path):
    with OperatorClient(tmp_path / "operator", KEY) as client:
        client.send(Operation.ARM)
        request = server.next_request()
        granted = OperatorReply(request.boot_id, request.seq, request.operation, Mode.READY, ())
        server._socket.sendto(pack(granted, OTHER_KEY), server._asker)
        assert client.reply() is None
        server.reply(replace(granted, boot_id=request.boot_id ^ 1, seq=2))
        server.reply(replace(granted, seq=1))
        with pytest.raises(ChannelError, match="no answer"):
            client.ask(Operation.ARM, timeout_s=0.05)


def test_without_a_gateway_the_operator_is_told_so(tmp_path):
    with pytest.raises(ChannelError, match=f"no gateway listens on {tmp_path}/operator"):
        OperatorClient(tmp_path / "operator", KEY)
    with pytest.raises(ChannelError, match=r"no gateway listens on .*operator\.sock; `--control` or a rig file"):
        operator_client(control_path(tmp_path / "nowhere"))
    assert list(tmp_path.iterdir()) == []


def test_a_socket_in_use_is_refused_and_a_dead_one_taken_over(tmp_path, stranger):
    paths = tmp_path / "gateway", tmp_path / "controller"
    with Channel(*paths, KEY) as gateway:
        with pytest.raises(ChannelError, match="in use"):
            Channel(*paths, KEY)
        with Channel(paths[1], paths[0], KEY):
            gateway.send(STATE)
            with pytest.raises(ChannelError, match="in use"):  # also when the kernel lets nobody else in
                Channel(*paths, KEY)
    stranger.bind(str(paths[0]))
    stranger.close()
    with Channel(*paths, KEY):
        assert stat.S_ISSOCK(paths[0].stat().st_mode)
    assert not paths[0].exists()


def test_a_socket_that_cannot_be_is_one_line(tmp_path):
    for path in (tmp_path / "nowhere" / "gateway", tmp_path / ("x" * 200)):
        with pytest.raises((ChannelError, OSError)) as caught:
            Channel(path, tmp_path / "controller", KEY)
        assert isinstance(caught.value, ChannelError)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


@pytest.mark.req("S1")
@pytest.mark.parametrize(("umask", "mode"), [(0o077, 0o600), (0o022, 0o640), (0o007, 0o660), (0o000, 0o660)])
def test_sockets_never_let_others_in(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with OperatorServer(tmp_path / "operator", KEY), Channel(tmp_path / "gateway", tmp_path / "controller", KEY):
            modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("operator", "gateway")}
    finally:
        os.umask(before)
    assert modes == {mode}


@pytest.mark.req("S1")
def test_by_default_all_is_in_a_directory_of_the_users_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    control = control_path()
    assert control.directory == tmp_path / "xilgate"
    assert stat.S_IMODE(control.directory.stat().st_mode) == 0o700
    sockets = (control.gateway_socket, control.controller_socket, control.operator_socket)
    assert {path.parent for path in sockets} == {control.directory}
    assert len(set(sockets)) == 3
    key = control.key()
    assert key == control.key() == control_path().key()
    assert control_path(tmp_path).key() != key
    control.directory.chmod(0o755)
    with pytest.raises(SetupFailure, match="expected a directory of user"):
        control_path()


@pytest.mark.req("S1")
def test_without_a_run_time_directory_it_is_still_the_users_own(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(runtime, "Path", lambda text, *more: Path(str(text).replace("/tmp", str(tmp_path)), *more))
    directory = control_path().directory
    assert directory == tmp_path / f"xilgate-{os.getuid()}"
    directory.rmdir()
    directory.symlink_to("/")
    with pytest.raises(SetupFailure, match="expected a directory of user"):
        control_path()


@pytest.mark.req("S1")
def test_a_key_file_that_is_named_must_be_there(tmp_path):
    with pytest.raises(KeyMistake, match="no such file"):
        control_path(tmp_path, tmp_path / "rig.key").key()
    assert list(tmp_path.iterdir()) == []
    make_key(tmp_path / "rig.key")
    assert len(control_path(tmp_path, tmp_path / "rig.key").key()) == 32
