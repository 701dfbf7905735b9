"""Own frames on their way: never more than two of a message, and none that is forgotten by mistake or remembered for ever."""

from hypothesis import given
from hypothesis import strategies as st

from dbc.confirmation import FORGET_NS, MAX_ON_THE_WAY, Confirmation

MS = 1_000_000


def test_a_frame_is_on_its_way_until_it_is_seen():
    confirmation = Confirmation()
    assert confirmation.oldest_ns(5) == 0
    confirmation.sent(1, b"a", 10)
    confirmation.sent(2, b"b", 30)
    assert confirmation.oldest_ns(100) == 90
    confirmation.seen(1, b"a")
    assert confirmation.oldest_ns(100) == 70
    confirmation.seen(2, b"b")
    assert confirmation.oldest_ns(100) == 0


def test_no_more_than_two_of_a_message_are_on_their_way():
    confirmation = Confirmation()
    for number in range(MAX_ON_THE_WAY):
        assert confirmation.has_room(1)
        confirmation.sent(1, bytes([number]), number)
    assert not confirmation.has_room(1)
    assert confirmation.has_room(2)
    confirmation.seen(1, b"\0")
    assert confirmation.has_room(1)


def test_a_frame_that_was_lost_is_confirmed_by_the_next_of_its_message():
    confirmation = Confirmation()
    confirmation.sent(1, b"lost", 0)
    confirmation.sent(1, b"next", 10)
    confirmation.seen(1, b"next")
    assert confirmation.oldest_ns(20) == 0


def test_a_frame_that_nobody_sent_confirms_nothing():
    confirmation = Confirmation()
    confirmation.sent(1, b"a", 0)
    confirmation.seen(1, b"other")
    confirmation.seen(7, b"a")
    assert confirmation.oldest_ns(20) == 20


def test_of_two_equal_frames_the_older_is_seen_first():
    confirmation = Confirmation()
    confirmation.sent(1, b"same", 0)
    confirmation.sent(1, b"same", 10)
    confirmation.seen(1, b"same")
    assert confirmation.oldest_ns(20) == 10


def test_a_lost_frame_of_a_rare_message_is_forgotten_when_much_later_frames_were_seen():
    confirmation = Confirmation()
    confirmation.sent(1, b"rare", 0)
    confirmation.sent(2, b"a", FORGET_NS - 1)
    confirmation.seen(2, b"a")
    assert confirmation.oldest_ns(FORGET_NS) == FORGET_NS
    confirmation.sent(2, b"b", FORGET_NS)
    confirmation.seen(2, b"b")
    assert confirmation.oldest_ns(2 * FORGET_NS) == 0


def test_on_a_dead_bus_nothing_is_forgotten():
    confirmation = Confirmation()
    confirmation.sent(1, b"a", 0)
    confirmation.sent(2, b"b", 5 * FORGET_NS)
    assert confirmation.oldest_ns(10 * FORGET_NS) == 10 * FORGET_NS


def test_what_is_on_its_way_can_be_given_up():
    confirmation = Confirmation()
    for number in range(MAX_ON_THE_WAY):
        confirmation.sent(1, bytes([number]), 0)
    confirmation.clear()
    assert confirmation.has_room(1)
    assert confirmation.oldest_ns(9) == 0


@given(st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=200))
def test_a_bus_that_loses_frames_never_blocks_a_message_for_good(course):
    """Every frame that is sent is seen a millisecond later or lost; after one that is seen the message has room for two again."""
    confirmation = Confirmation()
    for step, (message, is_lost) in enumerate(course):
        now_ns = step * MS
        if not confirmation.has_room(message):
            continue
        data = step.to_bytes(2, "little")
        confirmation.sent(message, data, now_ns)
        if not is_lost:
            confirmation.seen(message, data)
            assert confirmation.has_room(message)
        assert 0 <= confirmation.oldest_ns(now_ns) <= now_ns
