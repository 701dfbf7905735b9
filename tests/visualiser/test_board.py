"""Newest sample per topic, ages and what counts as lost, with time as an argument."""

import msgspec
import pytest

from gateway.telemetry import Sample, SceneSample, topic_of
from tests.visualiser.feeder import samples_at
from visualiser.board import Board

MS = 1_000_000


def encoded(topic: str, t_ns: int, seq: int = 0, **changes: object) -> bytes:
    sample = next(one for one in samples_at(2.0, t_ns, seq) if topic_of(one) == topic)
    return msgspec.json.encode(msgspec.structs.replace(sample, **changes))


def newest(board: Board, topic: str) -> Sample:
    return board.newest[topic].sample


def test_the_newest_sample_replaces_the_one_before() -> None:
    board = Board()
    for seq in (1, 2, 3):
        assert board.accept("state", encoded("state", seq * MS, seq), seq * MS)
    assert newest(board, "state").seq == 3
    assert board.newest["state"].number == 3
    assert list(board.newest) == ["state"]


@pytest.mark.parametrize("payload", [b"", b"{}", b"\xff\xfe", b"[1, 2", b'{"t_ns": "yesterday", "seq": 0}', b"null"])
def test_junk_is_counted_and_changes_nothing(payload: bytes) -> None:
    board = Board()
    board.accept("state", encoded("state", MS, 7), MS)
    assert not board.accept("state", payload, 2 * MS)
    assert board.rejected == 1
    assert newest(board, "state").seq == 7


def test_a_sample_on_the_wrong_topic_is_junk() -> None:
    board = Board()
    assert not board.accept("command", encoded("state", MS), MS)
    assert not board.accept("no-such-topic", encoded("state", MS), MS)
    assert board.rejected == 2


def test_age_counts_from_the_making_of_a_sample_not_from_its_arrival() -> None:
    board = Board()
    board.accept("state", encoded("state", 100 * MS), now_ns=350 * MS)
    assert board.age_ms("state", 400 * MS) == pytest.approx(300.0)


def test_from_another_machine_age_counts_from_arrival_since_its_clock_is_another() -> None:
    board = Board(is_clock_shared=False)
    board.accept("state", encoded("state", 10**15), now_ns=350 * MS)
    assert board.age_ms("state", 400 * MS) == pytest.approx(50.0)
    assert board.is_lost("state", 900 * MS)


def test_age_is_never_negative() -> None:
    board = Board()
    board.accept("state", encoded("state", 100 * MS), now_ns=90 * MS)
    assert board.age_ms("state", 90 * MS) == 0.0


@pytest.mark.parametrize(("stage", "age_ms"), [("mil", 50.0), ("sil", 50.0), ("hil", 9_950.0), ("vehil", 9_950.0)])
def test_in_lockstep_age_counts_from_arrival_since_time_is_virtual(stage: str, age_ms: float) -> None:
    board = Board()
    board.accept("scene", encoded("scene", 0, stage=stage), now_ns=9_000 * MS)
    assert isinstance(newest(board, "scene"), SceneSample)
    board.accept("state", encoded("state", 50 * MS), now_ns=9_950 * MS)
    assert board.age_ms("state", 10_000 * MS) == pytest.approx(age_ms)


@pytest.mark.parametrize(("topic", "limit_ms"), [("state", 500), ("plan", 500), ("scene", 2500)])
def test_a_topic_is_lost_when_it_is_older_than_its_limit(topic: str, limit_ms: int) -> None:
    board = Board()
    assert not board.is_lost(topic, 10**15)  # what never came is not lost
    board.accept(topic, encoded(topic, 0), 0)
    assert not board.is_lost(topic, limit_ms * MS)
    assert board.is_lost(topic, (limit_ms + 1) * MS)


def test_what_comes_once_per_event_is_never_lost() -> None:
    board = Board()
    board.accept("parameters", encoded("parameters", 0), 0)
    assert not board.is_lost("parameters", 10**15)
