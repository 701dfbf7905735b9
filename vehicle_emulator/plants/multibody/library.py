"""The compiled car: generated, compiled and cached once for all cars, because their numbers are arguments of the code."""

import ctypes
from collections.abc import Callable
from pathlib import Path

from dbc import build as builder
from dbc.build import Build, BuildError, Recipe, build_from, sha256_of_files
from vehicle_emulator.plants.multibody.layout import FELT, INPUTS, MOTION, STATE, leaves, numbers
from vehicle_emulator.plants.multibody.parameters import CarParameters

NAME = "multibody"
STATES, MOTIONS = sum(STATE), sum(MOTION)
OUTPUTS = MOTIONS + sum(FELT)
FLAGS = (*builder.FLAGS, f"-DSTATES={STATES}", f"-DMOTIONS={MOTIONS}")

_HERE = Path(__file__).parent
_STEPPER = _HERE / "rk4.c"
_PARTS = ("chassis", "tyre", "bristle", "brake", "steering", "powertrain")
_KEYED_SOURCES = (
    *(f"{name}.py" for name in ("layout", "symbols", "parameters", *_PARTS, "equations", "library")), _STEPPER.name, "../interface.py"
)  # fmt: skip
_GENERATED = "equations.c"
_INLINED = {"return fmin(x, y);": "return x < y ? x : y;", "return fmax(x, y);": "return x > y ? x : y;"}


def build(car: CarParameters, progress: Callable[[str], None]) -> Build:
    """The library; see `dbc.build.build_from`. Of the numbers of `car` only how many there are matters."""
    shape = [(name, len(values)) for name, values in leaves(car)]
    ingredients = {"sources": sha256_of_files(_HERE, _KEYED_SOURCES), "parameters": shape}
    return build_from(Recipe("the emulated car", NAME, ingredients, {}, FLAGS, lambda directory: _write(directory, car)), progress)


def _write(directory: Path, car: CarParameters) -> list[str]:
    import casadi as ca  # noqa: PLC0415 - CasADi is loaded only when there is something to build

    from vehicle_emulator.plants.multibody.equations import build_functions  # noqa: PLC0415

    generator = ca.CodeGenerator(_GENERATED, {"main": False, "with_header": False})
    for function in build_functions(car):
        generator.add(function)
    (directory / _GENERATED).write_text(_inlined(generator.dump()), encoding="utf-8")
    return [_GENERATED, str(_STEPPER)]


def _inlined(source: str) -> str:
    """The same code with comparisons for the calls of fmin and fmax, a fifth of its time; bytes of its results are the same.

    Raises:
        BuildError: the code does not have the form that CasADi 3.8 gives it.
    """
    for call, comparison in _INLINED.items():
        if source.count(call) != 1:
            raise BuildError(f"the code that CasADi generates has {source.count(call)} places {call!r}, expected one")
        source = source.replace(call, comparison)
    return source


class CompiledCar:
    """One car on fixed memory.

    Args:
        build: the library.
        car: the numbers.
    """

    def __init__(self, build: Build, car: CarParameters) -> None:
        self._library = ctypes.CDLL(str(build.library))
        self.state = (ctypes.c_double * STATES)()
        self.inputs = (ctypes.c_double * sum(INPUTS))()
        self.outputs = (ctypes.c_double * OUTPUTS)()
        values = numbers(car)
        self._parameters = (ctypes.c_double * len(values))(*values)
        self._advance = self._library.advance
        self._advance.argtypes = [*[ctypes.c_void_p] * 4, ctypes.c_double, ctypes.c_int]
        self._advance.restype = None
        # Addresses, because a thousand times a second ctypes would make four pointers.
        self._memory = tuple(map(ctypes.addressof, (self.state, self.outputs, self.inputs, self._parameters)))

    def advance(self, step_s: float, steps: int = 1) -> None:
        """Advance `state` by some steps with `inputs` held, and fill `outputs`."""
        self._advance(*self._memory, step_s, steps)
