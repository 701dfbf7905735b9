"""Writes the C source of the controller's functions, with measurements of the solver: its iterations and its profile.

The generated solver counts its iterations but tells nobody, and knows no clock. So its source is patched: lines that count, and
a pair of calls around each part of the solver that has a row in the paper's table of times. Each place must be there exactly
once, in the form that CasADi 3.8 gives it.
"""

import re
from collections.abc import Callable
from pathlib import Path

import casadi as ca

from controller.ocp import OcpFunctions
from controller.problem import OcpOptions
from dbc.errors import SetupFailure
from dbc.vehicle import ModelParameters

LINE_SEARCH = "line search"
_FUNCTIONS = {
    "qp": "qpsol",
    "cost and constraints": "nlp_fg",
    "gradient": "nlp_grad",
    "hessian": "nlp_hess_l",
    "jacobian": "nlp_jac_fg",
}
"""CasADi's function for each part of the solver but the line search, which is a loop in the solver itself.

`jacobian` is one call for the Jacobian of the constraints, the gradient of the cost, and both their values. `gradient` is the
multiplier of the parameters, at the end of a solve; the solver without it has no such part. `line search` holds its calls of
`cost and constraints`, as in CasADi's own statistics, so that the parts add up to more than the whole.
"""
_LINE_SEARCH_FROM = "    /* Line-search loop */\n"
_LINE_SEARCH_TO = "    /* Candidate accepted, update dual variables */\n"
_COUNTING = {
    "    iter_count++;\n": "    xilgate_counters[0]++;\n",
    "  d_qp.iter_count = d.iter;\n": "  xilgate_counters[1] += d.iter;\n",
}
"""Lines after which one is added that counts."""

_DECLARATIONS = """/* Added by xilgate: measurements of the calling thread since the library was loaded. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#define XILGATE_PARTS %(count)d
/* SQP iterations, QP iterations, then time [ns] and calls of each part. */
static _Thread_local long long int xilgate_counters[2 + 2 * XILGATE_PARTS];
static _Thread_local long long int xilgate_begun_ns[XILGATE_PARTS];
static long long int xilgate_now_ns(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return 1000000000LL * now.tv_sec + now.tv_nsec;
}
static void xilgate_begin(int part) { xilgate_begun_ns[part] = xilgate_now_ns(); }
static int xilgate_end(int part, int flag) {
  xilgate_counters[2 + 2 * part] += xilgate_now_ns() - xilgate_begun_ns[part];
  xilgate_counters[3 + 2 * part]++;
  return flag;
}
"""
_ACCESSORS = """
CASADI_SYMBOL_EXPORT const long long int* xilgate_measurements(void) { return xilgate_counters; }
CASADI_SYMBOL_EXPORT const char* xilgate_parts(void) { return "%(names)s"; }
"""


class CodegenError(SetupFailure):
    """CasADi generates other code than this module knows."""


def generate(
    path: Path,
    make_functions: Callable[[ModelParameters, OcpOptions], OcpFunctions],
    car: ModelParameters,
    options: OcpOptions,
) -> None:
    """Write the C source of `nmpc`, `kkt` and `advance` to `path`."""
    functions = make_functions(car, options)
    generator = ca.CodeGenerator(path.name, {"main": False, "with_header": False})
    for function in (functions.nmpc, functions.kkt, functions.advance):
        generator.add(function)
    path.write_text(with_measurements(generator.dump(), functions.parts), encoding="utf-8")


def with_measurements(source: str, parts: tuple[str, ...]) -> str:
    """Generated C code that also counts its iterations and takes the times of its parts.

    Args:
        parts: those that the solver consists of, names of `solver.PROFILE_PARTS`.

    Raises:
        CodegenError: the code does not have the form that CasADi 3.8 gives it.
    """
    for line, counting in _COUNTING.items():
        source = _replaced_once(source, line, line + counting)
    for i, part in enumerate(parts):
        begin, end = f"xilgate_begin({i})", f"xilgate_end({i}, "
        if part == LINE_SEARCH:
            source = _replaced_once(source, _LINE_SEARCH_FROM, f"{_LINE_SEARCH_FROM}    {begin};\n")
            source = _replaced_once(source, _LINE_SEARCH_TO, f"    {end}0);\n{_LINE_SEARCH_TO}")
        else:
            call = f"{_identifier(source, _FUNCTIONS[part])}(d->arg, d->res, d->iw, d->w, 0)"
            source = _replaced_once(source, call, f"({begin}, {end}{call}))")
    return _DECLARATIONS % {"count": len(parts)} + source + _ACCESSORS % {"names": ",".join(parts)}


def _identifier(source: str, function: str) -> str:
    """Name in C of one of CasADi's functions, from the comment above its definition."""
    found = re.findall(rf"^/\* {function}:.*\*/\nstatic int (\w+)\(", source, re.MULTILINE)
    if len(found) != 1:
        raise _unknown_form(f"definitions of {function}", len(found))
    identifier: str = found[0]
    return identifier


def _replaced_once(source: str, text: str, by: str) -> str:
    if (found := source.count(text)) != 1:
        raise _unknown_form(f"places {text.strip()!r}", found)
    return source.replace(text, by)


def _unknown_form(what: str, found: int) -> CodegenError:
    return CodegenError(f"CasADi {ca.CasadiMeta.version()} is not known here: its solver has {found} {what}, expected one")
