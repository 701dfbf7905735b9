"""What others wrote is a value or one clear mistake, whatever they wrote; and the memory stays."""

import random
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from dbc.catalogue import load
from gateway.conditions import UNDISTURBED
from gateway.journal import JournalReader, StepArguments, pack_step, pack_value
from gateway.record.files import SUFFIX_OF_FORMAT, FileOptions, RecordFiles
from gateway.telemetry.samples import TOPICS, decode
from tests.fuzz.junk import Junk
from tests.fuzz.parsers import parsers, spoil, tuning
from tests.support.drive import GatewayDrive
from tests.support.soak import rss_bytes
from vehicle_emulator.service import EmulatorService

QUICK = {
    "frames": 300, "datagrams": 3_000, "samples": 2_000, "services": 1_000, "journal": 1_500, "rig": 600, "vehicle": 150, "scenario": 150,
    "mapping": 40, "dbc": 40,
}  # fmt: skip
LONG_FACTOR = 50
GUIDED_S = 120
MAX_GROWTH_BYTES = 32_000_000
"""Compiled patterns, caches of the libraries and of the allocator."""


def fuzz(name, runs, seed):
    """Spoilt examples; the memory that they cost from the first tenth on [B]."""
    parser, rng, before = parsers()[name], random.Random(f"{name}/{seed}"), 0
    for run in range(runs):
        if run == runs // 10:
            before = rss_bytes()
        content = spoil(parser, rng)
        try:
            parser.parse(content)
        except BaseException as error:
            raise AssertionError(f"{name}: {type(error).__name__}: {error}: {content!r}") from error
    return rss_bytes() - before


def test_every_parser_is_fuzzed():
    assert parsers().keys() == QUICK.keys()


@pytest.mark.req("S3")
@pytest.mark.parametrize("name", QUICK)
def test_the_examples_are_good(name):
    for content in parsers()[name].examples:
        parsers()[name].parse(content)


@pytest.mark.req("S3")
@pytest.mark.parametrize("name", QUICK)
def test_whatever_is_read_is_a_value_or_one_clear_mistake(name):
    assert fuzz(name, QUICK[name], seed=0) <= MAX_GROWTH_BYTES


@pytest.mark.long
@pytest.mark.timeout(7_200)
@pytest.mark.req("S3")
@pytest.mark.parametrize("name", QUICK)
def test_much_that_is_read_is_a_value_or_one_clear_mistake(name, figure):
    runs = QUICK[name] * LONG_FACTOR
    growth = fuzz(name, runs, seed=1)
    figure(f"{name}: {runs} spoilt inputs, 0 crashes", growth / 1e6, "MB more", f"<= {MAX_GROWTH_BYTES / 1e6:g}")
    assert growth <= MAX_GROWTH_BYTES


@pytest.mark.long
@pytest.mark.timeout(7_200)
@pytest.mark.req("S3")
@pytest.mark.parametrize("name", QUICK)
def test_inputs_that_are_guided_by_coverage(name, tmp_path, figure):
    pytest.importorskip("atheris", reason="atheris has no wheel for this Python or this machine")
    options = [f"-max_total_time={GUIDED_S}", "-seed=1", "-rss_limit_mb=2048", f"-artifact_prefix={tmp_path}/"]
    command = [sys.executable, "-m", "tests.fuzz.guided", name, str(tmp_path), *options]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2], check=False)
    assert ended.returncode == 0, ended.stderr[-4000:]
    done = next(line for line in ended.stderr.splitlines() if line.startswith("Done "))
    figure(f"{name}: {done.split()[1]} inputs guided by coverage in {GUIDED_S} s, 0 crashes")


@pytest.mark.req("S3")
def test_text_that_is_no_utf_8_is_no_request_and_no_sample():
    for service in (tuning(), EmulatorService({})):
        assert msgspec.json.decode(service.answer(b'{"op":"set","who":"\xff"}'))["answer"] == "refused"
    assert all(decode(topic, b'{"\xff":"\xff","name":"\xff"}') is None for topic in TOPICS)


@pytest.mark.req("F11")
def test_whatever_was_received_can_be_recorded_in_every_format(tmp_path):
    drive, junk = GatewayDrive(), Junk(load(), 1)
    records = []
    for seq in range(50):
        drive.now_ns += 10_000_000
        frames = drive.car.speak(drive.now_ns)
        junk.hear(frames)
        arguments = StepArguments(drive.now_ns, junk.among(frames, 20, drive.now_ns), None, None, UNDISTURBED, [])
        records.append(pack_step(seq, arguments, arguments.step(drive.core)))
    files = RecordFiles(FileOptions(tmp_path, "gateway", formats=tuple(SUFFIX_OF_FORMAT)), pack_value(None), {}, 0)
    files.append(records, 0.0)
    with (tmp_path / min(path.name for path in tmp_path.iterdir() if path.suffix == ".journal")).open("rb") as stream:
        assert list(JournalReader(stream, "journal"))[-50:] == records
