"""Wire form of the control path."""

import math
import socket
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.channel import Channel, ChannelError
from gateway.messages import (
    HORIZON_STEPS,
    CommandStatus,
    ControlCommand,
    Mode,
    Operation,
    OperatorRequest,
    VehicleState,
    pack,
    unpack,
)

finite = st.floats(allow_nan=False, allow_infinity=False)
plan = st.tuples(*[finite] * HORIZON_STEPS)
u64 = st.integers(0, 2**64 - 1)
u32 = st.integers(0, 2**32 - 1)

states = st.builds(
    VehicleState, u32, u64, u64, st.sampled_from(Mode), st.booleans(), *[finite] * 9,
)
commands = st.builds(
    ControlCommand, u32, u64, u64, u64, st.sampled_from(CommandStatus), u64, finite, finite, plan, plan
)
requests = st.builds(OperatorRequest, u32, u64, st.sampled_from(Operation))


@given(st.one_of(states, commands, requests))
def test_round_trip(message):
    assert unpack(pack(message)) == message


@given(states, st.data())
def test_any_changed_byte_is_rejected(message, data):
    wire = bytearray(pack(message))
    wire[data.draw(st.integers(0, len(wire) - 1))] ^= data.draw(st.integers(1, 255))
    assert unpack(bytes(wire)) is None


@given(st.binary(max_size=700))
def test_junk_is_rejected(junk):
    assert unpack(junk) is None


@given(st.binary(max_size=64), st.integers(0, 255))
def test_junk_with_good_header_and_crc_is_rejected(body, kind):
    content = struct.pack("<HBBIQ", 0x4758, 1, kind, 1, 1) + body
    message = unpack(content + struct.pack("<I", zlib.crc32(content)))
    # The only body this short that means anything is an operator's request of one byte.
    assert message is None or (isinstance(message, OperatorRequest) and len(body) == 1)


def test_not_finite_is_rejected():
    state = VehicleState(1, 1, 0, Mode.READY, True, math.nan, *[0.0] * 8)
    assert unpack(pack(state)) is None


def test_channel_keeps_the_newest_and_counts_junk(tmp_path):
    with Channel(str(tmp_path / "a"), None) as receiver, Channel(None, str(tmp_path / "a")) as sender:
        for seq in range(5):
            sender.send(OperatorRequest(1, seq, Operation.ENGAGE))
        sender._socket.sendto(b"junk", str(tmp_path / "a"))
        newest = receiver.newest(OperatorRequest)
        assert newest is not None
        assert newest.seq == 4
        assert receiver.newest(OperatorRequest) is None
        assert receiver.newest(VehicleState) is None
        assert receiver.rejected == 1


def test_channel_without_a_listener_counts(tmp_path):
    with Channel(None, str(tmp_path / "nobody")) as sender:
        sender.send(OperatorRequest(1, 1, Operation.RESET))
        assert sender.unsent == 1


def test_a_socket_in_use_is_refused_and_a_dead_one_taken_over(tmp_path):
    path = str(tmp_path / "a")
    with Channel(path, None), pytest.raises(ChannelError, match="in use"):
        Channel(path, None)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(path)
    with Channel(path, None) as receiver, Channel(None, path) as sender:
        sender.send(OperatorRequest(1, 1, Operation.RESET))
        assert receiver.newest(OperatorRequest) is not None
