"""Packets on a stream: whole, in order, and none in part for good, however slowly the other end reads."""

import select
import socket

import pytest

from vehicle_emulator.bus.connection import PacketConnection, StreamConnection
from vehicle_emulator.bus.wire import MAX_PACKET_BYTES, WireError

PATIENCE_S = 20.0


@pytest.fixture
def stream():
    """Two ends of one stream, the first with a send buffer as small as the kernel allows."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        sending = socket.create_connection(listener.getsockname())
        ends = sending, listener.accept()[0]
    for end in ends:
        end.setblocking(False)
    sending.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    connections = [StreamConnection(end) for end in ends]
    yield connections
    for connection in connections:
        connection.close()


def read_all(connection) -> list[bytes]:
    packets = []
    while True:
        try:
            packets.append(connection.receive())
        except BlockingIOError:
            return packets


def is_taken(connection, packet) -> bool:
    try:
        connection.send(packet)
    except BlockingIOError:
        return False
    return True


def test_a_slow_reader_gets_whole_packets_with_gaps(stream):
    sender, reader = stream
    taken, received, split = [], [], 0
    for number in range(2000):
        packet = number.to_bytes(4, "little") * 700
        if is_taken(sender, packet):
            taken.append(packet)
        split += not sender.flush()
        if number % 9 == 0:
            received += read_all(reader)
    while len(received) < len(taken):
        sender.flush()
        select.select([reader], [], [], 1.0)
        received += read_all(reader)
    assert received == taken
    assert 0 < len(taken) < 2000
    assert split > 0


def test_a_packet_that_arrives_in_pieces(stream):
    sender, reader = stream
    for byte in b"\x03\x00abc":
        assert read_all(reader) == []
        sender._socket.send(bytes([byte]))
        select.select([reader], [], [], PATIENCE_S)
    assert read_all(reader) == [b"abc"]


@pytest.mark.parametrize("length", [0, MAX_PACKET_BYTES + 1, 0xFFFF])
def test_a_length_that_no_packet_has(stream, length):
    sender, reader = stream
    sender._socket.send(length.to_bytes(2, "little"))
    select.select([reader], [], [], PATIENCE_S)
    with pytest.raises(WireError, match=f"packet of {length} bytes, expected 1 to {MAX_PACKET_BYTES}"):
        reader.receive()


def test_the_end_of_a_stream_even_within_a_packet(stream):
    sender, reader = stream
    sender._socket.send(b"\x03\x00a")
    sender.close()
    reader._socket.settimeout(PATIENCE_S)  # waits for either of the two to arrive
    assert reader.receive() == b""


def test_a_packet_socket_gives_what_was_sent_before_a_reset():
    ours, theirs = (PacketConnection(end) for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    ours.send(b"unread")
    theirs.send(b"last words")
    theirs._socket.close()
    assert ours.receive() == b"last words"
    assert ours.receive() == b""
    ours.close()
