"""Controller of the automatic gearbox: from lever, pedal and speeds to the gear and to how far its clutches are closed.

Stepped with the plant. A shift opens the clutch, leads the ratio from the old gear to the new one meanwhile, and closes it again once
the engine has followed: a torque hole without a step. Against hunting there are three means: the schedule has other speeds for up and
down, the pedal counts as its recent maximum more than as its noise (fast up, slow down), and opposite shifts keep a distance in time.
"""

import math
from bisect import bisect_left
from typing import NamedTuple

from dbc.powertrain import Gearbox as GearboxParameters
from vehicle_emulator.plants.interface import Selector

_PEDALS = (0.0, 0.25, 0.5, 1.0)
"""Columns of the shift schedule: light, quarter, half, full."""
_PEDAL_RISE_S, _PEDAL_FALL_S = 0.15, 3.0
"""Assumption: time constants of the pedal that the schedule sees."""
_LEVEL_PEDAL = 0.1
"""Assumption: what a steady speed on a level road needs."""
_PLAUSIBLE_MPS2 = 12.0
"""No car changes its speed faster: wheels that lock or spin do not shift the gearbox through."""
_ENGAGE_MPS = 1.5
"""Drive or reverse is not engaged against a car that rolls faster the other way; one that is engaged stays."""
_PARK_MPS = 0.8
"""The pawl ratchets above this speed."""
_RATIO_BEGIN, _RATIO_END = 0.3, 0.65
"""Part of a shift in which the ratio changes; before it the clutch opens, behind it it closes."""

_IDLING_RADPS = 80.0
"""No engine follows a turbine that is slower."""
_MATCHED_RADPS = 40.0
"""Slip below which a shift closes its clutch; it does so at any slip when it takes twice as long as it should."""


_DIRECTION = {Selector.DRIVE: 1, Selector.REVERSE: -1}
_PARK = Selector.PARK


class GearboxState(NamedTuple):
    """What the gearbox does to the driveline.

    Args:
        gear: 1 upwards, 0 neutral or park, -1 reverse.
        ratio: engine speed over wheel speed, final drive included; negative in reverse, 0 in neutral.
        clutch_norm, lockup_norm: closed share of the clutches and of the converter's lock-up clutch.
        is_park_locked: whether the pawl holds the output.
    """

    gear: int = 0
    ratio: float = 0.0
    clutch_norm: float = 0.0
    lockup_norm: float = 0.0
    is_park_locked: bool = False


class Gearbox:
    """An automatic gearbox.

    Args:
        parameters: numbers of the gearbox.
        wheel_radius_m: by which the controller makes its speed of the wheels' speed.
    """

    def __init__(self, parameters: GearboxParameters, wheel_radius_m: float) -> None:
        self._p = p = parameters
        self._radius_m = wheel_radius_m
        up = (p.upshift_light_mps, p.upshift_quarter_mps, p.upshift_half_mps, p.upshift_full_mps)
        down = (p.downshift_light_mps, p.downshift_quarter_mps, p.downshift_half_mps, p.downshift_full_mps)
        self._up, self._down = (tuple(zip(*columns, strict=True)) for columns in (up, down))
        # By gear; reverse, -1, is the last.
        self._ratios = (0.0, *(p.final_drive * ratio for ratio in p.ratios), p.final_drive * -p.reverse_ratio)
        self._speed_mps: float | None = None
        self._pedal = 0.0
        self._closed_norm = 0.0
        self._from_gear = 0
        self._shift_norm = 1.0
        self._since_shift_s = math.inf
        self._last_direction = 0
        self._state = GearboxState()

    @property
    def state(self) -> GearboxState:
        """The state reached by the last step."""
        return self._state

    def start(self, gear: int) -> None:
        """Begin in a forward gear with its clutches closed, for a car that starts at speed."""
        self._from_gear = gear
        self._closed_norm = 1.0
        self._state = GearboxState(gear, self._ratios[gear], 1.0, float(gear >= self._p.lockup_gear))

    def gear_at(self, speed_mps: float) -> int:
        """The gear for a steady speed on a level road."""
        return 1 + sum(speed_mps > self.upshift_mps(gear, _LEVEL_PEDAL) for gear in range(1, len(self._p.ratios)))

    def upshift_mps(self, gear: int, pedal: float) -> float:
        """Speed at which the gearbox shifts up out of a gear."""
        return _interpolated(self._up[gear - 1], pedal)

    def downshift_mps(self, gear: int, pedal: float) -> float:
        """Speed at which the gearbox shifts down out of a gear."""
        return _interpolated(self._down[gear - 2], pedal)

    def step(
        self, dt_s: float, selector: Selector, accelerator_norm: float, driven_wheels_radps: float, engine_radps: float
    ) -> GearboxState:
        """Advance by `dt_s` and return the state reached.

        Args:
            driven_wheels_radps: mean speed of the two driven wheels.
        """
        raw_mps = driven_wheels_radps * self._radius_m
        before_mps = raw_mps if self._speed_mps is None else self._speed_mps
        speed_mps = before_mps + _within(raw_mps - before_mps, _PLAUSIBLE_MPS2 * dt_s)
        self._speed_mps = speed_mps
        self._pedal += (accelerator_norm - self._pedal) * dt_s / (_PEDAL_RISE_S if accelerator_norm > self._pedal else _PEDAL_FALL_S)
        gear = self._engage(dt_s, selector, accelerator_norm, speed_mps)
        if gear > 0:
            turbine_radps = self._ratios[gear] * driven_wheels_radps
            self._advance(dt_s, abs(engine_radps - max(turbine_radps, _IDLING_RADPS)) < _MATCHED_RADPS)
            gear = self._decide(gear, accelerator_norm, speed_mps, engine_radps)
        ratio = self._blended_ratio(gear)
        self._state = GearboxState(
            gear,
            ratio,
            self._closed_norm * self._hole(),
            self._lockup(dt_s, gear, ratio * driven_wheels_radps),
            selector is _PARK and (self._state.is_park_locked or abs(speed_mps) < _PARK_MPS),
        )
        return self._state

    def _engage(self, dt_s: float, selector: Selector, accelerator_norm: float, speed_mps: float) -> int:
        """Follow the lever: open the clutch, change direction, close it again; returns the gear."""
        p, gear = self._p, self._state.gear
        wanted = _DIRECTION.get(selector, 0)
        direction = (gear > 0) - (gear < 0)
        if wanted != direction and wanted * speed_mps < -_ENGAGE_MPS:
            wanted = 0
        is_there = direction == wanted
        if not is_there and self._closed_norm == 0.0:
            gear = self.gear_at(speed_mps) if wanted > 0 else wanted
            self._from_gear, self._shift_norm, is_there = gear, 1.0, True
        share = max(accelerator_norm / p.creep_pedal_norm, abs(speed_mps) / p.creep_mps)
        closed = p.creep_clutch_norm + (1.0 - p.creep_clutch_norm) * min(share, 1.0)
        target = closed if is_there and gear != 0 else 0.0
        self._closed_norm += _within(target - self._closed_norm, dt_s / p.select_s)
        return gear

    def _advance(self, dt_s: float, is_matched: bool) -> None:
        """Go on with a shift."""
        self._since_shift_s += dt_s
        step = dt_s / self._p.shift_s
        waits = self._shift_norm + step > _RATIO_END and not is_matched and self._since_shift_s < 2.0 * self._p.shift_s
        if not waits or self._shift_norm > _RATIO_END:
            self._shift_norm = min(self._shift_norm + step, 1.0)

    def _decide(self, gear: int, accelerator_norm: float, speed_mps: float, engine_radps: float) -> int:
        """Begin a shift; returns the gear, which is the new one from the beginning of a shift."""
        if self._shift_norm < 1.0:
            return gear
        is_kickdown = accelerator_norm >= self._p.kickdown_norm
        target = self._scheduled(gear, 1.0 if is_kickdown else self._pedal, speed_mps, engine_radps)
        if target < gear:  # at once as far as the pedal of this moment says
            target = min(target, self._scheduled(gear, accelerator_norm, speed_mps, engine_radps))
        direction = (target > gear) - (target < gear)
        has_dwelt = self._since_shift_s >= self._p.dwell_s or direction == self._last_direction or (is_kickdown and direction < 0)
        if direction == 0 or not has_dwelt:
            return gear
        self._from_gear, self._shift_norm, self._since_shift_s, self._last_direction = gear, 0.0, 0.0, direction
        return target

    def _scheduled(self, gear: int, pedal: float, speed_mps: float, engine_radps: float) -> int:
        """The gear that the schedule wants next."""
        top = len(self._p.ratios)
        if gear < top and (speed_mps > self.upshift_mps(gear, pedal) or engine_radps > self._p.upshift_radps):
            return gear + 1
        while gear > 1 and speed_mps < self.downshift_mps(gear, pedal):
            gear -= 1
        return gear

    def _blended_ratio(self, gear: int) -> float:
        before, after = self._ratios[self._from_gear], self._ratios[gear]
        return before + _smooth((self._shift_norm - _RATIO_BEGIN) / (_RATIO_END - _RATIO_BEGIN)) * (after - before)

    def _hole(self) -> float:
        """What a shift leaves of the clutch: nothing in a downshift, in which it would brake the car with the engine."""
        if self._shift_norm == 1.0:
            return 1.0
        open_share = _smooth(self._shift_norm / _RATIO_BEGIN) - _smooth((self._shift_norm - _RATIO_END) / (1.0 - _RATIO_END))
        rest_norm = self._p.shift_clutch_norm if self._last_direction > 0 else 0.0
        return 1.0 - (1.0 - rest_norm) * open_share

    def _lockup(self, dt_s: float, gear: int, turbine_radps: float) -> float:
        """Closed in a high gear at speed; opens in a shift, and before a slow turbine stalls the engine."""
        p, closed = self._p, self._state.lockup_norm
        limit_radps = p.lockup_open_radps if closed > 0.0 else p.lockup_close_radps
        if gear >= p.lockup_gear and self._shift_norm == 1.0 and turbine_radps > limit_radps:
            return min(closed + dt_s / p.lockup_close_s, 1.0)
        return max(closed - dt_s / p.lockup_open_s, 0.0)


def _interpolated(speeds_mps: tuple[float, ...], pedal: float) -> float:
    """Shift speed between those of `_PEDALS`."""
    i = bisect_left(_PEDALS, pedal, 1, len(_PEDALS) - 1)
    share = (pedal - _PEDALS[i - 1]) / (_PEDALS[i] - _PEDALS[i - 1])
    return speeds_mps[i - 1] + min(max(share, 0.0), 1.0) * (speeds_mps[i] - speeds_mps[i - 1])


def _within(value: float, limit: float) -> float:
    return value if -limit <= value <= limit else min(max(value, -limit), limit)


def _smooth(x: float) -> float:
    """From 0 at 0 to 1 at 1, with a continuous derivative."""
    if x >= 1.0:
        return 1.0
    x = max(x, 0.0)
    return x * x * (3.0 - 2.0 * x)
