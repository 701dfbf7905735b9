"""The measurements patched into generated code: only where it has exactly the known form, and telling what happened."""

import re
from itertools import pairwise

import casadi as ca
import pytest

from controller import ocp, qrqp
from controller.codegen import CodegenError, generate, with_measurements
from controller.solver import PROFILE_PARTS
from tests.support.kinematic import kinematic_options

GENERATED = """
/* nlp_fg:(x[2])->(f) */
static int casadi_f11(const casadi_real** arg) {}
/* qpsol:(h)->(x) */
static int casadi_f27(const casadi_real** arg) {
  d_qp.iter_count = d.iter;
}
/* nmpc:(x0)->(x) */
    iter_count++;
    ret = casadi_f27(d->arg, d->res, d->iw, d->w, 0);
    /* Line-search loop */
    while (1) {
      if (casadi_f11(d->arg, d->res, d->iw, d->w, 0)) {
    /* Candidate accepted, update dual variables */
"""
PARTS = ("qp", "line search", "cost and constraints")


def test_measurements_are_put_where_the_work_is_done():
    lines = [line.strip() for line in with_measurements(GENERATED, PARTS).splitlines()]
    assert lines[lines.index("iter_count++;") + 1] == "xilgate_counters[0]++;"
    assert lines[lines.index("d_qp.iter_count = d.iter;") + 1] == "xilgate_counters[1] += d.iter;"
    assert "ret = (xilgate_begin(0), xilgate_end(0, casadi_f27(d->arg, d->res, d->iw, d->w, 0)));" in lines
    assert "if ((xilgate_begin(2), xilgate_end(2, casadi_f11(d->arg, d->res, d->iw, d->w, 0)))) {" in lines
    assert lines[lines.index("/* Line-search loop */") + 1] == "xilgate_begin(1);"
    assert lines[lines.index("/* Candidate accepted, update dual variables */") - 1] == "xilgate_end(1, 0);"
    assert 'CASADI_SYMBOL_EXPORT const char* xilgate_parts(void) { return "qp,line search,cost and constraints"; }' in lines


CALLS = [line for line in GENERATED.splitlines() if line.startswith("  ") and "while" not in line]
DEFINITIONS = [f"{comment}\n{head}" for comment, head in pairwise(GENERATED.splitlines()) if head.startswith("static")]


@pytest.mark.parametrize("lines", CALLS + DEFINITIONS)
@pytest.mark.parametrize("times", [0, 2])
def test_code_of_another_form_is_refused(lines, times):
    with pytest.raises(CodegenError, match=r"is not known here: its solver has [02] .* expected one") as caught:
        with_measurements(GENERATED.replace(lines + "\n", times * (lines + "\n")), PARTS)
    assert "\n" not in str(caught.value)


def test_a_part_that_is_not_there_is_named():
    with pytest.raises(CodegenError, match="0 definitions of nlp_jac_fg"):
        with_measurements(GENERATED, (*PARTS, "jacobian"))


@pytest.mark.parametrize("module", [ocp, qrqp])
def test_casadi_generates_the_known_form(vehicle, tmp_path, module):
    path = tmp_path / "nmpc.c"
    generate(path, module.build_functions, vehicle.model, kinematic_options())
    source = path.read_text()
    parts = [part for part in PROFILE_PARTS if part != "stage sweep" and (module is ocp or part != "gradient")]
    assert f'return "{",".join(parts)}"' in source
    assert set(re.findall(r"#\s*include\s+(\S+)", source)) <= {"<math.h>", "<stdarg.h>", "<stdio.h>", "<string.h>", "<time.h>"}
    assert source.count("xilgate_begin(") == source.count("xilgate_end(") == len(parts) + 1


def test_what_is_profiled_is_known_to_casadi_by_that_name(vehicle):
    functions = ocp.build_functions(vehicle.model, kinematic_options())
    assert set(functions.parts) < set(PROFILE_PARTS)
    assert {"nlp_fg", "nlp_grad", "nlp_hess_l", "nlp_jac_fg"} <= set(functions.nmpc.get_function())
    assert isinstance(functions.nmpc, ca.Function)
