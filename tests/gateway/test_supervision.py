"""Judgement on frames, and on those that are missing."""

import random
from dataclasses import replace

import pytest

from dbc.catalogue import load
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from gateway.causes import Cause, Finding
from gateway.supervision import MAX_BAD_FRAMES, MAX_LOST_FRAMES, RECOVERY_NS, WINDOW_FRAMES, Flow, Supervisor

CATALOGUE = load()
MS = 1_000_000
STATUS = CATALOGUE.by_name["SR_Status"]
POSITION = CATALOGUE.by_name["PosLocal"]


class Sender:
    """Sends good frames of a message, or spoilt ones."""

    def __init__(self, name="SR_Status", **values):
        self.spec = CATALOGUE.by_name[name]
        self._payload = CATALOGUE.encode(name, values)
        self._protector = None if self.spec.e2e_data_id is None else E2EProtector(self.spec.e2e_data_id)

    def frame(self, t_ns):
        payload = self._payload if self._protector is None else self._protector.protect(self._payload)
        return CanFrame(self.spec.arbitration_id, payload, t_ns)

    def bad(self, t_ns):
        good = self.frame(t_ns)
        return good._replace(data=bytes([good.data[0] ^ 0xFF]) + good.data[1:])


def supervisor():
    return Supervisor(CATALOGUE, ["SR_Status", "PosLocal"])


def causes(findings):
    return {(finding.cause, finding.source) for finding in findings}


def test_good_frames_are_decoded_the_newest_wins():
    watching, sender = supervisor(), Sender(AngleActual=12.5)
    newer = Sender(AngleActual=13.0)
    newer.frame(0)
    values = watching.observe([sender.frame(5), newer.frame(6), Sender("PosLocal", PosLocalX=3.0).frame(7)])
    assert values["SR_Status"]["AngleActual"] == 13.0
    assert values["PosLocal"]["PosLocalX"] == 3.0
    assert (watching.arrival_ns("SR_Status"), watching.arrival_ns("PosLocal")) == (6, 7)
    assert (watching.received, watching.rejected) == (3, {})
    assert watching.findings(8) == []


def test_nothing_has_arrived_yet():
    watching = supervisor()
    assert watching.arrival_ns("SR_Status") is None
    missing = Finding(Cause.MESSAGE_MISSING, (STATUS.timeout_ns + 1) * 1e-6, STATUS.timeout_ns * 1e-6, "SR_Status")
    assert missing in watching.findings(0)
    assert causes(watching.findings(0)) == {(Cause.MESSAGE_MISSING, "SR_Status"), (Cause.MESSAGE_MISSING, "PosLocal")}


@pytest.mark.req("F6")
def test_a_message_is_missing_from_its_timeout_on():
    watching = supervisor()
    watching.observe([Sender().frame(10), Sender("PosLocal").frame(10 + MS)])
    assert watching.findings(10 + STATUS.timeout_ns) == []
    late_ns = 10 + STATUS.timeout_ns + 1
    assert watching.findings(late_ns) == [
        Finding(Cause.MESSAGE_MISSING, (STATUS.timeout_ns + 1) * 1e-6, STATUS.timeout_ns * 1e-6, "SR_Status")
    ]


@pytest.mark.req("F7")
@pytest.mark.parametrize("data", [b"", bytes(7), bytes(9), bytes(64)])
def test_another_length_is_no_frame(data):
    watching = supervisor()
    assert watching.observe([CanFrame(STATUS.arbitration_id, data, 0)]) == {}
    assert watching.rejected == {"SR_Status: length": 1}
    assert watching.arrival_ns("SR_Status") is None


@pytest.mark.req("F7")
def test_wrong_crc_and_repeated_counter_are_ignored_at_once():
    watching, sender = supervisor(), Sender(AngleActual=1.0)
    good = sender.frame(0)
    assert "SR_Status" in watching.observe([good])
    assert watching.observe([good._replace(t_ns=1), sender.bad(2)]) == {}
    assert watching.rejected == {"SR_Status: repeated": 1, "SR_Status: wrong crc": 1}
    assert watching.arrival_ns("SR_Status") == 0


def test_a_value_out_of_its_range_is_ignored():
    watching = supervisor()
    angle_raw = (32767).to_bytes(2, "little")
    payload = E2EProtector(STATUS.e2e_data_id).protect(bytes(2) + angle_raw + bytes(4))
    assert watching.observe([CanFrame(STATUS.arbitration_id, payload, 3)]) == {}
    assert watching.rejected == {"SR_Status: range": 1}
    assert watching.arrival_ns("SR_Status") is None


@pytest.mark.req("F7")
def test_three_bad_frames_of_ten_make_a_message_invalid_until_a_second_is_clean():
    watching, sender = supervisor(), Sender()
    position = Sender("PosLocal")

    def observe(k, is_bad):
        t_ns = k * 10 * MS
        watching.observe([sender.bad(t_ns) if is_bad else sender.frame(t_ns), position.frame(t_ns)])
        return watching.findings(t_ns)

    for k, is_bad in enumerate([False, True, False, True, False]):
        assert observe(k, is_bad) == []
    assert observe(5, True) == [Finding(Cause.MESSAGE_INVALID, MAX_BAD_FRAMES + 1, MAX_BAD_FRAMES, "SR_Status")]
    for k in range(6, 106):
        assert causes(observe(k, False)) == {(Cause.MESSAGE_INVALID, "SR_Status")}
    assert (105 - 5) * 10 * MS == RECOVERY_NS
    assert observe(106, False) == []
    assert observe(107, False) == []
    assert observe(108, True) == []  # and a single bad one is only counted again


def test_bad_frames_that_lie_far_apart_are_only_counted():
    watching, sender, position = supervisor(), Sender(), Sender("PosLocal")
    for k in range(100):
        t_ns = k * 10 * MS
        is_bad = k % (WINDOW_FRAMES // 2) == 4
        watching.observe([sender.bad(t_ns) if is_bad else sender.frame(t_ns), position.frame(t_ns)])
        assert watching.findings(t_ns) == []
    assert watching.rejected == {"SR_Status: wrong crc": 20}


@pytest.mark.req("F7")
@pytest.mark.parametrize(("last", "is_invalid"), [(WINDOW_FRAMES - 1, True), (WINDOW_FRAMES, False)])
def test_three_bad_frames_count_together_when_ten_frames_hold_them(last, is_invalid):
    watching, sender, position = supervisor(), Sender(), Sender("PosLocal")
    watching.observe([sender.frame(0)])
    for k in range(WINDOW_FRAMES + 1):
        t_ns = k * 10 * MS
        watching.observe([sender.bad(t_ns) if k in (0, 4, last) else sender.frame(t_ns), position.frame(t_ns)])
    assert causes(watching.findings(t_ns)) == ({(Cause.MESSAGE_INVALID, "SR_Status")} if is_invalid else set())


def test_a_message_without_a_cycle_is_neither_expected_nor_counted_among_those_that_are():
    specs = [CATALOGUE.by_name[name] for name in FAST]
    event = replace(STATUS, name="Event", cycle_time_ns=0)
    flow = Flow([*specs, event])
    for k in range(20):
        for _ in range(100):
            flow.note_good(event, k * 10 * MS)
        found = flow.losses(k * 10 * MS).finding("bus")
    limit = pytest.approx(100 * (len(FAST) + MAX_LOST_FRAMES) / (13 * len(FAST)))
    assert found == Finding(Cause.FRAMES_LOST, pytest.approx(100.0), limit, "bus")


@pytest.mark.req("F11")
def test_unknown_ids_are_counted_and_known_ones_that_nobody_needs_are_not():
    watching = supervisor()
    watching.observe([CanFrame(0x7FF, b"", 0), Sender("AR_Status").frame(0)])
    watching.observe([CanFrame(0x7FE, b"", 0)])
    assert watching.rejected == {"unknown id": 2}
    assert watching.received == 3


@pytest.mark.req("F5")
def test_a_second_sender_of_our_frames_is_named_once():
    watching = supervisor()
    watching.observe([Sender().frame(0), Sender("PosLocal").frame(0), Sender("SR_Command").frame(0), Sender("SR_Command").frame(0)])
    watching.observe([])
    assert watching.findings(0) == [Finding(Cause.SECOND_SENDER, 2, 0, "SR_Command")]
    assert watching.findings(0) == []
    assert watching.rejected == {"SR_Command: second sender": 2}


class Traffic:
    """Both buses as they should be, of which `keeps` decides what arrives."""

    def __init__(self, *names):
        self.watching = Supervisor(CATALOGUE, names)
        self.senders = [Sender(name) for name in names]
        self.now_ns = 0

    def run(self, ticks, keeps):
        causes_found = []
        for _ in range(ticks):
            self.now_ns += 10 * MS
            sent = [sender.frame(self.now_ns) for sender in self.senders]
            self.watching.observe([frame for k, frame in enumerate(sent) if keeps(k)])
            causes_found += [finding for finding in self.watching.findings(self.now_ns) if finding.cause is Cause.FRAMES_LOST]
        return causes_found


FAST = ("PosLocal", "VelocityLevel", "AccelLevel", "VelYawLocal", "RateVehicle", "MilliTime")
ROBOTS = ("SR_Status", "AR_Status", "BR_Status", "RC_SafetyStatus", "CAR_WheelSpeeds", "CAR_Powertrain")


@pytest.mark.req("F9")
def test_losses_that_no_message_shows_by_itself_are_found_in_the_sum():
    for seed in range(50):
        dice = random.Random(seed)
        for names, source in ((FAST, "navigation"), (ROBOTS, "robots")):
            traffic = Traffic(*FAST, *ROBOTS)
            lossy_ids = {CATALOGUE.by_name[name].arbitration_id for name in names}
            is_lossy = [sender.spec.arbitration_id in lossy_ids for sender in traffic.senders]
            assert traffic.run(100, lambda _: True) == []
            lossy = traffic.run(15, lambda k, is_lossy=is_lossy, dice=dice: not is_lossy[k] or dice.random() >= 0.3)
            assert lossy
            assert source in {finding.source for finding in lossy} <= {source, "buses"}
            assert all(finding.value > finding.limit for finding in lossy)


@pytest.mark.req("F9")
def test_what_comes_too_often_makes_up_for_nothing_else():
    traffic = Traffic(*FAST)
    traffic.senders += [Sender(name) for name in FAST[2:]] * 3
    assert traffic.run(20, lambda _: True) == []
    found = [finding for tick in range(14) for finding in traffic.run(1, lambda k, tick=tick: k > 1 or tick % 3 == 0)]
    assert found
    assert {finding.source for finding in found} == {"navigation", "buses"}


@pytest.mark.req("F9")
def test_what_both_buses_lose_is_found_in_their_sum():
    traffic = Traffic(*FAST, *ROBOTS)
    traffic.run(20, lambda _: True)
    found = [finding for tick in range(14) for finding in traffic.run(1, lambda k, tick=tick: k not in {0, 10} or tick % 4 == 0)]
    assert {finding.source for finding in found} == {"buses"}


@pytest.mark.req("F9")
def test_one_per_cent_of_losses_is_ridden_out():
    dice = random.Random(1)
    assert Traffic(*FAST).run(6_000, lambda _: dice.random() >= 0.01) == []


def test_the_exact_number_of_losses():
    expected = 13 * len(FAST)
    limit = len(FAST) + MAX_LOST_FRAMES
    for lost in (limit, limit + 1):
        traffic = Traffic(*FAST)
        traffic.run(20, lambda _: True)
        to_lose = iter(range(lost))
        found = traffic.run(9, lambda k, to_lose=to_lose: k == 0 or next(to_lose, None) is None)
        assert [(f.value, f.limit) for f in found[:1]] == (
            [(pytest.approx(100 * lost / expected, rel=1e-9), pytest.approx(100 * limit / expected, rel=1e-9))] if lost > limit else []
        )
        traffic.run(13, lambda _: True)
        assert traffic.run(1, lambda _: True) == []  # what was lost is forgotten after the window


def test_a_short_time_says_nothing_and_slow_messages_are_not_counted():
    traffic = Traffic(*FAST, "NcomStatus05") if "NcomStatus05" in CATALOGUE.by_name else Traffic(*FAST)
    assert traffic.run(13, lambda k: k == 0) == []
    assert traffic.run(1, lambda k: k == 0)


@pytest.mark.req("F9")
def test_when_all_the_senders_pause_nothing_is_lost():
    for pause_ticks in range(1, 5):  # after five every message is missing
        traffic = Traffic(*FAST)
        traffic.run(20, lambda _: True)
        assert traffic.run(pause_ticks, lambda _: False) == []
        assert traffic.run(20, lambda _: True) == []


@pytest.mark.req("F9")
def test_a_pause_of_one_bus_is_no_loss_in_the_sum_either():
    for is_paused in (lambda k: k < len(FAST), lambda k: k >= len(FAST)):
        traffic = Traffic(*FAST, *ROBOTS)
        traffic.run(20, lambda _: True)
        assert traffic.run(4, lambda k, is_paused=is_paused: not is_paused(k)) == []
        assert traffic.run(20, lambda _: True) == []


def test_the_exact_number_of_losses_beside_a_pause():
    traffic = Traffic(*FAST)
    traffic.run(20, lambda _: True)
    traffic.run(4, lambda k: k == 0)
    for pause_ticks in range(1, 4):
        found, same = traffic.run(1, lambda _: False)  # of its bus and of all
        assert same._replace(source="buses") == found
        expected = len(FAST) * (13 - (pause_ticks - 1))  # 10 ms without a frame are usual
        arrived = len(FAST) * (13 - 4 - pause_ticks) + 4
        assert found.value == pytest.approx(100 * (expected - arrived) / expected, rel=1e-9)
        assert found.limit == pytest.approx(100 * (len(FAST) + MAX_LOST_FRAMES) / expected, rel=1e-9)


@pytest.mark.req("F9")
def test_a_pause_that_is_over_for_long_excuses_no_losses():
    found = []
    for pause_ticks in (0, 4):
        traffic = Traffic(*FAST)
        traffic.run(20, lambda _: True)
        traffic.run(pause_ticks, lambda _: False)
        traffic.run(20, lambda _: True)
        found.append(traffic.run(5, lambda k: k == 0))
    assert found[0] == found[1] != []


@pytest.mark.req("F9")
def test_who_pauses_again_and_again_loses():
    traffic = Traffic(*FAST)
    traffic.run(20, lambda _: True)
    found = []
    for _ in range(7):
        found += traffic.run(1, lambda _: False) + traffic.run(1, lambda _: True)
    assert found
