"""What the bus oracle holds against the gateway: numbers written down a second time, each with its source; never read from the product.

"Issue" is the issue that the gateway was built for, "B2", "B3" its acceptance list (docs/safety.md has both in its tables).
"""

from dataclasses import dataclass, replace
from enum import Enum

MS = 1_000_000
"""Nanoseconds."""


@dataclass(frozen=True)
class Car:
    """The car that the limits are about; defaults are those of dbc/focus.toml."""

    wheelbase_m: float = 2.648
    wheel_radius_m: float = 0.31
    steering_ratio: float = 14.7
    mass_kg: float = 1500.0
    full_drive_force_n: float = 4838.7
    full_brake_force_n: float = 15000.0


@dataclass(frozen=True)
class Envelope:
    """What no frame of the gateway may exceed while it moves the car.

    Args:
        steering_wheel_limit_deg, steering_wheel_rate_dps: of the steering-wheel demand [deg, deg/s]; the car's own end stop applies too.
        lateral_acceleration_mps2, lateral_jerk_mps3: of v^2 tan(road-wheel angle) / wheelbase, and of its change at constant speed.
        acceleration_mps2, deceleration_mps2: that the pedal demands stand for.
        drive_jerk_mps3, brake_jerk_mps3: how fast the accelerator may be pressed, and the brake pressed or released.
        max_speed_kmh: largest value of GW_SafetyCommand.MaxSpeed.
        is_on_the_road: whether the wheels turn with the car.
    """

    steering_wheel_limit_deg: float
    steering_wheel_rate_dps: float
    lateral_acceleration_mps2: float
    lateral_jerk_mps3: float
    acceleration_mps2: float
    deceleration_mps2: float
    drive_jerk_mps3: float
    brake_jerk_mps3: float
    max_speed_kmh: float
    is_on_the_road: bool = True


ENVELOPES = {
    "nominal": Envelope(
        steering_wheel_limit_deg=463.3,  # end stop of the car: 0.55 rad at the road wheel, dbc/focus.toml
        steering_wheel_rate_dps=796.5,  # profile: 13.9 rad/s, as proving_ground
        lateral_acceleration_mps2=3.0,  # ISO 11270, as panda has it; B2 computes the fault-tolerant time with it
        lateral_jerk_mps3=5.0,  # ISO 11270; B2
        acceleration_mps2=2.0,  # issue and B3, row G1
        deceleration_mps2=3.5,  # the same
        drive_jerk_mps3=10.0,  # profile
        brake_jerk_mps3=20.0,  # profile
        max_speed_kmh=143.0,  # UN R157: 130 km/h; the robots' own limit acts 10 % later
    ),
    "proving_ground": Envelope(
        steering_wheel_limit_deg=463.3,
        steering_wheel_rate_dps=796.5,  # profile: 13.9 rad/s
        lateral_acceleration_mps2=15.0,  # profile
        lateral_jerk_mps3=200.0,  # profile
        acceleration_mps2=3.3,  # profile: full accelerator
        deceleration_mps2=10.0,  # profile: full brake
        drive_jerk_mps3=20.0,  # profile: as fast as the accelerator robot
        brake_jerk_mps3=64.0,  # profile
        max_speed_kmh=143.0,
    ),
    "bench": Envelope(
        steering_wheel_limit_deg=90.0,  # profile: a quarter of a turn
        steering_wheel_rate_dps=100.3,  # profile: 1.75 rad/s
        lateral_acceleration_mps2=1.0,
        lateral_jerk_mps3=2.0,
        acceleration_mps2=1.0,
        deceleration_mps2=3.5,
        drive_jerk_mps3=2.0,
        brake_jerk_mps3=20.0,
        max_speed_kmh=33.5,  # 30 km/h, and 10 %
        is_on_the_road=False,
    ),
}
ENVELOPES["lifted"] = replace(ENVELOPES["proving_ground"], is_on_the_road=False)  # the virtual car drives there

SAFE_STOP_MPS2, SAFE_STOP_JERK_MPS3 = 2.5, 1.5  # B3, F1
COMFORT_STOP_MPS2, COMFORT_STOP_JERK_MPS3 = 1.0, 0.3  # decision on issue 5: Autoware's comfortable stop
STANDSTILL_BRAKE_PERCENT = 35.0  # holds a 30 % slope: 4300 N of 15000 N
STANDING_MPS = 0.2
PLAN_TAIL_NS = 1_200 * MS  # B3, F1: the plan in a command is at most 1.2 s long; then the angle is held
MESSAGE_RATE_RATIO = 1.2  # B3, G1
REQUEST_WINDOW_NS = 50 * MS  # an operator request acts in the tick that takes it in, or never
MAX_COMMAND_AGE_MS = 100.0  # B2: one missed solve is tolerated, two are not
WATCHDOG_ANSWER_NS = 50 * MS


class Kind(Enum):
    """What counts as the gateway's reaction to a fault."""

    NONE = "goes on driving"
    ANY = "whatever is safe"
    STOP = "stops the car itself, or lets go"
    RELEASE = "lets go of the robots"
    SILENCE = "lets go or sends nothing any more"

    @property
    def severity(self) -> int:
        """Rank; of two reactions to two faults the severer counts."""
        return {Kind.NONE: 0, Kind.ANY: 1, Kind.STOP: 2, Kind.RELEASE: 3, Kind.SILENCE: 4}[self]


@dataclass(frozen=True)
class Reaction:
    """What has to follow on a fault.

    Args:
        within_ns: from the fault to the first safe frame on the bus [ns], in virtual time.
        source: where the number is from.
        within_process_ns: the same for real processes on a shared machine, where the list has a number of its own; else 0.
    """

    kind: Kind
    within_ns: int
    source: str
    within_process_ns: int = 0


REACTIONS = {
    "F1": Reaction(Kind.STOP, 120 * MS, "B3 F1: command age 100 ms, first safe frame 120 ms", 150 * MS),
    "F2": Reaction(Kind.STOP, 120 * MS, "B3 F2: same as F1", 150 * MS),
    "F3": Reaction(Kind.NONE, 0, "B3 F3: exactly one missed solve: no disengagement"),
    "F4": Reaction(Kind.STOP, 12 * MS, "B3 F4: within one tick (10.5 ms) after the third degraded cycle, or a failed one"),
    "F5": Reaction(Kind.STOP, 100 * MS, "B3 F5: in the tick of the third bad command in a row; from the first one, every 40 ms"),
    "F5 one": Reaction(Kind.NONE, 0, "B3 F5: a single bad command is dropped, never encoded"),
    "F6": Reaction(Kind.STOP, 70 * MS, "B3 F6: 3 periods and at least 30 ms, at most 50 ms; first safe frame 70 ms"),
    "F7": Reaction(Kind.STOP, 100 * MS, "B3 F7: 3 bad of 10 frames at 100 Hz"),
    "F8": Reaction(Kind.STOP, 220 * MS, "B3 F8: found in 200 ms"),
    "F9": Reaction(Kind.STOP, 150 * MS, "B3 F9: 20 % lost or 120 ms late"),
    "F9 mild": Reaction(Kind.NONE, 0, "B3 F9: 1 % lost: no disengagement in 10 min"),
    "F9 any": Reaction(Kind.ANY, 0, "B3 F9: never a violation of a limit"),
    "F10": Reaction(Kind.SILENCE, 62 * MS, "B3 F10: found in 50 ms, and one step (10.5 ms); stop sending", 150 * MS),
    "F11": Reaction(Kind.STOP, 150 * MS, "B3 F11: own frames do not get through"),
    "F11 idle": Reaction(Kind.NONE, 0, "B3 F11: unknown identifiers that leave the bus its time"),
    "F12": Reaction(Kind.SILENCE, 10 * MS, "B3 F12: the gateway is dead; the robots let go after 110 ms", 40 * MS),
    "F13": Reaction(Kind.STOP, 0, "B3 F13: from waking; the first frame is safe"),
    "F14": Reaction(Kind.NONE, 0, "B3 F14: no effect"),
    "F15": Reaction(Kind.NONE, 0, "B3 F15: control unchanged"),
    "F17": Reaction(Kind.STOP, 150 * MS, "B3 F17: as F1"),
    "F17 telemetry": Reaction(Kind.NONE, 0, "B3 F17: what the gateway does not obey may be lost or flooded"),
    "second sender": Reaction(Kind.SILENCE, 12 * MS, "issue, Gate: a second sender of our own identifiers; in one step (10.5 ms)"),
    "E3": Reaction(Kind.RELEASE, 12 * MS, "B3 E3: the driver ends ENGAGED in the same tick (up to 10.5 ms)", 50 * MS),
}
