"""One DBC file as it is read: its messages, the bus that it is about, and its hash."""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cantools
from cantools.database.can.database import Database
from cantools.database.can.formats.dbc import DbcSpecifics
from cantools.database.can.message import Message
from cantools.database.errors import Error as CantoolsError

from dbc.errors import UserMistake
from dbc.whole_file import read_whole

ROBOTS, NAVIGATION = NETWORKS = ("robots", "navigation")
"""The buses of a car with driving robots: what `BusName` of a DBC file may say."""

_DEFAULT_BITRATE_BPS = 500_000
_MAX_BITRATE_BPS = 1_000_000
_MAX_FILE_BYTES = 16_000_000
_MAX_PAGES = 65_536
_SHOWN = 30
_TEXT = re.compile(r'"(?:[^"\\]|\\.)*"')
_ABSURD_NUMBER = re.compile(
    r"\b\d[\d.]*[eE][+-]?\d{4,}"  # an exponent of more than three digits
    r"|\b\d{6,}\s*\||\|\s*\d{6,}\s*@"  # start and length of a signal
    r"|^[ \t]*BO_\s+\d+\s+\w+\s*:\s*\d{6,}",  # length of a message
    re.MULTILINE,
)
_PAGES = re.compile(r"^[ \t]*SG_MUL_VAL_\s[^;]*", re.MULTILINE)
_PAGE_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


class CatalogueError(UserMistake):
    """A DBC file cannot be used; the text names the file and the message."""


@dataclass(frozen=True, slots=True)
class DbcFile:
    """What one DBC file says.

    Args:
        sha256: of the bytes of the file.
        network: the bus that its messages travel on, one of `NETWORKS`.
        bitrate_bps: of that bus [bit/s].
    """

    path: Path
    sha256: str
    network: str
    bitrate_bps: int
    messages: tuple[Message, ...]


def read_dbc(path: Path, is_strict: bool = True) -> DbcFile:
    """Read a DBC file.

    Args:
        is_strict: whether signals that overlap or reach beyond their message make the file unusable.

    Raises:
        CatalogueError: the file is not there, is no DBC, or names a bus that cannot be; the text has the path.
    """
    try:
        content = read_whole(path, _MAX_FILE_BYTES)
        text = content.decode("latin-1")
        _refuse_absurd(path, text)
        database = cantools.database.load_string(text, database_format="dbc", strict=is_strict)
    except OSError as error:
        raise CatalogueError(f"{path}: {error.strerror or error}") from error
    except (CantoolsError, ValueError) as error:
        raise CatalogueError(f"{path}: not a usable DBC: {' '.join(str(error).split())}") from error
    assert isinstance(database, Database)
    network, bitrate_bps = _network_of(path, database)
    return DbcFile(path, hashlib.sha256(content).hexdigest(), network, bitrate_bps, tuple(database.messages))


def _refuse_absurd(path: Path, text: str) -> None:
    """Numbers for which the parser would take all memory, or years: it counts bits and pages one by one, and expands exponents.

    Raises:
        CatalogueError: there is one.
    """
    outside_texts = _TEXT.sub('""', text)
    if found := _ABSURD_NUMBER.search(outside_texts):
        raise CatalogueError(f"{path}: not a usable DBC: number too large: {found[0].strip()[:_SHOWN]}")
    for line in _PAGES.findall(outside_texts):
        for first, last in _PAGE_RANGE.findall(line):
            if max(len(first), len(last)) > _SHOWN or int(last) - int(first) >= _MAX_PAGES:
                raise CatalogueError(f"{path}: not a usable DBC: more than {_MAX_PAGES} pages: {first[:_SHOWN]}-{last[:_SHOWN]}")


def bitrates(files: Iterable[DbcFile]) -> dict[str, int]:
    """Bit rate of every network [bit/s], which all files about it must agree on.

    Raises:
        CatalogueError: two files disagree.
    """
    stated: dict[str, int] = {}
    for file in files:
        if stated.setdefault(file.network, file.bitrate_bps) != file.bitrate_bps:
            agreed_bps = stated[file.network]
            raise CatalogueError(f"{file.path}: Baudrate {file.bitrate_bps}: another file gives bus {file.network} {agreed_bps} bit/s")
    return dict.fromkeys(NETWORKS, _DEFAULT_BITRATE_BPS) | stated


def attributes_of(message: Message) -> dict[str, object]:
    """Attributes of a message by name, with the file's default where it has none of its own."""
    assert message.dbc is not None
    return _stated(message.dbc)


def _stated(of: DbcSpecifics) -> dict[str, object]:
    defaults: dict[str, object] = {name: definition.default_value for name, definition in of.attribute_definitions.items()}
    return defaults | {name: attribute.value for name, attribute in of.attributes.items()}


def _network_of(path: Path, database: Database) -> tuple[str, int]:
    """The bus that a file is about, and its bit rate; a file that names none is about the robots' bus, as one for everything is."""
    assert database.dbc is not None
    stated = _stated(database.dbc)
    network, bitrate_bps = stated.get("BusName") or ROBOTS, stated.get("Baudrate") or _DEFAULT_BITRATE_BPS
    if not (isinstance(network, str) and network in NETWORKS):
        raise CatalogueError(f"{path}: BusName {network!r}: expected {' or '.join(NETWORKS)}")
    if not (isinstance(bitrate_bps, int) and 0 < bitrate_bps <= _MAX_BITRATE_BPS):
        raise CatalogueError(f"{path}: Baudrate {bitrate_bps} outside [1, {_MAX_BITRATE_BPS}]")
    return network, bitrate_bps
