"""Libraries that only some plants need: loaded when such a plant is asked for."""

import importlib
from typing import Any

from dbc.errors import UserMistake


class ExtraMissing(UserMistake):
    """A library of an optional extra is not installed; one line that says how to get it."""


def optional(module: str, extra: str) -> Any:  # noqa: ANN401 - neither library has types
    """A module of a library that comes with an extra of xilgate.

    Raises:
        ExtraMissing: it is not installed.
    """
    library = module.partition(".")[0]
    try:
        importlib.import_module(library)
    except ModuleNotFoundError as error:
        if error.name != library:
            raise
        raise ExtraMissing(f"this plant needs the library {library}: .venv/bin/pip install '.[{extra}]'") from error
    return importlib.import_module(module)
