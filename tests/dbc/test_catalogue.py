"""Catalogue, codec and end-to-end protection, for every message and signal of the DBC files."""

import math

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, DecodeError, EncodeError, load
from dbc.e2e import E2EProtector, E2EReceiver, E2EStatus
from dbc.frame import CanFrame

CATALOGUE = load()
MESSAGES = [m for path in (ROBOTS_DBC, GNSS_IMU_DBC) for m in cantools.database.load_file(str(path)).messages]
SIGNALS = [(m, s) for m in MESSAGES for s in m.signals]
SITE_DBC = 'VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n SG_ S : 0|8@1+ (1,0) [0|255] "" A\n'
PROTECTED = [s.name for s in CATALOGUE.by_name.values() if s.e2e_data_id is not None]


def frame_of(name, payload):
    return CanFrame(CATALOGUE.by_name[name].arbitration_id, payload, 0)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.name)
def test_every_message_that_is_sent_is_cyclic_and_supervised(message):
    spec = CATALOGUE.by_name[message.name]
    assert spec.arbitration_id == message.frame_id
    assert spec.timeout_ns >= 3 * spec.cycle_time_ns
    assert spec.sender in ("GW", "RC", "SR", "AR", "BR", "CAR", "INS")
    # What the navigation system could send as well is described, but has no cycle time.
    assert (spec.cycle_time_ns > 0) == (spec.timeout_ns > 0)
    assert spec.cycle_time_ns > 0 or spec.sender == "INS"


@pytest.mark.parametrize(("message", "signal"), SIGNALS, ids=lambda x: x.name)
def test_extremes_of_every_signal_survive(message, signal):
    spec = CATALOGUE.by_name[message.name]
    for value in (signal.minimum, signal.maximum):
        decoded = CATALOGUE.decode(spec, frame_of(message.name, CATALOGUE.encode(message.name, {signal.name: value})))
        assert decoded[signal.name] == pytest.approx(value, abs=0.5 * abs(signal.scale))
        for beyond in (math.nan, math.inf, signal.maximum + 2 * signal.scale, signal.minimum - 2 * signal.scale):
            with pytest.raises(EncodeError, match=signal.name):
                CATALOGUE.encode(message.name, {signal.name: beyond})


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_round_trip_within_half_a_bit(data):
    message, signal = data.draw(st.sampled_from(SIGNALS))
    value = data.draw(st.floats(float(signal.minimum), float(signal.maximum)))
    frame = frame_of(message.name, CATALOGUE.encode(message.name, {signal.name: value}))
    decoded = CATALOGUE.decode(CATALOGUE.by_name[message.name], frame)
    assert decoded[signal.name] == pytest.approx(value, abs=0.5000001 * abs(signal.scale))


def test_golden_vectors():
    # Worked out by hand from the bit positions in the DBC: 12.5 deg = 250 * 0.05, mode 2 in bits 12..14, enable in bit 15.
    assert CATALOGUE.encode("SR_Command", {"AngleCommand": 12.5, "Mode": 2, "Enable": 1}).hex() == "00a0fa0000000000"
    # 123.4567 m = 1234567 = 0x0012D687, little endian; -1 m = -10000 = 0xFFFFD8F0.
    assert CATALOGUE.encode("PosLocal", {"PosLocalX": 123.4567, "PosLocalY": -1.0}).hex() == "87d61200f0d8ffff"


@pytest.mark.parametrize("length", [0, 1, 7])
def test_wrong_length_is_rejected(length):
    with pytest.raises(DecodeError, match="expected 8"):
        CATALOGUE.decode(CATALOGUE.by_name["PosLocal"], frame_of("PosLocal", bytes(length)))


def test_value_out_of_range_is_rejected():
    with pytest.raises(DecodeError, match="PositionActual"):
        CATALOGUE.decode(CATALOGUE.by_name["AR_Status"], frame_of("AR_Status", b"\x00\x00\xff\xff\x00\x00\x00\x00"))


def test_a_multiplexed_message_carries_the_page_of_its_signals():
    spec = CATALOGUE.by_name["RC_FaultReport"]

    def decoded(values):
        return CATALOGUE.decode(spec, frame_of("RC_FaultReport", CATALOGUE.encode("RC_FaultReport", values)))

    # 460 deg = 4600 * 0.1 = 0x11F8 from bit 8, 60 Nm = 600 * 0.1 = 0x0258 from bit 40.
    assert CATALOGUE.encode("RC_FaultReport", {"Page": 1, "MaxAngle": 460.0, "MaxTorque": 60.0}).hex() == "01f8110000580200"
    assert decoded({"BrStroke": 150.0}) == {"Page": 3, "BrStroke": 150.0, "BrMaxForce": 0.0}
    assert set(decoded({})) == {"Page", "Robot", "Active", "Latched", "Dtc", "Count", "TimeStamp"}
    with pytest.raises(DecodeError, match="multiplexer"):
        CATALOGUE.decode(spec, frame_of("RC_FaultReport", b"\x09" + bytes(7)))


def test_unknown_signal_is_named():
    with pytest.raises(EncodeError, match="Angel"):
        CATALOGUE.encode("SR_Command", {"Angel": 1})


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("not a dbc at all", "not a usable DBC"),
        ('VERSION ""\nBU_: A\nBO_ 1 X: 8 A\n SG_ S : 0|8@1+ (1,0) [0|255] "" A\n SG_ T : 4|8@1+ (1,0) [0|255] "" A\n', "not a usable DBC"),
    ],
)
def test_broken_dbc_is_one_line_with_its_path(tmp_path, content, named):
    path = tmp_path / "site.dbc"
    path.write_text(content)
    with pytest.raises(CatalogueError, match=named) as caught:
        load([path])
    assert "site.dbc" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_dbc_and_clash(tmp_path):
    with pytest.raises(CatalogueError, match=r"nowhere\.dbc"):
        load([tmp_path / "nowhere.dbc"])
    with pytest.raises(CatalogueError, match="defined twice"):
        load([ROBOTS_DBC, ROBOTS_DBC])


@pytest.mark.parametrize(
    ("attributes", "network", "bitrate_bps"),
    [
        ("", "robots", 500_000),
        ('BA_ "BusName" "navigation";\n', "navigation", 500_000),
        ('BA_ "BusName" "robots";\nBA_ "Baudrate" 1000000;\n', "robots", 1_000_000),
        ('BA_DEF_DEF_ "Baudrate" 250000;\n', "robots", 250_000),
    ],
)
def test_a_file_says_which_bus_it_is_about(tmp_path, attributes, network, bitrate_bps):
    path = tmp_path / "site.dbc"
    path.write_text(f'{SITE_DBC}BA_DEF_ "BusName" STRING ;\nBA_DEF_ "Baudrate" INT 0 9000000;\n{attributes}')
    catalogue = load([path])
    assert catalogue.by_name["X"].network == network
    assert catalogue.bitrate_bps == {"robots": 500_000, "navigation": 500_000} | {network: bitrate_bps}


def test_robots_and_navigation_system_are_on_buses_of_their_own():
    assert {(spec.sender, spec.network) for spec in CATALOGUE.by_name.values()} == {
        *((sender, "robots") for sender in ("GW", "RC", "SR", "AR", "BR", "CAR")),
        ("INS", "navigation"),
    }


@pytest.mark.parametrize(
    ("attributes", "named"),
    [
        ('BA_ "BusName" "Chassis";\n', r"site\.dbc: BusName 'Chassis': expected robots or navigation$"),
        ('BA_ "Baudrate" 2000000;\n', r"site\.dbc: Baudrate 2000000 outside \[1, 1000000\]$"),
        ('BA_ "Baudrate" 250000;\n', r"site\.dbc: Baudrate 250000: another file gives bus robots 500000 bit/s$"),
    ],
)
def test_a_bus_that_cannot_be_is_one_line(tmp_path, attributes, named):
    path = tmp_path / "site.dbc"
    path.write_text(f'{SITE_DBC}BA_DEF_ "BusName" STRING ;\nBA_DEF_ "Baudrate" INT 0 9000000;\n{attributes}')
    with pytest.raises(CatalogueError, match=named):
        load([ROBOTS_DBC, path])


def test_protection_without_data_id_is_refused(tmp_path):
    path = tmp_path / "site.dbc"
    path.write_text(ROBOTS_DBC.read_text().replace('BA_ "E2EDataId" BO_ 272 17;', ""))
    with pytest.raises(CatalogueError, match=r"SR_Command.*E2EDataId"):
        load([path])


@pytest.mark.parametrize("name", PROTECTED)
def test_protected_stream_is_accepted_and_every_wrong_frame_is_not(name):
    data_id = CATALOGUE.by_name[name].e2e_data_id
    protector, receiver = E2EProtector(data_id), E2EReceiver(data_id)
    payload = CATALOGUE.encode(name, {})
    statuses = [receiver.check(protector.protect(payload)) for _ in range(40)]
    assert statuses == [E2EStatus.INITIAL] + [E2EStatus.OK] * 39
    for other in PROTECTED:
        if other != name:
            foreign = E2EReceiver(CATALOGUE.by_name[other].e2e_data_id)
            assert {foreign.check(protector.protect(payload)) for _ in range(16)} == {E2EStatus.WRONG_CRC}


def test_every_error_of_up_to_three_bits_is_found():
    wire = int.from_bytes(E2EProtector(17).protect(CATALOGUE.encode("SR_Command", {"AngleCommand": 12.5})), "little")
    receiver = E2EReceiver(17)
    masks = {(1 << i) | (1 << j) | (1 << k) for i in range(64) for j in range(i, 64) for k in range(j, 64)}
    assert len(masks) == 64 + 64 * 63 // 2 + 64 * 63 * 62 // 6
    passed = [mask for mask in masks if receiver.check((wire ^ mask).to_bytes(8, "little")) is not E2EStatus.WRONG_CRC]
    assert passed == []


@given(st.lists(st.integers(0, 15), min_size=1, max_size=40))
def test_counter_rules(steps):
    protector, receiver = E2EProtector(5), E2EReceiver(5)
    frames = [protector.protect(bytes(8)) for _ in range(16)]
    position = 0
    assert receiver.check(frames[0]) is E2EStatus.INITIAL
    for step in steps:
        position = (position + step) % 16
        status = receiver.check(frames[position])
        expected = {0: E2EStatus.REPEATED, 1: E2EStatus.OK, 2: E2EStatus.SOME_LOST, 3: E2EStatus.SOME_LOST}
        assert status is expected.get(step, E2EStatus.WRONG_SEQUENCE)


def test_all_zero_frame_is_rejected_by_every_protected_message():
    for name in PROTECTED:
        assert E2EReceiver(CATALOGUE.by_name[name].e2e_data_id).check(bytes(8)) is E2EStatus.WRONG_CRC
