"""The library cache and the compilers. No test here runs a real compiler."""

import importlib.util
import sys
from pathlib import Path

import pytest

from controller import build as recipes
from controller.build import build
from controller.problem import OcpOptions
from dbc import build as builder
from dbc.build import BuildError, cache_directory, find_compiler
from dbc.errors import SetupFailure

FAKE_COMPILER = """#!{python}
import sys
if "--version" in sys.argv:
    print("fakecc 1.0")
else:
    with open({log!r}, "a") as log:
        log.write("run\\n")
    {act}
"""
WRITE = 'open(sys.argv[sys.argv.index("-o") + 1], "wb").write(b"library")'
FAIL = 'sys.exit("nmpc.c:1:1: error: no good\\nmore")'


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A cache of its own, a compiler that only says it compiled, and a generator that writes one line."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def install(act=WRITE):
        path = tmp_path / "fakecc"
        path.write_text(FAKE_COMPILER.format(python=sys.executable, log=str(tmp_path / "log"), act=act))
        path.chmod(0o755)
        monkeypatch.setenv("CC", str(path))

    install()
    monkeypatch.setattr("controller.codegen.generate", lambda path, *made_from: path.write_text("int x;\n"))
    install.runs = lambda: (tmp_path / "log").read_text().count("run") if (tmp_path / "log").exists() else 0
    return install


def test_a_second_build_comes_from_the_cache(fake, vehicle):
    said = []
    first = build(vehicle.model, OcpOptions(), said.append)
    assert not first.was_cached
    assert "fakecc 1.0" in first.compiler
    assert any("fakecc" in line for line in said)
    said.clear()
    second = build(vehicle.model, OcpOptions(), said.append)
    assert second.was_cached
    assert (second.library, second.sha256) == (first.library, first.sha256)
    assert (fake.runs(), said) == (1, [])
    assert sorted(path.name for path in cache_directory().iterdir()) == [first.library.parent.name]


@pytest.mark.parametrize(
    ("car", "options", "is_new"),
    [
        ({"mass_kg": 1501.0}, {}, True),
        ({}, {"integrator_steps": 3}, True),
        ({}, {"horizon_steps": 20}, True),
        ({}, {"input_weights": (2.0, 0.2)}, False),  # weights and bounds are given at every solve
        ({}, {"input_bounds": ((-0.3, 0.3), (-1.0, 1.0))}, False),
    ],
)
def test_a_changed_number_that_is_in_the_code_means_a_new_library(fake, vehicle, car, options, is_new):
    first = build(vehicle.model, OcpOptions(), print)
    second = build(vehicle.model.model_copy(update=car), OcpOptions(**options), print)
    assert (second.library != first.library, fake.runs()) == (is_new, 2 if is_new else 1)


def test_another_compiler_means_a_new_library(fake, vehicle, tmp_path, monkeypatch):
    first = build(vehicle.model, OcpOptions(), print)
    monkeypatch.setenv("CC", f"{tmp_path / 'fakecc'} -m32")
    assert build(vehicle.model, OcpOptions(), print).library != first.library


def test_changed_sources_mean_a_new_library(fake, vehicle, monkeypatch):
    first = build(vehicle.model, OcpOptions(), print)
    monkeypatch.setattr(recipes, "_KEYED_SOURCES", ("model.py",))
    assert build(vehicle.model, OcpOptions(), print).library != first.library


def test_every_module_that_the_code_comes_from_is_in_the_key():
    sources = Path(recipes.__file__).parent
    for keyed in (recipes._KEYED_SOURCES, recipes._KEYED_SOURCES + recipes._QRQP_SOURCES):
        for name in keyed:
            for line in (sources / name).read_text().splitlines():
                if line.startswith("from controller.") and name != "build.py":
                    assert f"{line.split()[1].removeprefix('controller.').replace('.', '/')}.py" in keyed


def test_a_damaged_library_is_made_anew(fake, vehicle):
    first = build(vehicle.model, OcpOptions(), print)
    first.library.write_bytes(b"cut off")
    again = build(vehicle.model, OcpOptions(), print)
    assert not again.was_cached
    assert again.library.read_bytes() == b"library"


def test_a_compiler_error_is_one_line_and_leaves_nothing(fake, vehicle):
    fake(FAIL)
    with pytest.raises(BuildError) as caught:
        build(vehicle.model, OcpOptions(), print)
    assert "error: no good" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(cache_directory().iterdir()) == []


def test_losing_the_race_takes_the_winners_library(fake, vehicle, monkeypatch):
    """Another process publishes while this one compiles."""
    publish = builder._publish

    def publish_after_another(work, directory, name):
        directory.mkdir()
        for file in work.iterdir():
            (directory / file.name).write_bytes(file.read_bytes())
        publish(work, directory, name)

    monkeypatch.setattr(builder, "_publish", publish_after_another)
    library = build(vehicle.model, OcpOptions(), print).library
    assert library.read_bytes() == b"library"
    assert [path.name for path in cache_directory().iterdir()] == [library.parent.name]


def test_no_compiler_is_one_line_that_says_what_to_do(monkeypatch, tmp_path, vehicle):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(builder.importlib.util, "find_spec", lambda name: None if name == "ziglang" else find_spec(name))
    with pytest.raises(SetupFailure) as caught:
        build(vehicle.model, OcpOptions(), print)
    assert "no C compiler" in str(caught.value)
    assert "ziglang" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_compiler_variable_that_does_not_run_is_named(monkeypatch):
    monkeypatch.setenv("CC", "/nonexistent/cc")
    with pytest.raises(BuildError, match=r"\$CC .*nonexistent"):
        find_compiler()


def test_without_a_system_compiler_ziglang_is_taken(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(builder.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(builder, "compiler_at", lambda command: builder.Compiler(command, "clang 20") if "ziglang" in command else None)
    compiler = find_compiler()
    assert compiler.command[1:4] == ("-m", "ziglang", "cc")
    assert "-mcpu=baseline" in compiler.command
    assert "ziglang" in str(compiler)


def test_a_place_that_cannot_be_written_is_named(fake, vehicle, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(BuildError, match="cannot write the library cache"):
        build(vehicle.model, OcpOptions(), print)
