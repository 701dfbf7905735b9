"""Records played back: at their time, in their order, nothing skipped, nothing of the gateway unless asked."""

import json
import random
import threading
from pathlib import Path

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dbc.catalogue import load
from dbc.errors import SetupFailure, UserMistake
from tests.support.processes import xilgate
from xil.cli_record import _wait
from xil.replay import Player, RecordedFrame, RecordError, Selection, contents, open_buses, read_record, select

CATALOGUE = load()
ALL = Selection(CATALOGUE, with_gateway=True)
MS = 1_000_000
S = 1_000_000_000
UNKNOWN_ID = next(one for one in range(0x700) if one not in CATALOGUE.by_id)


def frame(due_ns, number=0, channel="robots", arbitration_id=UNKNOWN_ID):
    message = can.Message(
        timestamp=due_ns * 1e-9, arbitration_id=arbitration_id, is_extended_id=False, channel=channel, data=number.to_bytes(4, "big")
    )
    return RecordedFrame(due_ns, channel, message)


class FakeTime:
    """A clock that a late sleep and a slow bus move on."""

    def __init__(self, overshoot_ns=lambda: 0, send_ns=lambda: 0):
        self.now_ns = 5 * S
        self._overshoot_ns = overshoot_ns
        self._send_ns = send_ns
        self.sent = []
        self.refusals = 0

    def clock(self):
        return self.now_ns

    def sleep(self, duration_ns):
        assert duration_ns > 0
        self.now_ns += duration_ns + self._overshoot_ns()

    def send(self, message):
        self.now_ns += self._send_ns()
        if self.refusals:
            self.refusals -= 1
            raise can.CanOperationError("Transmit buffer full")
        self.sent.append((self.now_ns - 5 * S, message))

    def player(self, selection=ALL, speed=1.0, channels=("robots",)):
        return Player(dict.fromkeys(channels, self.send), selection, speed, clock=self.clock, sleep=self.sleep)


@pytest.mark.parametrize("speed", [1.0, 0.5, 20.0])
def test_there_is_no_drift_in_ten_minutes_of_late_sleeps_and_slow_sends(speed):
    rng = random.Random(1)
    time = FakeTime(lambda: rng.randrange(300_000), lambda: rng.randrange(5_000, 40_000))
    due_ns = [k * 10 * MS + rng.randrange(8 * MS) for k in range(60_000)]
    player = time.player(speed=speed)
    player.play(frame(t_ns, k) for k, t_ns in enumerate(due_ns))
    late_ns = [sent_ns - t_ns / speed for (sent_ns, _), t_ns in zip(time.sent, due_ns, strict=True)]
    assert max(late_ns[-100:]) <= 1 * MS
    assert max(late_ns) <= 1 * MS
    assert min(late_ns) >= 0
    assert abs(sum(late_ns[-6000:]) - sum(late_ns[:6000])) / 6000 < 0.05 * MS
    assert player.played.latest_ns == pytest.approx(max(late_ns), abs=1)
    assert due_ns[-1] > 599 * S


def test_a_stall_is_caught_up_with_and_skips_nothing():
    pauses = iter([0] * 100 + [500 * MS] + [0] * 1000)
    time = FakeTime(send_ns=lambda: next(pauses))
    player = time.player()
    player.play(frame(k * 10 * MS, k) for k in range(300))
    assert [int.from_bytes(message.data, "big") for _, message in time.sent] == list(range(300))
    times_ns = [t_ns for t_ns, _ in time.sent]
    assert times_ns[99:101] == [990 * MS, 1500 * MS]
    assert times_ns[150:] == [k * 10 * MS for k in range(150, 300)]
    assert player.played.latest_ns == 500 * MS


def test_a_bus_without_room_is_waited_for():
    time = FakeTime()
    time.refusals = 30
    player = time.player()
    player.play([frame(0, 1), frame(10 * MS, 2), frame(100 * MS, 3)])
    assert [t_ns for t_ns, _ in time.sent] == [30 * MS, 30 * MS, 100 * MS]
    assert player.played.sent == {"robots": 3}


def test_a_bus_that_never_has_room_ends_the_replay():
    time = FakeTime()
    time.refusals = 1 << 30
    with pytest.raises(SetupFailure, match="the bus of channel robots takes no frames: Transmit buffer full"):
        time.player().play([frame(0)])
    assert time.now_ns == 10 * S  # five seconds later


def test_a_stop_in_a_pause_of_the_record_sends_nothing_more():
    time = FakeTime()
    player = time.player()
    player.play([frame(0), frame(10 * S)], lambda: time.now_ns > 6 * S)
    assert len(time.sent) == 1
    assert player.played.sent == {"robots": 1}


def test_it_can_be_stopped():
    time, stop = FakeTime(), threading.Event()
    player = time.player()

    def frames():
        for k in range(100):
            if k == 50:
                stop.set()
            yield frame(k * MS, k)

    player.play(frames(), stop.is_set)
    assert player.played.sent == {"robots": 50}


# --- what is played


def by_name(name):
    return CATALOGUE.by_name[name].arbitration_id


def play(selection, ids):
    time = FakeTime()
    player = time.player(selection)
    player.play(frame(0, arbitration_id=one) for one in ids)
    return [message.arbitration_id for _, message in time.sent], player.played.left_out


def test_nothing_of_the_gateway_is_sent_unless_asked():
    every = list(CATALOGUE.by_id)
    own = {one for one, spec in CATALOGUE.by_id.items() if spec.sender == "GW"}
    assert len(own) >= 5
    sent, left_out = play(Selection(CATALOGUE), [*every, UNKNOWN_ID])
    assert sent == [one for one in every if one not in own] + [UNKNOWN_ID]
    assert left_out == {"of the gateway": len(own)}
    assert play(ALL, every)[0] == every
    # Not even when they are named.
    assert play(select(CATALOGUE, ["SR_Command"], None, with_gateway=False), every)[0] == []
    assert play(select(CATALOGUE, None, ["GW"], with_gateway=False), every)[0] == []


def test_an_extended_frame_is_asked_for_by_a_number_that_needs_to_be_one():
    for number, is_extended, is_asked_for in ((0x210, False, True), (0x210, True, False), (0x18FF0001, True, True)):
        time, chosen = FakeTime(), select(CATALOGUE, [hex(number)], None, with_gateway=False)
        message = can.Message(arbitration_id=number, is_extended_id=is_extended)
        player = time.player(chosen)
        player.play([RecordedFrame(0, "robots", message)])
        assert (len(time.sent), player.played.not_found) == ((1, []) if is_asked_for else (0, [number]))


def test_ids_and_senders_choose():
    every = list(CATALOGUE.by_id)
    assert play(select(CATALOGUE, ["SR_Status", f"0x{by_name('AR_Status'):x}"], None, with_gateway=False), every)[0] == [
        one for one in every if one in (by_name("SR_Status"), by_name("AR_Status"))
    ]
    sent, left_out = play(select(CATALOGUE, None, ["INS"], with_gateway=False), [*every, UNKNOWN_ID])
    assert {CATALOGUE.by_id[one].sender for one in sent} == {"INS"}
    assert left_out["other sender"] > 1
    assert play(select(CATALOGUE, ["SR_Command"], None, with_gateway=True), every)[0] == [by_name("SR_Command")]


def test_an_extended_id_is_no_message_of_the_dbc():
    time = FakeTime()
    message = can.Message(arbitration_id=by_name("SR_Command"), is_extended_id=True, data=b"")
    time.player(Selection(CATALOGUE)).play([RecordedFrame(0, "robots", message)])
    assert [m.is_extended_id for _, m in time.sent] == [True]


@pytest.mark.parametrize(
    ("ids", "senders", "said"),
    [
        (["SR_Statos"], None, r"--id SR_Statos: expected a message of the DBC files, or a number from 0 to 0x1FFFFFFF"),
        (["-1"], None, "--id -1"),
        (["0x20000000"], None, "--id 0x20000000"),
        (None, ["ROBOT"], "--sender ROBOT: the DBC files know .*GW.*"),
    ],
)
def test_what_is_no_choice_is_one_clear_line(ids, senders, said):
    with pytest.raises(UserMistake, match=said):
        select(CATALOGUE, ids, senders, with_gateway=False)


# --- reading


WRITERS = {".blf": can.BLFWriter, ".asc": can.ASCWriter, ".log": can.CanutilsLogWriter}
START_S = 1_700_000_000.0


def write(path, messages):
    with WRITERS[path.suffix](path) as writer:
        for message in messages:
            writer.on_message_received(message)
    return path


def recorded(count, channel=lambda k: k % 2, period_s=0.01):
    return [
        can.Message(
            timestamp=START_S + k * period_s,
            arbitration_id=0x100 + k % 7,
            is_extended_id=False,
            channel=channel(k),
            data=k.to_bytes(4, "big"),
        )
        for k in range(count)
    ]


@pytest.mark.parametrize("suffix", WRITERS)
def test_every_format_is_read_with_times_from_its_first_frame_on(tmp_path, suffix):
    frames = list(read_record(write(tmp_path / f"record{suffix}", recorded(200))))
    assert [int.from_bytes(one.message.data, "big") for one in frames] == list(range(200))
    for k, one in enumerate(frames):
        assert one.due_ns == pytest.approx(k * 10 * MS, abs=2_000)
    assert {one.channel for one in frames} == ({"can0", "can1"} if suffix == ".log" else {"0", "1"})
    summary = contents(frames)
    assert [(one.frames, one.ids) for one in summary] == [(100, 7), (100, 7)]


def test_frames_of_other_kinds_survive_and_error_frames_are_left_out(tmp_path):
    messages = [
        can.Message(timestamp=START_S, arbitration_id=0x18DAF110, is_extended_id=True, data=b"\x01", channel=0),
        can.Message(timestamp=START_S + 0.1, is_error_frame=True, channel=0),
        can.Message(timestamp=START_S + 0.2, arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=0, channel=0),
        can.Message(timestamp=START_S + 0.3, arbitration_id=0x124, is_extended_id=False, is_fd=True, data=bytes(12), channel=0),
    ]
    for suffix in WRITERS:
        frames = [one.message for one in read_record(write(tmp_path / f"record{suffix}", messages))]
        assert [(m.arbitration_id, m.is_extended_id, m.is_remote_frame, m.is_fd) for m in frames] == [
            (0x18DAF110, True, False, False), (0x123, False, True, False), (0x124, False, False, True),
        ]  # fmt: skip


def test_channels_out_of_step_are_merged_by_time_and_each_keeps_its_order(tmp_path):
    slow = [(START_S + k * 0.01, "a", k) for k in range(100)]
    fast = [(START_S + k * 0.01 + 0.005, "b", k) for k in range(100)]
    mixed = [one for start in range(0, 100, 20) for one in (*fast[start : start + 20], *slow[start : start + 20])]  # as listeners do
    path = tmp_path / "bus.log"
    path.write_text("".join(f"({t_s:.6f}) {channel} 100#{k:08X}\n" for t_s, channel, k in mixed))
    frames = list(read_record(path))
    assert len(frames) == 200
    for channel in "ab":
        assert [int.from_bytes(one.message.data, "big") for one in frames if one.channel == channel] == list(range(100))
    # Time zero is that of the first line, which is 5 ms after the first frame of the other channel.
    due_ns = [one.due_ns for one in frames]
    assert due_ns == sorted(due_ns)
    assert due_ns[-1] == pytest.approx(990 * MS, abs=2_000)


def test_a_clock_that_goes_back_makes_no_pause_and_changes_no_order(tmp_path):
    path = tmp_path / "bus.log"
    times_s = [10.0, 10.1, 10.2, 3.0, 3.1, 10.3]
    path.write_text("".join(f"({t_s:.6f}) a 100#{k:08X}\n" for k, t_s in enumerate(times_s)))
    frames = list(read_record(path))
    assert [int.from_bytes(one.message.data, "big") for one in frames] == list(range(6))
    assert [one.due_ns // MS for one in frames] == [0, 100, 200, 200, 200, 300]


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("lost", [1, 7, 20, 40])
def test_a_record_that_a_crash_cut_is_read_to_its_end_or_refused_in_one_line(tmp_path, suffix, lost):
    path = write(tmp_path / f"record{suffix}", recorded(50))
    path.write_bytes(path.read_bytes()[:-lost])
    try:
        assert len(list(read_record(path))) > 40 or suffix == ".blf"
    except RecordError as error:
        assert "after" in str(error)  # noqa: PT017 - either is right


@pytest.mark.parametrize("name", ["nothing.blf", "record.mf4", "directory.log"])
def test_what_is_no_record_is_one_clear_line(tmp_path, name):
    (tmp_path / "directory.log").mkdir()
    with pytest.raises(RecordError, match=name):
        list(read_record(tmp_path / name))


@pytest.mark.parametrize("time_s", ["inf", "-inf", "nan", "1e300"])
def test_a_time_that_is_none_is_one_clear_line(tmp_path, time_s):
    path = tmp_path / "record.log"
    path.write_text(f"(1.0) can0 123#00\n({time_s}) can0 123#00\n")
    with pytest.raises(RecordError, match=r"record\.log: no record of this format after 1 frames: time -?(inf|nan|1e\+300) s$"):
        list(read_record(path))


@pytest.mark.timeout(20)
def test_a_device_is_no_record(tmp_path):
    (tmp_path / "record.log").symlink_to("/dev/zero")
    with pytest.raises(RecordError, match=r"record\.log: not a regular file$"):
        list(read_record(tmp_path / "record.log"))


def test_a_gap_of_centuries_is_waited_in_until_somebody_wants_an_end():
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    _wait(stop, 1000 * 365 * 86_400 * S)
    assert stop.is_set()


CORPUS = {}


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_garbled_record_is_never_a_traceback(tmp_path, data):
    suffix = data.draw(st.sampled_from(sorted(WRITERS)))
    if suffix not in CORPUS:
        CORPUS[suffix] = write(tmp_path / f"good{suffix}", recorded(20)).read_bytes()
    content = bytearray(data.draw(st.one_of(st.just(CORPUS[suffix]), st.binary(max_size=300))))
    for _ in range(data.draw(st.integers(0, 4))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"garbled{suffix}"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        frames = list(read_record(path))
    except RecordError as error:
        assert str(error).isprintable()  # noqa: PT017 - either is right
    else:
        assert all(one.due_ns >= 0 for one in frames)


# --- onto buses


def test_channels_go_onto_their_buses(tmp_path):
    path = write(tmp_path / "record.log", recorded(60, lambda k: f"bus{k % 3}", 0.001))
    name = f"replay {tmp_path}"
    with can.Bus(interface="virtual", channel=f"{name} a") as a, can.Bus(interface="virtual", channel=f"{name} b") as b:
        with open_buses([f"bus0=virtual:{name} a", f"bus2=virtual:{name} b"], path) as send:
            player = Player(send, ALL)
            player.play(read_record(path))
        numbers = [[int.from_bytes(message.data, "big") for message in iter(lambda bus=bus: bus.recv(0), None)] for bus in (a, b)]
    assert numbers == [list(range(0, 60, 3)), list(range(2, 60, 3))]
    assert player.played.left_out == {"other channel": 20}


def test_all_channels_go_onto_one_bus(tmp_path):
    path = write(tmp_path / "record.blf", recorded(30, period_s=0.001))
    with can.Bus(interface="virtual", channel=f"one {tmp_path}") as bus:
        with open_buses([f"virtual:one {tmp_path}"], path) as send:
            Player(send, ALL).play(read_record(path))
        assert len(list(iter(lambda: bus.recv(0), None))) == 30


@pytest.mark.parametrize(
    ("bus", "kind", "said"),
    [
        ("robots", UserMistake, "--bus robots: expected INTERFACE:CHANNEL"),
        ("can0=virtual:", UserMistake, "--bus virtual:: expected"),
        ("robots=virtual:x", UserMistake, "record.log has no channel 'robots'; it has can0, can1"),
        ("socketcan:none0", SetupFailure, "bus 'socketcan:none0' does not open"),
        ("toaster:x", SetupFailure, "bus 'toaster:x' does not open"),
    ],
)
def test_a_bus_that_is_none_is_one_clear_line(tmp_path, bus, kind, said):
    path = write(tmp_path / "record.log", recorded(4))
    with pytest.raises(kind) as mistake, open_buses([bus], path):
        pass
    assert said in str(mistake.value)


def test_the_command_line_tells_what_is_in_a_record_and_what_it_played(tmp_path):
    path = write(tmp_path / "record.blf", recorded(50, lambda k: 0))
    listed = xilgate("replay", str(path), "--json")
    assert json.loads(listed.stdout) == [{"channel": "0", "frames": 50, "ids": 7, "from_s": 0.0, "to_s": pytest.approx(0.49, abs=1e-5)}]
    played = xilgate("replay", str(path), "--bus", "virtual:x", "--speed", "2", "--id", "0x101", "--id", "0x102", "--id", "0x7FE")
    assert played.returncode == 0, played.stderr
    assert played.stdout.startswith("sent 14 on 0 in 0.2")
    assert played.stdout.rstrip().endswith("left out: 36 other id; not in the record: 0x7FE")
    refused = xilgate("replay", str(Path(path).with_suffix(".txt")))
    assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
