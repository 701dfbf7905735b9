"""Everything that can go wrong: one table, from which faults are checked, typed in, listed and documented."""

from dataclasses import dataclass
from enum import StrEnum

from vehicle_emulator.ins import GNSS_MODES, MAX_LATENCY_EXTRA_S

Value = float | str | tuple[str, ...]
"""What a parameter can be: a number, a word, or names of messages."""

MAX_TIME_S = 3600.0
_MAX_WORD = 200


class Group(StrEnum):
    """What a fault is about."""

    FRAMES = "frames"
    WIRE = "wire"
    ROBOTS = "robots"
    DRIVER = "driver"
    NAVIGATION = "navigation system"
    CAR = "car"


@dataclass(frozen=True, slots=True)
class Number:
    """A parameter that is a number, both ends of its range allowed."""

    low: float
    high: float
    unit: str = ""
    is_whole: bool = False

    @property
    def allowed(self) -> str:
        """What is allowed, for people."""
        return f"{'a whole number, ' if self.is_whole else ''}{self.low:.15g} to {self.high:.15g}{f' {self.unit}' if self.unit else ''}"

    def accept(self, value: object) -> Value | None:
        """The value of the parameter, or None when this is none."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not self.low <= value <= self.high:
            return None
        return None if self.is_whole and value != int(value) else value

    def read(self, text: str) -> object:
        """What somebody typed: decimal, or hexadecimal where it is whole."""
        try:
            return int(text, 0) if self.is_whole else float(text)
        except ValueError:
            return text


@dataclass(frozen=True, slots=True)
class Word:
    """A parameter that is a word: one of some, or any text without control characters."""

    choices: tuple[str, ...] = ()
    unit = ""

    @property
    def allowed(self) -> str:
        """What is allowed, for people."""
        return " or ".join(self.choices) if self.choices else f"text of 1 to {_MAX_WORD} printable characters"

    def accept(self, value: object) -> Value | None:
        """The value of the parameter, or None when this is none."""
        if not isinstance(value, str) or not 0 < len(value) <= _MAX_WORD or not value.isprintable():
            return None
        return value if not self.choices or value in self.choices else None

    def read(self, text: str) -> object:
        """What somebody typed."""
        return text


@dataclass(frozen=True, slots=True)
class Names:
    """A parameter that is a list of names; one name alone need not be in a list."""

    unit = ""
    allowed = 'a name or a list of names: of messages, of nodes for all that they send, identifiers such as "0x123", or "*" for everything'

    def accept(self, value: object) -> Value | None:
        """The value of the parameter, or None when this is none."""
        names = [value] if isinstance(value, str) else value
        if not isinstance(names, list | tuple) or not 0 < len(names) <= _MAX_WORD:
            return None
        return tuple(names) if all(Word().accept(name) for name in names) else None

    def read(self, text: str) -> object:
        """What somebody typed: names with commas between them."""
        return text.split(",")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One key of a fault.

    Args:
        domain: what it can be.
        default: its value where none is given; None where one must be.
        is_optional: whether it may be left out without a default.
    """

    name: str
    domain: Number | Word | Names
    description: str
    default: Value | None = None
    is_optional: bool = False


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault.

    Args:
        needs_one: whether at least one of its parameters must differ from its default.
        is_counted: whether it hits single frames, so that `COUNTING` applies.
    """

    name: str
    group: Group
    description: str
    parameters: tuple[Parameter, ...] = ()
    needs_one: bool = False
    is_counted: bool = False


def _whole(name: str, low: int, high: int, description: str, default: int | None = None) -> Parameter:
    return Parameter(name, Number(low, high, is_whole=True), description, default)


TIMING = (
    Parameter("from_s", Number(0.0, MAX_TIME_S, "s"), "not before; since the start of the emulator, or since it was added", 0.0),
    Parameter("until_s", Number(0.0, MAX_TIME_S, "s"), "not from then on; same clock", is_optional=True),
    Parameter("duration_s", Number(0.001, MAX_TIME_S, "s"), "for so long from its beginning, once", is_optional=True),
    Parameter("condition", Word(), "begins when this holds; without duration_s, active as long as it holds", is_optional=True),
)
"""When a fault is active: keys of every kind."""
COUNTING = (
    _whole("after_count", 0, 1_000_000, "frames that pass first, counted while it is active", 0),
    _whole("every", 1, 1_000_000, "of those that follow, hits each n-th, beginning with the first", 1),
    Parameter("probability", Number(0.0, 1.0), "hits each of these with this probability", 1.0),
    Parameter("count", Number(1, 1_000_000, is_whole=True), "ends after so many hits", is_optional=True),
)
"""Which frames a fault hits: keys of every kind that hits single frames."""
_MESSAGES = Parameter("messages", Names(), "the frames it is about, in both directions")
_ROBOT = Parameter("robot", Word(("SR", "AR", "BR")), "which robot")
_PERIOD = Parameter("period_ms", Number(1.0, 10_000.0, "ms"), "again each time after so long; else once, when it begins", is_optional=True)


def _frames(name: str, description: str, *parameters: Parameter) -> Kind:
    return Kind(name, Group.FRAMES, description, (_MESSAGES, *parameters), is_counted=True)


def _frame_time(name: str, description: str) -> Parameter:
    return Parameter(name, Number(1.0, 10_000.0, "ms"), description)


_KINDS = (
    _frames("drop", "the frame is lost"),
    _frames("corrupt_bits", "bits of the payload are inverted, at random places", _whole("bits", 1, 64, "how many", 1)),
    _frames("wrong_length", "the payload is cut, or filled up with zeros", _whole("length", 0, 8, "its length in bytes")),
    _frames("bad_crc", "the CRC is wrong; protected messages only"),
    _frames("bad_counter", "the alive counter stays as at the first hit, the CRC is right; protected messages only"),
    _frames("freeze_payload", "the payload stays as it was at the first hit, with live counter and CRC"),
    _frames("replay", "the frame of an earlier time, byte by byte", _frame_time("age_ms", "how much earlier")),
    _frames("delay", "the frame comes late", _frame_time("delay_ms", "by how much")),
    _frames(
        "jitter", "the frame comes late by a random time, in order with its message, frames that are not hit included",
        _frame_time("jitter_ms", "at most by how much"),
    ),
    _frames("duplicate", "the frame comes several times", _whole("copies", 1, 100, "how many more", 1)),
    _frames("reorder", "frames are collected and come in reverse order", _whole("depth", 2, 64, "how many", 2)),
    Kind("silence", Group.FRAMES, "a node is not heard: all that it sends is lost", (Parameter("node", Word(), "a node of the DBC"),)),
    Kind(
        "babble", Group.FRAMES, "a node on the emulator's bus floods it (babbling idiot)",
        (
            _whole("id", 0, 0x7FF, "identifier of its frames"),
            Parameter("rate_hz", Number(1.0, 10_000.0, "Hz"), "how many a second", 1_000.0),
            _whole("length", 0, 8, "their payload in bytes, zeros", 8),
        ),
    ),
    Kind(
        "bus_error", Group.WIRE, "frames are destroyed on the wire and sent again by their controller; emulated bus only",
        (_MESSAGES, _whole("errors", 1, 1_000, "transmissions of each message that are destroyed", 1), _PERIOD),
    ),
    Kind(
        "bus_off", Group.WIRE, "transmissions of a node are destroyed until its controller is bus-off; emulated bus only",
        (Parameter("node", Word(), "a node of the DBC; one controller may serve several"), _PERIOD),
    ),
    Kind("robot_stuck", Group.ROBOTS, "the robot stays where it is, whatever is commanded", (_ROBOT,)),
    Kind("robot_slow", Group.ROBOTS, "the robot moves at a share of its rates", (_ROBOT, Parameter("factor", Number(0.01, 1.0), "share"))),
    Kind(
        "steering_offset", Group.ROBOTS, "the steering robot takes an angle beside the commanded one",
        (Parameter("angle_deg", Number(-180.0, 180.0, "deg"), "of the steering wheel, left positive"),),
    ),
    Kind(
        "pedal_offset", Group.ROBOTS, "a pedal robot takes a position beside the commanded one",
        (Parameter("robot", Word(("AR", "BR")), "which robot"), Parameter("stroke", Number(-1.0, 1.0), "share of the pedal's stroke")),
    ),
    Kind("robot_silent", Group.ROBOTS, "the robot sends nothing, and works", (_ROBOT,)),
    Kind(
        "robot_dtc", Group.ROBOTS, "the robot reports a diagnostic trouble code and a fault",
        (_ROBOT, _whole("code", 1, 254, "its number in the DBC")),
    ),
    Kind("robot_torque_loss", Group.ROBOTS, "the robot has no torque: it lets the steering wheel or the pedal go", (_ROBOT,)),
    Kind("dead_man_released", Group.DRIVER, "the safety driver lets the dead-man switch go"),
    Kind("stop_button", Group.DRIVER, "the safety driver presses the emergency stop in the cabin"),
    Kind(
        "driver_steering", Group.DRIVER, "the safety driver turns the steering wheel against the robot",
        (Parameter("torque_nm", Number(-50.0, 50.0, "Nm"), "of the hands, left positive"),),
    ),
    Kind(
        "driver_pedals", Group.DRIVER, "the safety driver presses pedals",
        (
            Parameter("accelerator", Number(0.0, 1.0), "share of its stroke", 0.0),
            Parameter("brake", Number(0.0, 1.0), "share of its stroke", 0.0),
        ),
        needs_one=True,
    ),
    Kind(
        "ins_bias", Group.NAVIGATION, "the solution is off by an amount; several add up",
        (
            Parameter("x_m", Number(-1e4, 1e4, "m"), "position, east", 0.0),
            Parameter("y_m", Number(-1e4, 1e4, "m"), "position, north", 0.0),
            Parameter("z_m", Number(-1e4, 1e4, "m"), "position, up", 0.0),
            Parameter("yaw_deg", Number(-180.0, 180.0, "deg"), "yaw, left positive", 0.0),
            Parameter("speed_mps", Number(-100.0, 100.0, "m/s"), "velocity along the heading", 0.0),
            Parameter("yaw_rate_degps", Number(-300.0, 300.0, "deg/s"), "yaw rate, left positive", 0.0),
            Parameter("ax_mps2", Number(-100.0, 100.0, "m/s2"), "acceleration along the car", 0.0),
        ),
        needs_one=True,
    ),
    Kind(
        "ins_drift", Group.NAVIGATION, "the position wanders off at a constant speed, in a random direction",
        (Parameter("rate_mps", Number(0.001, 100.0, "m/s"), "how fast"),),
    ),
    Kind(
        "ins_jump", Group.NAVIGATION, "the position jumps, in a random direction, as after a wrong fix",
        (Parameter("distance_m", Number(0.001, 1e4, "m"), "how far"),),
    ),
    Kind("ins_freeze", Group.NAVIGATION, "the solution stands still, its time goes on"),
    Kind("ins_time_freeze", Group.NAVIGATION, "the time of validity stands still"),
    Kind("ins_dropout", Group.NAVIGATION, "the instrument sends nothing"),
    Kind(
        "gnss_mode", Group.NAVIGATION, "satellite reception is worse; accuracies follow",
        (Parameter("mode", Word(GNSS_MODES), "kind of fix"),),
    ),
    Kind(
        "ins_latency", Group.NAVIGATION, "the solution comes later",
        (Parameter("latency_ms", Number(1.0, 1e3 * MAX_LATENCY_EXTRA_S, "ms"), "by how much, rounded up to whole steps"),),
    ),
    Kind("ins_noise", Group.NAVIGATION, "all white noise is larger", (Parameter("factor", Number(0.0, 1_000.0), "how many times"),)),
    Kind("friction", Group.CAR, "the road has less grip", (Parameter("factor", Number(0.05, 2.0), "on the grip of the road"),)),
    Kind("drive_loss", Group.CAR, "drive torque is lost", (Parameter("left", Number(0.0, 1.0), "share that is left", 0.0),)),
    Kind("brake_loss", Group.CAR, "brake torque is lost", (Parameter("left", Number(0.0, 1.0), "share that is left", 0.0),)),
    Kind("gust", Group.CAR, "a force on the centre of gravity", (Parameter("push_n", Number(-2e4, 2e4, "N"), "to the left of the car"),)),
)  # fmt: skip
KINDS = {kind.name: kind for kind in _KINDS}
"""Every kind of fault by its name."""


def keys(kind: Kind) -> dict[str, Parameter]:
    """All keys that a fault of this kind takes, besides `kind` and `name`."""
    return {key.name: key for key in (*kind.parameters, *TIMING, *(COUNTING if kind.is_counted else ()))}



def shown(value: Value) -> str:
    """A value as people type it."""
    if isinstance(value, tuple):
        value = ",".join(value)
    if isinstance(value, str):
        return f"'{value}'" if " " in value else value
    return f"{value:.15g}"
