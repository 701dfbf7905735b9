"""`xilgate lift`: take the car of a running emulator off the ground, and set it down again."""

import msgspec

from dbc.errors import SetupFailure
from vehicle_emulator.lift import LOWER, RAISE
from vehicle_emulator.service import request

OPERATIONS = {"raise": RAISE, "lower": LOWER}


class Told(msgspec.Struct, frozen=True, kw_only=True):
    """Where the emulator tells that its car is."""

    is_lifted: bool


def move(how: str, base_port: int) -> str:
    """Raise or lower the car of the emulator that runs on these ports; one line that tells where it then is.

    Args:
        how: one of `OPERATIONS`.

    Raises:
        UserMistake: the emulator refuses, for every reason that it names.
        TelemetryError: no emulator answers.
    """
    result = request(OPERATIONS[how], {}, base_port)
    try:
        told = msgspec.convert(result, Told)
    except msgspec.ValidationError as error:
        raise SetupFailure(f"the emulator's answer does not tell where the car is: {error}; is it of another version?") from error
    return "the car hangs on the lift" if told.is_lifted else "the car stands on the road"
