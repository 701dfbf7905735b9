"""The journal: the exact input and output of every step of a core, so that it can be run again (`xilgate resim`).

A file is a row of blocks; each is a header with a check sum and some records, compressed. The first record tells what ran: the
session. A file that ends within a block was cut off, by a power failure or a full disk, and is good up to there.

Records are written by what the types say: a new field of a datagram, of the surroundings or of the output is recorded without a
change here, a new argument of `GatewayCore.step` is one more field of `StepArguments`.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, TypeVar

import msgspec

from dbc.errors import UserMistake
from dbc.frame import CanFrame
from gateway.conditions import UNDISTURBED, Surroundings
from gateway.messages import ControlCommand, OperatorRequest

if TYPE_CHECKING:  # whoever keeps records does not need the core
    from gateway.core import GatewayCore, StepOutput

FORMAT = 1
"""Number of the layout of blocks and sessions."""
MAX_RECORD_BYTES = 1 << 20
"""Longest record [bytes]: a session with a path of some kilometres, or forty times a step with all that one poll of every bus can bring."""

_BLOCK = struct.Struct("<4sIII")  # magic, length of the compressed records, of the records, CRC-32 of the compressed ones
_MAGIC = b"XGJ1"
_LENGTH = struct.Struct("<I")
_MAX_RECORDS_BYTES = 1 << 22
"""Most that a block holds [bytes]: what a reader has to keep in memory, whatever the file says of itself."""
_MAX_COMPRESSED_BYTES = _MAX_RECORDS_BYTES + (1 << 16)
_COMPRESSION = 1

T = TypeVar("T")


class JournalError(UserMistake):
    """A journal cannot be read; one line that says where and why."""


class Glance(NamedTuple):
    """What `GatewayCore.sense` is called with."""

    now_ns: int
    frames: Sequence[CanFrame]


class StepArguments(NamedTuple):
    """What `GatewayCore.step` is called with, and `GatewayCore.sense` between the step before and this one."""

    now_ns: int
    frames: Sequence[CanFrame]
    command: ControlCommand | None = None
    request: OperatorRequest | None = None
    surroundings: Surroundings = UNDISTURBED
    glances: Sequence[Glance] = ()

    @property
    def received(self) -> list[CanFrame]:
        """All frames since the step before, in the order of their arrival."""
        return [frame for frames in (*(glance.frames for glance in self.glances), self.frames) for frame in frames]

    def step(self, core: "GatewayCore") -> "StepOutput":
        """Let a core do it."""
        for glance in self.glances:
            core.sense(*glance)
        return core.step(self.now_ns, self.frames, self.command, self.request, self.surroundings)


class Session(msgspec.Struct, frozen=True, kw_only=True, tag_field="of"):
    """What ran, and in which circumstances.

    Args:
        version: of xilgate.
        started_utc: by the clock on the wall, ISO 8601.
        wall_offset_ns: that clock less the monotonic one at the start [ns].
        boot_id: of the process.
        sha256: of all that decided on what it did, by name.
    """

    format: int = FORMAT
    version: str
    started_utc: str
    wall_offset_ns: int
    boot_id: int
    sha256: dict[str, str]


class GatewaySession(Session, frozen=True, kw_only=True, tag="gateway"):
    """A gateway.

    Args:
        profile: name of the limit profile.
        limits: its numbers.
        dbc: content of the DBC files, by name, in the order in which they were read.
        mapping: content of the file that maps the names of the site to ours; None where they are ours.
        vehicle: content of the vehicle file.
        configuration: the effective configuration, for people.
    """

    profile: str
    limits: dict[str, Any]
    dbc: dict[str, str]
    mapping: str | None
    vehicle: str
    configuration: dict[str, Any]


class StepRecord(msgspec.Struct, frozen=True, array_like=True):
    """One step of the gateway.

    Args:
        seq: number of the step since the start; one that is not there was not recorded.
        output: of the step, as it was written: the same bytes are the same output, `plain` shows it.
    """

    seq: int
    arguments: StepArguments
    output: msgspec.Raw

    @property
    def sent(self) -> list[CanFrame]:
        """The frames that the step sent."""
        return _SENT.decode(self.output).frames


class _Sent(msgspec.Struct, frozen=True):
    frames: list[CanFrame]


def _as_plain(value: object) -> float:
    """A number of a library that is as good as one of Python, where a core in the same process was given one."""
    if isinstance(value, float):
        return float(value)
    raise NotImplementedError(f"{type(value).__name__} cannot be recorded")


# The order of sets and dictionaries would otherwise be that of a process, not of what is in them.
_ENCODER = msgspec.msgpack.Encoder(enc_hook=_as_plain, order="deterministic")
_STEPS = msgspec.msgpack.Decoder(StepRecord)
_SENT = msgspec.msgpack.Decoder(_Sent)
_PLAIN: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder()


def pack_value(value: object) -> bytes:
    """Bytes that are the same for the same value."""
    return _ENCODER.encode(value)


def pack_step(seq: int, arguments: StepArguments, output: "StepOutput") -> bytes:
    """The record of one step."""
    return _ENCODER.encode((seq, arguments, output))


def unpack_step(record: bytes, what: str) -> StepRecord:
    """The step in a record.

    Args:
        what: names the record in the error.

    Raises:
        JournalError: it holds none, or one of another build.
    """
    return _unpack(_STEPS, record, what)


def plain(packed: bytes) -> Any:  # noqa: ANN401 - whatever was packed
    """A packed value as dictionaries, lists, numbers and texts, to be looked at whatever build wrote it.

    Raises:
        JournalError: it is none.
    """
    return _unpack(_PLAIN, packed, "a packed value")


def pack_blocks(records: Iterable[bytes]) -> bytes:
    """Records as blocks of a file.

    Raises:
        ValueError: a record is longer than any may be.
    """
    blocks: list[bytes] = []
    pending: list[bytes] = []
    size = 0
    for record in records:
        if len(record) > MAX_RECORD_BYTES:
            raise ValueError(f"a record of {len(record)} bytes: at most {MAX_RECORD_BYTES}")
        if size + _LENGTH.size + len(record) > _MAX_RECORDS_BYTES:
            blocks.append(_pack_block(pending))
            pending, size = [], 0
        pending += (_LENGTH.pack(len(record)), record)
        size += _LENGTH.size + len(record)
    if pending:
        blocks.append(_pack_block(pending))
    return b"".join(blocks)


def _pack_block(parts: list[bytes]) -> bytes:
    content = b"".join(parts)
    compressed = zlib.compress(content, _COMPRESSION)
    return _BLOCK.pack(_MAGIC, len(compressed), len(content), zlib.crc32(compressed)) + compressed


class JournalReader:
    """Records of one file, oldest first.

    Args:
        name: of the file, for errors.

    Attributes:
        is_cut: whether the file ended within a block; known at the end.
    """

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self._stream = stream
        self._name = name
        self.is_cut = False

    def __iter__(self) -> Iterator[bytes]:
        """All records.

        Raises:
            JournalError: what stands there is no block.
        """
        offset = 0
        while head := self._stream.read(_BLOCK.size):
            if not head.startswith(_MAGIC[: len(head)]):
                raise self._error(offset, "no block of a journal")
            if len(head) < _BLOCK.size:
                self.is_cut = True
                return
            _, compressed_size, size, crc = _BLOCK.unpack(head)
            if compressed_size > _MAX_COMPRESSED_BYTES or size > _MAX_RECORDS_BYTES:
                raise self._error(offset, "longer than any block")
            compressed = self._stream.read(compressed_size)
            if len(compressed) < compressed_size:
                self.is_cut = True
                return
            if zlib.crc32(compressed) != crc:
                raise self._error(offset, "wrong check sum")
            yield from self._records(compressed, size, offset)
            offset += _BLOCK.size + compressed_size

    def _records(self, compressed: bytes, size: int, offset: int) -> Iterator[bytes]:
        try:
            content = zlib.decompressobj().decompress(compressed, size + 1)
        except zlib.error as error:
            raise self._error(offset, "not compressed data") from error
        if len(content) != size:
            raise self._error(offset, "another length than it says")
        start = 0
        while start < size:
            end = start + _LENGTH.size
            if end > size or (end := end + _LENGTH.unpack_from(content, start)[0]) > size:
                raise self._error(offset, "a record longer than its block")
            yield content[start + _LENGTH.size : end]
            start = end

    def _error(self, offset: int, problem: str) -> JournalError:
        return JournalError(f"{self._name}: byte {offset}: {problem}")


def unpack_as(kind: type[T], record: bytes, what: str) -> T:
    """A record as a value of this kind.

    Args:
        what: names the record in the error.

    Raises:
        JournalError: it is none.
    """
    return _unpack(msgspec.msgpack.Decoder(kind), record, what)


def _unpack(decoder: msgspec.msgpack.Decoder[T], record: bytes, what: str) -> T:
    try:
        return decoder.decode(record)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        raise JournalError(f"{what}: {error}") from error
