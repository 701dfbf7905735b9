"""Writes the C source of the controller's functions, with counters of the solver's iterations."""

from pathlib import Path

import casadi as ca

from controller.ocp import build_functions
from controller.problem import OcpOptions
from dbc.errors import SetupFailure
from dbc.vehicle import ModelParameters

_DECLARATION = """/* Added by xilgate: SQP and QP iterations of the calling thread since the library was loaded. */
static _Thread_local long long int xilgate_counters[2];
"""
_ACCESSOR = """
CASADI_SYMBOL_EXPORT const long long int* xilgate_iterations(void) { return xilgate_counters; }
"""
_COUNTING = {
    "    iter_count++;\n": "    xilgate_counters[0]++;\n",
    "  d_qp.iter_count = d.iter;\n": "  xilgate_counters[1] += d.iter;\n",
}
"""The generated solver counts its iterations but tells nobody. After each of these lines, which must be there once, one is added."""


class CodegenError(SetupFailure):
    """CasADi generates other code than this module knows."""


def generate(path: Path, car: ModelParameters, options: OcpOptions) -> None:
    """Write the C source of `nmpc`, `kkt` and `advance` to `path`."""
    functions = build_functions(car, options)
    generator = ca.CodeGenerator(path.name, {"main": False, "with_header": False})
    for function in (functions.nmpc, functions.kkt, functions.advance):
        generator.add(function)
    path.write_text(with_counters(generator.dump()), encoding="utf-8")


def with_counters(source: str) -> str:
    """Generated C code that also counts its iterations.

    Raises:
        CodegenError: the code does not have the form that CasADi 3.8 gives it.
    """
    for line, counting in _COUNTING.items():
        if (found := source.count(line)) != 1:
            version = ca.CasadiMeta.version()
            raise CodegenError(f"CasADi {version} is not known here: its solver has {found} lines {line.strip()!r}, expected one")
        source = source.replace(line, line + counting)
    return _DECLARATION + source + _ACCESSOR
