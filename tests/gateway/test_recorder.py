"""The recorder: a gateway that never waits, files that survive whoever is killed, disks that refuse."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest

from dbc.errors import SetupFailure
from gateway.journal import GatewaySession, JournalReader, StepArguments, pack_step, pack_value, unpack_as, unpack_step
from gateway.record import writer as writing
from gateway.record.files import BusFormat, FileOptions, RecordFiles, append_whole
from gateway.record.writer import RecordWriter
from gateway.recorder import MAX_REPORT_AGE_NS, Recorder, serve
from tests.support.drive import GatewayDrive
from tests.support.processes import is_running, wait_until
from tests.support.recording_gateway import session, step

EVERY_FORMAT = tuple(BusFormat)
READERS = {"blf": can.BLFReader, "log": can.CanutilsLogReader, "asc": can.ASCReader}
MAX_LOSS_S = 1.0
S = 1_000_000_000
WALL_NS = 1_700_000_000_000_000_000


def networks(catalogue):
    return {arbitration_id: spec.network for arbitration_id, spec in catalogue.by_id.items()}


def journal(path):
    with path.open("rb") as stream:
        reader = JournalReader(stream, str(path))
        head, *records = reader
    return head, [unpack_step(record, "step") for record in records], reader.is_cut


def bus_record(directory, suffix, stem="gateway-0000"):
    return list(READERS[suffix](directory / f"{stem}.{suffix}"))


class Source:
    """A gateway in virtual time, as records."""

    def __init__(self):
        self.drive = GatewayDrive()
        self.seq = 0
        self.frames = 0

    def records(self, count):
        made = []
        for _ in range(count):
            self.drive.now_ns += 10_000_000
            arguments = step(self.drive, self.drive.now_ns)
            self.frames += len(arguments.received) + len(self.drive.output.frames)
            made.append(pack_step(self.seq, arguments, self.drive.output))
            self.seq += 1
        return made


@pytest.fixture
def source():
    return Source()


def files_in(directory, source, **options):
    given = FileOptions(directory, "gateway", **({"formats": EVERY_FORMAT} | options))
    return RecordFiles(given, pack_value(session()), networks(source.drive.catalogue), WALL_NS)


# --- files


def test_every_format_holds_every_frame_with_its_time_and_bus(tmp_path, source):
    files = files_in(tmp_path, source)
    first_ns = source.drive.now_ns + 10_000_000
    for second in range(3):
        files.append(source.records(100), float(second))
    _, steps, is_cut = journal(tmp_path / "gateway-0000.journal")
    assert ([one.seq for one in steps], is_cut) == (list(range(300)), False)
    expected = [
        (frame.arbitration_id, frame.data, is_rx)
        for one in steps for frames, is_rx in ((one.arguments.received, True), (one.sent, False)) for frame in frames
    ]  # fmt: skip
    assert len(expected) == source.frames > 1000
    for suffix in READERS:
        messages = bus_record(tmp_path, suffix)
        assert [(m.arbitration_id, bytes(m.data), m.is_rx) for m in messages] == expected, suffix
        if suffix != "asc":  # python-can writes its start in whole milliseconds, in local time
            assert messages[0].timestamp == pytest.approx((WALL_NS + first_ns) * 1e-9, abs=2e-6)
        assert messages[-1].timestamp - messages[0].timestamp == pytest.approx(2.99, abs=2e-6)
    by_id = networks(source.drive.catalogue)
    assert {(m.arbitration_id, m.channel) for m in bus_record(tmp_path, "log")} == {(one, by_id[one]) for one, _, _ in expected}
    assert {m.channel for m in bus_record(tmp_path, "blf")} == {0, 1}


def test_a_frame_that_no_dbc_knows_has_a_channel_of_its_own(tmp_path, source):
    unknown = next(one for one in range(0x700) if one not in source.drive.catalogue.by_id)
    source.drive.now_ns += 10_000_000
    frame = source.drive.car.speak(source.drive.now_ns)[0]._replace(arbitration_id=unknown)
    output = source.drive.core.step(source.drive.now_ns, [frame])
    files_in(tmp_path, source).append([pack_step(0, StepArguments(source.drive.now_ns, [frame]), output)], 0.0)
    assert [m.channel for m in bus_record(tmp_path, "log")] == ["unknown"]
    assert [m.channel for m in bus_record(tmp_path, "blf")] == [2]


def test_files_rotate_by_size_and_time_and_their_number_is_bounded(tmp_path, source):
    (tmp_path / "controller-0000.journal").write_bytes(b"of somebody else")
    files = files_in(tmp_path, source, max_file_s=10.0, max_file_bytes=1 << 30, max_files=3)
    for number in range(6):
        files.append(source.records(5), number * 5.0)
        files.append(source.records(5), number * 5.0 + 4.9)
    assert sorted(path.name for path in tmp_path.glob("gateway-*.journal")) == [f"gateway-000{n}.journal" for n in range(3)]
    for number in range(6, 10):
        files.append(source.records(5), number * 10.0)
    for suffix in ("journal", "blf", "log", "asc"):
        assert sorted(path.name for path in tmp_path.glob(f"gateway-*.{suffix}")) == [f"gateway-000{n}.{suffix}" for n in (4, 5, 6)]
    assert (tmp_path / "controller-0000.journal").exists()
    assert len({journal(path)[0] for path in tmp_path.glob("gateway-*.journal")}) == 1  # each tells what ran
    assert journal(tmp_path / "gateway-0006.journal")[1][-1].seq == source.seq - 1


def test_a_clock_that_is_behind_costs_no_file_of_this_session(tmp_path, source):
    later_s = time.time() + 1e6
    earlier = [tmp_path / f"gateway-20300101T000000Z-{index}.journal" for index in ("9998", "9999", "10000")]
    for number, path in enumerate(reversed(earlier)):
        path.touch()
        os.utime(path, (later_s + number, later_s + number))
    options = FileOptions(tmp_path, "gateway-20260101T000000Z", max_file_s=10.0, max_files=4)
    files = RecordFiles(options, pack_value(session()), networks(source.drive.catalogue), WALL_NS)
    own = [options.path(index, "journal") for index in range(3)]
    for number, left in enumerate([[*earlier, own[0]], [*earlier[1:], *own[:2]], [earlier[2], *own]]):
        files.append(source.records(1), number * 10.0)
        assert set(tmp_path.iterdir()) == set(left)
    assert options.family("journal") == [earlier[2], *own]


def test_a_file_that_is_large_enough_is_followed_by_another(tmp_path, source):
    files = files_in(tmp_path, source, max_file_bytes=60_000)  # the head of a journal alone takes some 20,000
    for number in range(8):
        files.append(source.records(100), float(number))
    sizes = [path.stat().st_size for path in tmp_path.iterdir()]
    assert len(list(tmp_path.glob("*.journal"))) > 1
    assert max(sizes) < 60_000 + 100_000


def test_another_recording_is_not_written_into(tmp_path):
    (tmp_path / "gateway-0000.blf").touch()
    with pytest.raises(SetupFailure, match=r"gateway-0000\.blf: there is such a record already"):
        FileOptions(tmp_path, "gateway", EVERY_FORMAT).refuse_existing()


def test_what_does_not_fit_is_not_in_the_file_at_all(tmp_path, monkeypatch):
    path = tmp_path / "file"
    append_whole(path, b"good")
    limited = subprocess.run(
        [sys.executable, "-c", FILL, str(path)], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
    )  # fmt: skip
    assert limited.stdout.split() == ["refused", "27"]  # EFBIG
    assert path.read_bytes() == b"good"


FILL = """
import resource, signal, sys
from pathlib import Path
from gateway.record.files import append_whole
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    append_whole(Path(sys.argv[1]), bytes(5000))
except OSError as error:
    print("refused", error.errno)
"""


def test_a_blf_that_is_cut_anywhere_is_read_up_to_there(tmp_path, source):
    files = files_in(tmp_path, source, formats=(BusFormat.BLF,))
    for second in range(4):
        files.append(source.records(30), float(second))
    whole = bus_record(tmp_path, "blf")
    content = (tmp_path / "gateway-0000.blf").read_bytes()
    containers = [place for place in range(144, len(content)) if content[place : place + 4] == b"LOBJ"]
    assert len(containers) == 4
    for length in range(144, len(content), 97):
        # Within the head of a container, 32 bytes that are written at once, python-can raises; `xilgate replay` reads that too.
        if any(place < length < place + 32 for place in containers):
            continue
        (tmp_path / "cut.blf").write_bytes(content[:length])
        messages = list(can.BLFReader(tmp_path / "cut.blf"))
        assert [str(m) for m in messages] == [str(m) for m in whole[: len(messages)]]
        assert len(messages) >= len(whole) * sum(place < length for place in containers[1:]) // 4


# --- full, read-only and slow disks (F15)


def small_disk(directory):
    """A disk of 256 KiB, where this user may mount one."""
    return not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(directory)], capture_output=True, check=False
    ).returncode


def fill_up(path):
    with contextlib.suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


@pytest.mark.req("F15")
def test_a_full_disk_costs_what_does_not_fit_and_nothing_else(tmp_path, source):
    if not small_disk(tmp_path):
        pytest.skip("this user may not mount a tmpfs; the limit on the size of a file is tested everywhere")
    try:
        files = files_in(tmp_path, source)
        recorded, refused = [], 0
        ballast = tmp_path / "ballast"
        for second in range(40):
            if second == 20:
                ballast.unlink()
            elif second == 8:
                fill_up(ballast)
            records = source.records(3)
            try:
                files.append(records, float(second))
                recorded += records
            except OSError:
                refused += 1
        assert 0 < refused <= 12
        assert files.disk_free_share() > 0.0
        _, steps, is_cut = journal(tmp_path / "gateway-0000.journal")
        assert not is_cut
        assert {one.seq for one in steps} >= {unpack_step(record, "step").seq for record in recorded}
        assert steps[-1].seq == 119  # it goes on when there is room again
        for suffix in READERS:
            assert len(bus_record(tmp_path, suffix)) > 0.5 * source.frames
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def refuse(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.req("F15")
@pytest.mark.parametrize("refused", [0, 2])
def test_every_file_goes_on_whole_after_a_write_that_was_refused(tmp_path, source, monkeypatch, refused):
    files, kept = files_in(tmp_path, source), []
    for number in range(4):
        records = source.records(20)
        with monkeypatch.context() as patched:
            if number == refused:
                patched.setattr("gateway.record.files.append_whole", refuse)
                with pytest.raises(OSError, match="No space left"):
                    files.append(records, float(number))
            else:
                files.append(records, float(number))
                kept += [unpack_step(record, "step") for record in records]
    head, steps, is_cut = journal(tmp_path / "gateway-0000.journal")
    session_like(head)
    assert ([one.seq for one in steps], is_cut) == ([one.seq for one in kept], False)
    for suffix in READERS:
        assert len(bus_record(tmp_path, suffix)) == sum(len(one.arguments.received) + len(one.sent) for one in kept), suffix


@pytest.mark.req("F15")
def test_a_file_that_refuses_takes_no_other_with_it(tmp_path, source, monkeypatch):
    files = files_in(tmp_path, source)

    def append(path, content):
        (refuse if path.suffix == ".journal" else append_whole)(path, content)

    monkeypatch.setattr("gateway.record.files.append_whole", append)
    with pytest.raises(OSError, match="No space left"):
        files.append(source.records(20), 0.0)
    assert not (tmp_path / "gateway-0000.journal").exists()
    for suffix in READERS:
        assert len(bus_record(tmp_path, suffix)) == source.frames, suffix


class FakeFiles:
    """Files on a disk that does what a test wants."""

    def __init__(self):
        self.appended = []
        self.error = None
        self.is_open = threading.Event()
        self.is_open.set()

    def append(self, records, now_s):
        self.is_open.wait(30)
        if self.error:
            raise self.error
        self.appended += records

    def disk_free_share(self):
        return 0.5


@pytest.fixture
def disk():
    files = FakeFiles()
    yield files
    files.is_open.set()


@pytest.mark.req("F15")
def test_a_disk_that_refuses_is_named_and_recording_resumes(disk):
    writer = RecordWriter(disk)
    writer.put(b"one")
    wait_until(lambda: writer.recorded == 1, 10, "the first record")
    disk.error = OSError(30, "Read-only file system", "/records/\x1b[31mgateway\n-0000.journal")
    writer.put(b"two")
    wait_until(lambda: writer.lost == 1, 10, "the refusal")
    assert writer.problem == "/records/?[31mgateway?-0000.journal: Read-only file system"
    disk.error = None
    writer.put(b"three")
    wait_until(lambda: writer.recorded == 2, 10, "the third record")
    assert (writer.problem, writer.disk_free_share) == ("", 0.5)
    writer.close()
    assert disk.appended == [b"one", b"three"]


@pytest.mark.req("F15")
def test_a_slow_disk_fills_the_queue_and_no_more(disk, monkeypatch):
    monkeypatch.setattr(writing, "STALLED_S", 1.0)
    writer = RecordWriter(disk, max_queued_bytes=1000)
    disk.is_open.clear()
    writer.put(bytes(100))
    time.sleep(0.6)  # it is on its way to the disk now
    before_s = time.thread_time()
    for _ in range(1000):
        writer.put(bytes(100))
    assert time.thread_time() - before_s < 1.0
    assert writer.lost == 991
    wait_until(lambda: writer.problem == "the disk of the record does not answer", 10, "the stall to be named")
    disk.is_open.set()
    wait_until(lambda: writer.recorded == 10 and not writer.problem, 10, "the end of the stall")
    writer.close()


@pytest.mark.req("F15")
def test_what_has_been_written_makes_room_in_the_queue(disk, monkeypatch):
    monkeypatch.setattr(writing, "WRITE_PERIOD_S", 0.01)
    writer = RecordWriter(disk, max_queued_bytes=1000)
    for number in range(1, 6):
        writer.put(bytes(400))
        wait_until(lambda number=number: writer.recorded == number, 10, "the record to be written")
    assert writer.lost == 0
    writer.close()


@pytest.mark.req("F15")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_writer_that_dies_of_a_bug_is_named(disk, monkeypatch):
    monkeypatch.setattr(writing, "WRITE_PERIOD_S", 0.01)
    writer = RecordWriter(disk)
    disk.error = ZeroDivisionError()
    writer.put(b"one")
    wait_until(lambda: writer.problem == "the writer of the record has ended", 10, "the end of the writer")


def test_what_is_queued_is_written_at_the_end(disk):
    writer = RecordWriter(disk)
    for number in range(50):
        writer.put(bytes([number]))
    writer.close()
    assert disk.appended == [bytes([number]) for number in range(50)]


# --- the process


@pytest.fixture
def recorder(tmp_path):
    drive = GatewayDrive()
    with Recorder(FileOptions(tmp_path, "gateway", (BusFormat.BLF,)), session(), drive.catalogue) as recorder:
        yield recorder, drive


def feed(recorder, drive, seconds, at_hz=100):
    """Ticks in real time; the newest status."""
    end_s, count = time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        now_ns = time.monotonic_ns()
        recorder.record(step(drive, now_ns), drive.output)
        status = recorder.poll(now_ns)
        count += 1
        time.sleep(1 / at_hz)
    return count, status


def test_a_gateway_is_recorded_to_its_last_tick(tmp_path, recorder):
    recorder, drive = recorder
    count, status = feed(recorder, drive, 1.5)
    assert (status.is_recording, status.lost, status.problem) == (True, 0, "")
    assert 0 < status.recorded <= count
    disk = os.statvfs(tmp_path)
    assert status.disk_free_share == pytest.approx(disk.f_bavail / disk.f_blocks, abs=0.05)
    recorder.close()
    assert not is_running(recorder.pid)
    head, steps, is_cut = journal(tmp_path / "gateway-0000.journal")
    assert [one.seq for one in steps] == list(range(count))
    assert not is_cut
    assert head == pack_value(session_like(head))
    assert len(bus_record(tmp_path, "blf")) == sum(len(one.arguments.received) + len(one.sent) for one in steps)


def session_like(head):
    found = unpack_as(GatewaySession, head, "session")
    assert {"robots.dbc", "gnss_imu.dbc", "vehicle", "limits", "configuration"} <= found.sha256.keys()
    assert "SR_Command" in found.dbc["robots.dbc"]
    json.dumps(found.configuration)
    return found


def test_a_tick_that_is_too_long_for_any_record_is_counted_as_lost(recorder, monkeypatch):
    recorder, drive = recorder
    monkeypatch.setattr("gateway.recorder.MAX_RECORD_BYTES", 10)
    recorder.record(step(drive, time.monotonic_ns()), drive.output)
    assert recorder.poll(time.monotonic_ns() + S).lost == 1


def test_the_recorder_is_looked_for_ten_times_a_second(recorder):
    recorder, _ = recorder
    now_ns = time.monotonic_ns() + S
    status = recorder.poll(now_ns)
    assert recorder.poll(now_ns + 99_999_999) is status
    assert recorder.poll(now_ns + 100_000_000) is not status


def test_a_recorder_does_not_go_on_with_the_files_of_another(tmp_path):
    (tmp_path / "gateway-0000.journal").write_bytes(b"of another one")
    with pytest.raises(SetupFailure, match="there is such a record already"):
        Recorder(FileOptions(tmp_path, "gateway"), session(), GatewayDrive().catalogue)
    assert (tmp_path / "gateway-0000.journal").read_bytes() == b"of another one"


def test_the_signals_that_end_a_gateway_do_not_end_its_recorder(tmp_path, recorder):
    recorder, drive = recorder
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGABRT):
        os.kill(recorder.pid, number)
    count, status = feed(recorder, drive, 0.5)
    assert status.is_recording
    recorder.close()
    assert len(journal(tmp_path / "gateway-0000.journal")[1]) == count


def test_a_recorder_that_is_killed_is_noticed_and_costs_no_time(tmp_path, recorder):
    recorder, drive = recorder
    feed(recorder, drive, 0.2)
    os.kill(recorder.pid, signal.SIGKILL)
    wait_until(lambda: not recorder.poll(time.monotonic_ns()).is_recording, 5, "the death of the recorder")
    before = recorder.poll(time.monotonic_ns()).lost
    count, _ = feed(recorder, drive, 0.2)
    status = recorder.poll(time.monotonic_ns() + S)
    assert (status.problem, status.is_recording) == ("the recorder has ended", False)
    assert status.lost - before == count


def test_a_recorder_that_hangs_is_noticed_and_never_waited_for(recorder):
    recorder, drive = recorder
    feed(recorder, drive, 0.2)
    os.kill(recorder.pid, signal.SIGSTOP)
    try:
        arguments = step(drive, time.monotonic_ns())
        before_s = time.thread_time()
        for _ in range(20_000):  # far more than any socket holds
            recorder.record(arguments, drive.output)
        assert time.thread_time() - before_s < 10.0
        status = recorder.poll(time.monotonic_ns() + MAX_REPORT_AGE_NS)
        assert (status.is_recording, status.problem) == (False, "the recorder does not report")
        assert status.lost > 1000
    finally:
        os.kill(recorder.pid, signal.SIGCONT)
    wait_until(lambda: recorder.poll(time.monotonic_ns()).is_recording, 10, "the recorder to go on")


def test_a_directory_that_cannot_be_is_a_status_and_no_error(tmp_path):
    (tmp_path / "file").touch()
    drive = GatewayDrive()
    with Recorder(FileOptions(tmp_path / "file" / "records", "gateway"), session(), drive.catalogue) as recorder:
        feed(recorder, drive, 1.2)
        status = recorder.poll(time.monotonic_ns())
        assert not status.is_recording
        assert "Not a directory" in status.problem
        assert status.lost > 0


def test_packets_that_a_dead_gateway_left_are_read_though_reports_were_not(disk):
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    writer = RecordWriter(disk)
    theirs.send(b"a report that nobody reads")
    for number in range(20):
        ours.send(bytes([number]))
    ours.close()
    serve(theirs, writer)
    theirs.close()
    writer.close()
    assert disk.appended == [bytes([number]) for number in range(20)]


# --- kill -9


class Victim:
    """A recording gateway in a process of its own, and what it said of its ticks."""

    def __init__(self, directory, period_s):
        directory.mkdir()
        self.directory = directory
        self._said = directory / "said"
        arguments = [sys.executable, "-m", "tests.support.recording_gateway", str(directory), "60", str(period_s), *EVERY_FORMAT]
        with self._said.open("w") as output:
            self.process = subprocess.Popen(arguments, stdout=output, cwd=Path(__file__).parents[2])

    @property
    def recorder_pid(self):
        return int(self._said.read_text().split("\n")[0])

    @property
    def times_ns(self):
        """Of the ticks that are behind it."""
        return [int(line.split()[1]) for line in self._said.read_text().split("\n")[1:-1]]

    def kill(self, name):
        os.kill(self.recorder_pid if name == "recorder" else self.process.pid, signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        self.process.kill()
        self.process.wait(10)
        wait_until(lambda: not is_running(self.recorder_pid), 10, "the end of the recorder")
        return killed_ns


def test_nothing_older_than_a_second_is_lost_by_a_kill(tmp_path):
    cases = [(name, period_s) for name in ("recorder", "gateway") for period_s in (0.02, 0.2)]
    running = [(name, Victim(tmp_path / f"{name} {period_s}", period_s)) for name, period_s in cases]
    for _, victim in running:
        wait_until(lambda victim=victim: victim.times_ns, 30, "the first tick")
    time.sleep(MAX_LOSS_S + 0.5)
    for name, victim in running:
        check_kill(victim, name)


def check_kill(running, name):
    killed_ns = running.kill(name)
    times_ns = running.times_ns
    old = [t_ns for t_ns in times_ns if t_ns < killed_ns - MAX_LOSS_S * 1e9]
    _, steps, _ = journal(running.directory / "gateway-0000.journal")
    kept = [one.arguments.now_ns for one in steps]
    assert kept[: len(times_ns)] == times_ns[: len(kept)]
    assert len(kept) >= len(old) > 0
    if name == "gateway":  # the recorder lives on until it has everything
        assert len(kept) >= len(times_ns)
    frames = sum(len(one.arguments.received) + len(one.sent) for one in steps)
    for suffix in READERS:
        assert len(bus_record(running.directory, suffix)) == frames, suffix
