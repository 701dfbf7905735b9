"""The vehicle file."""

import pytest

from dbc.vehicle import FOCUS, VehicleError, load_vehicle

TEXT = FOCUS.read_text()


def test_the_two_sides_of_the_mismatch_share_the_wheelbase():
    vehicle = load_vehicle()
    model, plant = vehicle.model, vehicle.multibody.masses
    assert model.cog_to_front_m + model.cog_to_rear_m == pytest.approx(plant.cog_to_front_m + plant.cog_to_rear_m)
    assert plant.mass_kg != model.mass_kg


def test_pedal_calibration_is_the_controllers_unit_of_force():
    vehicle = load_vehicle()
    assert vehicle.pedals.full_drive_force_n == pytest.approx(vehicle.model.max_wheel_torque_nm / vehicle.model.wheel_radius_m, rel=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("mass_kg = { value = 1500.0", "mass_kg = { value = -3.0", "car.toml: model.mass_kg = -3.0: Input should be greater than 0"),
        ("mass_kg = { value = 1500.0", "mass = { value = 1500.0", "car.toml: model.mass_kg: missing"),
        ('{ value = 4.358, source = "Ford Focus Mk3 data sheet" }', "4.358", "body.length_m: a number needs its source"),
        ("value = 14.7", 'value = "14.7"', "steering.ratio = '14.7'"),
        ("[body]", "[body", "not valid TOML"),
        ("value = 14.7", "value = nan", "steering.ratio = nan: "),
        ("[body]", "spare = \"tyre\"\n[body]", "car.toml: spare: unknown key"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, named):
    assert old in TEXT
    path = tmp_path / "car.toml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(VehicleError) as caught:
        load_vehicle(path)
    assert named in str(caught.value)
    assert "car.toml" in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(VehicleError, match=r"none\.toml"):
        load_vehicle(tmp_path / "none.toml")
