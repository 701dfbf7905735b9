"""The journal: what goes in comes out, what is cut or garbled ends clearly, whatever it says of itself."""

import io
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbc.frame import CanFrame
from dbc.health import BusState, LinkHealth
from gateway.conditions import Surroundings
from gateway.journal import (
    MAX_RECORD_BYTES,
    Glance,
    JournalError,
    JournalReader,
    StepArguments,
    pack_blocks,
    pack_step,
    pack_value,
    plain,
    unpack_as,
    unpack_step,
)
from gateway.messages import Operation, OperatorRequest
from tests.support.drive import GatewayDrive


def read(content):
    reader = JournalReader(io.BytesIO(content), "a.journal")
    return list(reader), reader.is_cut


def mistake(call, *arguments):
    """What a call says of what it was given; nothing when it takes it."""
    try:
        call(*arguments)
    except JournalError as error:
        return str(error)
    return ""


def steps(count):
    """Arguments and outputs of a gateway that is given something of everything."""
    drive = GatewayDrive()
    links = {"robots": LinkHealth(BusState.ERROR_WARNING, 97, 3, 5_000_000, 1, 17), "navigation": LinkHealth()}
    for number in range(count):
        drive.now_ns += 10_000_000
        request = OperatorRequest(9, number, Operation.ARM, drive.now_ns) if number % 5 == 0 else None
        command = drive.command() if number % 4 == 0 else None
        early, late = (frames := drive.car.speak(drive.now_ns))[:5], frames[5:]
        surroundings, glances = Surroundings(links, False, 0.25), [Glance(drive.now_ns - 1_000_000, early)]
        arguments = StepArguments(drive.now_ns, late, command, request, surroundings, glances)
        output = arguments.step(drive.core)
        drive.car.hear(output.frames)
        yield arguments, output


def test_a_step_comes_back_as_it_was():
    for seq, (arguments, output) in enumerate(steps(20)):
        record = unpack_step(pack_step(seq, arguments, output), "step")
        assert record.seq == seq
        assert record.arguments == arguments
        assert all(type(frame) is CanFrame for frame in record.arguments.frames)
        assert record.sent == output.frames
        assert bytes(record.output) == pack_value(output)
        assert plain(bytes(record.output))["state"]["seq"] == output.state.seq


def test_what_was_received_is_in_the_order_of_its_arrival():
    first, second, third = (CanFrame(number, b"", number) for number in (3, 1, 2))
    assert StepArguments(9, [third], glances=[Glance(7, [first]), Glance(8, [second])]).received == [first, second, third]


def test_equal_values_have_equal_bytes_whatever_the_order_of_what_has_none():
    assert pack_value({"b": 1, "a": frozenset({"x", "y"})}) == pack_value({"a": frozenset({"y", "x"}), "b": 1})
    assert pack_value(1) != pack_value(1.0)
    assert pack_value(np.float64(0.1)) == pack_value(0.1)
    with pytest.raises(NotImplementedError, match="object cannot be recorded"):
        pack_value(object())


@given(st.lists(st.binary(max_size=300), max_size=30))
def test_blocks_give_back_their_records(records):
    assert read(pack_blocks(records)) == (records, False)


def test_many_records_make_several_blocks():
    records = [bytes([n % 251]) * (MAX_RECORD_BYTES - 7) for n in range(40)]
    content = pack_blocks(records)
    assert content.count(b"XGJ1") >= 3
    assert read(content) == (records, False)


def test_a_record_that_is_too_long_is_refused():
    with pytest.raises(ValueError, match=str(MAX_RECORD_BYTES)):
        pack_blocks([bytes(MAX_RECORD_BYTES + 1)])


CONTENT = b"".join(pack_blocks([bytes([n]) * 50 + bytes(range(n))] * 3) for n in range(5))
BLOCK_ENDS = [0, *(sum(len(pack_blocks([bytes([n]) * 50 + bytes(range(n))] * 3)) for n in range(k)) for k in range(1, 6))]


@given(st.integers(0, len(CONTENT)))
def test_a_cut_file_is_good_up_to_its_last_whole_block(length):
    records, is_cut = read(CONTENT[:length])
    whole = max(k for k, end in enumerate(BLOCK_ENDS) if end <= length)
    assert len(records) == 3 * whole
    assert is_cut is (length not in BLOCK_ENDS)


@given(st.integers(0, len(CONTENT) - 1), st.integers(1, 255))
def test_a_wrong_byte_is_one_clear_error(place, difference):
    garbled = bytearray(CONTENT)
    garbled[place] ^= difference
    if not (said := mistake(read, bytes(garbled))):
        # Only a length that points beyond the end cannot be told from a cut.
        records, is_cut = read(bytes(garbled))
        assert is_cut
        assert records == read(CONTENT)[0][: len(records)]
    else:
        assert said.startswith("a.journal: byte ")


@given(st.binary(max_size=400))
def test_any_bytes_are_a_clean_end_or_one_clear_error(content):
    assert "\n" not in mistake(read, content)


@given(st.binary(max_size=200), st.integers(0, 2**32 - 1))
def test_blocks_whose_check_sum_is_right_are_no_more_trusted(content, size):
    compressed = zlib.compress(content)
    block = struct.pack("<4sIII", b"XGJ1", len(compressed), size, zlib.crc32(compressed)) + compressed
    if not mistake(read, block):
        assert size == len(content) == sum(len(record) + 4 for record in read(block)[0])


def test_a_bomb_does_not_fill_the_memory():
    compressed = zlib.compress(bytes(200 << 20), 9)
    block = struct.pack("<4sIII", b"XGJ1", len(compressed), 1 << 20, zlib.crc32(compressed)) + compressed
    huge = struct.pack("<4sIII", b"XGJ1", 0xFFFFFFFF, 0xFFFFFFFF, 0)
    tracemalloc.start()
    for content, problem in ((block, "another length"), (huge, "longer than any block")):
        with pytest.raises(JournalError, match=problem):
            read(content)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 16 << 20


@given(st.binary(max_size=200))
def test_any_record_is_a_step_or_one_clear_error(record):
    assert mistake(unpack_step, record, "a.journal: step 3").startswith("a.journal: step 3: ")


@given(st.data())
def test_a_garbled_step_is_a_step_or_one_clear_error(data):
    record = bytearray(RECORDS[data.draw(st.integers(0, len(RECORDS) - 1))])
    for _ in range(data.draw(st.integers(1, 4))):
        record[data.draw(st.integers(0, len(record) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(record)))
    for content in (bytes(record), bytes(record[:cut])):
        if said := mistake(unpack_step, content, "step"):
            assert said.startswith("step: ")
        else:
            mistake(plain, bytes(unpack_step(content, "step").output))


RECORDS = [pack_step(seq, *step) for seq, step in enumerate(steps(8))]


def test_a_nest_without_end_is_one_clear_error():
    with pytest.raises(JournalError):
        plain(b"\x91" * 100_000)


def test_a_value_of_another_kind_is_named():
    with pytest.raises(JournalError, match=r"x\.journal: session: Expected `int`"):
        unpack_as(int, pack_value("seven"), "x.journal: session")
