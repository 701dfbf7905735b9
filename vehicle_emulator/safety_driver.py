"""The safety driver before the robots take over: holds the speed of a rolling start, or the standing car, and steers straight ahead.

From the first engagement on, feet are off the pedals and hands off the wheel; what is left is the dead-man switch.
"""

from vehicle_emulator.driver import Driver
from vehicle_emulator.plants.interface import PlantState

STANDING_BRAKE_NORM = 0.3
"""Brake pedal that holds a standing car on a slope of 30 %."""
PROPORTIONAL_PER_MPS = 0.35
INTEGRAL_PER_M = 0.15
"""Accelerator for each m/s, and for each metre, that the car is behind: about 1 m/s2 per m/s for the cars that come with xilgate."""
HOLDING_NM_PER_RAD = 20.0
HOLDING_NM_PER_RADPS = 2.0
STRONGEST_NM = 10.0
"""Hands that hold the steering wheel straight."""


class SafetyDriver:
    """What the person in the car does, one step at a time.

    Args:
        speed_mps: speed to hold; 0 to stand.
    """

    def __init__(self, speed_mps: float) -> None:
        self._speed_mps = speed_mps
        self._integral_norm = 0.0

    def step(self, dt_s: float, state: PlantState, was_engaged: bool) -> Driver:
        """The driver for the next `dt_s`, seeing what the car does.

        Args:
            was_engaged: whether the robots have ever been engaged.
        """
        if was_engaged:
            return Driver()
        held_nm = -HOLDING_NM_PER_RAD * state.steering_wheel_rad - HOLDING_NM_PER_RADPS * state.steering_wheel_rate_radps
        hands_nm = min(max(held_nm, -STRONGEST_NM), STRONGEST_NM)
        if self._speed_mps <= 0.0:
            return Driver(steering_torque_nm=hands_nm, brake_norm=STANDING_BRAKE_NORM)
        behind_mps = self._speed_mps - state.vx_mps
        self._integral_norm = min(max(self._integral_norm + INTEGRAL_PER_M * dt_s * behind_mps, 0.0), 1.0)
        pedal_norm = min(max(PROPORTIONAL_PER_MPS * behind_mps + self._integral_norm, 0.0), 1.0)
        return Driver(steering_torque_nm=hands_nm, accelerator_norm=pedal_norm)
