"""F15: whatever happens to the recorder or its disk, control goes on unchanged, and nobody engages without a record."""

import os
import signal
import tempfile
import time
from pathlib import Path

import pytest

from gateway.messages import Operation
from tests.support import process_trials as trials
from tests.support.process_bench import ProcessBench, percentile_s

pytestmark = [pytest.mark.realtime, pytest.mark.long, pytest.mark.timeout(1_800)]

TRIALS = 30
DISK_BYTES = 64 << 20
ON_A_SMALL_DISK = f'mount -t tmpfs -o size={DISK_BYTES} tmpfs "$0" && exec "$@"'
MAX_GROWTH_S = 0.0005  # B3, F15: p99 of the ticks
MAX_USUAL_S = 0.001  # a machine that is later than that by itself says nothing about growth
WATCHED_S = 5.0


@pytest.fixture(scope="module")
def rig():
    with tempfile.TemporaryDirectory(prefix="xil", dir="/tmp") as directory:
        namespaces = ["--mount"] if os.geteuid() == 0 else ["--mount", "--map-root-user"]
        rig = ProcessBench(Path(directory), ["unshare", *namespaces, "sh", "-c", ON_A_SMALL_DISK, f"{directory}/records"])
        try:
            yield rig
        finally:
            rig.close()


def fill_disk(bench, dice):
    since_ns = time.monotonic_ns()
    # The small disk is in the gateway's own mount namespace.
    with Path(f"/proc/{bench.gateway.pid}/root{bench.directory}/records/filler").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 16))
        except OSError:
            pass
    return since_ns


def recorder_signalled(number):
    def inject(bench, dice):
        since_ns = time.monotonic_ns()
        os.kill(bench.recorder_pid(), number)
        return since_ns

    return inject


WAYS = (
    trials.Way("F15", "disk full", "F15", "ENGAGED", fill_disk, ProcessBench.restart_gateway, 1.0),
    trials.Way("F15", "recorder killed", "F15", "ENGAGED", recorder_signalled(signal.SIGKILL), ProcessBench.restart_gateway, 1.0),
    trials.Way("F15", "recorder stopped, as by a disk that hangs", "F15", "ENGAGED", recorder_signalled(signal.SIGSTOP),
               ProcessBench.restart_gateway, 1.0),
)  # fmt: skip


@pytest.mark.req("F15")
@pytest.mark.parametrize("way", WAYS, ids=str)
def test_control_goes_on_without_a_record(rig, way, figure):
    outcomes = trials.run(rig, way, TRIALS, seed=1)
    failures = [failure for outcome in outcomes for failure in outcome.failures]
    figure(f"{way}: trials that failed, of {TRIALS}", sum(bool(outcome.failures) for outcome in outcomes), "", "= 0")
    assert failures == []


@pytest.mark.req("F15", "E2")
@pytest.mark.parametrize("way", WAYS, ids=str)
def test_ticks_are_as_punctual_and_nobody_engages_again(rig, way, figure):
    rig.restart_gateway()
    rig.engage()
    before = rig.buckets("tick_lateness_seconds")
    time.sleep(WATCHED_S)
    between = rig.buckets("tick_lateness_seconds")
    way.inject(rig, None)
    time.sleep(WATCHED_S)
    after = rig.buckets("tick_lateness_seconds")
    usual_s, now_s = percentile_s(before, between, 0.99), percentile_s(between, after, 0.99)
    assert usual_s <= MAX_USUAL_S, "inconclusive"
    assert figure(f"{way}: growth of the tick lateness, p99", (now_s - usual_s) * 1e3, "ms", f"<= {MAX_GROWTH_S * 1e3:g}")
    assert rig.mode == "ENGAGED"
    rig.release()
    time.sleep(1.5)
    reply = rig.ask(Operation.ARM)
    assert any("record" in refusal or "disk" in refusal for refusal in reply.refusals), reply
    rig.restart_gateway()
