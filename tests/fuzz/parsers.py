"""Everything of ours that reads what others wrote, each with good examples, and ways to spoil them."""

import contextlib
import io
import random
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path

import msgspec

from controller.parameters import ParameterStore
from controller.planning.options import PlannerOptions
from controller.problem import OcpOptions
from controller.tuning import TuningService
from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, Catalogue, DecodeError, EncodeError, load
from dbc.errors import UserMistake
from dbc.frame import CanFrame
from dbc.health import LinkHealth
from dbc.vehicle import FOCUS, load_vehicle
from gateway.codec import NEEDED_MESSAGES, Codec, RobotLimits
from gateway.conditions import Surroundings
from gateway.journal import JournalReader, StepArguments, pack_blocks, pack_step, plain, unpack_step
from gateway.messages import (
    HORIZON_STEPS,
    CommandStatus,
    ControlCommand,
    Mode,
    Operation,
    OperatorReply,
    OperatorRequest,
    VehicleState,
    pack,
    unpack,
)
from gateway.rig import read_rig
from gateway.supervision import Supervisor
from gateway.telemetry.samples import TOPICS, WorldSample, decode
from tests.support.drive import GatewayDrive
from tests.support.robots import StubCar
from tests.support.site import SITE_DBC, SITE_FILES, SITE_MAPPING
from vehicle_emulator.service import EmulatorService
from xil.scenario import SCENARIO_FOLDER, load_scenario

RIG = Path(__file__).resolve().parents[2] / "gateway" / "target" / "rig.toml"
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
_WORLD = WorldSample(
    t_ns=1, seq=2, x_m=1.5, y_m=-2.5, yaw_rad=0.1, vx_mps=22.2, vy_mps=0.0, yaw_rate_radps=0.0, ax_mps2=0.0, ay_mps2=0.0, sr_angle_rad=0.2,
    ar_position_norm=0.1, br_position_norm=0.0, robots_engaged=True,
)  # fmt: skip


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


def _file(read: Callable[[Path], object], suffix: str, *others: Path) -> Callable[[bytes], None]:
    """A parser of files; its mistakes are for people, who want no traceback and the name of the file, or of one of the others."""
    path = Path(tempfile.mkdtemp()) / f"fuzzed{suffix}"

    def parse(content: bytes) -> None:
        path.write_bytes(content)
        try:
            read(path)
        except UserMistake as error:
            if not all(any(file.name in line for file in (path, *others)) for line in str(error).split("\n")):
                raise ValueError(f"a mistake that does not name its file: {error}") from error

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
        if not str(error).startswith("fuzzed.journal: "):
            raise ValueError(f"a mistake that does not name its file: {error}") from error


def _sample(content: bytes) -> None:
    for topic, (_, kind) in TOPICS.items():
        sample = decode(topic, content)
        assert sample is None or type(sample) is kind


@cache
def tuning() -> TuningService:
    """The controller's service."""
    return TuningService(ParameterStore(OcpOptions(), PlannerOptions()))


def _service(content: bytes) -> None:
    for service in (tuning(), EmulatorService({})):
        assert msgspec.json.decode(service.answer(content))["answer"] in {"refused", "values", "history", "accepted"}


@cache
def _catalogue() -> Catalogue:
    return load()


def _frames(content: bytes) -> None:
    """Identifier, length and data of one frame after the other."""
    supervisor, stream, frames = Supervisor(_catalogue(), NEEDED_MESSAGES), io.BytesIO(content), []
    while len(head := stream.read(3)) == 3:
        frames.append(CanFrame(int.from_bytes(head[:2], "little"), stream.read(head[2]), len(frames)))
    assert supervisor.observe(frames).keys() <= set(NEEDED_MESSAGES)
    assert supervisor.received == len(frames)
    supervisor.findings(len(frames))


def _frame_examples() -> tuple[bytes, ...]:
    frames = StubCar(_catalogue()).speak(0)
    return (b"".join(frame.arbitration_id.to_bytes(2, "little") + bytes([len(frame.data)]) + frame.data for frame in frames),)


def _contents(*paths: Path) -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in paths)


def _journal_examples() -> tuple[bytes, ...]:
    drive, records = GatewayDrive(), []
    for seq in range(8):
        drive.now_ns += 10_000_000
        command, surroundings = drive.command() if seq % 4 == 0 else None, Surroundings({"robots": LinkHealth()})
        arguments = StepArguments(drive.now_ns, drive.car.speak(drive.now_ns), command, None, surroundings, [])
        records.append(pack_step(seq, arguments, arguments.step(drive.core)))
    return (pack_blocks(records), pack_blocks(records[:1]))


@cache
def parsers() -> Mapping[str, Parser]:
    """All of them, by what they read."""
    operations = (b'{"op":"list"}', b'{"op":"set","who":"a","changes":{"planner.safe_time_s":1.5}}', b'{"op":"add","who":"b","fault":{}}')
    return {
        "frames": Parser(_frames, _frame_examples()),
        "datagrams": Parser(_datagram, tuple(pack(message, KEY) for message in _DATAGRAMS)),
        "samples": Parser(_sample, (msgspec.json.encode(_WORLD), b'{"t_ns":1,"seq":2,"lanes":[]}'), is_text=True),
        "services": Parser(_service, operations, is_text=True),
        "journal": Parser(_journal, _journal_examples()),
        "rig": Parser(_file(read_rig, ".toml"), _contents(RIG), is_text=True),
        "vehicle": Parser(_file(load_vehicle, ".toml"), _contents(FOCUS), is_text=True),
        "scenario": Parser(
            _file(lambda path: load_scenario(str(path)), ".toml"), _contents(*sorted(SCENARIO_FOLDER.glob("*.toml"))), is_text=True
        ),
        "mapping": Parser(_file(lambda path: load(SITE_FILES, path), ".toml", *SITE_FILES), _contents(SITE_MAPPING), is_text=True),
        "dbc": Parser(_file(_read_dbc, ".dbc"), _contents(ROBOTS_DBC, GNSS_IMU_DBC, SITE_DBC), is_text=True),
    }


def _read_dbc(path: Path) -> None:
    """As a gateway reads it: a file that loads must also do for a codec, or be refused with its name."""
    catalogue = load([path])
    for spec in catalogue.by_name.values():
        with contextlib.suppress(EncodeError):
            payload = catalogue.encode(spec.name, {}, saturates=True)
            assert len(payload) == spec.length_bytes
        with contextlib.suppress(DecodeError):
            catalogue.decode(spec, CanFrame(spec.arbitration_id, bytes(spec.length_bytes), 0))
    Codec(catalogue, RobotLimits(10.0, 30.0))
