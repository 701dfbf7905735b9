"""The minimal risk manoeuvre: the gateway brings the car to a stop without the controller.

Steering follows the tail of the last valid plan, because centring would leave a bend, and then holds its last angle. The
deceleration is built up at a limited jerk and held until standstill, then the brake keeps the car where it is.
"""

from dataclasses import dataclass

from gateway.limits import StopGrade
from gateway.messages import HORIZON_STEPS, PLAN_PERIOD_NS, ControlCommand

STANDSTILL_MPS = 0.1
ROLLING_MPS = 0.5
"""A car that stands may be measured as fast as this."""
SLOWING_SHARE = 0.5
"""Part of what a stop asks for that must have become of the speed: a slope takes 1 m/s2 at 10 %, as much as a gentle stop gives."""
SLOWING_MARGIN_MPS = 2.0
"""What may be missing besides: an engine that still pulls with 3 m/s2 for 0.3 s, and brakes that begin as late."""


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
        grade: how firmly.
        steer_rad: road-wheel angle to hold without a plan [rad].
        speed_mps: at the start.
        deceleration_mps2: deceleration at the start: a car that brakes already goes on from there, and a comfort stop that becomes an
            emergency stop from what it has reached.
    """

    def __init__(
        self,
        start_ns: int,
        last_command: ControlCommand | None,
        grade: StopGrade,
        *,
        steer_rad: float,
        speed_mps: float,
        deceleration_mps2: float,
    ) -> None:
        self._start_ns = start_ns
        self._speed_mps = speed_mps
        self._last_command = last_command
        self._steer_rad = steer_rad
        self._initial_deceleration_mps2 = max(0.0, deceleration_mps2)
        self._grade = grade
        self._is_standing = False

    def allowed_mps(self, now_ns: int) -> float:
        """The largest speed at `now_ns` of a car that slows down [m/s]: a steep slope may be stronger than the brake of a gentle stop."""
        elapsed_s = (now_ns - self._start_ns) * 1e-9
        # One that brakes harder already is asked for no more than the stop is: the road may not give it.
        initial_mps2 = min(self._initial_deceleration_mps2, self._grade.deceleration_mps2)
        more_mps2 = self._grade.deceleration_mps2 - initial_mps2
        growing_s = min(elapsed_s, more_mps2 / self._grade.jerk_mps3)
        asked_mps = initial_mps2 * elapsed_s + 0.5 * self._grade.jerk_mps3 * growing_s**2 + more_mps2 * (elapsed_s - growing_s)
        return max(self._speed_mps + SLOWING_MARGIN_MPS - SLOWING_SHARE * asked_mps, ROLLING_MPS)

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
