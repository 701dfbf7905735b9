"""What each fault of the bus does to frames, and to which of them."""

from collections import Counter

import pytest

from dbc.catalogue import load
from dbc.e2e import E2EReceiver, E2EStatus

CATALOGUE = load()
SR_STATUS = CATALOGUE.by_name["SR_Status"]
STATUS = {"messages": "SR_Status"}
WINDOW = {"from_s": 0.1, "until_s": 0.2}
IN_WINDOW = list(range(100, 200, 10))
OUTSIDE = [step for step in range(0, 300, 10) if step not in IN_WINDOW]


def judged(bench):
    """Judgement of a receiver on each frame, by the step at which it came."""
    receiver = E2EReceiver(SR_STATUS.e2e_data_id)
    return {step: receiver.check(frame.data) for step, frame in bench.passed}


def steps_of(judgements, *statuses):
    return [step for step, status in judgements.items() if status in statuses]


def test_drop(bench):
    run = bench({"kind": "drop", **STATUS, **WINDOW}).run(300)
    assert run.times == OUTSIDE
    assert run.changed == []
    assert run.events == [(100, "drop", "begins"), (200, "drop", "ends")]


@pytest.mark.parametrize("bits", [1, 3, 64])
def test_corrupt_bits(bench, bits):
    run = bench({"kind": "corrupt_bits", "bits": bits, **STATUS, **WINDOW}).run(300)
    sent = dict(run.sent)
    wrong = {step: (int.from_bytes(frame.data) ^ int.from_bytes(sent[step].data)).bit_count() for step, frame in run.passed}
    assert wrong == dict.fromkeys(IN_WINDOW, bits) | dict.fromkeys(OUTSIDE, 0)


@pytest.mark.parametrize("length", [0, 1, 5, 8])
def test_wrong_length(bench, length):
    run = bench({"kind": "wrong_length", "length": length, **STATUS, **WINDOW}).run(300)
    assert [len(frame.data) for step, frame in run.passed if step in IN_WINDOW] == [length] * 10
    assert [len(frame.data) for step, frame in run.passed if step in OUTSIDE] == [8] * 20


def test_a_short_frame_is_filled_up(bench):
    cut, filled = ({"kind": "wrong_length", "length": length, **STATUS} for length in (3, 6))
    run = bench(cut, filled).run(1)
    assert run.passed[0][1].data == run.sent[0][1].data[:3] + bytes(3)


def test_bad_crc(bench):
    run = bench({"kind": "bad_crc", **STATUS, **WINDOW}).run(300)
    judgements = judged(run)
    assert steps_of(judgements, E2EStatus.WRONG_CRC) == IN_WINDOW
    # Nothing but the CRC is touched.
    sent = dict(run.sent)
    assert all(frame.data[1:] == sent[step].data[1:] for step, frame in run.passed)


def test_bad_counter(bench):
    run = bench({"kind": "bad_counter", **STATUS, **WINDOW}).run(300)
    judgements = judged(run)
    assert E2EStatus.WRONG_CRC not in judgements.values()
    # The first one has the counter that is due.
    assert steps_of(judgements, E2EStatus.REPEATED) == IN_WINDOW[1:]
    assert {frame.data[1] & 0x0F for step, frame in run.passed if step in IN_WINDOW} == {10}
    assert [frame.data[2:] for _, frame in run.passed] == [frame.data[2:] for _, frame in run.sent]


def test_freeze_payload_is_good_for_a_receiver(bench):
    run = bench({"kind": "freeze_payload", **STATUS, **WINDOW}).run(300)
    assert set(judged(run).values()) <= {E2EStatus.INITIAL, E2EStatus.OK}
    sent = dict(run.sent)
    assert all(frame.data[2:] == sent[100 if step in IN_WINDOW else step].data[2:] for step, frame in run.passed)


def test_freeze_payload_of_an_unprotected_message(bench):
    run = bench({"kind": "freeze_payload", "messages": "PosLocal", **WINDOW}, messages=("PosLocal",)).run(300)
    sent = dict(run.sent)
    assert all(frame.data == sent[100 if step in IN_WINDOW else step].data for step, frame in run.passed)


@pytest.mark.parametrize("kind", ["freeze_payload", "bad_counter"])
def test_what_freezes_again_freezes_anew(bench, kind):
    run = bench({"kind": kind, "condition": "engaged", **STATUS})
    for is_engaged in (True, False, True):
        run.situation = run.situation._replace(is_engaged=is_engaged)
        run.run(50)
    assert run.changed == [10, 20, 30, 40, 110, 120, 130, 140]


def test_replay_sends_old_bytes(bench):
    run = bench({"kind": "replay", "age_ms": 50.0, **STATUS, **WINDOW}).run(300)
    sent = dict(run.sent)
    assert all(frame.data == sent[step - 50 if step in IN_WINDOW else step].data for step, frame in run.passed)
    assert steps_of(judged(run), E2EStatus.WRONG_SEQUENCE)[0] == 100


def test_replay_of_what_nobody_saw_changes_nothing(bench):
    run = bench({"kind": "replay", "age_ms": 50.0, **STATUS}).run(100)
    assert run.changed == [50, 60, 70, 80, 90]


def test_delay(bench):
    run = bench({"kind": "delay", "delay_ms": 7.0, **STATUS, **WINDOW}).run(300)
    assert run.times == sorted(OUTSIDE + [step + 7 for step in IN_WINDOW])
    assert [frame.data for _, frame in run.passed] == [frame.data for _, frame in run.sent]
    assert all(frame.t_ns == 5_000_000_000 + step * 1_000_000 for step, frame in run.passed)


def test_what_is_on_its_way_arrives_after_the_end(bench):
    run = bench({"kind": "delay", "delay_ms": 35.0, **STATUS, **WINDOW}).run(300)
    assert [step for step, _ in run.passed][-13:] == [200, 205, 210, 215, 220, 225, 230, 240, 250, 260, 270, 280, 290]
    assert len(run.passed) == len(run.sent)


def test_jitter_delays_at_random_and_keeps_the_order(bench):
    run = bench({"kind": "jitter", "jitter_ms": 30.0, **STATUS, **WINDOW}).run(300)
    counters = [frame.data[1] & 0x0F for step, frame in run.passed if step < 200 or step not in OUTSIDE]
    assert counters == [k % 16 for k in range(len(counters))]
    late = [step for step in run.times if step not in OUTSIDE]
    assert len(run.passed) == len(run.sent)
    assert len({step % 10 for step in late}) > 3
    assert max(late) < 190 + 31


@pytest.mark.parametrize("copies", [1, 4])
def test_duplicate(bench, copies):
    run = bench({"kind": "duplicate", "copies": copies, **STATUS, **WINDOW}).run(300)
    assert Counter(run.times) == dict.fromkeys(OUTSIDE, 1) | dict.fromkeys(IN_WINDOW, 1 + copies)
    assert run.changed == []


def test_reorder_and_what_is_left_at_the_end(bench):
    run = bench({"kind": "reorder", "depth": 3, **STATUS, **WINDOW}).run(300)
    order = [(step, (frame.data[2] + 256 * frame.data[3]) // 10) for step, frame in run.passed if 90 <= step <= 210]
    assert order == [(90, 9), *((120, k) for k in (12, 11, 10)), *((150, k) for k in (15, 14, 13)), *((180, k) for k in (18, 17, 16)),
                     (200, 19), (200, 20), (210, 21)]  # fmt: skip


def test_silence_is_about_all_that_a_node_sends(bench):
    messages = ("SR_Status", "AR_Status", "PosLocal")
    run = bench({"kind": "silence", "node": "INS", **WINDOW}, messages=messages).run(300)
    counts = Counter(frame.arbitration_id for _, frame in run.passed)
    assert [counts[CATALOGUE.by_name[name].arbitration_id] for name in messages] == [30, 30, 20]


@pytest.mark.parametrize(("rate_hz", "expected"), [(1000.0, 100), (250.0, 25), (5000.0, 496)])
def test_babble(bench, rate_hz, expected):
    run = bench({"kind": "babble", "id": 1, "rate_hz": rate_hz, "length": 3, **WINDOW}).run(300)
    babbled = [(step, frame) for step, frame in run.passed if frame.arbitration_id == 1]
    assert len(babbled) == expected
    assert {frame.data for _, frame in babbled} == {bytes(3)}
    assert (babbled[0][0], babbled[-1][0] < 200) == (100, True)
    assert run.times.count(100) == 2  # its first frame, and that of the robot


def test_babble_that_comes_again_does_not_catch_up(bench):
    run = bench({"kind": "babble", "id": 1, "condition": "engaged"})
    for is_engaged in (True, False, True):
        run.situation = run.situation._replace(is_engaged=is_engaged)
        run.run(50)
    assert Counter(step for step, frame in run.passed if frame.arbitration_id == 1) == dict.fromkeys([*range(50), *range(100, 150)], 1)


def test_babble_is_not_heard_by_the_car(bench):
    assert bench({"kind": "babble", "id": 1}, is_to_car=True).run(20).changed == []


def test_commands_get_lost_on_their_way_to_the_robots(bench):
    fault = {"kind": "drop", "messages": "GW", **WINDOW}
    assert bench(fault, messages=("SR_Command",), is_to_car=True).run(300).times == OUTSIDE
    assert bench(fault).run(300).times == list(range(0, 300, 10))


@pytest.mark.parametrize(
    ("keys", "hit"),
    [
        ({}, range(30)),
        ({"count": 1}, [0]),
        ({"after_count": 7, "count": 1}, [7]),
        ({"after_count": 7}, range(7, 30)),
        ({"every": 4}, range(0, 30, 4)),
        ({"after_count": 3, "every": 5, "count": 4}, [3, 8, 13, 18]),
        ({"probability": 0.0}, []),
        ({"from_s": 0.1, "after_count": 2, "count": 3}, [12, 13, 14]),
    ],
)
def test_counting(bench, keys, hit):
    run = bench({"kind": "drop", **STATUS, **keys}).run(300)
    assert run.times == [10 * k for k in range(30) if k not in hit]


def test_a_fault_that_has_hit_its_count_ends(bench):
    run = bench({"kind": "drop", "count": 2, **STATUS}).run(300)
    assert run.events == [(0, "drop", "begins"), (11, "drop", "ends")]


def test_a_count_is_of_frames_in_both_directions_together(bench):
    run = bench({"kind": "drop", "messages": "*", "count": 3}, messages=("SR_Status", "PosLocal")).run(20)
    assert len(run.passed) == 1


def test_probability(bench):
    run = bench({"kind": "drop", "probability": 0.3, **STATUS}, period=1).run(3000)
    assert 0.27 < 1.0 - len(run.passed) / len(run.sent) < 0.33


@pytest.mark.parametrize(
    ("name", "hit"), [("SR_Status", 1), ("SR", 1), (f"0x{SR_STATUS.arbitration_id:x}", 1), ("*", 3), (["SR", "INS"], 2)]
)
def test_targets(bench, name, hit):
    run = bench({"kind": "drop", "messages": name}, messages=("SR_Status", "AR_Status", "PosLocal")).run(1)
    assert len(run.passed) == 3 - hit


@pytest.mark.parametrize("share", [{"probability": 0.5}, {"every": 3}, {"until_s": 1.0}])
def test_jitter_keeps_the_order_of_frames_that_it_does_not_hit(bench, share):
    run = bench({"kind": "jitter", "jitter_ms": 100.0, **STATUS, **share}).run(2000)
    numbers = [frame.data[2] + 256 * frame.data[3] for _, frame in run.passed]
    assert numbers == sorted(numbers)
    assert len(run.changed) > 30
    assert run.times[-1] == 1990 or "until_s" not in share


def test_delay_of_some_lets_the_others_overtake(bench):
    run = bench({"kind": "delay", "delay_ms": 15.0, "every": 2, **STATUS}).run(60)
    assert run.times == [10, 15, 30, 35, 50, 55]


def test_what_is_held_is_not_looked_at_before_it_is_due(bench):
    run = bench({"kind": "delay", "delay_ms": 10_000.0, "messages": "*"}, period=1).run(1)
    (hold,) = (effect for effect in run.engine.faults[0]._effects.values() if effect.is_holding)
    looked = []

    class Due(int):
        def __le__(self, other):
            looked.append(other)
            return int(self) <= other

    hold._kept = [(Due(10**18 + place), place, frame) for place, (_, frame) in enumerate(run.sent * 1000)]
    assert hold.release(10**18 - 1, is_active=True) == []
    assert len(looked) == 1
    assert [len(hold.release(10**18 + 9, is_active=True)), len(hold._kept)] == [10, 990]


@pytest.mark.parametrize(("rate_hz", "most"), [(10_000.0, 10), (250.0, 1), (1_500.0, 2)])
def test_babble_does_not_catch_up_after_a_pause(bench, rate_hz, most):
    run = bench({"kind": "babble", "id": 1, "rate_hz": rate_hz}).run(20)
    run.now += 5000
    before = len(run.passed)
    run.run(1)
    assert len([frame for _, frame in run.passed[before:] if frame.arbitration_id == 1]) == most
    before = len(run.passed)
    run.run(1000)
    assert len([frame for _, frame in run.passed[before:] if frame.arbitration_id == 1]) == pytest.approx(rate_hz, abs=1)
