"""The pure bus: order, times, errors and who is told, each against a figure worked out by hand or counted bit by bit."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.confinement import ErrorState
from vehicle_emulator.bus.core import QUEUE_FRAMES, BusCore
from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

BIT_NS = 2000
INTERMISSION_NS = 3 * BIT_NS
FRAME = BusFrame(0x123, b"\x01\x02", 0, 2)
BITS = frame_bits(FRAME)[0]
FOREVER_NS = 10**9
# From start of frame to the last bit of the CRC sequence, then two error flags and the delimiter.
DESTROYED_BITS = BITS - 10 + 6 + 6 + 8


def bus(nodes=3, **options) -> BusCore:
    core = BusCore(**options)
    for node in range(1, nodes + 1):
        core.join(node)
    core.advance(0)
    return core


def frame(arbitration_id: int, data: bytes = b"", flags: int = 0) -> BusFrame:
    return BusFrame(arbitration_id, data, flags, len(data))


def told(deliveries, node):
    """Identifier, data[1] and the counters of the error frames that a node was given."""
    frames = [delivery.frame for delivery in deliveries if delivery.frame.flags & ERROR and node in delivery.receivers]
    return [(one.arbitration_id, one.data[1], one.data[6], one.data[7]) for one in frames]


def through(deliveries):
    return [delivery for delivery in deliveries if not delivery.frame.flags & ERROR]


def test_a_frame_arrives_when_it_ends_and_not_before():
    core = bus()
    assert core.transmit(2, FRAME, 500)
    end_ns = 500 + BITS * BIT_NS
    assert core.next_event_ns() == end_ns
    assert core.advance(end_ns - 1) == []
    assert core.advance(end_ns) == [(FRAME, end_ns, (1, 3), (2,))]
    assert core.next_event_ns() is None
    assert core.nodes[2].transmitted == core.nodes[1].received == core.nodes[3].received == 1


@pytest.mark.parametrize(("bitrate_bps", "bit_ns"), [(1_000_000, 1000), (125_000, 8000), (83_333, 12_000)])
def test_bit_rate(bitrate_bps, bit_ns):
    core = bus(bitrate_bps=bitrate_bps)
    core.transmit(1, FRAME, 0)
    assert core.next_event_ns() == BITS * bit_ns


def test_data_phase_is_at_the_data_bit_rate():
    core = bus(data_bitrate_bps=4_000_000)
    switched = BusFrame(1, bytes(64), FD | BITRATE_SWITCH, 64)
    core.transmit(1, switched, 0)
    nominal, in_data_phase = frame_bits(switched)
    assert in_data_phase > 512
    assert core.next_event_ns() == nominal * BIT_NS + in_data_phase * 250


def test_the_lowest_identifier_goes_first_then_the_next_after_the_intermission():
    core = bus()
    core.transmit(1, frame(0x300), 0)
    core.transmit(2, frame(0x100), 0)
    core.transmit(3, frame(0x200), 0)
    deliveries = core.advance(FOREVER_NS)
    assert [(one.frame.arbitration_id, one.senders) for one in deliveries] == [(0x100, (2,)), (0x200, (3,)), (0x300, (1,))]
    ends_ns = [one.t_ns for one in deliveries]
    for earlier_ns, later in zip(ends_ns, deliveries[1:], strict=False):
        assert later.t_ns - earlier_ns == INTERMISSION_NS + frame_bits(later.frame)[0] * BIT_NS


def test_formats_with_one_base_identifier():
    core = bus(4)
    base = 0x155
    extended = BusFrame(base << 18, b"", EXTENDED, 0)
    for node, sent in enumerate((extended, frame(base, flags=REMOTE), frame(base)), start=1):
        core.transmit(node, sent, 0)
    assert [one.frame.flags for one in core.advance(FOREVER_NS)] == [0, REMOTE, EXTENDED]


def test_a_frame_on_the_wire_is_not_interrupted():
    core = bus()
    core.transmit(1, frame(0x700), 0)
    core.transmit(2, frame(0x001), 1)
    assert [one.frame.arbitration_id for one in core.advance(FOREVER_NS)] == [0x700, 0x001]


def test_a_node_sends_by_identifier_and_equal_ones_in_the_order_of_request():
    core = bus()
    for number, arbitration_id in enumerate((0x400, 0x200, 0x200, 0x100)):
        core.transmit(1, frame(arbitration_id, bytes([number])), number)
    sent = [(one.frame.arbitration_id, one.frame.data[0]) for one in core.advance(FOREVER_NS)]
    # The first was alone when it began.
    assert sent == [(0x400, 0), (0x100, 3), (0x200, 1), (0x200, 2)]


def test_a_full_queue_refuses_and_takes_again():
    core = bus()
    taken = [core.transmit(1, FRAME, 0) for _ in range(QUEUE_FRAMES + 2)]
    assert taken == [True] * QUEUE_FRAMES + [False] * 2
    assert (core.room(1), core.pending(1), core.nodes[1].refused) == (0, QUEUE_FRAMES, 2)
    core.advance(BITS * BIT_NS)
    assert core.room(1) == 1
    assert core.transmit(1, FRAME, BITS * BIT_NS)


def test_who_joins_during_a_frame_does_not_hear_it():
    core = bus(2)
    core.transmit(1, FRAME, 0)
    core.advance(1)
    core.join(9)
    core.transmit(1, FRAME, 2)
    assert [one.receivers for one in core.advance(FOREVER_NS)] == [(2,), (2, 9)]


def test_who_leaves_during_a_frame_does_not_hear_it_and_what_it_has_not_sent_is_lost():
    core = bus(3)
    core.transmit(1, FRAME, 0)
    core.transmit(3, FRAME._replace(arbitration_id=0x700), 0)
    core.advance(1)
    assert core.leave(3).received == 0
    assert [one.receivers for one in core.advance(FOREVER_NS)] == [(2,)]
    assert list(core.nodes) == [1, 2]


def test_a_sender_that_vanishes_leaves_an_error_to_its_receivers():
    core = bus(3)
    core.transmit(1, FRAME, 0)
    core.advance(20 * BIT_NS)
    core.leave(1)
    core.transmit(2, frame(0x200), 20 * BIT_NS)
    (delivery,) = core.advance(FOREVER_NS)
    # Two flags, delimiter, intermission, then the frame of the other.
    assert delivery.t_ns == (20 + 6 + 6 + 8 + 3 + frame_bits(delivery.frame)[0]) * BIT_NS
    assert (core.nodes[3].errors, core.nodes[3].rec) == (1, 0)


def test_a_sender_that_vanishes_in_the_end_of_frame_has_sent_it():
    core = bus(3)
    core.transmit(1, FRAME, 0)
    core.advance((BITS - 7) * BIT_NS)
    core.leave(1)
    assert core.advance(FOREVER_NS) == [(FRAME, BITS * BIT_NS, (2, 3), ())]


def test_a_destroyed_frame_is_repeated_after_the_error_frame():
    core = bus()
    core.disturb(FRAME.arbitration_id, 1)
    core.transmit(1, frame(0x400), 0)
    core.transmit(2, FRAME, 1)
    first, second = core.advance(FOREVER_NS)
    assert first.frame.arbitration_id == 0x400
    idle_ns = first.t_ns + INTERMISSION_NS
    assert second.t_ns == idle_ns + (DESTROYED_BITS + 3 + BITS) * BIT_NS
    assert (core.nodes[2].tec, core.nodes[1].rec, core.nodes[3].rec) == (7, 0, 0)
    assert [core.nodes[node].errors for node in (1, 2, 3)] == [1, 1, 1]
    assert core.disturbed_ids == 0


def test_any_frame_can_be_disturbed_and_others_are_left_alone():
    core = bus()
    core.disturb(0x7AA, 5)
    core.disturb(None, 2)
    core.transmit(1, FRAME, 0)
    core.transmit(2, frame(0x200), 0)
    deliveries = core.advance(FOREVER_NS)
    assert [one.frame.arbitration_id for one in deliveries] == [0x123, 0x200]
    assert core.nodes[1].tec == 15
    assert core.disturbed_ids == 1


def test_a_disturbance_takes_the_place_of_an_earlier_one_and_none_takes_it_back():
    core = bus()
    core.disturb(FRAME.arbitration_id, 20)
    core.disturb(FRAME.arbitration_id, 3)
    core.disturb(None, 5)
    core.disturb(None, 0)
    core.disturb(0x200, 0)
    assert core.disturbed_ids == 1
    core.transmit(1, FRAME, 0)
    core.advance(FOREVER_NS)
    assert core.nodes[1].tec == 23
    with pytest.raises(ValueError, match="count -1 of a disturbance"):
        core.disturb(None, -1)


def test_a_disturbance_taken_back_between_two_attempts_lets_the_next_through():
    core = bus()
    core.disturb(FRAME.arbitration_id, 30)
    core.transmit(1, FRAME, 0)
    assert core.advance(DESTROYED_BITS * BIT_NS) == []
    core.disturb(FRAME.arbitration_id, 0)
    assert len(through(core.advance(FOREVER_NS))) == 1
    assert core.nodes[1].tec == 7


def test_a_sender_that_always_fails_goes_bus_off_and_its_receivers_passive_only():
    core = bus()
    core.disturb(FRAME.arbitration_id, 40)
    core.transmit(1, FRAME, 0)
    core.transmit(1, FRAME, 0)
    deliveries = core.advance(FOREVER_NS)
    assert through(deliveries) == []
    assert told(deliveries, 1) == [(0x204, 0x08, 96, 0), (0x204, 0x20, 128, 0), (0x240, 0, 255, 0)]
    assert [core.nodes[node].state for node in (1, 2, 3)] == [ErrorState.BUS_OFF, ErrorState.ACTIVE, ErrorState.ACTIVE]
    assert (core.nodes[1].errors, core.nodes[2].rec, core.pending(1)) == (32, 32, 0)
    # From the 17th attempt on the sender is passive and waits 8 bits more.
    passive_from = 16
    expected_bits = 32 * (DESTROYED_BITS + 3) - 3 + (32 - passive_from) * 8
    assert deliveries[-1].t_ns == expected_bits * BIT_NS
    assert not core.transmit(1, FRAME, FOREVER_NS)


def test_a_node_in_bus_off_neither_hears_nor_acknowledges():
    core = bus(2)
    core.disturb(None, 32)
    core.transmit(1, FRAME, 0)
    off_ns = core.advance(FOREVER_NS)[-1].t_ns
    assert off_ns < FOREVER_NS
    core.transmit(2, FRAME, FOREVER_NS)
    assert through(core.advance(2 * FOREVER_NS)) == []
    assert core.nodes[2].tec >= 128 - 32


def test_others_go_first_while_a_passive_sender_is_suspended():
    core = bus()
    core.disturb(0x100, 17)
    core.transmit(1, frame(0x100), 0)
    attempt_bits = frame_bits(frame(0x100))[0] - 10 + 20
    # During the 17th attempt, the first as a passive node, somebody with a lower priority asks to send.
    begin_17th_ns = (16 * (attempt_bits + 3) + 8) * BIT_NS
    core.transmit(2, frame(0x600), begin_17th_ns + 1)
    deliveries = through(core.advance(FOREVER_NS))
    assert [one.frame.arbitration_id for one in deliveries] == [0x600, 0x100]
    assert deliveries[0].t_ns == begin_17th_ns + (attempt_bits + 3 + frame_bits(deliveries[0].frame)[0]) * BIT_NS
    # Somebody else's frame has gone by since; the suspension is over.
    assert deliveries[1].t_ns - deliveries[0].t_ns == INTERMISSION_NS + frame_bits(deliveries[1].frame)[0] * BIT_NS


def test_nobody_acknowledges_a_lonely_node_which_becomes_passive_and_never_bus_off():
    core = bus(1)
    core.transmit(1, FRAME, 0)
    deliveries = core.advance(FOREVER_NS)
    assert told(deliveries, 1) == [(0x204, 0x08, 96, 0), (0x204, 0x20, 128, 0)]
    # Up to the acknowledge slot, an error flag that nobody answers, the delimiter.
    attempt_bits = BITS - 8 + 6 + 8
    assert deliveries[0].t_ns == (12 * (attempt_bits + 3) - 3) * BIT_NS
    assert (core.nodes[1].tec, core.nodes[1].state, core.pending(1)) == (128, ErrorState.PASSIVE, 1)
    assert core.next_event_ns() is None
    core.join(2)
    (delivery,) = through(core.advance(2 * FOREVER_NS))
    assert delivery.receivers == (2,)
    assert delivery.t_ns - FOREVER_NS <= 2 * (attempt_bits + 11) * BIT_NS
    assert core.nodes[1].tec == 127


def test_bus_off_lasts_128_times_11_recessive_bits_after_the_restart():
    core = bus()
    core.disturb(None, 32)
    core.transmit(1, FRAME, 0)
    core.advance(FOREVER_NS)
    assert core.restart(1, FOREVER_NS)
    assert not core.restart(1, FOREVER_NS)
    assert not core.restart(2, FOREVER_NS)
    end_ns = FOREVER_NS + 128 * 11 * BIT_NS
    assert core.next_event_ns() == end_ns
    assert core.advance(end_ns - 1) == []
    deliveries = core.advance(end_ns)
    assert told(deliveries, 1) == [(0x300, 0, 0, 0)]
    assert deliveries[0].t_ns == end_ns
    assert core.nodes[1].state is ErrorState.ACTIVE
    assert core.transmit(1, FRAME, end_ns)
    assert len(through(core.advance(2 * FOREVER_NS))) == 1


def test_traffic_delays_recovery_by_one_sequence_for_each_frame():
    core = bus()
    core.disturb(None, 32)
    core.transmit(1, FRAME, 0)
    core.advance(FOREVER_NS)
    core.restart(1, FOREVER_NS)
    # 110 bits of idle bus are ten sequences, then comes a frame; the 11 bits at its end are one more.
    start_ns = FOREVER_NS + 115 * BIT_NS
    core.transmit(2, FRAME, start_ns)
    idle_ns = start_ns + (BITS + 3) * BIT_NS
    deliveries = core.advance(2 * FOREVER_NS)
    assert told(deliveries, 1) == [(0x300, 0, 0, 0)]
    assert deliveries[-1].t_ns == idle_ns + (128 - 10 - 1) * 11 * BIT_NS


def test_automatic_restart():
    core = bus(restart_ms=100)
    core.disturb(None, 32)
    core.transmit(1, FRAME, 0)
    deliveries = core.advance(FOREVER_NS)
    off_ns, again_ns = (one.t_ns for one in deliveries if one.receivers == (1,) and one.frame.arbitration_id in (0x240, 0x300))
    assert again_ns - off_ns == 100_000_000 + 1408 * BIT_NS
    core.set_restart(1, None)
    core.disturb(None, 32)
    core.transmit(1, FRAME, FOREVER_NS)
    core.advance(2 * FOREVER_NS)
    assert core.nodes[1].state is ErrorState.BUS_OFF
    assert core.next_event_ns() is None


def test_an_asked_restart_comes_before_the_automatic_one():
    core = bus(restart_ms=1000)
    core.disturb(None, 32)
    core.transmit(1, FRAME, 0)
    off_ns = core.advance(100_000_000)[-1].t_ns
    assert off_ns < 100_000_000
    assert core.restart(1, 100_000_000)
    assert core.next_event_ns() == 100_000_000 + 1408 * BIT_NS


def test_recovery_goes_on_beside_a_lonely_sender():
    core = bus(2)
    core.disturb(FRAME.arbitration_id, 32)
    core.transmit(1, FRAME, 0)
    core.advance(FOREVER_NS)
    core.transmit(2, frame(0x200), FOREVER_NS)
    core.advance(FOREVER_NS + 100_000_000)
    core.restart(1, FOREVER_NS + 100_000_000)
    assert core.next_event_ns() is not None
    deliveries = core.advance(2 * FOREVER_NS)
    assert told(deliveries, 1) == [(0x300, 0, 0, 0)]
    assert len(through(deliveries)) == 1


def test_an_error_passive_sender_says_so_in_fd_frames():
    core = bus()
    fd = frame(0x100, bytes(8), FD | BITRATE_SWITCH)
    core.disturb(0x100, 16)
    core.transmit(1, fd, 0)
    (delivery,) = through(core.advance(FOREVER_NS))
    assert delivery.frame.flags == fd.flags | ERROR_STATE_INDICATOR


def test_single_errors_are_told_to_who_asks():
    core = bus()
    for node in (1, 2):
        core.report_bus_errors(node, True)
    core.disturb(None, 2)
    core.transmit(1, FRAME, 0)
    deliveries = core.advance(FOREVER_NS)
    assert told(deliveries, 1) == [(0x288, 0, 8, 0), (0x288, 0, 16, 0)]
    assert told(deliveries, 2) == [(0x288, 0, 0, 1), (0x288, 0, 0, 2)]
    assert told(deliveries, 3) == []
    core = bus(1)
    core.report_bus_errors(1, True)
    core.transmit(1, FRAME, 0)
    assert told(core.advance(core.next_event_ns()), 1) == [(0x2A0, 0, 8, 0)]


def test_one_identifier_from_two_nodes_ends_in_errors_until_they_are_passive():
    core = bus()
    core.transmit(1, frame(0x100, b"\x00"), 0)
    core.transmit(2, frame(0x100, b"\xff"), 0)
    deliveries = through(core.advance(FOREVER_NS))
    # After 16 collisions both are passive: the flag of the one that meets a dominant bit no longer disturbs the other.
    assert [(one.frame.data, one.senders) for one in deliveries] == [(b"\x00", (1,)), (b"\xff", (2,))]
    assert [core.nodes[node].errors for node in (1, 2, 3)] == [16, 16, 16]
    assert (core.nodes[1].tec, core.nodes[2].tec) == (127, 128 + 8 - 1)


def test_the_same_frame_from_two_nodes_is_one_frame():
    core = bus()
    core.transmit(1, FRAME, 0)
    core.transmit(2, FRAME, 0)
    assert core.advance(FOREVER_NS) == [(FRAME, BITS * BIT_NS, (3,), (1, 2))]
    assert (core.nodes[1].transmitted, core.nodes[2].transmitted, core.nodes[3].received) == (1, 1, 1)


def test_load_is_the_exact_share_of_busy_bits():
    core = bus()
    ends_ns, busy_bits = [], 0
    for number in range(400):
        t_ns = number * 10_000_000
        for node, arbitration_id in ((1, 0x100), (2, 0x200)):
            sent = frame(arbitration_id, (number * 2654435761).to_bytes(8, "little"))
            core.transmit(node, sent, t_ns)
            busy_bits += frame_bits(sent)[0] + 3
        ends_ns += [one.t_ns for one in core.advance(t_ns + 5_000_000)]
    now_ns = 400 * 10_000_000
    assert core.mean_load(now_ns) == pytest.approx(busy_bits * BIT_NS / now_ns, rel=1e-12)
    window = list(_busy_spans(ends_ns))[-200:]
    assert core.load(now_ns) == pytest.approx(sum(window) / 1e9, rel=1e-12)


def _busy_spans(ends_ns):
    """Busy time of each frame, from its end alone: pairs begin every 10 ms, the second right after the first [ns]."""
    for first_ns, second_ns in zip(ends_ns[::2], ends_ns[1::2], strict=True):
        start_ns = first_ns // 10_000_000 * 10_000_000
        yield first_ns - start_ns + INTERMISSION_NS
        yield second_ns - first_ns


def test_load_of_a_bus_that_is_never_idle():
    core = bus()
    t_ns = 0
    while t_ns < 2_000_000_000:
        while core.transmit(1, FRAME, t_ns):
            pass
        t_ns += 1_000_000
    assert core.load(t_ns) == 1.0
    assert core.mean_load(t_ns) == 1.0


def test_errors_count_as_load():
    core = bus()
    core.disturb(None, 1)
    core.transmit(1, FRAME, 0)
    core.advance(10_000_000)
    assert core.mean_load(10_000_000) == (DESTROYED_BITS + 3 + BITS + 3) * BIT_NS / 10_000_000


def test_misuse_raises():
    core = bus(1)
    with pytest.raises(ValueError, match="node 1 has joined already"):
        core.join(1)
    with pytest.raises(KeyError):
        core.transmit(2, FRAME, 0)
    with pytest.raises(KeyError):
        core.leave(2)
    core.advance(10)
    with pytest.raises(ValueError, match="time goes back from 10 to 9 ns"):
        core.advance(9)


@st.composite
def schedules(draw):
    requests = draw(
        st.lists(
            st.tuples(st.integers(0, 3_000_000), st.integers(1, 3), st.integers(0, 7), st.binary(max_size=8)), min_size=1, max_size=40
        )
    )
    disturbances = draw(st.lists(st.tuples(st.none() | st.integers(0, 7), st.integers(1, 3)), max_size=3))
    steps_ns = draw(st.lists(st.integers(20_000, 400_000), min_size=1, max_size=8))
    return sorted(requests), disturbances, steps_ns


def drive(requests, disturbances, steps_ns):
    """Deliveries when time passes in these steps; identifiers differ between nodes."""
    core = bus()
    for disturbance in disturbances:
        core.disturb(*disturbance)
    pending = [(t_ns, node, frame(8 * kind + node, data)) for t_ns, node, kind, data in requests]
    deliveries, now_ns, turn = [], 0, 0
    while now_ns < 30_000_000:
        next_ns = now_ns + steps_ns[turn % len(steps_ns)]
        while pending and pending[0][0] < next_ns:
            t_ns, node, sent = pending.pop(0)
            core.transmit(node, sent, max(t_ns, now_ns))
        now_ns, turn = next_ns, turn + 1
        deliveries += core.advance(now_ns)
    return deliveries, core


@settings(max_examples=60, deadline=None)
@given(schedules())
def test_the_bus_does_not_depend_on_how_often_it_is_asked(schedule):
    requests, disturbances, steps_ns = schedule
    deliveries, core = drive(requests, disturbances, steps_ns)
    same, _ = drive(requests, disturbances, [51_000])
    assert deliveries == same
    sent = through(deliveries)
    assert sorted((one.senders[0], one.frame.arbitration_id) for one in sent) == sorted((n, 8 * k + n) for _, n, k, _ in requests)
    assert all(set(one.receivers) == {1, 2, 3} - set(one.senders) for one in sent)
    starts_ns = [one.t_ns - frame_bits(one.frame)[0] * BIT_NS for one in sent]
    assert all(start_ns - end.t_ns >= INTERMISSION_NS for end, start_ns in zip(sent, starts_ns[1:], strict=False))
    # Nobody has waited while the bus was his to have: at each start no pending frame had a lower identifier.
    for one, start_ns in zip(sent, starts_ns, strict=True):
        waiting = [8 * k + n for t_ns, n, k, _ in requests if t_ns < start_ns and (n, 8 * k + n) not in _sent_before(sent, start_ns)]
        assert all(one.frame.arbitration_id <= arbitration_id for arbitration_id in waiting)
    assert sum(core.nodes[node].transmitted for node in (1, 2, 3)) == len(requests)


def _sent_before(sent, t_ns):
    return {(one.senders[0], one.frame.arbitration_id) for one in sent if one.t_ns <= t_ns}


def test_next_event_is_never_late():
    core = bus()
    core.disturb(None, 40)
    for number in range(20):
        core.transmit(1 + number % 3, frame(0x100 + number), 0)
    seen = []
    while (due_ns := core.next_event_ns()) is not None:
        seen += core.advance(due_ns)
    whole = bus()
    whole.disturb(None, 40)
    for number in range(20):
        whole.transmit(1 + number % 3, frame(0x100 + number), 0)
    assert seen == whole.advance(FOREVER_NS)
    assert len(through(seen)) > 0
