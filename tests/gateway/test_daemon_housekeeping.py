"""The housekeeper: the watchdog lives on the progress of the control loop, logs are made here, reloads are judged here."""

import contextlib
import logging
import os
import socket
import threading
import time

import msgspec
import pytest

from dbc.errors import SetupFailure
from gateway.causes import Cause, Finding
from gateway.housekeeping import _MAX_EVENTS, Housekeeper, Notice, Orders, Pulse
from gateway.messages import Mode
from gateway.modes import Transition, Trigger
from gateway.rig import RigError
from gateway.systemd import Notifier
from tests.support.cycle import CycleBench
from tests.support.processes import wait_until
from tests.support.service_manager import ServiceManager

WATCHDOG_S = 0.3
TRANSITION = Transition(5, Mode.ENGAGED, Mode.SAFE_STOP, Trigger.STOP, Finding(Cause.COMMAND_LOST, 120.0, 100.0, "controller"))


@pytest.fixture
def manager(tmp_path):
    manager = ServiceManager(tmp_path / "notify")
    yield manager
    manager.close()


@pytest.fixture
def notifier(manager):
    notifier = Notifier(manager.environment)
    yield notifier
    notifier.close()


def housekeeper(pulse, orders, notifier, prepare=None):
    return Housekeeper(pulse, orders, notifier, WATCHDOG_S, prepare)


class Loop:
    """A control loop that does nothing but make progress, until it is told to hang."""

    def __init__(self, pulse):
        self._pulse = pulse
        self.hangs = threading.Event()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        while not self._ends.wait(0.01):
            if not self.hangs.is_set():
                self._pulse.ticks += 1

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ends.set()
        self._thread.join()


def test_ready_comes_with_the_first_tick_and_sets_the_watchdog(manager, notifier):
    pulse = Pulse()
    with housekeeper(pulse, Orders(), notifier):
        assert manager.hear(0.2) == []
        pulse.ticks = 1
        wait_until(lambda: manager.has_heard("READY=1"), 5, "ready")
    assert manager.texts[0] == f"READY=1\nWATCHDOG_USEC={round(WATCHDOG_S * 1e6)}\nWATCHDOG=1"
    assert manager.hear()[-1] == "WATCHDOG_USEC=30000000\nWATCHDOG=1"  # files may take longer to close than a loop may hang


@pytest.mark.req("F12")
def test_a_loop_that_hangs_starves_the_watchdog_though_this_thread_is_well(manager, notifier, caplog):
    pulse = Pulse()
    with caplog.at_level(logging.INFO), Loop(pulse) as loop, housekeeper(pulse, Orders(), notifier):
        wait_until(lambda: manager.has_heard("WATCHDOG=1", 5), 10, "the watchdog is fed")
        loop.hangs.set()
        manager.hear(0.2)
        fed = manager.texts.count("WATCHDOG=1")
        manager.hear(3 * WATCHDOG_S)
        assert manager.texts.count("WATCHDOG=1") == fed
        assert [record.message for record in caplog.records] == ["control loop hangs"]  # and that once
        loop.hangs.clear()
        wait_until(lambda: manager.has_heard("WATCHDOG=1", fed + 1), 5, "fed again")
        loop.hangs.set()
        wait_until(lambda: len(caplog.records) == 2, 10, "another line for another hang")


def test_nobody_is_told_where_nobody_listens():
    notifier = Notifier({})
    notifier.ready(1.0)
    notifier.alive()
    notifier.close()


def test_a_manager_that_has_gone_disturbs_nobody(manager, notifier):
    manager.close()
    notifier.ready(1.0)
    notifier.status("x")


@pytest.mark.timeout(20)
def test_a_manager_that_does_not_listen_holds_nobody_up(manager, notifier):
    for _ in range(10_000):  # far more than its socket holds
        notifier.alive()


def test_a_manager_may_have_a_name_without_a_file():
    name = f"xilgate test {os.getpid()}"
    notifier = Notifier({"NOTIFY_SOCKET": f"@{name}"})
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, contextlib.closing(notifier):
        manager.bind(f"\0{name}")
        manager.settimeout(5.0)
        notifier.stopping()
        assert manager.recv(4096) == b"STOPPING=1"


def test_the_time_of_a_reload_is_told_in_microseconds(manager, notifier):
    notifier.reloading(1_234_567_890)
    assert manager.hear() == ["RELOADING=1\nMONOTONIC_USEC=1234567"]


def test_without_a_watchdog_none_is_fed(manager):
    notifier = Notifier({"NOTIFY_SOCKET": manager.environment["NOTIFY_SOCKET"]})
    notifier.ready(1.0)
    notifier.alive()
    notifier.close()
    assert manager.hear() == ["READY=1"]


def test_status_is_told_when_it_changes(manager, notifier):
    bench = CycleBench()
    bench.tick(10)
    with housekeeper(bench.pulse, Orders(), notifier):
        wait_until(lambda: manager.has_heard("STATUS=SILENT: started"), 5, "status")
        manager.hear(0.2)
    assert sum(text.startswith("STATUS=") for text in manager.texts) == 1


def test_stopping_is_told(manager, notifier):
    orders = Orders()
    with housekeeper(Pulse(), orders, notifier):
        orders.ends = 1
        wait_until(lambda: manager.has_heard("STOPPING=1"), 5, "stopping")


def test_a_transition_is_a_line_for_people_with_its_parts_for_programs(notifier, caplog):
    pulse = Pulse()
    with caplog.at_level(logging.INFO), housekeeper(pulse, Orders(), notifier):
        pulse.post(TRANSITION)
        pulse.post(Notice(logging.WARNING, "50% of it", {"mode": "READY"}))
    transition, notice = caplog.records
    assert transition.message == f"ENGAGED -> SAFE_STOP: {TRANSITION.reason}"
    parts = (transition.cause, transition.value, transition.limit, transition.unit, transition.source)
    assert parts == ("COMMAND_LOST", 120.0, 100.0, "ms", "controller")
    assert (notice.message, notice.mode, notice.levelname) == ("50% of it", "READY", "WARNING")


def test_events_that_nobody_takes_are_counted():
    pulse = Pulse()
    for _ in range(_MAX_EVENTS + 3):
        pulse.post(TRANSITION)
    assert pulse.events_dropped == 3
    assert sum(1 for _ in iter(pulse.take, None)) == _MAX_EVENTS


def test_a_bus_is_told_when_its_state_changes(notifier, caplog):
    bench = CycleBench()
    bench.tick(10)
    status = bench.pulse.status
    with caplog.at_level(logging.INFO), housekeeper(bench.pulse, bench.orders, notifier):
        time.sleep(0.2)
        bench.pulse.status = msgspec.structs.replace(status, buses={"robots": "bus-off"})
        wait_until(lambda: caplog.records, 5, "a line")
        refusals = {"robots": "Operation not permitted"}
        bench.pulse.status = msgspec.structs.replace(status, buses={"robots": "bus-off"}, bus_refusals=refusals)
        wait_until(lambda: len(caplog.records) > 1, 5, "another line")
        time.sleep(0.2)
    said = [(record.message, record.bus) for record in caplog.records if hasattr(record, "bus")]
    assert said == [
        ("bus of the robots: bus-off", "robots"),
        ("bus of the robots: bus-off cannot be left: Operation not permitted", "robots"),
    ]


def test_a_record_is_told_when_it_ends_and_when_it_goes_on(notifier, caplog):
    bench = CycleBench()
    bench.tick(10)
    status = bench.pulse.status
    with caplog.at_level(logging.INFO), housekeeper(bench.pulse, bench.orders, notifier):
        for problem in ("No space left on device", ""):
            said = len(caplog.records)
            bench.pulse.status = msgspec.structs.replace(status, record_problem=problem)
            wait_until(lambda said=said: len(caplog.records) > said, 5, "a line")
    assert [record.message for record in caplog.records] == ["record: No space left on device", "record: goes on"]


def test_a_bus_that_goes_before_the_gateway_at_the_end_of_a_run_is_no_news(manager, notifier, caplog):
    bench = CycleBench()
    bench.tick(10)
    bench.orders.ends = 1
    bench.pulse.status = msgspec.structs.replace(bench.pulse.status, reason="nearly over", buses={"robots": "down"})
    with caplog.at_level(logging.INFO), housekeeper(bench.pulse, bench.orders, notifier):
        wait_until(lambda: manager.has_heard("STATUS=SILENT: nearly over"), 5, "a look at the status")
    assert caplog.records == []


def mistaken():
    raise RigError("rig.toml: a = 1: allowed: 2\nrig.toml: b: unknown key")


def not_set_up():
    raise SetupFailure("control.directory = 'x': there is no such directory")


@pytest.mark.parametrize(
    ("prepare", "ticks", "said"),
    [
        (None, 10, ["reload refused: there is no rig file to read"]),
        (mistaken, 10, ["reload refused: rig.toml: a = 1: allowed: 2", "reload refused: rig.toml: b: unknown key"]),
        (not_set_up, 10, ["reload refused: control.directory = 'x': there is no such directory"]),
        (mistaken, 0, ["reload refused: mode unknown"]),
    ],
)
def test_a_reload_that_cannot_be_is_refused_in_the_log(notifier, caplog, prepare, ticks, said):
    bench = CycleBench()
    bench.tick(ticks)
    with caplog.at_level(logging.INFO), housekeeper(bench.pulse, bench.orders, notifier, prepare):
        bench.orders.is_reload_asked = True
        wait_until(lambda: len(caplog.records) == len(said), 5, "refusal")
    assert [record.message for record in caplog.records] == said
    assert bench.pulse.successor is None


@pytest.mark.req("S5")
def test_a_reload_that_meets_a_bug_of_ours_is_refused_and_the_watchdog_fed(manager, notifier, caplog):
    def bug():
        raise ValueError("embedded null byte")

    bench = CycleBench()
    with housekeeper(bench.pulse, bench.orders, notifier, bug), Loop(bench.pulse):
        bench.tick(10)
        bench.orders.is_reload_asked = True
        wait_until(lambda: not bench.orders.is_reload_asked, 5, "the reload")
        manager.hear(0.3)
        manager.heard.clear()
        manager.hear(0.3)
        assert "WATCHDOG=1" in manager.texts
    (record,) = [record for record in caplog.records if "reload" in record.message]
    assert record.message == "reload refused: ValueError('embedded null byte')"
    assert record.exc_info


def test_a_reload_while_engaged_is_refused_without_reading_anything(notifier, caplog):
    bench = CycleBench().engage()
    with caplog.at_level(logging.INFO), housekeeper(bench.pulse, bench.orders, notifier, lambda: pytest.fail("was read")):
        bench.events()
        bench.orders.is_reload_asked = True
        wait_until(lambda: any("reload" in record.message for record in caplog.records), 5, "refusal")
    assert "reload refused: mode ENGAGED" in [record.message for record in caplog.records]


def test_a_good_reload_is_handed_to_the_control_thread(notifier):
    bench = CycleBench()
    bench.tick(10)
    with housekeeper(bench.pulse, bench.orders, notifier, lambda: bench.preparation):
        bench.orders.is_reload_asked = True
        wait_until(lambda: bench.pulse.successor is bench.preparation, 5, "the new configuration")
    assert not bench.orders.is_reload_asked


def test_a_reload_that_is_asked_for_during_another_comes_after_it(notifier):
    bench, files = CycleBench(), ["before the second change", "after it"]
    bench.tick(10)

    def prepare():
        bench.orders.is_reload_asked = len(files) == 2  # a signal, while the file is read
        return files.pop(0)

    with housekeeper(bench.pulse, bench.orders, notifier, prepare):
        bench.orders.is_reload_asked = True
        wait_until(lambda: bench.pulse.successor == "after it", 5, "what was asked for last")
