"""Conditions: what they mean, and what is none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_emulator.faults.condition import SIGNALS, Condition, ConditionError, Situation
from vehicle_emulator.plants.interface import PlantState

FAST = Situation(PlantState(x_m=31.0, vx_mps=20.0, gear=3), is_engaged=True)
SLOW = Situation(PlantState(x_m=-5.0, vx_mps=0.0), is_engaged=False)


@pytest.mark.parametrize(
    ("text", "is_fast", "is_slow"),
    [
        ("engaged", True, False),
        ("not engaged", False, True),
        ("x_m > 30", True, False),
        ("x_m>31", False, False),
        ("x_m >= 31", True, False),
        ("  vx_mps<=0 ", False, True),
        ("x_m < -4.5e0 and not engaged", False, True),
        ("engaged and x_m > 30 and x_m < 60", True, False),
        ("engaged and x_m > 60", False, False),
        ("gear == 3", True, False),
        ("gear != 3", False, True),
    ],
)
def test_meaning(text, is_fast, is_slow):
    condition = Condition(text)
    assert (condition.holds(FAST), condition.holds(SLOW)) == (is_fast, is_slow)


@pytest.mark.parametrize("signal", SIGNALS)
def test_every_signal_is_that_of_the_car(signal):
    above = Situation(PlantState()._replace(**{signal: 2.0}), is_engaged=False)
    assert Condition(f"{signal} > 1").holds(above)
    assert not Condition(f"{signal} > 1").holds(SLOW)


@pytest.mark.parametrize(
    "text",
    [
        "", " ", "and", "engaged and", "and engaged", "engaged or engaged", "engaged == 1", "not x_m > 3", "x_m", "x_m >", "> 3",
        "x_m > y_m", "x_m > nan", "x_m > inf", "x_m => 3", "x_m = 3", "3 < x_m", "30 < x_m < 60", "wheel_speeds_radps > 1",
        "x_m > 1 engaged", "(engaged)", "__class__ > 1", "state.x_m > 1", "x_m > 1; import os", "x_m > __import__('os')", "ENGAGED",
        "x_ｍ > 1", "not not engaged",
    ],
)  # fmt: skip
def test_what_is_no_condition_is_refused(text):
    with pytest.raises(ConditionError, match="is no clause; allowed: engaged, not engaged, SIGNAL < NUMBER") as caught:
        Condition(text)
    assert "\n" not in str(caught.value)


@given(st.text(alphabet="xyz_mps<>=! 0123456789.enandgot-", max_size=60) | st.text(max_size=40))
def test_any_text_is_a_condition_or_refused(text):
    try:
        condition = Condition(text)
    except ConditionError:
        return
    assert condition.holds(FAST) in (True, False)
