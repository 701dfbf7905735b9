"""Wire form of the control path."""

import math
import struct
from dataclasses import replace
from hashlib import blake2b

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.messages import (
    HORIZON_STEPS,
    MAX_DATAGRAM_BYTES,
    CommandStatus,
    ControlCommand,
    Kind,
    Mode,
    Operation,
    OperatorReply,
    OperatorRequest,
    VehicleState,
    pack,
    unpack,
)

KEY = bytes(range(32))
OTHER_KEY = bytes(range(1, 33))
MAGIC, VERSION = 0x4758, 3
FUZZED = settings(max_examples=5_000, deadline=None)

finite = st.floats(allow_nan=False, allow_infinity=False)
plan = st.tuples(*[finite] * HORIZON_STEPS)
u64 = st.integers(0, 2**64 - 1)
u32 = st.integers(0, 2**32 - 1)
names = st.text(st.characters(codec="ascii", exclude_categories=["C"]), min_size=1, max_size=60)

states = st.builds(VehicleState, u32, u64, u64, st.sampled_from(Mode), st.booleans(), *[finite] * 9)
commands = st.builds(ControlCommand, u32, u64, u64, u64, st.sampled_from(CommandStatus), u64, *[finite] * 4, plan, plan)
requests = st.builds(OperatorRequest, u32, u64, st.sampled_from(Operation), u64)
replies = st.builds(OperatorReply, u32, u64, st.sampled_from(Operation), st.sampled_from(Mode), st.lists(names, max_size=12).map(tuple))

STATE = VehicleState(1, 2, 3, Mode.READY, True, *[1.0] * 9)
COMMAND = ControlCommand(1, 2, 3, 4, CommandStatus.OK, 5, *[0.1] * 4, (0.1,) * HORIZON_STEPS, (0.2,) * HORIZON_STEPS)
REQUEST = OperatorRequest(1, 2, Operation.ARM, 3)
REPLY = OperatorReply(1, 2, Operation.ARM, Mode.STANDBY, ("no command", "bus-off"))
ONE_OF_EACH = pytest.mark.parametrize("message", [STATE, COMMAND, REQUEST, REPLY], ids=lambda message: type(message).__name__)


def signed(kind, body, *, magic=MAGIC, version=VERSION, key=KEY):
    """What somebody would send who has the key and other ideas of the rest."""
    content = struct.pack("<HBBIQ", magic, version, kind, 1, 1) + body
    return content + blake2b(content, key=key, digest_size=16).digest()


@given(st.one_of(states, commands, requests, replies))
@example(COMMAND)
def test_round_trip(message):
    assert unpack(pack(message, KEY), KEY) == message


@ONE_OF_EACH
def test_the_wire_form_is_documented_and_stable(message):
    """Against an encoder of our own, so that both ends cannot drift together."""
    body = {
        STATE: lambda: struct.pack("<QB?9d", 3, 1, True, *[1.0] * 9),
        COMMAND: lambda: struct.pack("<QQBQ64d", 3, 4, 0, 5, *[0.1] * 34, *[0.2] * 30),
        REQUEST: lambda: struct.pack("<BQ", 4, 3),
        REPLY: lambda: struct.pack("<BB", 4, 0) + b"no command\x1fbus-off",
    }[message]()
    kind = {VehicleState: 1, ControlCommand: 2, OperatorRequest: 3, OperatorReply: 4}[type(message)]
    content = struct.pack("<HBBIQ", MAGIC, VERSION, kind, 1, 2) + body
    assert pack(message, KEY) == content + blake2b(content, key=KEY, digest_size=16).digest()


@pytest.mark.req("S2", "F5")
@ONE_OF_EACH
def test_without_the_key_nothing_is_a_message(message):
    assert unpack(pack(message, OTHER_KEY), KEY) is None
    assert unpack(pack(message, KEY)[:-16] + bytes(16), KEY) is None


@pytest.mark.req("F5")
@ONE_OF_EACH
def test_every_changed_bit_is_rejected(message):
    wire = pack(message, KEY)
    for bit in range(8 * len(wire)):
        changed = bytearray(wire)
        changed[bit // 8] ^= 1 << bit % 8
        assert unpack(bytes(changed), KEY) is None, bit


@pytest.mark.req("F5")
@ONE_OF_EACH
def test_every_other_length_is_rejected(message):
    wire = pack(message, KEY)
    for length in range(len(wire)):
        assert unpack(wire[:length], KEY) is None
    for longer in (1, 2048 - len(wire), 60_000):
        assert unpack(wire + bytes(longer), KEY) is None


@pytest.mark.req("F5")
@pytest.mark.parametrize(("raw", "is_valid"), [(0, False), (1, True), (2, None), (0xFC, None), (0xFF, None)])
def test_a_yes_or_no_is_one_or_zero(raw, is_valid):
    state = unpack(signed(Kind.VEHICLE_STATE, struct.pack("<QBB9d", 3, 1, raw, *[1.0] * 9)), KEY)
    assert state is None if is_valid is None else state.is_valid is is_valid


@pytest.mark.req("F5")
@ONE_OF_EACH
def test_another_version_or_magic_is_rejected_whoever_signed_it(message):
    kind = Kind.OPERATOR_REQUEST
    body = struct.pack("<BQ", Operation.STOP, 7)
    assert unpack(signed(kind, body), KEY) == OperatorRequest(1, 1, Operation.STOP, 7)
    assert unpack(signed(kind, body, version=VERSION - 1), KEY) is None
    assert unpack(signed(kind, body, version=VERSION + 1), KEY) is None
    assert unpack(signed(kind, body, magic=MAGIC + 1), KEY) is None


@pytest.mark.req("F5")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_not_finite_is_rejected_in_every_place(value):
    for name in ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps", "ax_mps2", "steer_rad", "drive_norm"):
        assert unpack(pack(replace(STATE, **{name: value}), KEY), KEY) is None, name
    for name in ("lateral_error_m", "heading_error_rad", "steer_rad", "drive_norm"):
        assert unpack(pack(replace(COMMAND, **{name: value}), KEY), KEY) is None, name
    for name in ("plan_steer_rad", "plan_drive_norm"):
        for k in range(HORIZON_STEPS):
            demands = tuple(value if i == k else 0.0 for i in range(HORIZON_STEPS))
            assert unpack(pack(replace(COMMAND, **{name: demands}), KEY), KEY) is None, (name, k)


@pytest.mark.req("F5")
def test_enumerations_know_their_values_only():
    for value in range(256):
        state = unpack(signed(Kind.VEHICLE_STATE, struct.pack("<QB?9d", 0, value, True, *[0.0] * 9)), KEY)
        assert (state is not None) is (value in list(Mode))
        command = unpack(signed(Kind.CONTROL_COMMAND, struct.pack("<QQBQ64d", 0, 0, value, 0, *[0.0] * 64)), KEY)
        assert (command is not None) is (value in list(CommandStatus))
        request = unpack(signed(Kind.OPERATOR_REQUEST, struct.pack("<BQ", value, 0)), KEY)
        assert (request is not None) is (value in list(Operation))
        reply = unpack(signed(Kind.OPERATOR_REPLY, struct.pack("<BB", 1, value)), KEY)
        assert (reply is not None) is (value in list(Mode))
        if value not in list(Kind):
            assert unpack(signed(value, struct.pack("<BQ", 1, 0)), KEY) is None


def test_refusals_that_do_not_fit_are_cut_and_never_too_long_for_the_reader():
    reply = replace(REPLY, refusals=("brake not pressed: größer",) * 200)
    wire = pack(reply, KEY)
    assert len(wire) <= MAX_DATAGRAM_BYTES
    received = unpack(wire, KEY)
    assert isinstance(received, OperatorReply)
    assert received.refusals[0] == "brake not pressed: gr??er"
    assert len(received.refusals) > 30


@pytest.mark.req("F5", "S3")
@FUZZED
@given(st.binary(max_size=MAX_DATAGRAM_BYTES + 100))
def test_junk_is_rejected(junk):
    assert unpack(junk, KEY) is None


@pytest.mark.req("F5", "S3")
@FUZZED
@given(st.integers(0, 8), st.binary(max_size=700))
def test_junk_of_somebody_with_the_key_is_a_message_or_rejected(kind, body):
    message = unpack(signed(kind, body), KEY)
    assert message is None or isinstance(message, OperatorRequest | OperatorReply | VehicleState | ControlCommand)


@pytest.mark.req("F5", "S3")
@FUZZED
@given(st.sampled_from([STATE, COMMAND, REQUEST, REPLY]), st.integers(0, 568), st.binary(max_size=8))
def test_a_message_with_bytes_of_somebody_else_is_rejected(message, place, foreign):
    wire = bytearray(pack(message, KEY))
    wire[place : place + len(foreign)] = foreign
    assert (unpack(bytes(wire), KEY) == message) is (bytes(wire) == pack(message, KEY))
