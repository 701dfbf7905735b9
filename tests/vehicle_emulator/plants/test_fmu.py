"""Cars that are FMUs: FMI 2.0 made by pythonfmu and FMI 3.0 compiled here, against the same kinematic car in Python."""

import gc
import math
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest

from dbc.vehicle import load_vehicle
from tests.support.privilege import may_not_enter
from vehicle_emulator.plants import extras
from vehicle_emulator.plants.column import SteeringWheel
from vehicle_emulator.plants.extras import ExtraMissing
from vehicle_emulator.plants.fmu import FmuPlant
from vehicle_emulator.plants.fmu_mapping import MappingError
from vehicle_emulator.plants.fmu_slave import FmuFailed, FmuUnusable
from vehicle_emulator.plants.interface import Level, PlantInputs, SteeringInputs
from vehicle_emulator.road import RoadDescription, make_road

SOURCES = Path(__file__).parents[2] / "support" / "fmu"
VEHICLE = load_vehicle()
INPUTS = PlantInputs(SteeringInputs(0.8, 60.0), accelerator_norm=0.4)
STEP_S = 1e-3

MAPPING_2 = """
[inputs]
road_wheel_rad = { variable = "steer_deg", factor = 57.29577951308232 }
accelerator_norm = { variable = "gas_percent", factor = 100.0 }
[outputs]
x_m = "x"
y_m = { variable = "y_right", factor = -1.0 }
yaw_rad = { variable = "yaw_right_deg", factor = -0.017453292519943295 }
vx_mps = "vx"
vy_mps = "vy"
yaw_rate_radps = "yaw_rate"
ax_mps2 = "ax"
ay_mps2 = "ay"
[start]
x_m = "x_0"
speed_mps = "speed_0"
"""
MAPPING_3 = """
[inputs]
road_wheel_rad = "steer"
accelerator_norm = { variable = "gas", factor = 5.0 }
[outputs]
x_m = "x"
y_m = "y"
yaw_rad = "yaw"
vx_mps = "speed"
vy_mps = "zero"
yaw_rate_radps = "yaw_rate"
ax_mps2 = "ax"
ay_mps2 = "ay"
wheel_speed_rear_right_radps = { variable = "speed", factor = 4.0 }
[start]
x_m = "x_0"
speed_mps = "speed_0"
"""
VARIABLES_3 = ("steer", "gas", "x", "y", "yaw", "speed", "yaw_rate", "x_0", "speed_0", "fail_at", "zero", "ax", "ay")


def description_3():
    causality = dict.fromkeys(("steer", "gas"), "input") | dict.fromkeys(("x_0", "speed_0", "fail_at"), "parameter")
    lines, outputs = [], []
    for reference, name in enumerate(VARIABLES_3):
        kind = causality.get(name, "output")
        start = ' start="0"' if kind != "output" else ""
        variability = ' variability="fixed"' if kind == "parameter" else ""
        lines.append(f'<Float64 name="{name}" valueReference="{reference}" causality="{kind}"{variability}{start}/>')
        outputs += [f'<Output valueReference="{reference}"/>'] if kind == "output" else []
    lines.append('<Float64 name="time" valueReference="91" causality="independent" variability="continuous"/>')
    lines.append('<Float64 name="loads" valueReference="90" causality="output"><Dimension start="4"/></Float64>')
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="3.0" modelName="car" instantiationToken="{1}">'
        f'<CoSimulation modelIdentifier="car3"/><ModelVariables>{"".join(lines)}</ModelVariables>'
        f'<ModelStructure>{"".join(outputs)}<Output valueReference="90"/></ModelStructure></fmiModelDescription>'
    )


def compiled(source, library):
    subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", str(library), "-xc", "-", "-lm"], input=source, text=True, check=True)


@pytest.fixture(scope="module")
def fmu_2(tmp_path_factory):
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu is not installed")
    folder = tmp_path_factory.mktemp("fmu2")
    builder.FmuBuilder.build_FMU(SOURCES / "car2.py", folder / "car2.fmu")
    return folder / "car2.fmu"


@pytest.fixture(scope="module")
def fmu_3(tmp_path_factory):
    pytest.importorskip("fmpy", reason="fmpy is not installed")
    folder = tmp_path_factory.mktemp("fmu3")
    library = folder / "car3.so"
    compiled((SOURCES / "car3.c").read_text(encoding="utf-8"), library)
    with zipfile.ZipFile(folder / "car3.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", description_3())
        archive.write(library, "binaries/x86_64-linux/car3.so")
    return folder / "car3.fmu"


@pytest.fixture
def car_2(fmu_2, tmp_path):
    return placed(fmu_2, tmp_path, MAPPING_2)


@pytest.fixture
def car_3(fmu_3, tmp_path):
    return placed(fmu_3, tmp_path, MAPPING_3)


def placed(fmu, folder, mapping):
    """An FMU with its mapping beside it."""
    shutil.copy(fmu, folder / fmu.name)
    (folder / fmu.name).with_suffix(".toml").write_text(mapping, encoding="utf-8")
    return folder / fmu.name


def remapped(path, old, new):
    mapping = path.with_suffix(".toml")
    text = mapping.read_text(encoding="utf-8")
    assert old in text
    mapping.write_text(text.replace(old, new), encoding="utf-8")


def kinematic(steps, step_s=STEP_S, x_m=-20.0, speed_mps=8.0, every=1):
    """The same car in Python."""
    wheel, y_m, yaw_rad = SteeringWheel(VEHICLE, STEP_S), 0.0, 0.0
    for k in range(1, steps + 1):
        wheel.step(INPUTS.steering)
        if k % every:
            continue
        speed_mps += step_s * 5.0 * INPUTS.accelerator_norm
        yaw_rate_radps = speed_mps * math.tan(wheel.angle_rad / VEHICLE.steering.ratio) / 2.5
        yaw_rad += step_s * yaw_rate_radps
        x_m += step_s * speed_mps * math.cos(yaw_rad)
        y_m += step_s * speed_mps * math.sin(yaw_rad)
    return x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps, speed_mps * yaw_rate_radps


def driven(plant, steps):
    for _ in range(steps):
        plant.step(STEP_S, INPUTS)
    s = plant.state
    return s.x_m, s.y_m, s.yaw_rad, s.vx_mps, s.yaw_rate_radps, s.ay_mps2


def started(path, **more):
    return FmuPlant(path, VEHICLE, Level(), (-20.0, 0.0, 0.0), 8.0, **more)


@pytest.mark.parametrize("car", ["car_2", "car_3"])
def test_an_fmu_drives_as_the_same_car_in_python(car, request):
    with started(request.getfixturevalue(car)) as plant:
        assert (plant.state.x_m, plant.state.vx_mps) == (-20.0, 8.0)
        assert driven(plant, 2000) == pytest.approx(kinematic(2000), abs=1e-9)
        assert plant.state.steering_wheel_rad == pytest.approx(0.8, abs=1e-9)
        assert plant.state.ax_mps2 == pytest.approx(2.0)


@pytest.mark.parametrize("car", ["car_2", "car_3"])
def test_after_a_reset_it_drives_the_same_again(car, request):
    with started(request.getfixturevalue(car)) as plant:
        first = driven(plant, 500)
        plant.reset()
        assert (plant.state.x_m, plant.state.vx_mps, plant.state.steering_wheel_rad) == (-20.0, 8.0, 0.0)
        assert driven(plant, 500) == first


def test_wheels_are_told_one_by_one(car_3):
    with started(car_3) as plant:
        assert plant.state.wheel_speeds_radps == (0.0, 0.0, 0.0, 32.0)


def test_offsets_are_added_behind_the_factor(car_3):
    remapped(car_3, '"speed", factor = 4.0', '"speed", factor = 4.0, offset = 1.5')
    remapped(car_3, '"gas", factor = 5.0', '"gas", factor = 5.0, offset = -0.5')
    with started(car_3) as plant:
        assert plant.state.wheel_speeds_radps[3] == 33.5
        assert plant.step(STEP_S, INPUTS).ax_mps2 == pytest.approx(1.5)


def test_a_longer_communication_step_is_bridged_by_the_velocities(car_3):
    remapped(car_3, "[inputs]", "step_ms = 10\n[inputs]")
    with started(car_3) as plant:
        assert driven(plant, 2000) == pytest.approx(kinematic(2000, 10 * STEP_S, every=10), abs=1e-9)
        x_m, vx_mps = plant.state.x_m, plant.state.vx_mps
        way_m = [plant.step(STEP_S, INPUTS).x_m - x_m for _ in range(9)]
        assert way_m == pytest.approx([k * STEP_S * vx_mps * math.cos(plant.state.yaw_rad) for k in range(1, 10)], rel=0.02)
        assert plant.state.vx_mps == vx_mps
        assert plant.step(STEP_S, INPUTS).vx_mps > vx_mps


def test_an_fmu_can_be_told_of_the_road(car_3):
    remapped(car_3, '"steer"', '"steer"\nroad_slope_x = "zero"')
    with pytest.raises(MappingError, match=r"inputs\.road_slope_x = 'zero': a variable of causality output; allowed: input, parameter"):
        started(car_3)
    remapped(car_3, 'road_wheel_rad = "steer"\nroad_slope_x = "zero"', 'road_slope_x = "steer"')
    with FmuPlant(car_3, VEHICLE, make_road(RoadDescription(grade_percent=10.0)), (-20.0, 0.0, 0.0), 8.0) as plant:
        plant.step(STEP_S, INPUTS)
        assert plant.state.yaw_rate_radps == pytest.approx(plant.state.vx_mps * math.tan(0.1) / 2.5)


def test_an_fmu_may_have_the_steering_wheel_itself(car_3):
    remapped(car_3, 'ay_mps2 = "ay"', 'ay_mps2 = "ay"\nsteering_wheel_rad = { variable = "steer", factor = 14.7 }')
    with pytest.raises(MappingError, match=r"outputs\.steering_wheel_rad = 'steer': a variable of causality input"):
        started(car_3)
    remapped(car_3, '"steer", factor = 14.7', '"yaw", factor = 14.7')
    with started(car_3) as plant:
        driven(plant, 100)
        assert plant.state.steering_wheel_rad == pytest.approx(14.7 * plant.state.yaw_rad)


def test_other_parameters_are_set_and_an_error_of_the_fmu_is_one_line_with_its_words(car_3):
    remapped(car_3, "[start]", '[parameters]\nfail_at = 0.05\n[start]')
    plant = started(car_3)
    with pytest.raises(FmuFailed) as caught:
        driven(plant, 100)
    assert str(caught.value) == f"{car_3}: fmi3DoStep failed with status 3 (error).: the road has ended"
    assert plant.state.vx_mps == pytest.approx(8.0 + 50 * STEP_S * 2.0, abs=0.003)
    plant.close()


def test_an_fmu_of_fmi_2_that_returns_an_error_is_told(car_2):
    with started(car_2) as plant, pytest.raises(FmuFailed, match="fmi2DoStep failed with status"):
        driven(plant, 5100)


def test_a_number_that_is_none_is_refused(car_3):
    with FmuPlant(car_3, VEHICLE, Level(), (-20.0, 0.0, 0.0), 8.0) as plant, pytest.raises(FmuFailed, match="gives a number that is none"):
        plant.step(STEP_S, PlantInputs(accelerator_norm=math.nan))


@pytest.mark.parametrize("car", ["car_2", "car_3"])
def test_what_was_unpacked_is_removed(car, request, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = request.getfixturevalue(car)
    unpacked = lambda: list(tmp_path.glob("xilgate-fmu-*"))  # noqa: E731
    plant = started(path)
    assert len(unpacked()) == 1
    plant.close()
    assert unpacked() == []
    forgotten = started(path)
    assert len(unpacked()) == 1
    del forgotten
    gc.collect()
    assert unpacked() == []
    with pytest.raises(MappingError):
        FmuPlant(path, VEHICLE, Level(), (-20.0, 1.0, 0.0), 8.0)
    assert unpacked() == []


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('"steer"', '"angle"', "inputs.road_wheel_rad = 'angle': the FMU has no such variable; known: steer, gas, x_0, speed_0, fail_at"),
        ('x_m = "x"', 'x_m = "loads"', "outputs.x_m = 'loads': a variable of type array of Float64; allowed: Real or Float64"),
        ('x_m = "x"\n', "", "outputs: allowed: all of x_m, y_m, yaw_rad"),
        ("road_wheel_rad", "wheel_angle", "inputs: allowed: no key 'wheel_angle'; known: steering_wheel_rad"),
        ("factor = 5.0", "factor = 0.0", "inputs.accelerator_norm.factor = 0.0: allowed: a factor other than 0"),
        ("factor = 5.0", "scale = 5.0", "inputs.accelerator_norm.scale: unknown key"),
        ("[inputs]", "step_ms = 0\n[inputs]", "step_ms = 0: allowed: 1 to 100"),
        ("[inputs]", "step_ms = 1.5\n[inputs]", "step_ms = 1.5"),
        ('x_m = "x_0"\n', "", "start.x_m: missing; the car is to start with -20"),
        ("[start]", "[parameters]\nmass = 1.0\n[start]", "parameters.mass = 'mass': the FMU has no such variable"),
    ],
)
def test_a_mistake_in_the_mapping_is_named(car_3, old, new, named):
    remapped(car_3, old, new)
    with pytest.raises(MappingError) as caught:
        started(car_3)
    assert str(caught.value).startswith(f"{car_3.with_suffix('.toml')}: ")
    assert named in str(caught.value)


def test_a_variable_of_another_type_is_named(car_2):
    remapped(car_2, '"gas_percent", factor = 100.0', '"lights"')
    with pytest.raises(MappingError, match=r"inputs\.accelerator_norm = 'lights': a variable of type Integer; allowed: Real or Float64"):
        started(car_2)


def test_another_mapping_file_may_be_given(car_3, tmp_path):
    other = car_3.with_suffix(".toml").rename(tmp_path / "other.toml")
    with pytest.raises(MappingError, match=r"car3\.toml: No such file"):
        started(car_3)
    with started(car_3, mapping=other) as plant:
        assert plant.state.vx_mps == 8.0


def test_files_that_are_no_fmu_for_here_are_refused(car_3, tmp_path):
    mapping = car_3.with_suffix(".toml")

    def refusal(path):
        with pytest.raises(FmuUnusable) as caught:
            started(path, mapping=mapping)
        return str(caught.value)

    assert refusal(tmp_path / "none.fmu") == f"{tmp_path / 'none.fmu'}: no such file"
    with may_not_enter(closed := tmp_path / "closed"):
        assert refusal(closed / "car.fmu") == f"{closed / 'car.fmu'}: no such file"
    assert refusal(mapping) == f"{mapping}: no FMU: not a ZIP archive"
    other = tmp_path / "other.fmu"

    def made(text, *names):
        with zipfile.ZipFile(other, "w") as archive:
            archive.writestr("modelDescription.xml", text)
            for name in names:
                archive.writestr(name, "no library")
        return refusal(other)

    assert made(description_3(), "binaries/win64/car3.dll") == f"{other}: no binary for x86_64-linux; it has: win64"
    assert "its library cannot be loaded" in made(description_3(), "binaries/x86_64-linux/car3.so")
    compiled((SOURCES / "car3.c").read_text(encoding="utf-8").partition("#define NONE")[0], tmp_path / "part.so")
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("modelDescription.xml", description_3())
        archive.write(tmp_path / "part.so", "binaries/x86_64-linux/car3.so")
    assert refusal(other) == f"{other}: its library is not complete: no fmi3ActivateModelPartition"
    exchange = description_3().replace("<CoSimulation", "<ModelExchange")
    assert made(exchange) == f"{other}: an FMU for model exchange; allowed: co-simulation"
    broken = made(description_3().replace(' valueReference="3"', "", 1))
    assert broken.startswith(f"{other}: ")
    assert "\n" not in broken


def test_without_the_library_it_is_told_how_to_get_it(tmp_path, monkeypatch):
    (tmp_path / "car.toml").write_text(MAPPING_3, encoding="utf-8")
    monkeypatch.setitem(sys.modules, "fmpy", None)
    (tmp_path / "car.fmu").touch()
    with pytest.raises(ExtraMissing, match=r"^this plant needs the library fmpy: .venv/bin/pip install '\.\[fmu\]'$"):
        started(tmp_path / "car.fmu")


def test_a_library_that_lacks_another_one_is_no_missing_extra(tmp_path, monkeypatch):
    (tmp_path / "half_there.py").write_text("import not_there_at_all\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="not_there_at_all"):
        extras.optional("half_there", "fmu")
