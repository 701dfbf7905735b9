"""The part of the vehicle file that describes the driving robots. Positions and rates of pedals are shares of the learned stroke."""

from pydantic import ValidationInfo, field_validator

from dbc.section import NotNegative, Positive, Section, misfit


class RobotParameters(Section):
    """What all robots have: a second-order servo behind a dead time, and how long something must last until it counts.

    Args:
        dead_time_s, dead_time_jitter_s: from a command to its effect; the mean, and how far a single command may be off.
        override_time_s: of a driver who is stronger than `override_...`.
        following_error_time_s: of an error larger than `following_error_...`, which then is a fault.
    """

    bandwidth_hz: Positive
    damping_ratio: Positive
    dead_time_s: NotNegative
    dead_time_jitter_s: NotNegative
    override_time_s: Positive
    following_error_time_s: Positive


class SteeringRobot(RobotParameters):
    """Steering robot, at the steering wheel.

    Args:
        resistance_hz: bandwidth with which it learns what resists it, the integral action of its position loop.
        resolution_rad: of its demand and of its encoder.
        play_rad: lash between robot and steering wheel, from end to end.
        range_rad: its hard limit, to each side.
        learned_range_rad: what it has learned of this car, to each side.
        noise_rad: of the encoder, 1 sigma.
        override_nm: torque of the driver's hands that takes over.
        ramp_out_s: time in which its torque fades out in a stop.
    """

    resistance_hz: Positive
    resolution_rad: Positive
    play_rad: NotNegative
    rate_limit_radps: Positive
    acceleration_limit_radps2: Positive
    torque_limit_nm: Positive
    range_rad: Positive
    learned_range_rad: Positive
    noise_rad: NotNegative
    override_nm: Positive
    following_error_rad: Positive
    ramp_out_s: Positive


class PedalRobot(RobotParameters):
    """Robot on one pedal, with that pedal's spring, which leaves no lash.

    Args:
        resolution_norm: of its demand and of its encoder.
        stroke_m: learned stroke of the pedal.
        force_limit_n: its hard limit.
        preload_n, full_stroke_n, friction_n: spring force of the pedal at the beginning and the end of its stroke, and friction.
        noise_norm: of the encoder, 1 sigma.
        override_norm: how much deeper than the robot the driver's foot must be to take over.
    """

    resolution_norm: Positive
    rate_limit_per_s: Positive
    acceleration_limit_per_s2: Positive
    stroke_m: Positive
    force_limit_n: Positive
    preload_n: NotNegative
    full_stroke_n: Positive
    friction_n: NotNegative
    noise_norm: NotNegative
    override_norm: Positive
    following_error_norm: Positive

    @field_validator("full_stroke_n")
    @classmethod
    def _rises(cls, full_stroke_n: float, info: ValidationInfo) -> float:
        if full_stroke_n <= (preload_n := info.data.get("preload_n", 0.0)):
            raise misfit(f"more than preload_n, {preload_n:g}")
        return full_stroke_n


class BrakeRobot(PedalRobot):
    """Robot on the brake pedal.

    Args:
        stop_force_n: force with which it stops the car on its own.
    """

    stop_force_n: Positive


class Robots(Section):
    """The three driving robots."""

    steering: SteeringRobot
    accelerator: PedalRobot
    brake: BrakeRobot
