"""The life of the gateway's process: signals, logs, the service manager, and one gateway after another as its configuration changes."""

import contextlib
import logging
import signal
import time
from collections.abc import Callable

from gateway.app import run
from gateway.housekeeping import Orders
from gateway.logs import LogThread
from gateway.preparation import Preparation
from gateway.systemd import Notifier

log = logging.getLogger("xilgate.gateway")


def serve(preparation: Preparation, logs: LogThread, prepare: Callable[[], Preparation] | None = None) -> None:
    """Be the gateway until a signal ends it.

    SIGTERM and SIGINT end it in order: a car that is driven is stopped first. A second one ends it at once, after the tick that it is
    in. SIGHUP takes the configuration anew, unless the gateway drives or is ready to.

    Args:
        prepare: makes the configuration anew; None where there is no file to make it from.

    Raises:
        UserMistake, SetupFailure: see `run`.
    """
    orders = Orders()
    _heed_signals(orders)
    with contextlib.closing(Notifier()) as notifier:
        following: Preparation | None = preparation
        while following is not None:
            rig = following.rig
            log.info("%s begins with limits %s", rig.name, rig.profile, extra={"profile": rig.profile, "sha256": dict(following.hashes)})
            following = run(following, orders, notifier, logs, prepare)
            if following is not None:
                notifier.reloading(time.monotonic_ns())
    log.info("%s ended", rig.name)


def _heed_signals(orders: Orders) -> None:
    def end(*_: object) -> None:
        orders.ends += 1

    def reload(*_: object) -> None:
        orders.is_reload_asked = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    signal.signal(signal.SIGHUP, reload)
