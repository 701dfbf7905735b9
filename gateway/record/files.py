"""The files of a recording: the journal, and the frames in formats that other tools read, rotating and bounded in number.

What is appended to a file gets there as a whole or not at all, so that a full disk leaves good files behind, and a file goes on where
it was when there is room again. No file is kept open: whatever was appended survives the death of this process.
"""

import contextlib
import io
import os
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import can

from dbc.errors import SetupFailure
from gateway.journal import pack_blocks, unpack_step

JOURNAL_SUFFIX = "journal"
UNKNOWN_NETWORK = "unknown"
"""Channel of frames whose identifier is in no DBC."""

_NS_PER_S = 1e9
_BLF_HEADER_BYTES = 144
_BLF_FILE_SIZE = struct.Struct("<Q")
_BLF_FILE_SIZE_OFFSET = 16


class BusFormat(StrEnum):
    """Formats of the bus record."""

    BLF = "blf"
    CANDUMP = "candump"
    ASC = "asc"


SUFFIX_OF_FORMAT = {BusFormat.BLF: "blf", BusFormat.CANDUMP: "log", BusFormat.ASC: "asc"}


@dataclass(frozen=True, slots=True)
class FileOptions:
    """Where and how much is kept.

    Args:
        directory: made when it is not there.
        stem: the files are `STEM-0000.journal` and so on; its part before the first `-` names the family that `max_files` bounds.
        formats: of the bus record, none for no bus record.
        max_file_bytes, max_file_s: size and time after which the next files are begun.
        max_files: of one suffix and family in the directory; the oldest go.
    """

    directory: Path
    stem: str
    formats: tuple[BusFormat, ...] = ()
    max_file_bytes: int = 64 << 20
    max_file_s: float = 600.0
    max_files: int = 20

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Of all the files."""
        return (JOURNAL_SUFFIX, *(SUFFIX_OF_FORMAT[form] for form in self.formats))

    def path(self, index: int, suffix: str) -> Path:
        """A file."""
        return self.directory / f"{self.stem}-{index:04d}.{suffix}"

    def refuse_existing(self) -> None:
        """Refuse to write into the files of another recording.

        Raises:
            SetupFailure: there is one of this name, or nobody can tell.
        """
        for first in (self.path(0, suffix) for suffix in self.suffixes):
            try:
                is_there = first.exists()
            except OSError as error:
                raise SetupFailure(f"{self.directory}: {error.strerror}") from error
            if is_there:
                raise SetupFailure(f"{first}: there is such a record already; choose another directory")

    def family(self, suffix: str) -> list[Path]:
        """The files of one suffix that `max_files` bounds, oldest first: our own are the newest, whatever the clock says."""
        by_stem: dict[str, list[Path]] = {}
        for path in self.directory.glob(f"{self.stem.partition('-')[0]}-*.{suffix}"):
            by_stem.setdefault(path.stem.rpartition("-")[0], []).append(path)

        def age(stem: str) -> tuple[bool, int, str]:
            return stem == self.stem, max(path.stat().st_mtime_ns for path in by_stem[stem]), stem

        # Of one stem the shorter number is the smaller one.
        return [path for stem in sorted(by_stem, key=age) for path in sorted(by_stem[stem], key=lambda path: (len(path.name), path.name))]


def append_whole(path: Path, content: bytes) -> None:
    """Append all of it, or nothing.

    Raises:
        OSError: it does not get in.
    """
    with path.open("ab", buffering=0) as file:
        start, rest = file.tell(), memoryview(content)
        try:
            while rest:
                rest = rest[file.write(rest) :]
        except OSError:
            file.truncate(start)
            raise


class Sink(Protocol):
    """One file."""

    path: Path

    def append(self, records: Sequence[bytes], messages: Sequence[can.Message]) -> None:
        """Add records of steps, and the frames in them.

        Raises:
            OSError: they do not get in; the file is as it was.
        """


class JournalFile:
    """A journal.

    Args:
        session: the record that tells what ran, first in the file.
    """

    def __init__(self, path: Path, session: bytes) -> None:
        self.path = path
        self._head: list[bytes] = [session]

    def append(self, records: Sequence[bytes], messages: Sequence[can.Message] = ()) -> None:
        """Add records; see `Sink`."""
        append_whole(self.path, pack_blocks([*self._head, *records]))
        self._head = []


class _KeptBytes(io.BytesIO):
    def close(self) -> None:
        """Leave the content to whoever reads it; python-can closes what it has written."""


class BlfFile:
    """Vector's binary format. Each append is a container of its own, of which a reader needs no other."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, records: Sequence[bytes], messages: Sequence[can.Message]) -> None:
        """Add frames; see `Sink`."""
        before = self._header()
        memory = _KeptBytes(before)
        with can.BLFWriter(memory, append=bool(before)) as writer:
            for message in messages:
                writer.on_message_received(message)
        written = memory.getvalue()
        append_whole(self.path, written[len(before) :])
        # The counts in the header; most readers do without.
        header = bytearray(written[:_BLF_HEADER_BYTES])
        _BLF_FILE_SIZE.pack_into(header, _BLF_FILE_SIZE_OFFSET, self.path.stat().st_size)
        with self.path.open("r+b", buffering=0) as file:
            file.write(header)

    def _header(self) -> bytes:
        try:
            with self.path.open("rb") as file:
                return file.read(_BLF_HEADER_BYTES)
        except FileNotFoundError:
            return b""


class CandumpFile:
    """The format of `candump -l`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, records: Sequence[bytes], messages: Sequence[can.Message]) -> None:
        """Add frames; see `Sink`."""
        text = io.StringIO()
        writer = can.CanutilsLogWriter(text)
        for message in messages:
            writer.on_message_received(message)
        append_whole(self.path, text.getvalue().encode("ascii"))


class AscFile:
    """Vector's text format."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._begin()

    def _begin(self) -> None:
        self._text = io.StringIO()
        self._writer = can.ASCWriter(self._text)

    def append(self, records: Sequence[bytes], messages: Sequence[can.Message]) -> None:
        """Add frames; see `Sink`."""
        for message in messages:
            self._writer.on_message_received(message)
        content = self._text.getvalue().encode("ascii")
        self._text.seek(0)
        self._text.truncate()
        try:
            append_whole(self.path, content)
        except OSError:
            if not self.path.exists() or not self.path.stat().st_size:
                self._begin()  # its head was in what was lost
            raise


_SINK_OF_FORMAT: Mapping[BusFormat, type[BlfFile | CandumpFile | AscFile]] = {
    BusFormat.BLF: BlfFile,
    BusFormat.CANDUMP: CandumpFile,
    BusFormat.ASC: AscFile,
}


class RecordFiles:
    """All files of one recording.

    Args:
        session: packed; every journal begins with it.
        networks: network of every known arbitration id.
        wall_offset_ns: to be added to a monotonic time for the clock on the wall [ns].
    """

    def __init__(self, options: FileOptions, session: bytes, networks: Mapping[int, str], wall_offset_ns: int) -> None:
        self._options = options
        self._session = session
        self._networks = networks
        self._wall_offset_ns = wall_offset_ns
        channels = [*dict.fromkeys(networks.values()), UNKNOWN_NETWORK]
        self._numbers = {channel: number for number, channel in enumerate(channels)}
        self._index = -1
        self._begun_s = 0.0
        self._sinks: list[Sink] = []

    def append(self, records: Sequence[bytes], now_s: float) -> None:
        """Add records to every file that takes them.

        Args:
            now_s: by any clock, for the rotation [s].

        Raises:
            OSError: a file did not take them.
        """
        if self._is_due(now_s):
            self._rotate(now_s)
        problem: OSError | None = None
        for sink in self._sinks:
            try:
                sink.append(records, self._messages(records, is_named=isinstance(sink, CandumpFile)))
            except OSError as error:
                problem = problem or error
        if problem is not None:
            raise problem

    def disk_free_share(self) -> float:
        """Share of the disk that is free for everybody.

        Raises:
            OSError: there is no such directory.
        """
        disk = os.statvfs(self._options.directory)
        return disk.f_bavail / disk.f_blocks if disk.f_blocks else 0.0

    def _is_due(self, now_s: float) -> bool:
        if not self._sinks or now_s - self._begun_s >= self._options.max_file_s:
            return True
        return any(_size(sink.path) >= self._options.max_file_bytes for sink in self._sinks)

    def _rotate(self, now_s: float) -> None:
        options = self._options
        options.directory.mkdir(parents=True, exist_ok=True)
        for suffix in options.suffixes:
            for path in options.family(suffix)[: 1 - options.max_files or None]:
                path.unlink(missing_ok=True)
        self._index, self._begun_s = self._index + 1, now_s
        self._sinks = [JournalFile(options.path(self._index, JOURNAL_SUFFIX), self._session)]
        self._sinks += [_SINK_OF_FORMAT[form](options.path(self._index, SUFFIX_OF_FORMAT[form])) for form in options.formats]

    def _messages(self, records: Iterable[bytes], is_named: bool) -> list[can.Message]:
        """The frames of steps; with the name of their bus, or its number for formats that know numbers only."""
        if not self._options.formats:
            return []
        messages = []
        for record in records:
            step = unpack_step(record, "step")
            for frames, is_rx in ((step.arguments.received, True), (step.sent, False)):
                for frame in frames:
                    network = self._networks.get(frame.arbitration_id, UNKNOWN_NETWORK)
                    messages.append(
                        can.Message(
                            timestamp=(frame.t_ns + self._wall_offset_ns) / _NS_PER_S,
                            arbitration_id=frame.arbitration_id,
                            is_extended_id=False,
                            data=frame.data,
                            channel=network if is_named else self._numbers[network],
                            is_rx=is_rx,
                        )
                    )
        return messages


def _size(path: Path) -> int:
    with contextlib.suppress(OSError):
        return path.stat().st_size
    return 0
