"""The safety driver: holds the speed of a rolling start, or the standing car, and steers straight ahead until the robots take over.

From the first engagement on, hands are off the wheel and feet off the pedals, with the dead-man switch pressed. A car that the robots
have handed back is braked once it is slow, and held until they are engaged again.
"""

from vehicle_emulator.driver import Driver
from vehicle_emulator.plants.interface import PlantState

STANDING_BRAKE_NORM = 0.3
"""Brake pedal that holds a standing car on a slope of 30 %."""
WALKING_PACE_MPS = 2.0
"""Below it he stops a car that was handed back; the cars that come with xilgate creep at 1.4 and 1.6 m/s on a level road."""
PROPORTIONAL_PER_MPS = 1.0
INTEGRAL_PER_M = 0.6
"""Accelerator for each m/s, and for each metre, that the car is behind: the cars that come with xilgate stay within 0.3 m/s."""
HOLDING_NM_PER_RAD = 20.0
HOLDING_NM_PER_RADPS = 2.0
STRONGEST_NM = 10.0
"""Hands that hold the steering wheel straight."""
_HANDS_OFF = Driver()
_HOLDING = Driver(brake_norm=STANDING_BRAKE_NORM)


class SafetyDriver:
    """What the person in the car does, one step at a time.

    Args:
        speed_mps: speed to hold; 0 to stand.
    """

    def __init__(self, speed_mps: float) -> None:
        self._speed_mps = speed_mps
        self._integral_norm = 0.0
        self._is_holding = False

    def step(self, dt_s: float, state: PlantState, *, was_engaged: bool, are_robots_active: bool) -> Driver:
        """The driver for the next `dt_s`, seeing what the car does.

        Args:
            was_engaged: whether the robots have ever been engaged.
            are_robots_active: whether they are engaged or stop the car now.
        """
        if was_engaged:
            self._is_holding = not are_robots_active and (self._is_holding or abs(state.vx_mps) < WALKING_PACE_MPS)
            return _HOLDING if self._is_holding else _HANDS_OFF
        held_nm = -HOLDING_NM_PER_RAD * state.steering_wheel_rad - HOLDING_NM_PER_RADPS * state.steering_wheel_rate_radps
        hands_nm = min(max(held_nm, -STRONGEST_NM), STRONGEST_NM)
        if self._speed_mps <= 0.0:
            return Driver(steering_torque_nm=hands_nm, brake_norm=STANDING_BRAKE_NORM)
        behind_mps = self._speed_mps - state.vx_mps
        self._integral_norm = min(max(self._integral_norm + INTEGRAL_PER_M * dt_s * behind_mps, 0.0), 1.0)
        pedal_norm = min(max(PROPORTIONAL_PER_MPS * behind_mps + self._integral_norm, 0.0), 1.0)
        return Driver(steering_torque_nm=hands_nm, accelerator_norm=pedal_norm)
