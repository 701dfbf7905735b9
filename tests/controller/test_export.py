"""The exported directory: it builds and checks itself with nothing of ours, here and under emulators, and the check can fail.

The tests use a problem with a coarse integrator, whose code compiles in a few seconds; the default one differs in nothing but size.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest

from controller.export import library, targets
from controller.export.directory import ExportError, export
from controller.export.targets import TARGETS, TargetName, find_toolchain
from controller.export.vectors import Vector, write_vectors
from controller.nmpc import DRIVE_MODEL
from controller.problem import OcpOptions
from controller.riccati.build import build_riccati
from controller.riccati.solver import RiccatiSolver
from controller.solver import Effort
from dbc.build import BuildError
from dbc.errors import SetupFailure
from dbc.vehicle import FOCUS

pytestmark = pytest.mark.shared_setup

OPTIONS = OcpOptions(integrator_steps=1)
PER_SET = 4
VECTORS = 3 * PER_SET + 1
LIBC_AND_LIBM = {"memcpy", "memset", "memcmp", "memmove", "bcmp", "fmin", "fmax", "sqrt", "sin", "cos", "sincos", "atan", "clock_gettime"}
"""All that the library may ask of others."""
OF_THE_TOOLCHAIN = re.compile(r"_ITM_|__gmon_start__|__cxa_finalize|__stack_chk_|_GLOBAL_OFFSET_TABLE_|__aeabi_")


@pytest.fixture(scope="session")
def pristine(tmp_path_factory):
    directory = tmp_path_factory.mktemp("export") / "new" / "nmpc"
    facts = export(directory, FOCUS, TargetName.HOST, print, options=OPTIONS, vectors_per_set=PER_SET)
    assert facts["vectors"] == VECTORS
    return directory


@pytest.fixture
def exported(pristine, tmp_path):
    """A copy that a test may build in and change."""
    return shutil.copytree(pristine, tmp_path / "nmpc")


@pytest.fixture(scope="session")
def built(pristine, tmp_path_factory):
    """A copy built and checked with the flags of its own."""
    directory = shutil.copytree(pristine, tmp_path_factory.mktemp("built") / "nmpc")
    return directory, make(directory, "check")


def make(directory, *arguments):
    environment = {name: value for name, value in os.environ.items() if name not in {"CC", "CFLAGS", "LDFLAGS", "AR", "MAKEFLAGS"}}
    return subprocess.run(
        ["make", "-C", str(directory), *arguments], capture_output=True, text=True, check=False, timeout=240, env=environment
    )


def passes(finished, lanes):
    """Whether the checker ran on all vectors and found nothing."""
    print(finished.stdout[-2000:], finished.stderr[-2000:])
    summary = finished.stdout.splitlines()[-2 if "Leaving" in finished.stdout.splitlines()[-1] else -1]
    return finished.returncode == 0 and summary.startswith(f"{VECTORS} of {VECTORS} vectors pass") and f"lanes {lanes}," in summary


def undefined(path, *flags):
    lines = subprocess.run(["nm", *flags, str(path)], capture_output=True, text=True, check=True).stdout.splitlines()
    symbols = [line.split() for line in lines if line.strip() and not line.endswith(":")]
    defined = {words[-1] for words in symbols if words[-2] not in {"U", "w"}}
    return {words[-1].partition("@")[0] for words in symbols if words[-2] in {"U", "w"}} - defined


def test_it_builds_and_checks_itself(built, vehicle):
    directory, finished = built
    lanes = json.loads((directory / "manifest.json").read_text())["exported_on"]["lanes"]
    assert passes(finished, lanes)
    assert (directory / "libnmpc.a").is_file()
    assert make(directory, "size").stdout.count("libnmpc.so") >= 1


def test_the_exported_library_answers_as_the_cached_one(built, vehicle, problem):
    directory, _ = built
    cached = build_riccati(vehicle.model, OPTIONS, print).library
    ours, theirs = (RiccatiSolver(path, OPTIONS) for path in (directory / "libnmpc.so", cached))
    for state, previous_input, horizon in (problem, (problem[0] + (-6.0, 0, 0, 0.5, 0.5, 0), *problem[1:])):
        one, other = (solver.solve(state, previous_input, horizon) for solver in (ours, theirs))
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.inputs, other.inputs)
        assert one.effort.work == other.effort.work


def foreign_symbols(directory):
    """What the library asks for that is neither libc's nor libm's."""
    needed = undefined(directory / "libnmpc.so", "-D") | undefined(directory / "libnmpc.a")
    return {name for name in needed if not OF_THE_TOOLCHAIN.match(name)} - LIBC_AND_LIBM


def test_it_asks_for_nothing_but_libc_and_libm(built):
    directory, _ = built
    assert foreign_symbols(directory) == set()
    dynamic = subprocess.run(["readelf", "-d", str(directory / "libnmpc.so")], capture_output=True, text=True, check=True).stdout
    assert set(re.findall(r"NEEDED.*\[(.*?)\.so", dynamic)) <= {"libc", "libm"}
    shown = subprocess.run(["nm", "-D", "--defined-only", str(directory / "libnmpc.so")], capture_output=True, text=True, check=True).stdout
    assert all(line.split()[-1].startswith("nmpc_") for line in shown.splitlines())


@pytest.mark.parametrize(("arch", "lanes"), [("", None), ("-DLANES=1", 1)])
def test_other_builds_of_this_machine_give_the_same_answers(exported, arch, lanes):
    """Without the vectors and the fused multiply-add of this very machine, and without vectors at all."""
    if lanes is None:
        lanes = 2 if os.uname().machine in {"x86_64", "aarch64"} else 1
    assert passes(make(exported, "check", f"ARCH={arch}"), lanes)
    assert foreign_symbols(exported) == set()


@pytest.mark.parametrize("target", list(TARGETS))
def test_it_checks_itself_under_an_emulator(exported, target):
    row = TARGETS[target]
    for program in (f"{row.prefix}gcc", row.emulator[0]):
        if shutil.which(program) is None:
            pytest.skip(f"NOT RUN on {target}: no {program}; install the Debian packages {row.package} and qemu-user-static")
    assert passes(make(exported, "check", f"TARGET={target}"), row.lanes)
    assert foreign_symbols(exported) == set()


def change_first(path, pattern, replacement):
    text, count = re.subn(pattern, replacement, path.read_text(), count=1)
    assert count == 1
    path.write_text(text)


@pytest.mark.parametrize(
    ("pattern", "replacement", "complaint"),
    [
        (r"\.status = 0", ".status = 1", r"FAIL nominal/\w+: status 0 instead of 1"),
        (r"\.status = 2", ".status = 0", r"FAIL invalid/nan: status 2 instead of 0"),
        ("w", "1e-5 + ", r"FAIL nominal/\w+: the plan differs by 1e-05, allowed"),
        ("lam_g", "1e-2 + ", r"FAIL nominal/\w+: a multiplier differs by"),
    ],
)
def test_a_changed_vector_fails(built, tmp_path, pattern, replacement, complaint):
    exported = shutil.copytree(built[0], tmp_path / "nmpc")
    vectors = exported / "check" / "vectors.c"
    if "status" not in pattern:  # then the first number of that array
        array = re.search(rf"\.{pattern} = (\w+)", vectors.read_text()).group(1)
        pattern, replacement = rf"({array}\[\d+\] = {{)", rf"\g<1>{replacement}"
    change_first(vectors, pattern, replacement)
    finished = make(exported, "check")
    assert finished.returncode != 0
    assert re.search(complaint, finished.stdout)
    assert f"{VECTORS - 1} of {VECTORS} vectors pass" in finished.stdout


def test_a_solver_that_remembers_fails(built, tmp_path):
    exported = shutil.copytree(built[0], tmp_path / "nmpc")
    change_first(
        exported / "src" / "nmpc.c",
        r"    sqp\(s\);",
        "    static double last; s->current.z[1][0] += 1e-9 * last; last += 1.0;\n    sqp(s);",
    )
    assert "two solvers that take turns answer differently" in make(exported, "check").stdout


def test_the_readme_shows_code_that_compiles(built, tmp_path):
    directory, _ = built
    readme = (directory / "README.md").read_text()
    code = re.search(r"```c\n(.*?)```", readme, re.DOTALL).group(1)
    (tmp_path / "use.c").write_text(f"{code}\nint main(void) {{ (void)control; return sizeof memory < nmpc_solver_bytes(); }}\n")
    program = tmp_path / "use"
    strict = ("cc", "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{directory}/include")
    command = [*strict, tmp_path / "use.c", directory / "libnmpc.a", "-lm"]
    subprocess.run([*command, "-o", program], check=True)
    subprocess.run([program], check=True)


def test_the_manifest_names_every_file_and_the_problem(pristine):
    manifest = json.loads((pristine / "manifest.json").read_text())
    there = {path.relative_to(pristine).as_posix(): path for path in pristine.rglob("*") if path.is_file()}
    sums = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in there.items() if name != "manifest.json"}
    assert sums == manifest["files"]
    assert {"README.md", "LICENSE", "Makefile", "include/nmpc.h", "src/nmpc.c", "src/stage_functions.c", "check/check.c"} <= set(there)
    assert manifest["options"]["model"]["name"] == "single-track"
    assert set(manifest["options"]) == {field.name for field in fields(OcpOptions)}
    assert sorted({row["name"].partition("/")[0] for row in manifest["vectors"]}) == ["active", "hard", "invalid", "nominal"]


def test_nothing_of_this_machine_or_of_ours_is_needed(pristine):
    for path in pristine.rglob("*.[ch]"):
        for include in re.findall(r'#include "(.*?)"', path.read_text()):
            assert list(pristine.rglob(include)), f"{path.name} includes {include}"
    assert str(pristine.parent) not in (pristine / "Makefile").read_text()


def test_vectors_keep_every_bit(tmp_path):
    values = np.array((0.0, -0.0, 0.1, -1e300, 5e-324, np.inf, -np.inf, np.nan, 1.0))
    vector = Vector("set/case", {"w_guess": values}, 0, {"w": values}, False, Effort(), 1.0)
    write_vectors(tmp_path, [vector])
    text = (tmp_path / "vectors.c").read_text()
    written = re.search(r"numbers_0\[9\] = \{(.*)\};", text).group(1).split(", ")
    special = {"INFINITY": np.inf, "-INFINITY": -np.inf, "NAN": np.nan}
    read = np.array([special[word] if word in special else float.fromhex(word) for word in written])
    assert read.tobytes() == values.tobytes()
    assert "numbers_1" not in text  # the same numbers are written once


def test_a_car_that_nothing_converges_with_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("controller.export.vectors._LARGEST_WORK", 0.0)
    with pytest.raises(SetupFailure, match="no problem of the set nominal converges"):
        export(tmp_path / "nmpc", FOCUS, TargetName.HOST, print, options=OPTIONS)
    assert list((tmp_path / "nmpc").iterdir()) == []


@pytest.mark.parametrize("occupant", ["file in it", "file in its place"])
def test_nothing_is_overwritten(tmp_path, occupant):
    directory = tmp_path / "nmpc"
    if occupant == "file in it":
        directory.mkdir()
        (directory / "mine").write_text("x")
    else:
        directory.write_text("x")
    with pytest.raises(ExportError, match=str(directory)) as caught:
        export(directory, FOCUS, TargetName.HOST, print)
    assert "\n" not in str(caught.value)
    assert (directory / "mine").read_text() == "x" if directory.is_dir() else directory.read_text() == "x"


def test_a_missing_cross_compiler_names_the_package(monkeypatch):
    monkeypatch.setattr(targets, "compiler_at", lambda command: None)
    with pytest.raises(BuildError, match="gcc-arm-linux-gnueabihf") as caught:
        find_toolchain(TargetName.CORTEX_A15)
    assert "\n" not in str(caught.value)


def test_a_cross_compiler_is_called_with_the_flags_of_its_target(tmp_path, monkeypatch):
    """By a fake one, since the real one takes half a minute."""
    fake = tmp_path / "arm-linux-gnueabihf-gcc"
    act = 'open(sys.argv[sys.argv.index("-o") + 1], "w").write(" ".join(sys.argv))'
    fake.write_text(f'#!{sys.executable}\nimport sys\nif "--version" in sys.argv:\n    print("fake 1")\nelse:\n    {act}\n')
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("CC", "something-else")
    facts = library.build_for(TargetName.CORTEX_A15, FOCUS, print)
    assert os.environ["CC"] == "something-else"
    command = (tmp_path / "cache").joinpath(facts["library"]).read_text()
    assert "-mcpu=cortex-a15 -mfpu=neon-vfpv4 -mfloat-abi=hard" in command
    assert "-mavx2" not in command
    assert facts["compiler"] == "arm-linux-gnueabihf-gcc (fake 1)"
    assert (facts["solver"], facts["target"], facts["lanes"], facts["was_cached"]) == ("riccati", "cortex-a15", 1, False)
    assert facts["bytes"] == len(command)
    assert library.build_for(TargetName.CORTEX_A15, FOCUS, print)["was_cached"]


def test_the_library_of_this_machine_is_the_default_solvers(vehicle):
    facts = library.build_for(TargetName.HOST, FOCUS, print)
    built = library.LIBRARIES[library.DEFAULT_SOLVER](vehicle.model, OcpOptions(model=DRIVE_MODEL), print)
    assert (facts["library"], facts["sha256"]) == (str(built.library), built.sha256)
    assert hashlib.sha256(built.library.read_bytes()).hexdigest() == facts["sha256"]
    json.dumps(facts)


def test_the_command_line_exports_and_refuses(tmp_path):
    command = [sys.executable, "-m", "xil", "build", "--export", str(tmp_path / "nmpc"), "--json"]
    first, second = (subprocess.run(command, capture_output=True, text=True, check=False, timeout=120) for _ in range(2))
    assert first.returncode == 0, first.stderr
    assert json.loads(first.stdout)["files"] == sum(path.is_file() for path in (tmp_path / "nmpc").rglob("*"))
    assert second.returncode == 2
    assert second.stderr == f"xilgate: {tmp_path / 'nmpc'}: is not empty; name a new or an empty directory\n"
    missing = subprocess.run([*command[:-1], "--target", "pentium"], capture_output=True, text=True, check=False, timeout=60)
    assert missing.returncode == 2
