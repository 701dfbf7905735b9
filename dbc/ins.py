"""The part of the vehicle file that describes the navigation system."""

from typing import Annotated

from pydantic import AfterValidator, Field

from dbc.section import NotNegative, Positive, Section, between, misfit

OUTPUT_RATES_HZ = (100.0, 250.0)
"""What a navigation system of this class can be ordered with."""


def _offered(rate_hz: float) -> float:
    if rate_hz not in OUTPUT_RATES_HZ:
        raise misfit(" or ".join(f"{rate:g}" for rate in OUTPUT_RATES_HZ))
    return rate_hz


_Coordinate = Annotated[float, between(-10.0, 10.0)]
Place = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Field(strict=False)]  # TOML knows lists, no tuples


class GnssFix(Section):
    """What a satellite fix that is worse than RTK integer is good for: 1 sigma, each horizontal axis."""

    position_sigma_m: NotNegative
    velocity_sigma_mps: NotNegative


class InsParameters(Section):
    """The navigation system: where it is, how often and how late it speaks, and its errors (1 sigma).

    Args:
        output_rate_hz: one of `OUTPUT_RATES_HZ`.
        lever_arm_m: place of the instrument, from the reference point, in the car's axes: forward, left, up.
        output_lever_m: the point whose motion it is told to output, in the same way; zero is the reference point.
        position_sigma_m, velocity_sigma_mps: with an RTK integer fix, each horizontal axis; of the position what wanders.
        tilt_sigma_rad, tilt_white_sigma_rad: of roll and of pitch; they wander as slowly as the heading.
        yaw_rate_sigma_radps, acceleration_sigma_mps2: white, each of the three axes; the biases likewise.
        bias_correlation_s: in which the biases change.
        drift_acceleration_sigma_mps2: by which the solution runs away, each axis, while there is no fix.
        search_s, ambiguity_s: time in search before there is a fix again, and in RTK float before RTK integer.
    """

    output_rate_hz: Annotated[float, AfterValidator(_offered)]
    lever_arm_m: Place
    output_lever_m: Place
    latency_s: Annotated[float, between(0.0, 1.0)]
    position_sigma_m: NotNegative
    position_correlation_s: Positive
    position_white_sigma_m: NotNegative
    velocity_sigma_mps: NotNegative
    heading_sigma_rad: NotNegative
    heading_correlation_s: Positive
    heading_white_sigma_rad: NotNegative
    tilt_sigma_rad: NotNegative
    tilt_white_sigma_rad: NotNegative
    yaw_rate_sigma_radps: NotNegative
    gyro_bias_sigma_radps: NotNegative
    acceleration_sigma_mps2: NotNegative
    acceleration_bias_sigma_mps2: NotNegative
    bias_correlation_s: Positive
    drift_acceleration_sigma_mps2: NotNegative
    search_s: NotNegative
    ambiguity_s: NotNegative
    rtk_float: GnssFix
    differential: GnssFix
    sps: GnssFix
