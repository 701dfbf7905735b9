"""The codec and the DBC it is given."""

import pytest

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load
from gateway.codec import Codec, RobotLimits

LIMITS = RobotLimits(steering_wheel_rate_radps=10.0, max_speed_mps=36.0)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (" SG_ AngleCommand ", " SG_ WheelAngle ", "AngleCommand"),
        (" SG_ PositionActual ", " SG_ Position ", "PositionActual"),
        ("BO_ 304 BR_Command", "BO_ 304 Brake_Command", "BR_Command"),
        ('3 "Engage"', '3 "Go"', "Engage"),
        ('2 "AnglePosition"', '2 "Angle"', "AnglePosition"),
        ('5 "EStop"', '5 "Halt"', "EStop"),
    ],
)
def test_a_dbc_that_lacks_something_is_refused_at_start(tmp_path, old, new, named):
    site = tmp_path / "site.dbc"
    text = ROBOTS_DBC.read_text()
    assert old in text
    site.write_text(text.replace(old, new))
    with pytest.raises(CatalogueError, match=named) as caught:
        Codec(load([site, GNSS_IMU_DBC]), LIMITS)
    assert "site.dbc" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_shipped_dbc_is_accepted():
    assert Codec(load(), LIMITS) is not None
