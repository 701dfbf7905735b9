"""Journals as they lie in a directory: the files of each session, in their order."""

import re
import stat
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

import msgspec

from gateway.journal import FORMAT, JournalError, JournalReader, unpack_as

_FILE_NAME = re.compile(r"(?P<stem>.+)-(?P<index>\d{4,})\.journal")

T = TypeVar("T")


class Journal:
    """The files of one session, in their order.

    Raises:
        JournalError: there is no beginning.
    """

    def __init__(self, stem: str, paths: list[Path]) -> None:
        self.stem = stem
        self._paths = paths
        self._cut = ""
        self._session = self._first()

    @property
    def name(self) -> str:
        """For people."""
        return str(self._paths[0])

    @property
    def cut(self) -> str:
        """That the record ends within a block, if it does; known at the end."""
        return self._cut

    def session(self, kind: type[T]) -> T:
        """What ran.

        Raises:
            JournalError: it is of another kind or build.
        """
        return unpack_as(kind, self._session, f"{self.name}: session")

    def of(self, known: Collection[str]) -> str:
        """Whose journal it is.

        Args:
            known: whose there can be.

        Raises:
            JournalError: nobody's that is known, or one of another layout.
        """
        kind = self.session(_Kind)
        if kind.format != FORMAT:
            raise JournalError(f"{self.name}: journal of format {kind.format}, expected {FORMAT}; xilgate {kind.version} wrote it")
        if kind.of not in known:
            raise JournalError(f"{self.name}: journal of {kind.of!r}, expected one of {', '.join(known)}")
        return kind.of

    def records(self) -> Iterator[bytes]:
        """All records after the session.

        Raises:
            JournalError: a file is no journal, or is of another session.
        """
        for path in self._paths:
            with _opened(path) as stream:
                reader = JournalReader(stream, str(path))
                records = iter(reader)
                session = next(records, None)
                if session is not None and session != self._session:
                    raise JournalError(f"{path}: of another session than {self.name}")
                yield from records
                if reader.is_cut:
                    self._cut = f"{path} ends within a block"

    def _first(self) -> bytes:
        path = self._paths[0]
        index = _index_of(path)
        if index != 0:
            raise JournalError(f"{path}: the beginning of this record is gone, {self.stem}-0000.journal: it cannot be run again")
        with _opened(path) as stream:
            for record in JournalReader(stream, str(path)):
                return record
        raise JournalError(f"{path}: an empty journal")


class _Kind(msgspec.Struct, frozen=True):
    of: str
    format: int
    version: str


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror or error}") from error


def _index_of(path: Path) -> int:
    found = _FILE_NAME.fullmatch(path.name)
    if found is None:
        raise JournalError(f"{path}: not the name of a journal, NAME-0000.journal")
    return int(found["index"])


def find_journals(path: Path) -> list[Journal]:
    """The journals of a run directory, or the one that a file belongs to.

    Raises:
        JournalError: there is none, or its beginning is gone.
    """
    try:
        is_directory = stat.S_ISDIR(path.stat().st_mode)
        there = list((path if is_directory else path.parent).iterdir())
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror}") from error
    files = [file for file in there if _FILE_NAME.fullmatch(file.name)]
    if not is_directory:
        _index_of(path)
        files = [file for file in files if file.name.startswith(path.name.rpartition("-")[0] + "-")]
    by_stem: dict[str, list[Path]] = {}
    for file in sorted(files, key=lambda file: (file.name.rpartition("-")[0], _index_of(file))):
        by_stem.setdefault(file.name.rpartition("-")[0], []).append(file)
    if not by_stem:
        raise JournalError(f"{path}: no journal; `xilgate drive` leaves NAME-0000.journal in its run directory")
    return [Journal(stem, paths) for stem, paths in by_stem.items()]
