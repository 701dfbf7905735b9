"""What the gateway's process does beside control, on a thread of its own: feed the watchdog, log, take a new configuration.

The control thread leaves what happened in a `Pulse` and never waits for anybody; the watchdog is fed only while the pulse beats, so
that a control loop that hangs is restarted although this thread is well.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

from dbc.errors import SetupFailure, UserMistake
from dbc.health import BusState
from dbc.realtime import Grant
from gateway.loop import Histogram
from gateway.messages import Mode
from gateway.modes import QUIET, Transition
from gateway.preparation import Preparation
from gateway.systemd import Notifier
from gateway.telemetry import StatusSample

log = logging.getLogger("xilgate.gateway")

_PERIOD_S = 0.05
_MAX_EVENTS = 256


@dataclass
class Orders:
    """What people ask of the process by signals; the handlers only set these.

    Args:
        ends: how often it was asked to end: once is in order, twice is at once.
        is_reload_asked: whether it was asked to take its configuration anew.
    """

    ends: int = 0
    is_reload_asked: bool = False


@dataclass(frozen=True, slots=True)
class Notice:
    """Something for the log.

    Args:
        fields: for programs.
    """

    level: int
    text: str
    fields: Mapping[str, object] = field(default_factory=dict)


class Pulse:
    """What the control thread tells; each attribute is replaced as a whole, so that reading needs no lock.

    Attributes:
        ticks: steps since the start.
        status: the newest status, None before the first.
        events_dropped: events lost because nobody took them.
        realtime: what the control thread was granted.
        lateness, step_cpu: durations of every tick.
        successor: the configuration that the control thread shall go on with, if it may; set by the housekeeper.
    """

    def __init__(self) -> None:
        self.ticks = 0
        self.status: StatusSample | None = None
        self.events_dropped = 0
        self.realtime: Mapping[str, Grant] = {}
        self.lateness = Histogram()
        self.step_cpu = Histogram()
        self.successor: Preparation | None = None
        self._events: deque[Transition | Notice] = deque()

    def post(self, event: Transition | Notice) -> None:
        """Tell an event; from the control thread."""
        if len(self._events) >= _MAX_EVENTS:
            self.events_dropped += 1
        else:
            self._events.append(event)

    def take(self) -> Transition | Notice | None:
        """The oldest event that was not taken yet; from the housekeeper."""
        return self._events.popleft() if self._events else None


class Housekeeper:
    """The thread. As a context manager it begins after the set-up and ends with the control loop.

    Args:
        prepare: makes the configuration of a reload; None where there is no rig file.
    """

    def __init__(
        self, pulse: Pulse, orders: Orders, notifier: Notifier, watchdog_s: float, prepare: Callable[[], Preparation] | None
    ) -> None:
        self._pulse = pulse
        self._orders = orders
        self._notifier = notifier
        self._watchdog_s = watchdog_s
        self._prepare = prepare
        self._ticks = 0
        self._last_progress_s = time.monotonic()
        self._is_stalled = False
        self._is_stopping = False
        self._bus_states: Mapping[str, str] = {}
        self._bus_refusals: Mapping[str, str] = {}
        self._record_problem = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="housekeeper", daemon=True)

    def _run(self) -> None:
        while not self._closing.wait(_PERIOD_S):
            self._round()
        self._log_events()
        self._tell_stopping()

    def _round(self) -> None:
        self._check_progress()
        self._log_events()
        self._tell_status()
        self._tell_stopping()
        if self._orders.is_reload_asked:
            self._orders.is_reload_asked = False
            self._reload()

    def _check_progress(self) -> None:
        ticks, now_s = self._pulse.ticks, time.monotonic()
        if ticks == self._ticks:
            if not self._is_stalled and now_s - self._last_progress_s > self._watchdog_s:
                self._is_stalled = True
                log.critical("control loop hangs", extra={"tick": ticks, "value": now_s - self._last_progress_s, "unit": "s"})
            return
        if self._ticks == 0:
            self._notifier.ready(self._watchdog_s)
        self._notifier.alive()
        self._ticks, self._last_progress_s, self._is_stalled = ticks, now_s, False

    def _log_events(self) -> None:
        while (event := self._pulse.take()) is not None:
            if isinstance(event, Notice):
                log.log(event.level, "%s", event.text, extra=dict(event.fields))
            else:
                log_transition(event)

    def _tell_stopping(self) -> None:
        if self._orders.ends and not self._is_stopping:
            self._is_stopping = True
            self._notifier.stopping()

    def _tell_status(self) -> None:
        if (status := self._pulse.status) is None:
            return
        self._notifier.status(f"{status.mode}: {status.reason}")
        if self._orders.ends:
            return  # at the end of a run its buses may go first
        for network, state in status.buses.items():
            if state != self._bus_states.get(network, BusState.ERROR_ACTIVE.value):
                log.warning("bus of the %s: %s", network, state, extra={"bus": network, "state": state})
        self._bus_states = status.buses
        for network, refusal in status.bus_refusals.items():
            if refusal != self._bus_refusals.get(network, ""):
                log.warning("bus of the %s: bus-off cannot be left: %s", network, refusal, extra={"bus": network})
        self._bus_refusals = status.bus_refusals
        if status.record_problem != self._record_problem:
            self._record_problem = status.record_problem
            log.warning("record: %s", status.record_problem or "goes on")

    def _reload(self) -> None:
        """Make the new configuration; the control thread takes it at a tick at which it drives nobody, or refuses it."""
        if self._prepare is None:
            log.warning("reload refused: there is no rig file to read")
            return
        if (status := self._pulse.status) is None or Mode[status.mode] not in QUIET:
            log.warning("reload refused: mode %s", "unknown" if status is None else status.mode)
            return
        try:
            self._pulse.successor = self._prepare()
        except (UserMistake, SetupFailure) as error:
            for line in str(error).splitlines():
                log.error("reload refused: %s", line)
        except Exception as error:  # our bug; but whoever feeds the watchdog goes on, and the gateway with what it has
            log.exception("reload refused: %s", repr(error))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._notifier.pausing()


def log_transition(transition: Transition) -> None:
    """One line for people, the parts of it for programs."""
    fields: dict[str, object] = {"before": transition.before.name, "after": transition.after.name, "t_ns": transition.t_ns}
    if (finding := transition.finding) is not None:
        fields |= {"cause": finding.cause.name, "value": finding.value, "limit": finding.limit}
        fields |= {"unit": finding.cause.value.unit, "source": finding.source}
    log.info("%s -> %s: %s", transition.before.name, transition.after.name, transition.reason, extra=fields)
