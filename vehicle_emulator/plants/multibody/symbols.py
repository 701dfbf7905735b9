"""The vectors and parameters of `layout` as CasADi symbols."""

from typing import Any, TypeVar

import casadi as ca
from pydantic import BaseModel

from vehicle_emulator.plants.multibody.layout import SX, Table

Numbers = TypeVar("Numbers", bound=BaseModel)


def symbols(sizes: Table) -> tuple[Table, SX]:
    """Symbols for each field of a table, and the whole vector."""
    fields = [ca.SX.sym(name, size) for name, size in zip(sizes._fields, sizes, strict=True)]
    return type(sizes)(*fields), ca.vertcat(*fields)


def parameter_symbols(section: Numbers) -> tuple[Numbers, SX]:
    """The same section with a symbol for each number, and all symbols in the order of `layout.numbers`."""
    found: list[SX] = []
    return _symbolic(section, found), ca.vertcat(*found)


def _symbolic(section: Numbers, found: list[SX]) -> Numbers:
    fields: dict[str, Any] = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            fields[name] = _symbolic(value, found)
            continue
        fields[name] = tuple(ca.SX.sym(name) for _ in value) if isinstance(value, tuple) else ca.SX.sym(name)
        found.extend(fields[name] if isinstance(value, tuple) else (fields[name],))
    return type(section).model_construct(**fields)
