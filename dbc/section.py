"""Files that people write in TOML: what their sections have in common, and how a mistake in one is told."""

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from dbc.errors import UserMistake

_TOML_LINE = re.compile(r"at line (\d+)")

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
        UserMistake: of that class. Missing file or malformed TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text)
    except OSError as error:
        raise error_class(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise error_class(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from error
    except tomllib.TOMLDecodeError as error:
        raise error_class(f"{path}: not valid TOML: {error}{_quoted_line(text, str(error))}") from error


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


def _quoted_line(text: str, message: str) -> str:
    found = _TOML_LINE.search(message)
    return f": {text.splitlines()[int(found.group(1)) - 1].strip()}" if found else ""


def _mistake(path: Path, content: type[Section], details: ErrorDetails) -> str:
    key = ".".join(str(part) if str(part).isprintable() else ascii(part) for part in details["loc"]) or content.__name__.lower()
    if details["type"] == "missing":
        return f"{path}: {key}: missing"
    if details["type"] == "extra_forbidden":
        return f"{path}: {key}: unknown key"
    value: Any = details["input"]
    message = "allowed: a path" if details["type"] == "path_type" else details["msg"]
    shown = "" if isinstance(value, dict | list) else f" = {value!r}"
    return f"{path}: {key}{shown}: {message}"
