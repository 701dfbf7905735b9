"""The pure bus: who hears what, and the book-keeping."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, rule

from vehicle_emulator.bus.core import BusCore, BusFrame, Delivery, NodeStatistics

FRAME = BusFrame(0x123, b"\x01\x02", 0, 2)


class BusMachine(RuleBasedStateMachine):
    """Any order of joining, leaving, sending and losing, against a book kept frame by frame."""

    nodes = Bundle("nodes")

    def __init__(self):
        super().__init__()
        self.core = BusCore()
        self.next_node = 0
        self.now_ns = 0
        self.heard: dict[int, list[int]] = {}
        self.sent: dict[int, int] = {}
        self.lost: dict[int, int] = {}

    @rule(target=nodes)
    def join(self):
        self.next_node += 1
        self.core.join(self.next_node)
        self.heard[self.next_node], self.sent[self.next_node], self.lost[self.next_node] = [], 0, 0
        return self.next_node

    @rule(node=consumes(nodes))
    def leave(self, node):
        assert self.core.leave(node) == self._expected(node)
        del self.heard[node], self.sent[node], self.lost[node]

    @rule(node=nodes, arbitration_id=st.integers(0, 0x7FF), step_ns=st.integers(0, 10**9))
    def transmit(self, node, arbitration_id, step_ns):
        self.now_ns += step_ns
        frame = BusFrame(arbitration_id, b"", 0, 0)
        deliveries = self.core.transmit(node, frame, self.now_ns)
        self.sent[node] += 1
        for delivery in deliveries:
            assert delivery.t_ns <= self.now_ns
            for receiver in delivery.receivers:
                self.heard[receiver].append(delivery.frame.arbitration_id)
        for other, heard in self.heard.items():
            if other != node:
                assert heard[-1] == arbitration_id
        assert sorted(deliveries[0].receivers) == sorted(self.heard.keys() - {node})

    @rule(node=nodes)
    def lose(self, node):
        if len(self.heard[node]) > self.lost[node]:
            self.core.record_loss(node)
            self.lost[node] += 1

    def _expected(self, node):
        return NodeStatistics(self.sent[node], len(self.heard[node]) - self.lost[node], self.lost[node])

    @invariant()
    def statistics_agree(self):
        assert self.core.nodes == {node: self._expected(node) for node in self.heard}


TestBusMachine = BusMachine.TestCase


def test_a_frame_reaches_every_node_but_its_sender():
    core = BusCore()
    for node in (1, 2, 3):
        core.join(node)
    assert core.transmit(2, FRAME, 77) == [Delivery(FRAME, 77, (1, 3))]


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=20).map(sorted))
def test_deliveries_keep_the_order_and_the_time_of_their_requests(times_ns):
    core = BusCore()
    core.join(1)
    core.join(2)
    delivered = [d for t_ns in times_ns for d in core.transmit(1, FRAME._replace(arbitration_id=t_ns % 0x800), t_ns)]
    assert [d.t_ns for d in delivered] == times_ns
    assert [d.frame.arbitration_id for d in delivered] == [t_ns % 0x800 for t_ns in times_ns]


def test_a_node_hears_nothing_before_it_joins_and_after_it_leaves():
    core = BusCore()
    core.join(1)
    assert core.transmit(1, FRAME, 0)[0].receivers == ()
    core.join(2)
    assert core.transmit(1, FRAME, 1)[0].receivers == (2,)
    core.leave(2)
    assert core.transmit(1, FRAME, 2)[0].receivers == ()


def test_misuse_raises():
    core = BusCore()
    core.join(1)
    with pytest.raises(ValueError, match="node 1 has joined already"):
        core.join(1)
    with pytest.raises(KeyError):
        core.transmit(2, FRAME, 0)
    with pytest.raises(KeyError):
        core.leave(2)
