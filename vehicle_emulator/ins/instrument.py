"""The navigation system as one instrument: takes the true motion, gives the messages of a cycle.

All messages of one cycle are views of one solution, as in the instrument: a wrong heading also turns the velocity in the car's axes.
The IMU sits at a lever arm and feels the motion there; the instrument carries the solution to the point that it is told to output,
with its own angles, rates and angular accelerations.
"""

import math
from collections import deque
from collections.abc import Iterable
from datetime import datetime, timedelta
from random import Random
from typing import NamedTuple

from dbc.catalogue import Catalogue, CatalogueError
from dbc.ins import GnssFix, InsParameters
from vehicle_emulator.ins.axes import Vector, add, turned
from vehicle_emulator.ins.errors import ErrorModel, Errors
from vehicle_emulator.ins.messages import GPS_EPOCH, NAVIGATION, STATUS, Signals
from vehicle_emulator.ins.motion import Motion, reference_point
from vehicle_emulator.ins.receiver import GNSS_MODES, SATELLITES, GnssMode, Receiver
from vehicle_emulator.ins.schedule import Schedule
from vehicle_emulator.ins.solution import Solution, Status
from vehicle_emulator.plants.interface import PlantState

START = datetime(2026, 1, 5, 8, 0, 0)
"""GPS time at which a run starts that is told no other, so that runs repeat."""
_FIRST_START = datetime(2017, 1, 1)
MAX_LATENCY_EXTRA_S = 1.0
"""Bound of `InsFaults.latency_extra_s`."""

_BLEND_METHOD = "RealTime"
_ANGULAR_ACCELERATION_LAG_S = 0.016  # assumption: low pass of 10 Hz, as the maker filters before output displacement
_HOLD_MPS = 0.2  # RT3000 manual, table of message Distance
_MS = timedelta(milliseconds=1)
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000


class InsFaults(NamedTuple):
    """What is wrong with the instrument; neutral by default. Replaced as a whole, at any step.

    Args:
        position_bias_m: added to the position: x east, y north, z up.
        yaw_bias_rad: added to the yaw, left positive; turns the velocity in the car's axes as a wrong heading does.
        velocity_bias_mps: added to the velocity along the heading.
        yaw_rate_bias_radps: added to the yaw rate, left positive.
        acceleration_bias_mps2: added to the acceleration along the car's x axis.
        is_frozen: the solution stands still, the time of validity goes on.
        is_time_frozen: the time of validity stands still.
        is_silent: the instrument sends nothing.
        gnss_mode: the best that reception allows, one of `GNSS_MODES`; None for a clear sky with corrections.
        latency_extra_s: added to the latency of the output, 0 to `MAX_LATENCY_EXTRA_S`.
        noise_factor: on all white noise.
    """

    position_bias_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_bias_rad: float = 0.0
    velocity_bias_mps: float = 0.0
    yaw_rate_bias_radps: float = 0.0
    acceleration_bias_mps2: float = 0.0
    is_frozen: bool = False
    is_time_frozen: bool = False
    is_silent: bool = False
    gnss_mode: str | None = None
    latency_extra_s: float = 0.0
    noise_factor: float = 1.0


class NavigationSystem:
    """The instrument.

    Args:
        random: the source of all its errors.
        period_ns: time between two calls of `observe` [ns]; the latency is rounded up to whole periods.
        start_ns: monotonic time at which the run starts [ns].
        state: true motion at the start.
        start_time: GPS time at which the run starts, without a time zone, from 2017 on.

    Raises:
        CatalogueError: the DBC has no number for a kind of fix.
        ValueError: `start_time` is earlier: the leap seconds of that time are not known here.
    """

    def __init__(
        self,
        parameters: InsParameters,
        catalogue: Catalogue,
        random: Random,
        *,
        period_ns: int,
        start_ns: int,
        state: PlantState,
        start_time: datetime = START,
    ) -> None:
        if start_time < _FIRST_START:
            raise ValueError(f"start_time {start_time} is before {_FIRST_START:%Y-%m-%d}, since when UTC is 18 s behind GPS time")
        p = self._p = parameters
        self._period_ns = period_ns
        self._start_ns = start_ns
        self._start_ms = (start_time - GPS_EPOCH) // _MS
        steps = _steps(p.latency_s + MAX_LATENCY_EXTRA_S, period_ns) + 2
        self._history = deque([state] * steps, maxlen=steps)
        self._fixes = _fixes(p)
        self._errors = ErrorModel(p, random, self._fixes[GnssMode.RTK_INTEGER])
        self._receiver = Receiver(p.search_s, p.ambiguity_s, start_ns)
        out, arm = p.output_lever_m, p.lever_arm_m
        self._displacement_m = (out[0] - arm[0], out[1] - arm[1], out[2] - arm[2])
        self._schedule = Schedule(catalogue, p.output_rate_hz, start_ns)
        self._mode_numbers = _numbers(catalogue, "NcomStatus00", "PosMode", GNSS_MODES)
        self._blend_method = _numbers(catalogue, "NcomStatus04", "BlendMethod", (_BLEND_METHOD,))[_BLEND_METHOD]
        self._faults = InsFaults()
        self._solved_ns = start_ns
        self._solution: Solution | None = None
        self._felt: Motion | None = None
        self._distance_m = self._held_distance_m = 0.0
        self._unsolved_periods = 0
        self._transmitted = 0

    @property
    def faults(self) -> InsFaults:
        """What is wrong with the instrument.

        Raises:
            ValueError: when set to a `gnss_mode` that the receiver has not, or to a latency out of range.
        """
        return self._faults

    @faults.setter
    def faults(self, faults: InsFaults) -> None:
        if faults.gnss_mode is not None and faults.gnss_mode not in GNSS_MODES:
            raise ValueError(f"gnss_mode {faults.gnss_mode!r}: expected one of {', '.join(GNSS_MODES)}")
        if not 0.0 <= faults.latency_extra_s <= MAX_LATENCY_EXTRA_S:
            raise ValueError(f"latency_extra_s {faults.latency_extra_s}: expected 0 to {MAX_LATENCY_EXTRA_S:g}")
        self._faults = faults

    def observe(self, state: PlantState) -> None:
        """Take the true motion of one more period."""
        self._history.append(state)
        self._unsolved_periods += 1

    def due(self, now_ns: int) -> tuple[str, ...]:
        """Names of the messages to send now, in the order of their identifiers.

        A message of the DBC comes every `GenMsgCycleTime` / 10 ms cycles of the instrument, and of the status channels one per
        cycle, in turn. Cycles that a stall of the caller has swallowed are skipped, not sent in a burst. A silent instrument goes on
        navigating: only its output is missing.
        """
        names = self._schedule.due(now_ns)
        if names:
            self.solution(now_ns)
        if self._faults.is_silent:
            return ()
        self._transmitted += len(names)
        return names

    def message(self, name: str, now_ns: int) -> Signals:
        """Signals of one of `MESSAGES` sent at `now_ns`, in the units of the DBC."""
        solution = self.solution(now_ns)
        return STATUS[name](self._status(solution)) if name in STATUS else NAVIGATION[name](solution)

    def solution(self, now_ns: int) -> Solution:
        """The navigation solution that is sent at `now_ns`; the same for all messages of a cycle."""
        if self._solution is None or now_ns != self._solved_ns:
            self._solution = self._next(now_ns, self._solution)
            self._solved_ns = now_ns
        return self._solution

    def _next(self, now_ns: int, last: Solution | None) -> Solution:
        faults = self._faults
        solution = self._solve(now_ns)
        if last is not None and faults.is_frozen:
            solution = last._replace(valid_ms=solution.valid_ms)
        if last is not None and faults.is_time_frozen:
            solution = solution._replace(valid_ms=last.valid_ms)
        return solution

    def _solve(self, now_ns: int) -> Solution:
        """Feel the motion of the IMU, with errors, and carry it to the output point."""
        faults, dt_s = self._faults, (now_ns - self._solved_ns) / _NS_PER_S
        age_steps = _steps(self._p.latency_s + faults.latency_extra_s, self._period_ns)
        truth = reference_point(self._history[-1 - age_steps], self._history[-2 - age_steps], self._period_ns / _NS_PER_S)
        mode = self._receiver.update(now_ns, GnssMode(faults.gnss_mode or GnssMode.RTK_INTEGER))
        errors = self._errors.step(dt_s, self._fixes.get(mode), faults.noise_factor)
        imu = _disturbed(truth.displaced(self._p.lever_arm_m), errors)
        self._felt = imu._replace(angular_accelerations_radps2=_filtered(self._felt, imu.rates_radps, dt_s))
        motion = _biased(self._felt.displaced(self._displacement_m), faults)
        self._cover(math.hypot(motion.velocity_mps[0], motion.velocity_mps[1]))
        valid_ns = now_ns - age_steps * self._period_ns - self._start_ns
        return Solution(self._start_ms + valid_ns // _NS_PER_MS, motion, self._distance_m, self._held_distance_m)

    def _cover(self, speed_mps: float) -> None:
        """Count the way of the periods observed since the last solution: in a stall of the caller the car stands still."""
        way_m = speed_mps * self._unsolved_periods * self._period_ns / _NS_PER_S
        self._unsolved_periods = 0
        self._distance_m += way_m
        if speed_mps >= _HOLD_MPS:
            self._held_distance_m += way_m

    def _status(self, solution: Solution) -> Status:
        return Status(
            valid_ms=solution.valid_ms,
            mode=self._mode_numbers[self._receiver.mode],
            satellites=SATELLITES[self._receiver.mode],
            accuracy=self._errors.accuracy(),
            blend_method=self._blend_method,
            transmitted=self._transmitted,
        )


def _numbers(catalogue: Catalogue, message: str, signal: str, entries: Iterable[str]) -> dict[str, int]:
    """The value table of a signal, which must have these entries."""
    numbers = catalogue.enumeration(message, signal)
    if missing := [entry for entry in entries if entry not in numbers]:
        raise CatalogueError(f"{', '.join(catalogue.sha256)}: {message}.{signal} has no value {', '.join(missing)}")
    return numbers


def _steps(duration_s: float, period_ns: int) -> int:
    """Whole periods that hold a duration."""
    return -(-round(duration_s * _NS_PER_S) // period_ns)


def _fixes(p: InsParameters) -> dict[GnssMode, GnssFix]:
    """What each kind of fix is good for; a kind that is missing is none."""
    return {
        GnssMode.RTK_INTEGER: GnssFix(position_sigma_m=p.position_sigma_m, velocity_sigma_mps=p.velocity_sigma_mps),
        GnssMode.RTK_FLOAT: p.rtk_float,
        GnssMode.DIFFERENTIAL: p.differential,
        GnssMode.SPS: p.sps,
    }


def _disturbed(motion: Motion, errors: Errors) -> Motion:
    return Motion(
        position_m=add(motion.position_m, errors.position_m),
        velocity_mps=add(motion.velocity_mps, errors.velocity_mps),
        roll_rad=motion.roll_rad + errors.roll_rad,
        pitch_rad=motion.pitch_rad + errors.pitch_rad,
        yaw_rad=motion.yaw_rad + errors.yaw_rad,
        rates_radps=add(motion.rates_radps, errors.rates_radps),
        specific_force_mps2=add(motion.specific_force_mps2, errors.accelerations_mps2),
    )


def _filtered(last: Motion | None, rates_radps: Vector, dt_s: float) -> Vector:
    """Angular accelerations as the instrument finds them: its own rates, differentiated and low-passed."""
    if last is None or dt_s <= 0.0:
        return (0.0, 0.0, 0.0)
    share = 1.0 - math.exp(-dt_s / _ANGULAR_ACCELERATION_LAG_S)
    (p, q, r), (p0, q0, r0), (dp, dq, dr) = rates_radps, last.rates_radps, last.angular_accelerations_radps2
    return dp + share * ((p - p0) / dt_s - dp), dq + share * ((q - q0) / dt_s - dq), dr + share * ((r - r0) / dt_s - dr)


def _biased(motion: Motion, faults: InsFaults) -> Motion:
    yaw_rad = motion.yaw_rad + faults.yaw_bias_rad
    return motion._replace(
        position_m=add(motion.position_m, faults.position_bias_m),
        velocity_mps=add(motion.velocity_mps, turned((faults.velocity_bias_mps, 0.0, 0.0), yaw_rad)),
        yaw_rad=yaw_rad,
        rates_radps=add(motion.rates_radps, (0.0, 0.0, faults.yaw_rate_bias_radps)),
        specific_force_mps2=add(motion.specific_force_mps2, (faults.acceleration_bias_mps2, 0.0, 0.0)),
    )
