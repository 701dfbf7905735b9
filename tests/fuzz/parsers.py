"""Everything of ours that reads what others wrote, each with good examples, and ways to spoil them."""

import io
import random
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path

import msgspec

from controller.operation.parameters import ParameterStore, TuningService
from controller.planning.reference import PlannerOptions
from controller.problem import OcpOptions
from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, load
from dbc.errors import UserMistake
from dbc.vehicle import FOCUS, load_vehicle
from gateway.codec import NEEDED_MESSAGES
from gateway.journal import JournalReader, pack_blocks, plain, unpack_step
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Mode, Operation, OperatorReply, OperatorRequest, VehicleState
from gateway.messages import pack, unpack
from gateway.rig import read_rig
from gateway.supervision import Supervisor
from gateway.telemetry.samples import TOPICS, decode
from tests.support.site import SITE_DBC, SITE_FILES, SITE_MAPPING
from vehicle_emulator.service import EmulatorService
from xil.scenario import SCENARIO_FOLDER, load_scenario

KEY = bytes(range(32))
MAC_BYTES = 16
HOSTILE = (
    *("-1", "0", "1e999", "-1e999", "nan", "inf", "99999999999999999999", "0.1", "true", '""', '"\\u0000"', "[]", "{}", "[[1]]"),
    *("[0.0, 1.0]", '"../../etc"', "x" * 300, "\x00", "\u2028", "|", "@", ":", ";", "=", "[", "]", "(", ")", '"', "\n", "8388608"),
)
_PLAN = (0.0,) * HORIZON_STEPS
_DATAGRAMS = (
    VehicleState(1, 2, 3, Mode.ENGAGED, True, *(0.5,) * 9),
    ControlCommand(1, 2, 3, 4, CommandStatus.OK, 5, 0.0, 0.0, 0.1, 0.2, _PLAN, _PLAN),
    OperatorRequest(1, 2, Operation.ARM, 3),
    OperatorReply(1, 2, Operation.ENGAGE, Mode.READY, ("robots not armed", "no command")),
)


@dataclass(frozen=True)
class Parser:
    """One of them.

    Args:
        parse: takes any bytes, and raises nothing but what it says it raises; that is caught here.
        examples: what it accepts.
        is_text: whether it reads lines of words rather than bytes.
    """

    parse: Callable[[bytes], None]
    examples: tuple[bytes, ...]
    is_text: bool = False


def spoil(parser: Parser, rng: random.Random) -> bytes:
    """An example with some things removed, repeated, exchanged or replaced."""
    content = rng.choice(parser.examples)
    for _ in range(rng.choice((1, 1, 2, 4))):
        content = _spoil_text(content, rng) if parser.is_text and rng.random() < 0.8 else _spoil_bytes(content, rng)
    return content


def _spoil_text(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    k, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(5):
        case 0:
            del lines[k]
        case 1:
            lines.insert(other, lines[k])
        case 2:
            lines[k], lines[other] = lines[other], lines[k]
        case _:
            words = lines[k].split(b" ")
            words[rng.randrange(len(words))] = rng.choice(HOSTILE).encode()
            lines[k] = b" ".join(words)
    return b"\n".join(lines)


def _spoil_bytes(content: bytes, rng: random.Random) -> bytes:
    start, length = rng.randrange(len(content) + 1), rng.choice((0, 1, 4, 60))
    new = rng.choice((b"", bytes([rng.randrange(256)]), rng.randbytes(4), b"\xff" * 8, content[:40]))
    return content[:start] + new + content[start + length :] if rng.random() < 0.9 else content[:start]


def _file(read: Callable[[Path], object], suffix: str) -> Callable[[bytes], None]:
    """A parser of files; its mistakes are for people, who want no traceback and the name of the file."""
    path = Path(tempfile.mkdtemp()) / f"fuzzed{suffix}"

    def parse(content: bytes) -> None:
        path.write_bytes(content)
        try:
            read(path)
        except UserMistake as error:
            assert str(error)
            assert all(line.startswith(str(path)) or "fuzzed" in line for line in str(error).split("\n")), str(error)

    return parse


def _datagram(content: bytes) -> None:
    for datagram in (content, content[:-MAC_BYTES] + blake2b(content[:-MAC_BYTES], key=KEY, digest_size=MAC_BYTES).digest()):
        message = unpack(datagram, KEY)
        assert message is None or pack(message, KEY) == datagram


def _journal(content: bytes) -> None:
    try:
        for record in JournalReader(io.BytesIO(content), "fuzzed.journal"):
            plain(bytes(unpack_step(record, "fuzzed.journal: step").output))
    except UserMistake as error:
        assert str(error).startswith("fuzzed.journal: ")


def _sample(content: bytes) -> None:
    for topic, (_, kind) in TOPICS.items():
        sample = decode(topic, content)
        assert sample is None or type(sample) is kind


@cache
def _tuning() -> TuningService:
    return TuningService(ParameterStore(OcpOptions(), PlannerOptions()))


def _service(content: bytes) -> None:
    for service in (_tuning(), EmulatorService({})):
        assert msgspec.json.decode(service.answer(content))["answer"] in {"refused", "values", "history", "accepted"}


@cache
def _catalogue_frames() -> tuple[bytes, ...]:
    return tuple(spec.arbitration_id.to_bytes(2, "little") + bytes([8]) + bytes(8) for spec in load().by_name.values())


def _frames(content: bytes) -> None:
    from dbc.frame import CanFrame

    supervisor, stream, frames = Supervisor(load(), NEEDED_MESSAGES), io.BytesIO(content), []
    while len(head := stream.read(3)) == 3:
        frames.append(CanFrame(int.from_bytes(head[:2], "little"), stream.read(head[2]), len(frames)))
    assert supervisor.observe(frames).keys() <= set(NEEDED_MESSAGES)
    assert supervisor.received == len(frames)
    supervisor.findings(len(frames))


def _texts(*paths: Path) -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in paths)
