"""Error counters and states (ISO 11898-1, 12.1.4), and how they are told (linux/can/error.h)."""

import pytest

from vehicle_emulator.bus import error_frames
from vehicle_emulator.bus.confinement import ErrorCounters, ErrorState
from vehicle_emulator.bus.frame import ERROR

# Classes of linux/can/error.h.
CRTL, PROT, ACK, BUSOFF, BUSERROR, RESTARTED, CNT = 0x4, 0x8, 0x20, 0x40, 0x80, 0x100, 0x200


@pytest.mark.parametrize(
    ("tec", "rec", "state"),
    [
        (95, 95, ErrorState.ACTIVE),
        (96, 0, ErrorState.WARNING),
        (0, 96, ErrorState.WARNING),
        (127, 127, ErrorState.WARNING),
        (128, 0, ErrorState.PASSIVE),
        (0, 128, ErrorState.PASSIVE),
        (255, 128, ErrorState.PASSIVE),
        (256, 0, ErrorState.BUS_OFF),
    ],
)
def test_limits(tec, rec, state):
    counters = ErrorCounters(tec, rec)
    assert counters.state is state
    assert counters.is_passive == (state >= ErrorState.PASSIVE)
    assert counters.is_off == (state is ErrorState.BUS_OFF)


def test_32_failures_in_a_row_lead_to_bus_off_and_16_to_passive():
    counters = ErrorCounters()
    states = []
    for _ in range(32):
        counters.transmit_failed()
        states.append(counters.state)
    assert [states.index(state) + 1 for state in list(ErrorState)[1:]] == [12, 16, 32]


def test_a_frame_sent_or_received_well_takes_one_off():
    counters = ErrorCounters(8, 3)
    counters.sent()
    counters.received()
    assert (counters.tec, counters.rec) == (7, 2)
    nothing = ErrorCounters()
    nothing.sent()
    nothing.received()
    assert (nothing.tec, nothing.rec) == (0, 0)


def test_a_passive_receiver_is_no_longer_passive_after_one_good_frame():
    counters = ErrorCounters(0, 127)
    for _ in range(500):
        counters.receive_failed()
    assert counters.rec == 128
    counters.received()
    assert 119 <= counters.rec <= 127


def test_a_passive_node_does_not_count_missing_acknowledgement():
    counters = ErrorCounters()
    for _ in range(100):
        counters.unacknowledged()
    assert (counters.tec, counters.state) == (128, ErrorState.PASSIVE)


@pytest.mark.parametrize(
    ("tec", "rec", "status"),
    [(96, 0, 0x08), (0, 96, 0x04), (100, 100, 0x0C), (128, 96, 0x20), (96, 128, 0x10), (130, 128, 0x30), (95, 95, 0x40)],
)
def test_state_changes_are_told_as_linux_tells_them(tec, rec, status):
    counters = ErrorCounters(tec, rec)
    frame = error_frames.state_changed(counters)
    assert frame == (CRTL | CNT, bytes([0, status, 0, 0, 0, 0, tec, rec]), ERROR, 8)
    assert error_frames.state_in(frame) is counters.state


def test_bus_off_and_restart_are_told_as_linux_tells_them():
    off = error_frames.state_changed(ErrorCounters(256, 3))
    assert off == (BUSOFF | CNT, bytes([0, 0, 0, 0, 0, 0, 255, 3]), ERROR, 8)
    assert error_frames.state_in(off) is ErrorState.BUS_OFF
    again = error_frames.restarted(ErrorCounters())
    assert again == (RESTARTED | CNT, bytes(8), ERROR, 8)
    assert error_frames.state_in(again) is ErrorState.ACTIVE


def test_single_errors_are_told_as_linux_tells_them():
    # PROT_BIT | PROT_TX and PROT_STUFF, both in the CRC sequence; the acknowledge slot.
    assert error_frames.destroyed(ErrorCounters(8, 0), True) == (PROT | BUSERROR | CNT, bytes([0, 0, 0x81, 0x08, 0, 0, 8, 0]), ERROR, 8)
    assert error_frames.destroyed(ErrorCounters(0, 1), False) == (PROT | BUSERROR | CNT, bytes([0, 0, 0x04, 0x08, 0, 0, 0, 1]), ERROR, 8)
    lonely = error_frames.unacknowledged(ErrorCounters(16, 0))
    assert lonely == (ACK | BUSERROR | CNT, bytes([0, 0, 0, 0x19, 0, 0, 16, 0]), ERROR, 8)
    assert error_frames.state_in(lonely) is None
