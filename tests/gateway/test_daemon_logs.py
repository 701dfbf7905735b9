"""Logs: one JSON object a line, never waited for, never anybody else's line."""

import errno
import io
import json
import logging
import subprocess
import sys
import threading

import pytest

from gateway import logs as logs_module
from gateway.logs import QUEUE_LENGTH, JsonFormatter, LogThread, PlainFormatter, is_journal
from tests.support.processes import wait_until

log = logging.getLogger("xilgate.test")


def lines(formatter, *calls):
    stream = io.StringIO()
    with LogThread(formatter, stream):
        for call in calls:
            call()
    return stream.getvalue().splitlines()


def test_a_record_is_one_json_object_with_what_the_caller_gave():
    (line,) = lines(JsonFormatter("gateway"), lambda: log.warning("%s of %d", "one\nline", 2, extra={"bus": "robots", "value": 0.5}))
    record = json.loads(line)
    assert record.pop("ts").endswith("Z")
    assert record == {
        "level": "warning", "process": "gateway", "logger": "xilgate.test", "message": "one\nline of 2", "bus": "robots", "value": 0.5,
    }  # fmt: skip


@pytest.mark.parametrize(("level", "prefix"), [("critical", "<2>"), ("error", "<3>"), ("warning", "<4>"), ("info", "<6>")])
def test_the_journal_is_told_the_level(level, prefix):
    (line,) = lines(JsonFormatter("gateway", has_level_prefix=True), lambda: getattr(log, level)("x"))
    assert line.startswith(prefix)
    assert json.loads(line[3:])["level"] == level


def test_an_error_carries_its_traceback_in_the_same_line():
    def fail():
        try:
            raise ValueError("gone")
        except ValueError:
            log.exception("failed")

    (line,) = lines(JsonFormatter("gateway"), fail)
    assert "ValueError: gone" in json.loads(line)["traceback"]


@pytest.mark.req("S7")
@pytest.mark.parametrize("text", ["a\nxilgate forged line", "a\rb", "a\x1b[31mred", "a\u2028b"])
def test_remote_text_makes_no_line_and_no_colour_of_its_own(text):
    for formatter in (PlainFormatter(), JsonFormatter("gateway")):
        (line,) = lines(formatter, lambda: log.info("heard %s", text))
        assert line.isprintable()


def test_what_is_too_much_is_dropped_and_counted_and_nobody_waits():
    gate = threading.Event()

    class Stuck(io.StringIO):
        def write(self, text):
            gate.wait(10)
            return super().write(text)

    stream = Stuck()
    with LogThread(PlainFormatter(), stream) as logs:
        log.info("first")
        wait_until(lambda: not logs._records, 5, "the writer has taken the first record")
        for k in range(QUEUE_LENGTH + 7):
            log.info("%d", k)
        assert logs.dropped == 7
        gate.set()
    assert len(stream.getvalue().splitlines()) == 1 + QUEUE_LENGTH


def test_what_the_disk_refuses_is_counted_and_the_log_goes_on():
    class Full(io.StringIO):
        is_full = True

        def write(self, text):
            if self.is_full:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(text)

    stream = Full()
    with LogThread(PlainFormatter(), stream) as logs:
        log.info("one")
        log.info("two")
        wait_until(lambda: logs.dropped == 2, 5, "the refusal")
        stream.is_full = False
        log.info("three")
    assert [line[-5:] for line in stream.getvalue().splitlines()] == ["three"]
    assert logs.dropped == 2


def test_handing_over_takes_no_lock():
    handler = LogThread(PlainFormatter(), io.StringIO())
    assert handler.lock is None
    handler.acquire()
    handler.release()


def test_the_writer_is_another_thread():
    writers = set()

    class Stream(io.StringIO):
        def write(self, text):
            writers.add(threading.current_thread())
            return super().write(text)

    with LogThread(PlainFormatter(), Stream()):
        log.info("x")
    assert threading.current_thread() not in writers
    assert len(writers) == 1


def test_the_journal_is_known_by_device_and_inode(tmp_path, monkeypatch):
    with (tmp_path / "file").open("w") as stream:
        found = (tmp_path / "file").stat()
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        assert is_journal(stream)
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino + 1}")
        assert not is_journal(stream)
        monkeypatch.delenv("JOURNAL_STREAM")
        assert not is_journal(stream)


@pytest.mark.parametrize("where", ["raise RuntimeError('ours')", "threading.Thread(target=lambda: 1 / 0, name='t').start()"])
def test_an_error_of_our_own_is_one_json_line_too(where):
    code = f"import threading\nfrom gateway.logs import *\nlog_crashes(JsonFormatter('gateway'))\n{where}\n"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    (line,) = finished.stderr.splitlines()
    record = json.loads(line)
    assert record["level"] == "critical"
    assert "Error" in record["message"]
    assert "Traceback" in record["traceback"]


def test_poll_period_is_short_against_the_second_that_may_be_lost():
    assert logs_module._POLL_S <= 0.1
