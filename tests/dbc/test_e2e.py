"""End-to-end protection: every message of the DBC files, every small error, and the receiver's rules against a naive model of them."""

import random
from dataclasses import FrozenInstanceError
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc import e2e
from dbc.catalogue import GNSS_IMU_DBC, load
from dbc.e2e import E2EProtector, E2EReceiver, E2EState, E2EStatus, E2EWindow, WindowRules, alive_counter, data_id_list, seal

SUPPORT = Path(__file__).parent.parent / "support"
CATALOGUES = {"robots": load(), "site": load([SUPPORT / "site_robots.dbc", GNSS_IMU_DBC], SUPPORT / "site_mapping.toml")}
PROTECTED = [(kind, spec.name) for kind, found in CATALOGUES.items() for spec in found.by_name.values() if spec.e2e_data_id is not None]
MS = 1_000_000


def payload_of(kind, name):
    """A payload of the message with something in it, and its data id."""
    catalogue = CATALOGUES[kind]
    return catalogue.encode(name, {}), catalogue.by_name[name].e2e_data_id


def crc8h2f(data):
    """CRC-8 of AUTOSAR, polynomial 0x2F, bit by bit as its specification states it."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF


def test_the_crc_is_that_of_autosar():
    assert crc8h2f(b"123456789") == 0xDF  # check value in the specification of the CRC library
    rng = random.Random(1)
    for _ in range(500):
        length, data_id, counter = rng.randint(2, 8), rng.randint(1, 255), rng.randrange(16)
        sealed = seal(rng.randbytes(length), data_id, counter)
        assert sealed[0] == crc8h2f(sealed[1:] + bytes([data_id]))


def test_golden_vectors():
    # Counter 3 in the low nibble, the high one kept; CRC of 53 01 02 03 04 05 06 11 (hexadecimal) worked out with the function above.
    assert seal(bytes.fromhex("ff5c010203040506"), 0x11, 3).hex() == "68" + "53010203040506"
    assert seal(bytes(8), 0xA0, 0).hex() == "b1" + "00" * 7
    assert E2EProtector(0xA0).protect(b"\xaa" + bytes(7)) == seal(bytes(8), 0xA0, 0)


def test_a_seal_changes_nothing_else():
    payload = bytes(range(0x18, 0x20))
    for counter in range(16):
        sealed = seal(payload, 7, counter)
        assert (sealed[1] & 0xF0, sealed[2:], alive_counter(sealed)) == (payload[1] & 0xF0, payload[2:], counter)
    assert payload == bytes(range(0x18, 0x20))
    assert data_id_list(9) == b"\x09" * 16


def test_a_sender_counts_from_zero_and_round():
    protector = E2EProtector(5)
    assert [alive_counter(protector.protect(bytes(8))) for _ in range(34)] == [*range(16), *range(16), 0, 1]


@pytest.mark.parametrize(("kind", "name"), PROTECTED)
def test_protected_stream_is_accepted_and_that_of_any_other_message_is_not(kind, name):
    payload, data_id = payload_of(kind, name)
    protector, receiver = E2EProtector(data_id), E2EReceiver(data_id)
    assert [receiver.check(protector.protect(payload)) for _ in range(40)] == [E2EStatus.INITIAL] + [E2EStatus.OK] * 39
    for other_kind, other in PROTECTED:
        if other_kind == kind and other != name:
            foreign = E2EReceiver(CATALOGUES[kind].by_name[other].e2e_data_id)
            assert {foreign.check(protector.protect(payload)) for _ in range(16)} == {E2EStatus.WRONG_CRC}


@pytest.mark.req("F7")
@pytest.mark.parametrize(("kind", "name"), PROTECTED)
def test_every_error_of_one_and_two_bits_is_found_in_every_message(kind, name):
    payload, data_id = payload_of(kind, name)
    one_bit = [1 << bit for bit in range(8 * len(payload))]
    masks = one_bit + [one | other for one, other in combinations(one_bit, 2)]
    receiver = E2EReceiver(data_id)
    for counter in range(16):
        wire = int.from_bytes(seal(payload, data_id, counter), "little")
        judged = {receiver.check((wire ^ mask).to_bytes(len(payload), "little")) for mask in masks}
        assert judged == {E2EStatus.WRONG_CRC}


def test_every_error_of_three_bits_and_every_burst_of_a_byte_is_found():
    wire = int.from_bytes(seal(CATALOGUES["robots"].encode("SR_Command", {"AngleCommand": 12.5}), 17, 0), "big")
    masks = {(1 << i) | (1 << j) | (1 << k) for i, j, k in combinations(range(64), 3)}
    # A burst is contiguous in the order of transmission; the CRC itself comes first, though it is worked out last.
    masks |= {pattern << shift for pattern in range(1, 256) for shift in range(49)}
    receiver = E2EReceiver(17)
    assert [mask for mask in masks if receiver.check((wire ^ mask).to_bytes(8, "big")) is not E2EStatus.WRONG_CRC] == []


@pytest.mark.req("F7")
def test_random_corruption_is_found(figure):
    """Whatever the rest is, one CRC of 256 fits; of the frames that it lets pass, the counter stops most."""
    rng = random.Random(7)
    for _ in range(300):
        body = rng.randbytes(7)
        assert sum(E2EReceiver(33).check(bytes([crc]) + body) is not E2EStatus.WRONG_CRC for crc in range(256)) == 1
    receiver, frames, passed_crc, passed = E2EReceiver(33), 100_000, 0, 0
    for _ in range(frames):
        status = receiver.check(rng.randbytes(8))
        passed_crc += status is not E2EStatus.WRONG_CRC
        passed += status.is_usable
    caught, caught_by_crc = 1 - passed / frames, 1 - passed_crc / frames
    figure(f"random corruption caught: {caught:.3%} (target >= 99.6 %), by the CRC alone {caught_by_crc:.3%}, of {frames} frames")
    assert caught >= 0.996
    assert caught_by_crc == pytest.approx(255 / 256, abs=0.001)


@pytest.mark.parametrize("length", range(2, 9))
def test_a_stuck_bus_passes_under_few_data_ids_which_are_known(length):
    payloads = (bytes(length), b"\xff" * length)
    passing = {data_id for data_id in range(256) if any(E2EReceiver(data_id).check(one) is not E2EStatus.WRONG_CRC for one in payloads)}
    assert {data_id for data_id in range(256) if not e2e.tells_stuck_bits(data_id, length)} == passing
    assert len(passing) == 2
    assert length != 8 or 232 in passing


class NaiveReceiver:
    """What the receiver is to say of frames that are given as counters, None for one with a wrong CRC."""

    def __init__(self, max_delta):
        self.max_delta = max_delta
        self.last = None

    def check(self, counter):
        if counter is None:
            return E2EStatus.WRONG_CRC
        last, self.last = self.last, counter
        if last is None:
            return E2EStatus.INITIAL
        allowed = {last: E2EStatus.REPEATED}
        for delta in range(1, self.max_delta + 1):
            allowed[(last + delta) % 16] = E2EStatus.OK if delta == 1 else E2EStatus.SOME_LOST
        return allowed.get(counter, E2EStatus.WRONG_SEQUENCE)


@given(st.lists(st.none() | st.integers(0, 15), max_size=60), st.integers(1, 14))
def test_counter_rules(counters, max_delta):
    receiver, naive = E2EReceiver(5, max_delta), NaiveReceiver(max_delta)
    for counter in counters:
        sealed = seal(b"\x00\x50\x01\x02\x03\x04\x05\x06", 5, counter or 0)
        frame = bytes([sealed[0] ^ 1]) + sealed[1:] if counter is None else sealed
        assert receiver.check(frame) is naive.check(counter)


@pytest.mark.req("F7")
def test_two_lost_frames_are_tolerated_and_three_are_not():
    assert e2e.MAX_DELTA_COUNTER == 3
    for start in range(16):
        told = {0: "repeated", 1: "ok", 2: "some lost", 3: "some lost", 4: "wrong sequence", 15: "wrong sequence"}
        for delta, expected in told.items():
            receiver = E2EReceiver(5)
            assert receiver.check(seal(bytes(8), 5, start)).value == "initial"
            assert receiver.check(seal(bytes(8), 5, (start + delta) % 16)).value == expected


def test_what_may_be_used():
    assert {status.value for status in E2EStatus if status.is_usable} == {"initial", "ok", "some lost"}
    assert {status.value for status in E2EStatus if not status.is_usable} == {"repeated", "wrong sequence", "wrong crc"}


def states(window, frames, period_ns=10 * MS, start_ns=0):
    """State after each of the frames, which come every period; 'x' is a bad one, '-' one that does not come."""
    found = []
    for index, frame in enumerate(frames):
        if frame != "-":
            window.add(start_ns + index * period_ns, frame == ".")
        found.append({E2EState.INIT: "?", E2EState.VALID: "v", E2EState.INVALID: "i"}[window.state])
    return "".join(found)


@pytest.mark.req("F7")
@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ("....", "??vv"),  # three good ones make a new stream valid
        ("..x...", "?????v"),  # in a row
        ("xx...", "????v"),
        ("xxx", "??i"),  # a new stream can be invalid before it was ever valid
        ("x..x..x..", "??????iii"),
        ("...x.x...", "??vvvvvvv"),  # two bad ones of ten are only ignored
        ("...xxx....", "??vvviiiii"),  # the third makes it invalid, in its own frame
        ("...x.......x.x.", "??vvvvvvvvvvvvv"),  # the first has left the window of ten
        ("...x......x.x..", "??vvvvvvvvvviii"),  # the first is the tenth of the window
        ("...x........x.x", "??vvvvvvvvvvvvv"),
    ],
)
def test_window(frames, expected):
    assert states(E2EWindow(50 * MS, WindowRules()), frames) == expected


@pytest.mark.req("F7")
def test_an_invalid_stream_recovers_after_one_clean_second():
    # The last bad frame comes at 50 ms, the first clean one at 60 ms: a second later is the frame after 101 clean ones.
    assert states(E2EWindow(50 * MS, WindowRules()), "...xxx" + 105 * ".") == "??vvvi" + 100 * "i" + 5 * "v"
    assert states(E2EWindow(50 * MS, WindowRules()), "...xxx" + 99 * "." + "x" + 102 * ".") == "??vvvi" + 200 * "i" + 2 * "v"


@pytest.mark.parametrize(("gap", "is_clean"), [(4, True), (5, False)])
def test_a_gap_longer_than_the_timeout_is_not_clean(gap, is_clean):
    """Between the good frames around four that do not come are 50 ms, which is the timeout."""
    after = states(E2EWindow(50 * MS, WindowRules()), "...xxx" + 50 * "." + gap * "-" + 150 * ".")[6:]
    # Clean since the first good frame, or since the one after the gap.
    assert after.index("v") == (100 if is_clean else 50 + gap + 100)


def test_a_gap_alone_makes_no_stream_invalid_and_a_new_stream_begins_again():
    assert states(E2EWindow(50 * MS, WindowRules()), "..." + 50 * "-" + ".") == "??v" + 50 * "v" + "v"
    assert states(E2EWindow(50 * MS, WindowRules()), ".." + 5 * "-" + "...") == "??" + 5 * "?" + "??v"
    assert states(E2EWindow(50 * MS, WindowRules()), ".." + 4 * "-" + ".") == "??" + 4 * "?" + "v"


def test_a_slow_stream_needs_a_clean_window_as_well():
    rules = WindowRules(size=4, max_bad=1, min_good=2, clean_ns=100 * MS)
    # A second bad frame at 300 ms; clean for 100 ms from 400 ms on at 500 ms; the one at 100 ms has left the window of four by then.
    assert states(E2EWindow(1000 * MS, rules), ".x.x..", 100 * MS) == "???iiv"
    # Here both are still in it at 400 ms, and neither is at 600 ms.
    assert states(E2EWindow(1000 * MS, rules), ".xx....", 100 * MS) == "??iiiv" + "v"
    assert states(E2EWindow(1000 * MS, WindowRules(size=4, max_bad=1, min_good=2, clean_ns=0)), ".xx...", 1 * MS) == "??iiiv"


def test_recovery_needs_several_frames_however_long_it_takes():
    rules = WindowRules(size=2, max_bad=0, min_good=3, clean_ns=1)
    assert states(E2EWindow(10_000 * MS, rules), "x...", 5_000 * MS) == "iiiv"


def test_first_frame_long_after_the_start_of_the_clock():
    assert states(E2EWindow(50 * MS, WindowRules()), "...xxx" + 101 * ".", start_ns=10**15) == "??vvvi" + 100 * "i" + "v"


def test_default_rules_are_those_of_the_requirement():
    assert WindowRules() == WindowRules(size=10, max_bad=2, min_good=3, clean_ns=1_000_000_000)
    with pytest.raises(FrozenInstanceError):
        WindowRules().size = 3


class NaiveWindow:
    """The rules of the window from the whole history of the stream."""

    def __init__(self, timeout_ns, rules):
        self.timeout_ns, self.rules = timeout_ns, rules
        self.history = []
        self.state = E2EState.INIT

    def add(self, now_ns, is_good):
        self.history.append((now_ns, is_good))
        clean = []
        for t_ns, was_good in reversed(self.history):
            if not was_good or (clean and clean[-1] - t_ns > self.timeout_ns):
                break
            clean.append(t_ns)
        bad = [was_good for _, was_good in self.history[-self.rules.size :]].count(False)
        needed_ns = self.rules.clean_ns if self.state is E2EState.INVALID else 0
        if bad > self.rules.max_bad:
            self.state = E2EState.INVALID
        elif len(clean) >= self.rules.min_good and now_ns - clean[-1] >= needed_ns:
            self.state = E2EState.VALID
        return self.state, bad


@given(
    st.lists(st.tuples(st.integers(0, 60), st.sampled_from([True, True, True, False])), max_size=80),
    st.builds(WindowRules, st.integers(1, 10), st.integers(0, 4), st.integers(1, 5), st.integers(0, 100)),
)
@settings(max_examples=300)
def test_window_is_that_of_the_whole_history(frames, rules):
    window, naive, now_ns = E2EWindow(40, rules), NaiveWindow(40, rules), 0
    for step_ns, is_good in frames:
        now_ns += step_ns
        assert (window.add(now_ns, is_good), window.bad_frames) == naive.add(now_ns, is_good)
        assert window.state is naive.state
