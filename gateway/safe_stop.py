"""The minimal risk manoeuvre: the gateway brings the car to a stop without the controller.

Steering follows the tail of the last valid plan, because centring would leave a bend, and then holds its last angle. The
deceleration is built up at a limited jerk and held until standstill, then the brake keeps the car where it is.
"""

from dataclasses import dataclass

from gateway.limits import StopGrade
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS, ControlCommand

STANDSTILL_MPS = 0.1


def plan_index(command: ControlCommand, now_ns: int) -> int:
    """Entry of a command's plan that holds at `now_ns`; the last one after the plan's end."""
    return min(max((now_ns - command.t_ns) // PLAN_PERIOD_NS, 0), HORIZON_STEPS - 1)


@dataclass(frozen=True, slots=True)
class StopDemand:
    """What the safe stop asks for at one moment.

    Args:
        steer_rad: road-wheel angle [rad].
        deceleration_mps2: at least 0.
        is_standing: the car stands and is to be held.
    """

    steer_rad: float
    deceleration_mps2: float
    is_standing: bool


class SafeStop:
    """One stop, from the moment it begins.

    Args:
        last_command: the newest valid command, or None when there never was one.
        steer_rad: road-wheel angle to hold without a plan [rad].
        deceleration_mps2: deceleration at the start: a car that brakes already goes on from there, and a comfort stop that becomes an
            emergency stop from what it has reached.
        grade: how firmly.
    """

    def __init__(
        self, start_ns: int, last_command: ControlCommand | None, steer_rad: float, deceleration_mps2: float, grade: StopGrade
    ) -> None:
        self._start_ns = start_ns
        self._last_command = last_command
        self._steer_rad = steer_rad
        self._initial_deceleration_mps2 = max(0.0, deceleration_mps2)
        self._grade = grade
        self._is_standing = False

    def demand(self, now_ns: int, vx_mps: float) -> StopDemand:
        """Demand at `now_ns` for a car at speed `vx_mps`; standing is latched."""
        self._is_standing |= abs(vx_mps) < STANDSTILL_MPS
        elapsed_s = (now_ns - self._start_ns) * 1e-9
        deceleration_mps2 = max(
            self._initial_deceleration_mps2,
            min(self._initial_deceleration_mps2 + self._grade.jerk_mps3 * elapsed_s, self._grade.deceleration_mps2),
        )
        steer_rad = self._steer_rad
        if self._last_command is not None:
            steer_rad = self._last_command.plan_steer_rad[plan_index(self._last_command, now_ns)]
        return StopDemand(steer_rad, deceleration_mps2, self._is_standing)
