"""Gateway and car on two buses in virtual time: who hears what, when, and in which order."""

from collections.abc import Iterable

import pytest

from dbc.catalogue import load
from dbc.frame import CanFrame
from vehicle_emulator.bus.bits import frame_bits
from vehicle_emulator.bus.frame import BusFrame
from xil.virtual_bus import VirtualBuses

CATALOGUE = load()
BIT_NS = 2_000
START_NS = 1_000_000_000
MS_NS = 1_000_000


def frame(name: str, data: bytes = bytes(8)) -> CanFrame:
    return CanFrame(CATALOGUE.by_name[name].arbitration_id, data, 0)


def duration_ns(sent: CanFrame) -> int:
    bits, _ = frame_bits(BusFrame(sent.arbitration_id, sent.data, 0, len(sent.data)))
    return bits * BIT_NS


def send(buses: VirtualBuses, frames: Iterable[CanFrame], now_ns: int) -> None:
    """Every frame from whom the DBC has it."""
    for each in frames:
        spec = CATALOGUE.by_id.get(each.arbitration_id)
        one = buses.send_from_gateway if spec is not None and spec.sender == "GW" else buses.send_from_car
        one([each], now_ns)


@pytest.fixture
def buses():
    buses = VirtualBuses(CATALOGUE)
    assert buses.advance(START_NS) == []
    return buses


def test_a_frame_arrives_when_its_last_bit_has(buses):
    sent = frame("SR_Command", b"\x01\x02\x03\x04\x05\x06\x07\x08")
    send(buses, [sent], START_NS)
    end_ns = START_NS + duration_ns(sent)
    assert buses.advance(end_ns - 1) == []
    (arrival,) = buses.advance(end_ns)
    assert arrival == ("robots", sent._replace(t_ns=end_ns), False, True)
    assert buses.advance(START_NS + 10 * MS_NS) == []


def test_the_car_hears_the_gateway_alone_and_the_gateway_everybody(buses):
    names = ("SR_Command", "SR_Status", "RC_SafetyStatus", "PosLocal")
    send(buses, map(frame, names), START_NS)
    heard = {CATALOGUE.by_id[a.frame.arbitration_id].name: a for a in buses.advance(START_NS + 5 * MS_NS)}
    assert {name for name, a in heard.items() if a.is_for_car} == {"SR_Command"}
    assert {name for name, a in heard.items() if a.is_for_gateway} == {"SR_Status", "RC_SafetyStatus", "PosLocal"}
    assert {name for name, a in heard.items() if a.network == "navigation"} == {"PosLocal"}


def test_frames_of_one_moment_go_by_priority_on_each_bus_and_the_buses_side_by_side(buses):
    names = ["MilliTime", "BR_Status", "SR_Command", "PosLocal", "RC_SafetyStatus", "GW_SafetyCommand", "SR_Status"]
    send(buses, map(frame, names), START_NS)
    arrivals = buses.advance(START_NS + 10 * MS_NS)
    assert [a.frame.t_ns for a in arrivals] == sorted(a.frame.t_ns for a in arrivals)
    for network, expected in {
        "robots": ["GW_SafetyCommand", "RC_SafetyStatus", "SR_Command", "SR_Status", "BR_Status"],
        "navigation": ["PosLocal", "MilliTime"],
    }.items():
        own = [a.frame for a in arrivals if a.network == network]
        assert [CATALOGUE.by_id[each.arbitration_id].name for each in own] == expected
        end_ns = START_NS
        for each in own:
            end_ns += duration_ns(each)
            assert each.t_ns == end_ns
            end_ns += 3 * BIT_NS  # intermission


def test_a_command_waits_for_the_frame_on_the_wire_and_no_longer(buses):
    slow, urgent = frame("GW_Heartbeat"), frame("SR_Command")
    send(buses, [slow, frame("BR_Status")], START_NS)
    first_ns = START_NS + duration_ns(frame("BR_Status"))
    buses.advance(START_NS + 10 * BIT_NS)
    send(buses, [urgent], START_NS + 10 * BIT_NS)
    order = [CATALOGUE.by_id[a.frame.arbitration_id].name for a in buses.advance(START_NS + 5 * MS_NS)]
    assert order == ["BR_Status", "SR_Command", "GW_Heartbeat"]
    assert first_ns > START_NS + 10 * BIT_NS


def test_a_stranger_is_heard_by_the_gateway_on_the_robots_bus(buses):
    send(buses, [CanFrame(1, b"\xff", 0)], START_NS)
    (arrival,) = buses.advance(START_NS + MS_NS)
    assert (arrival.network, arrival.frame.arbitration_id, arrival.is_for_gateway, arrival.is_for_car) == ("robots", 1, True, False)


def test_what_the_car_sends_under_an_identifier_of_the_gateway_is_not_sent_by_the_gateway(buses):
    forged, genuine = frame("SR_Command", b"\x01" * 8), frame("SR_Command", b"\x02" * 8)
    buses.send_from_car([forged], START_NS)
    (arrival,) = buses.advance(START_NS + MS_NS)
    assert (arrival.frame.data, arrival.is_for_gateway, arrival.is_for_car) == (forged.data, True, False)
    buses.send_from_gateway([genuine], START_NS + MS_NS)
    (arrival,) = buses.advance(START_NS + 2 * MS_NS)
    assert (arrival.frame.data, arrival.is_for_gateway, arrival.is_for_car) == (genuine.data, False, True)


def test_a_disturbance_can_be_taken_back(buses):
    sent = [frame("SR_Command"), frame("PosLocal")]
    for arbitration_id in (None, sent[0].arbitration_id):
        buses.disturb(arbitration_id, 20)
        buses.disturb(arbitration_id, 0)
    send(buses, sent, START_NS)
    ends_ns = {a.network: a.frame.t_ns - START_NS for a in buses.advance(START_NS + 5 * MS_NS)}
    assert ends_ns == {"robots": duration_ns(sent[0]), "navigation": duration_ns(sent[1])}


def test_a_disturbed_frame_is_repeated_and_comes_later(buses):
    sent = frame("SR_Command")
    buses.disturb(sent.arbitration_id, 2)
    send(buses, [sent, frame("PosLocal")], START_NS)
    arrivals = {a.network: a.frame for a in buses.advance(START_NS + 5 * MS_NS)}
    assert arrivals["navigation"].t_ns == START_NS + duration_ns(frame("PosLocal"))
    assert arrivals["robots"].t_ns > START_NS + 3 * duration_ns(sent)


def test_any_frame_of_either_bus_can_be_disturbed(buses):
    buses.disturb(None, 1)
    sent = [frame("SR_Command"), frame("PosLocal")]
    send(buses, sent, START_NS)
    arrivals = buses.advance(START_NS + 5 * MS_NS)
    assert {a.network for a in arrivals} == {"robots", "navigation"}
    assert all(a.frame.t_ns > START_NS + 2 * min(map(duration_ns, sent)) for a in arrivals)


def test_load_is_the_share_of_busy_bits(buses):
    sent = [frame("SR_Command"), frame("PosLocal"), frame("MilliTime")]
    send(buses, sent, START_NS)
    buses.advance(START_NS + 5 * MS_NS)
    loads = buses.load(START_NS + 10 * MS_NS)
    busy_ns = [duration_ns(each) + 3 * BIT_NS for each in sent]
    assert loads == {"robots": pytest.approx(busy_ns[0] / 1e7), "navigation": pytest.approx(sum(busy_ns[1:]) / 1e7)}


def test_the_bit_rate_is_that_of_the_dbc():
    faster = load()
    faster.bitrate_bps["navigation"] = 1_000_000
    buses = VirtualBuses(faster)
    send(buses, [frame("PosLocal"), frame("SR_Status")], START_NS)
    ends = {a.network: a.frame.t_ns - START_NS for a in buses.advance(START_NS + MS_NS)}
    assert ends == {"robots": duration_ns(frame("SR_Status")), "navigation": duration_ns(frame("PosLocal")) // 2}
