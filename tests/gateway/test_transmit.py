"""The last line before the bus: what passes, and that nothing else does."""

import random
from dataclasses import replace

import pytest

from dbc.catalogue import CatalogueError, load
from dbc.frame import CanFrame
from gateway.messages import Mode
from gateway.transmit import MAX_FRAMES, RATE_CYCLES, TransmitGate

pytestmark = pytest.mark.req("G2")

CATALOGUE = load()
MS = 1_000_000
NOW_NS = 1_000_000_000
OWN = {spec.arbitration_id: spec for spec in CATALOGUE.by_name.values() if spec.sender == "GW"}
REQUEST = {
    Mode.STANDBY: "Disarm", Mode.READY: "Arm", Mode.ENGAGED: "Engage", Mode.COMFORT_STOP: "Engage", Mode.SAFE_STOP: "Engage",
    Mode.FAULT: "Disarm",
}  # fmt: skip
SENDING = list(REQUEST)
DRIVING = [Mode.ENGAGED, Mode.COMFORT_STOP, Mode.SAFE_STOP]
RESTING = [mode for mode in SENDING if mode not in DRIVING]
ROBOTS = {"SR_Command": "AngleCommand", "AR_Command": "PositionCommand", "BR_Command": "PositionCommand"}


def frame(name, **values):
    raw = {signal: CATALOGUE.enumeration(name, signal)[value] if isinstance(value, str) else value for signal, value in values.items()}
    return CanFrame(CATALOGUE.by_name[name].arbitration_id, CATALOGUE.encode(name, raw), NOW_NS)


def safety(request):
    return frame("GW_SafetyCommand", SystemRequest=request)


def neutral(name):
    return frame(name, Mode="Standby")


def active(name, **values):
    return frame(name, Mode="AnglePosition" if name == "SR_Command" else "Position", Enable=1, **values)


def cause(mode, sent, gate=None):
    """Why a frame is dropped; empty when it passes."""
    gate = gate or TransmitGate(CATALOGUE)
    before = gate.rejected.total()
    admitted = gate.admit(NOW_NS, mode, [sent])
    assert admitted == ([] if gate.rejected.total() > before else [sent])
    return next(iter(gate.rejected), "")


# ---- allow-list


@pytest.mark.parametrize("mode", list(Mode), ids=lambda mode: mode.name)
def test_of_2048_identifiers_and_9_lengths_only_the_listed_pass(mode):
    valid = {f.arbitration_id: f.data for f in (*map(neutral, ROBOTS), frame("GW_Heartbeat"), frame("GW_Status"))}
    if mode is not Mode.SILENT:
        valid[safety(REQUEST[mode]).arbitration_id] = safety(REQUEST[mode]).data
    expected = set() if mode is Mode.SILENT else {(spec.arbitration_id, spec.length_bytes) for spec in OWN.values()}
    gate, passed = TransmitGate(CATALOGUE), set()
    for arbitration_id in range(2048):
        payload = valid.get(arbitration_id, bytes(8))
        for length in range(9):
            sent = CanFrame(arbitration_id, payload[:length], NOW_NS)
            if gate.admit(NOW_NS, mode, [sent]):
                passed.add((arbitration_id, length))
    assert passed == expected
    assert gate.rejected.total() == 2048 * 9 - len(expected)
    causes = {"silent"} if mode is Mode.SILENT else {"not in the allow-list", "length"}
    assert set(gate.rejected) == causes


def test_the_list_is_what_the_gateway_sends_by_the_dbc():
    assert {spec.name for spec in OWN.values()} == {*ROBOTS, "GW_SafetyCommand", "GW_Heartbeat", "GW_Status"}


@pytest.mark.req("S4")
@pytest.mark.parametrize(("arbitration_id", "is_refused"), [(0x7DE, False), (0x7DF, True), (0x7E0, True), (0x7EF, True), (0x7F0, False)])
def test_a_dbc_that_makes_the_gateway_diagnose_is_refused(arbitration_id, is_refused):
    catalogue = load()
    catalogue.by_name["GW_Heartbeat"] = replace(catalogue.by_name["GW_Heartbeat"], arbitration_id=arbitration_id)
    if is_refused:
        with pytest.raises(CatalogueError) as caught:
            TransmitGate(catalogue)
        assert str(caught.value) == f"message GW_Heartbeat (id 0x{arbitration_id:X}): 0x7DF and 0x7E0 to 0x7EF are for diagnosis"
    else:
        TransmitGate(catalogue)


def test_100000_extended_identifiers_are_refused():
    gate, rng = TransmitGate(CATALOGUE), random.Random(5)
    payloads = [neutral("SR_Command").data, safety("Engage").data, bytes(8), b""]
    frames = [CanFrame(rng.randrange(0x800, 1 << 29), rng.choice(payloads), NOW_NS) for _ in range(100_000)]
    # A list that is compared modulo 2048 would let these through.
    frames += [CanFrame(own + (high << 11), payload, NOW_NS) for own in OWN for high in range(1, 64) for payload in payloads]
    frames += [CanFrame(own - 2048, neutral("SR_Command").data, NOW_NS) for own in OWN]
    assert gate.admit(NOW_NS, Mode.ENGAGED, frames) == []
    assert gate.rejected == {"not in the allow-list": len(frames)}


@pytest.mark.parametrize("extra", [b"\0", bytes(56)])
def test_longer_payloads_are_refused(extra):
    sent = neutral("SR_Command")
    assert cause(Mode.READY, sent._replace(data=sent.data + extra)) == "length"


def test_another_node_has_another_list():
    gate = TransmitGate(CATALOGUE, node="RC")
    status = CanFrame(CATALOGUE.by_name["RC_SafetyStatus"].arbitration_id, bytes(8), NOW_NS)
    assert gate.admit(NOW_NS, Mode.STANDBY, [status, neutral("SR_Command")]) == [status]


# ---- silence


def test_silent_means_that_nothing_is_sent():
    for sent in (neutral("SR_Command"), safety("None"), safety("Disarm"), frame("GW_Heartbeat"), frame("GW_Status")):
        assert cause(Mode.SILENT, sent) == "silent"


@pytest.mark.parametrize("mode", SENDING, ids=lambda mode: mode.name)
def test_the_frames_of_each_mode_pass_in_their_order_and_unchanged(mode):
    robots = [active(name, **{ROBOTS[name]: 12.0}) if mode in DRIVING else neutral(name) for name in ROBOTS]
    frames = [safety(REQUEST[mode]), *robots, frame("GW_Heartbeat", UpTime=12.0), frame("GW_Status", Mode=2)]
    gate = TransmitGate(CATALOGUE)
    assert gate.admit(NOW_NS, mode, frames) == frames
    assert not gate.rejected


# ---- what the robots are asked for


@pytest.mark.parametrize("mode", SENDING, ids=lambda mode: mode.name)
def test_the_request_must_be_that_of_the_mode(mode):
    allowed = {Mode.STANDBY: {"None", "Disarm"}, Mode.FAULT: {"None", "Disarm"}}.get(mode, {REQUEST[mode]})
    for name in CATALOGUE.enumeration("GW_SafetyCommand", "SystemRequest"):
        assert cause(mode, safety(name)) == ("" if name in allowed else "request")
    nameless = frame("GW_SafetyCommand", SystemRequest=6)
    assert cause(mode, nameless) == "request"


@pytest.mark.parametrize("mode", RESTING, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", ROBOTS)
def test_outside_the_driving_modes_robots_are_told_to_rest(mode, name):
    assert cause(mode, frame(name, Mode="Standby")) == ""
    assert cause(mode, frame(name, Mode="Off")) == ""
    assert cause(mode, frame(name, Mode="Standby", RateLimit=800.0)) == ""
    assert cause(mode, frame(name, Mode="Standby", Enable=1)) == "not neutral"
    assert cause(mode, frame(name, Mode="AnglePosition" if name == "SR_Command" else "Position")) == "not neutral"
    step = {"SR_Command": 0.05}.get(name, 0.01)
    assert cause(mode, frame(name, Mode="Standby", **{ROBOTS[name]: step})) == "not neutral"
    assert cause(mode, active(name, **{ROBOTS[name]: 50.0})) == "not neutral"


def test_a_demand_to_the_right_is_one_too():
    assert cause(Mode.READY, frame("SR_Command", Mode="Standby", AngleCommand=-0.05)) == "not neutral"


@pytest.mark.parametrize("mode", SENDING, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", ROBOTS)
def test_robots_are_moved_by_position_only(mode, name):
    named = CATALOGUE.enumeration(name, "Mode")
    for robot_mode in named:
        if robot_mode not in ("Off", "Standby", "AnglePosition", "Position"):
            assert cause(mode, frame(name, Mode=robot_mode)) == "robot mode"
    assert cause(mode, frame(name, Mode=6)) == "robot mode"  # has no name
    effort = {"TorqueFeedForward": 0.1} if name == "SR_Command" else {"ForceCommand": 0.5}
    assert cause(mode, frame(name, Mode="Standby", **effort)) == "robot mode"
    assert cause(mode, active(name, **effort)) == "robot mode"


@pytest.mark.parametrize("mode", DRIVING, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", ROBOTS)
def test_while_driving_demands_pass(mode, name):
    assert cause(mode, active(name, **{ROBOTS[name]: 50.0})) == ""
    assert cause(mode, neutral(name)) == ""
    assert cause(mode, frame(name, Mode="Standby", Enable=1)) == ""


def test_a_demand_outside_the_range_of_the_dbc_is_dropped():
    data = bytearray(active("AR_Command").data)
    for raw, expected in ((10_000, ""), (10_001, "range")):
        data[2:4] = raw.to_bytes(2, "little")
        assert cause(Mode.ENGAGED, CanFrame(288, bytes(data), NOW_NS)) == expected


def test_a_dropped_frame_does_not_hold_up_the_others_and_is_counted():
    gate = TransmitGate(CATALOGUE)
    good = [neutral("SR_Command"), neutral("BR_Command")]
    assert gate.admit(NOW_NS, Mode.READY, [good[0], active("AR_Command"), safety("Engage"), safety("Disarm"), good[1]]) == good
    assert gate.rejected == {"not neutral": 1, "request": 2}


# ---- rate


@pytest.mark.parametrize("name", ["SR_Command", "GW_Status"])
def test_of_ten_periods_at_most_twelve_frames(name):
    assert (RATE_CYCLES, MAX_FRAMES) == (10, 12)
    gate, period_ns = TransmitGate(CATALOGUE), CATALOGUE.by_name[name].cycle_time_ns
    sent = neutral(name) if name in ROBOTS else frame(name)

    def passes(t_ns, sent=sent):
        return gate.admit(t_ns, Mode.READY, [sent]) == [sent]

    assert all(passes(NOW_NS + k) for k in range(12))
    assert not passes(NOW_NS + 12)
    assert not passes(NOW_NS + 10 * period_ns - 1)
    assert passes(NOW_NS + 10 * period_ns)  # the first is ten periods old
    assert not passes(NOW_NS + 10 * period_ns)
    assert passes(NOW_NS + 10 * period_ns + 1)
    assert gate.rejected == {"rate": 3}
    assert passes(NOW_NS + 12, neutral("BR_Command"))  # each message has its own


def test_frames_that_were_dropped_do_not_count_for_the_rate():
    gate = TransmitGate(CATALOGUE)
    for _ in range(20):
        assert not gate.admit(NOW_NS, Mode.READY, [active("SR_Command")])
    assert gate.rejected == {"not neutral": 20}
    assert gate.admit(NOW_NS, Mode.READY, [neutral("SR_Command")])


def test_late_ticks_never_cost_a_frame():
    gate, rng = TransmitGate(CATALOGUE), random.Random(11)
    frames = [safety("Engage"), *map(active, ROBOTS)]
    last_ns = 0
    for k in range(20_000):  # each up to 15 ms late, none before the one before it: a burst after every stall
        last_ns = max(last_ns, NOW_NS + k * 10 * MS + rng.choice((0, 0, 0, rng.randrange(15 * MS))))
        assert gate.admit(last_ns, Mode.ENGAGED, frames) == frames
    assert not gate.rejected


def test_in_any_second_at_most_1_2_times_the_rate():
    gate, rng, passed, t_ns = TransmitGate(CATALOGUE), random.Random(3), [], NOW_NS
    for _ in range(5_000):
        t_ns += rng.randrange(2 * MS)
        if gate.admit(t_ns, Mode.READY, [neutral("SR_Command")]):
            passed.append(t_ns)
    assert max(sum(t - 1_000 * MS < other <= t for other in passed) for t in passed) <= 120
    assert len(passed) / ((t_ns - NOW_NS) / 1e9) == pytest.approx(120, rel=0.02)
