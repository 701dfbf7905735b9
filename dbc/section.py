"""Files that people write in TOML: what their sections have in common, and how a mistake in one is told."""

import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from dbc.errors import UserMistake
from dbc.whole_file import read_whole

_TOML_LINE = re.compile(r"at line (\d+)")
_MAX_FILE_BYTES = 16 << 20
_MAX_DEPTH = 50
_TOO_DEEP = f"sections and lists in each other: allowed: up to {_MAX_DEPTH}"
_MAX_INTEGER_BITS = 63

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Section(BaseModel):
    """A section of a file: unknown keys, numbers that are none and values of another type are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


Content = TypeVar("Content", bound=Section)


def between(low: float, high: float) -> AfterValidator:
    """The range of a number, both ends allowed."""

    def check(value: float) -> float:
        if not low <= value <= high:
            raise misfit(f"{low:g} to {high:g}")
        return value

    return AfterValidator(check)


def misfit(allowed: str) -> PydanticCustomError:
    """The error of a value that does not fit, with what would."""
    return PydanticCustomError("fit", "allowed: {allowed}", {"allowed": allowed})


def read_section(path: Path, content: type[Content], error_class: type[UserMistake]) -> Content:
    """Read a TOML file: `read_toml` and `checked`."""
    return checked(path, read_toml(path, error_class), content, error_class)


def read_toml(path: Path, error_class: type[UserMistake]) -> dict[str, Any]:
    """What a TOML file says.

    Args:
        error_class: of the error that is raised.

    Raises:
        UserMistake: of that class. Missing file, malformed TOML, or what no file needs: gigabytes, deep nesting, huge numbers, zero bytes.
    """
    try:
        text = read_whole(path, _MAX_FILE_BYTES).decode("utf-8")
        tree = tomllib.loads(text)
    except OSError as error:
        raise error_class(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise error_class(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from error
    except tomllib.TOMLDecodeError as error:
        raise error_class(f"{path}: not valid TOML: {error}{_quoted_line(text, str(error))}") from error
    except RecursionError as error:
        raise error_class(f"{path}: not usable TOML: {_TOO_DEEP}") from error
    except ValueError as error:  # of int(): more digits than Python converts
        raise error_class(f"{path}: not usable TOML: {str(error).partition(';')[0]}") from error
    if oddity := _oddity(tree):
        raise error_class(f"{path}: {oddity}")
    return tree


def checked(path: Path, tree: dict[str, Any], content: type[Content], error_class: type[UserMistake]) -> Content:
    """What a file says, as sections.

    Args:
        path: of the file, for messages.
        content: what the file is to hold.
        error_class: of the error that is raised.

    Raises:
        UserMistake: of that class. Unknown or missing key, value out of range; one line per mistake, each with file, key, value and
            what is allowed.
    """
    try:
        return content.model_validate(tree)
    except ValidationError as error:
        raise error_class("\n".join(_mistake(path, content, details) for details in error.errors())) from error


def absolute(value: Any, base: Path) -> Any:  # noqa: ANN401 - any part of a section
    """Any part of a section with every path in it absolute: what has no leading slash is below `base`."""
    match value:
        case Path():
            return base / value
        case tuple():
            return tuple(absolute(entry, base) for entry in value)
        case Section():
            return value.model_copy(update={name: absolute(getattr(value, name), base) for name in type(value).model_fields})
        case _:
            return value


def _oddity(tree: dict[str, Any]) -> str:
    """The first thing that TOML allows and that a later step would stumble over; empty where there is none."""
    level: list[tuple[str, Any]] = [("", tree)]
    for _ in range(_MAX_DEPTH):
        level = [(f"{name}.{_named(key)}", child) for name, node in level for key, child in _children(node)]
        for name, value in level:
            if isinstance(value, str) and "\0" in value:
                return f"{name[1:]} = {value!r}: allowed: text without zero bytes"
            if isinstance(value, int) and value.bit_length() > _MAX_INTEGER_BITS:
                return f"{name[1:]}: {value.bit_length()} bits: allowed: whole numbers of up to {_MAX_INTEGER_BITS}"
        if not level:
            return ""
    return _TOO_DEEP


def _children(node: Any) -> Iterable[tuple[str | int, Any]]:  # noqa: ANN401 - whatever the file says
    if isinstance(node, dict):
        return node.items()
    return enumerate(node) if isinstance(node, list) else ()


def _quoted_line(text: str, message: str) -> str:
    found = _TOML_LINE.search(message)
    return f": {text.splitlines()[int(found.group(1)) - 1].strip()}" if found else ""


def _named(part: str | int) -> str:
    """A part of a key, in printable characters."""
    return str(part) if str(part).isprintable() else ascii(part)


def _mistake(path: Path, content: type[Section], details: ErrorDetails) -> str:
    key = ".".join(map(_named, details["loc"])) or content.__name__.lower()
    if details["type"] == "missing":
        return f"{path}: {key}: missing"
    if details["type"] == "extra_forbidden":
        return f"{path}: {key}: unknown key"
    value: Any = details["input"]
    message = "allowed: a path" if details["type"] == "path_type" else details["msg"]
    shown = "" if isinstance(value, dict | list) else f" = {value!r}"
    return f"{path}: {key}{shown}: {message}"
