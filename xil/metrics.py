"""The verdict on a run: figures computed from its recording, each against its limit, and one reason for people.

Pure: recording, scenario and vehicle in, verdict out. Figures stand in the order of cause: when several limits are broken, the reason
of the first is the reason of the verdict.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dbc.vehicle import Vehicle
from gateway.causes import Cause
from gateway.messages import CommandStatus, Mode
from gateway.telemetry import CommandSample, ObjectsSample, StatusSample, WorldObject
from xil.course import STANDSTILL_MPS, Array, Course, Outline, Projection, passage, separation_m
from xil.recording import ModeChange, Recording
from xil.scenario import Scenario, Stage

SAMPLE_TIME_MS = 40.0
"""Time between two commands [ms] (T_s of the paper): a solve must fit into it."""
LONGEST_GAP_S = 0.05
"""Poses this far apart still give the path to 2 mm at 6 m/s2 (a t^2 / 8); across more, a touched gate could go unseen."""


@dataclass(frozen=True)
class Metric:
    """One figure and its limit.

    Args:
        value: None when the run did not get as far as to measure it.
        relation: "at most", "at least", or "" for a figure that is shown, not judged.
        failure: why it is not passed, for people; empty when it is.
    """

    name: str
    value: float | None
    unit: str
    relation: str = ""
    limit: float | None = None
    failure: str = ""

    @property
    def passed(self) -> bool:
        """Whether the figure keeps its limit."""
        return not self.failure


@dataclass(frozen=True)
class Verdict:
    """The judgement on a run.

    Args:
        reason: one line for people.
        metrics: figures that a seed determines in lockstep.
        timing: times that the machine determines; they have limits in real-time stages only.
    """

    passed: bool
    reason: str
    metrics: tuple[Metric, ...]
    timing: tuple[Metric, ...]


@dataclass(frozen=True)
class Trace:
    """The drive that a recording holds, on the times of its poses; all arrays of shape (n,).

    Args:
        end_s: time from which the run is over: the judged part is behind the car and the car stands, or it stands for good where the
            course ends short; infinite when that never was.
        changes: the gateway's changes of mode.
        engaged_s: first engagement; infinite when there was none.
    """

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    lateral_acceleration_mps2: Array
    along: Projection
    changes: tuple[ModeChange, ...]
    engaged_s: float
    end_s: float

    @property
    def speed_error_mps(self) -> Array:
        """Speed minus reference speed [m/s]."""
        return self.speed_mps - self.along.speed_mps

    @property
    def heading_error_rad(self) -> Array:
        """Heading minus that of the reference, -pi to pi [rad]; at the centre of gravity it contains the sideslip angle."""
        difference = self.yaw_rad - self.along.yaw_rad
        return np.asarray(np.arctan2(np.sin(difference), np.cos(difference)))

    def between(self, course: Course) -> NDArray[np.bool_]:
        """Which poses lie in the judged part of the course."""
        return (self.along.station_m >= course.from_m) & (self.along.station_m <= course.to_m)


def trace(recording: Recording, course: Course, stage: Stage) -> Trace:
    """The drive of a recording that holds at least one pose."""
    topic = stage.pose_topic
    t_s, x_m, y_m, yaw_rad, speed_mps = (
        recording.times_s(topic), *(recording.series(topic, field) for field in ("x_m", "y_m", "yaw_rad", "vx_mps"))
    )
    ay_mps2 = recording.series("world", "ay_mps2") if topic == "world" else speed_mps * recording.series("state", "yaw_rate_radps")
    along = course.project(x_m, y_m)
    stands = np.abs(speed_mps) < STANDSTILL_MPS
    is_over = stands & (_is_last_run(stands) if course.ends_short else along.station_m >= course.to_m)
    changes = tuple(recording.mode_changes())
    engaged_s = min((change.t_s for change in changes if change.mode == Mode.ENGAGED.name), default=np.inf)
    end_s = float(t_s[np.argmax(is_over)]) if is_over.any() else np.inf
    return Trace(t_s, x_m, y_m, np.unwrap(yaw_rad), speed_mps, ay_mps2, along, changes, engaged_s, end_s)


def _is_last_run(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where a condition holds and goes on to do so to the end."""
    return np.logical_and.accumulate(holds[::-1])[::-1]


def evaluate(recording: Recording, scenario: Scenario, vehicle: Vehicle, stage: Stage, interruption: str = "") -> Verdict:
    """Judge a run.

    Args:
        interruption: why the runner cut the run short, for people; it fails the run, and its reason begins with it.
    """
    if not recording.samples(stage.pose_topic):
        return Verdict(False, interruption or f"nothing to judge: no sample of {stage.pose_topic!r} was recorded", (), ())
    course = scenario.course(vehicle)
    drive = trace(recording, course, stage)
    metrics = (
        *_completeness(recording, drive, stage),
        *_control(recording, drive, course),
        *_gates(course, drive),
        *_objects(recording, scenario, course, drive),
        *_arrival(recording, scenario, course, drive),
        *_tracking(scenario, course, drive),
        *_counts(recording),
    )
    timing = tuple(_timing(recording, drive, stage))
    failures = [metric.failure for metric in (*metrics, *timing) if metric.failure]
    reasons = [text for text in (interruption, *failures[:1]) if text]
    return Verdict(not reasons, "; ".join(reasons) or "every limit kept", metrics, timing)


def _at_most(name: str, value: float | None, unit: str, limit: float | None, failure: str = "") -> Metric:
    """A figure with an upper limit. A figure that could not be measured breaks its limit."""
    if limit is None:
        return Metric(name, value, unit)
    if value is None:
        return Metric(name, value, unit, "at most", limit, failure or f"{name} could not be measured")
    text = failure or f"{name} {value:.2f} {unit}, limit {limit:g} {unit}".strip()
    return Metric(name, value, unit, "at most", limit, text if value > limit else "")


def _at_least(name: str, value: float | None, unit: str, limit: float, failure: str) -> Metric:
    """A figure with a lower limit. A figure that could not be measured breaks its limit."""
    return Metric(name, value, unit, "at least", limit, failure if value is None or value < limit else "")


def _completeness(recording: Recording, drive: Trace, stage: Stage) -> Iterator[Metric]:
    from_s = drive.engaged_s if drive.engaged_s < drive.t_s[-1] else float(drive.t_s[0])
    gap = recording.longest_gap(stage.pose_topic, from_s, min(drive.end_s, float(drive.t_s[-1])))
    gap_ms, limit_ms = round(gap.length_s * 1e3, 3), LONGEST_GAP_S * 1e3
    failure = f"recording incomplete: no pose of the car for {gap_ms:.0f} ms at t = {gap.t_s:.2f} s, limit {limit_ms:.0f} ms"
    yield _at_most("longest time between two poses", gap_ms, "ms", limit_ms, failure)
    yield Metric("poses lost", float(recording.lost(stage.pose_topic)), "")


def _control(recording: Recording, drive: Trace, course: Course) -> Iterator[Metric]:
    # A disengagement that the operator asked for is no fault; whether the drive was then complete shows in what follows.
    is_engaged = np.isfinite(drive.engaged_s)
    station_m = float(np.interp(drive.engaged_s, drive.t_s, drive.along.station_m)) if is_engaged else None
    late = f"engaged too late: at {station_m or 0.0:.1f} m, the judged part begins at {course.from_m:.1f} m"
    yield _at_most("engaged at station", station_m, "m", course.from_m, late if is_engaged else _never_engaged(recording))

    ends = [
        after for before, after in pairwise(drive.changes)
        if before.mode == Mode.ENGAGED.name and after.t_s < drive.end_s and not after.reason.startswith(Cause.OPERATOR_DISENGAGE.value.text)
    ]
    stopped = "the car stopped" if abs(drive.speed_mps[-1]) < STANDSTILL_MPS else "the car did not stop"
    failure = f"{ends[0].reason or ends[0].mode} at t = {ends[0].t_s:.2f} s, {stopped}" if ends else ""
    yield _at_most("disengagements before the end", float(len(ends)), "", 0.0, failure)
    yield Metric("time engaged", _time_engaged_s(drive), "s")

    statuses = [s.status for s in _commands(recording, drive)]
    failed = statuses.count(CommandStatus.FAILED.name)
    yield _at_most("failed commands", float(failed), "", 0.0, f"commands without a usable solution: {failed}")
    yield Metric("degraded commands", float(statuses.count(CommandStatus.DEGRADED.name)), "")


def _never_engaged(recording: Recording) -> str:
    status = recording.latest("status")
    if not isinstance(status, StatusSample):
        return "never engaged: no status of the gateway was recorded"
    return "never engaged: " + (", ".join(status.blockers) or f"gateway in {status.mode}, nothing in the way")


def _time_engaged_s(drive: Trace) -> float:
    end_s = min(drive.end_s, float(drive.t_s[-1]))
    bounds_s = [min(change.t_s, end_s) for change in drive.changes] + [end_s]
    return sum(
        until_s - since_s
        for change, (since_s, until_s) in zip(drive.changes, pairwise(bounds_s), strict=True)
        if change.mode == Mode.ENGAGED.name
    )


def _commands(recording: Recording, drive: Trace) -> list[CommandSample]:
    """Commands from the first engagement to the end of the run."""
    times_s, samples = recording.times_s("command"), recording.samples("command")
    return [
        sample for t_s, sample in zip(times_s, samples, strict=True)
        if isinstance(sample, CommandSample) and drive.engaged_s <= t_s <= drive.end_s
    ]


def _gates(course: Course, drive: Trace) -> Iterator[Metric]:
    for lane in course.lanes:
        way = passage(lane, course.outline, drive.x_m, drive.y_m, drive.yaw_rad)
        failure = f"{lane.name} touched by {-way.clearance_m:.3f} m at x = {way.contact_x_m:.1f} m" if way else f"{lane.name} not reached"
        yield _at_least(f"clearance in {lane.name}", way.clearance_m if way else None, "m", 0.0, failure)


def _objects(recording: Recording, scenario: Scenario, course: Course, drive: Trace) -> Iterator[Metric]:
    limit_m = scenario.judge.object_clearance_m
    for name in (thing.name for thing in scenario.objects):
        meeting = closest(recording, name, course, drive)
        if meeting is None:
            yield _at_least(f"clearance to {name}", None, "m", limit_m, f"{name} did not appear")
            continue
        failure = f"{name} touched" if meeting.clearance_m < 0.0 else f"{name} passed at {meeting.clearance_m:.3f} m, limit {limit_m:g} m,"
        yield _at_least(f"clearance to {name}", meeting.clearance_m, "m", limit_m, f"{failure} at t = {meeting.t_s:.2f} s")


@dataclass(frozen=True)
class Meeting:
    """The car and an object when they were closest.

    Args:
        name: of the object.
        clearance_m: between their outlines; negative where they overlap.
        box_m: corners of the object, shape (4, 2).
    """

    name: str
    t_s: float
    clearance_m: float
    box_m: Array


def closest(recording: Recording, name: str, course: Course, drive: Trace) -> Meeting | None:
    """The closest approach of the car to an object, of all samples of the objects; None when it never was there."""
    if not (found := _seen(recording, name)):
        return None
    times_s = np.array([t_s for t_s, _ in found])
    car = course.outline.corners_m(*(np.interp(times_s, drive.t_s, values) for values in (drive.x_m, drive.y_m, drive.yaw_rad)))
    boxes = np.concatenate([_corners_m(thing) for _, thing in found])
    clearance_m = separation_m(car, boxes)
    k = int(np.argmin(clearance_m))
    return Meeting(name, float(times_s[k]), float(clearance_m[k]), boxes[k])


def _seen(recording: Recording, name: str) -> list[tuple[float, WorldObject]]:
    """An object at the times at which it was there."""
    return [
        ((sample.t_ns - recording.start_ns) * 1e-9, thing)
        for sample in recording.samples("objects") if isinstance(sample, ObjectsSample)
        for thing in sample.objects if thing.name == name
    ]  # fmt: skip


def _final_gap_m(recording: Recording, name: str, course: Course, drive: Trace) -> float | None:
    """Distance along the course from the car's front to an object, at the end; None when it never was there."""
    if not (found := _seen(recording, name)):
        return None
    car = course.outline.corners_m(drive.x_m[-1:], drive.y_m[-1:], drive.yaw_rad[-1:])[0]
    box = _corners_m(found[-1][1])[0]
    return float(course.project(*box.T).station_m.min() - course.project(*car.T).station_m.max())


def _corners_m(thing: WorldObject) -> Array:
    outline = Outline(0.5 * thing.length_m, 0.5 * thing.length_m, 0.5 * thing.width_m)
    return outline.corners_m(*(np.array([value]) for value in (thing.x_m, thing.y_m, thing.yaw_rad)))


def _arrival(recording: Recording, scenario: Scenario, course: Course, drive: Trace) -> Iterator[Metric]:
    reached_m, final_mps = float(drive.along.station_m.max()), abs(float(drive.speed_mps[-1]))
    if (name := scenario.judge.stands_before) is None:
        short = f"not completed: the car got to {reached_m:.1f} m in {drive.t_s[-1]:.1f} s, it was to pass {course.to_m:.1f} m"
        yield _at_least("station reached", reached_m, "m", course.to_m, short)
    else:
        yield Metric("station reached", reached_m, "m")
        gap_m, limit_m = _final_gap_m(recording, name, course, drive), scenario.judge.stands_within_m
        far = "" if gap_m is None else f"the car ended {gap_m:.1f} m before {name}, it was to stand within {limit_m:g} m"
        yield _at_most(f"final distance to {name}", gap_m, "m", limit_m, far)
        yield _at_least(f"stands before {name}", gap_m, "m", 0.0, f"the car was to stand before {name}, it ended beside or behind it")
    rolling = f"the car still rolled at {final_mps:.2f} m/s when the run ended, after {drive.t_s[-1]:.1f} s"
    yield _at_most("final speed", final_mps, "m/s", STANDSTILL_MPS, rolling)
    room_m = np.minimum(drive.along.left_m - drive.along.lateral_error_m, drive.along.right_m + drive.along.lateral_error_m)
    k = int(np.argmin(room_m))
    off = f"corridor left by {-room_m[k]:.3f} m at station {drive.along.station_m[k]:.1f} m"
    yield _at_least("smallest room in the corridor", float(room_m[k]), "m", 0.0, off)


def _tracking(scenario: Scenario, course: Course, drive: Trace) -> Iterator[Metric]:
    limits, judged = scenario.judge, drive.between(course)
    entry_kmh = None
    if drive.along.station_m.max() >= course.from_m:
        entry_mps = drive.speed_mps[int(np.argmax(drive.along.station_m >= course.from_m))]
        entry_kmh = abs(float(entry_mps) - scenario.speed.cruise_mps) * 3.6
    yield _at_most("entry speed error", entry_kmh, "km/h", limits.entry_speed_error_kmh)
    lateral_m, heading_deg = drive.along.lateral_error_m[judged], np.degrees(drive.heading_error_rad[judged])
    yield _at_most("lateral error, RMS", _rms(lateral_m), "m", limits.lateral_error_rms_m)
    yield _at_most("lateral error, largest", _largest(lateral_m), "m", limits.lateral_error_max_m)
    yield _at_most("heading error, RMS", _rms(heading_deg), "deg", None)
    yield _at_most("heading error, largest", _largest(heading_deg), "deg", limits.heading_error_max_deg)
    yield _at_most("speed error, RMS", _rms(drive.speed_error_mps[judged]), "m/s", limits.speed_error_rms_mps)
    yield _at_most("speed error, largest", _largest(drive.speed_error_mps[judged]), "m/s", None)
    ay_mps2 = _largest(drive.lateral_acceleration_mps2[judged])
    yield _at_most("lateral acceleration, largest", ay_mps2, "m/s2", limits.lateral_acceleration_max_mps2)


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _largest(values: Array) -> float | None:
    return float(np.abs(values).max()) if len(values) else None


def _counts(recording: Recording) -> Iterator[Metric]:
    status = recording.latest("status")
    if isinstance(status, StatusSample):
        yield Metric("frames rejected", float(sum(status.frames_rejected.values())), "")
        yield Metric("commands rejected", float(sum(status.commands_rejected.values())), "")
        yield Metric("demands held back by limits, beyond the smoothing of a plan's steps", 100.0 * status.limited_share, "%")
        yield from (Metric(f"ticks at a limit, smoothing too: {name}", float(limit.ticks), "") for name, limit in status.limits.items())
        yield Metric("age of the measurement that robots act on, largest", status.actuation_age_max_ms, "ms")


def _timing(recording: Recording, drive: Trace, stage: Stage) -> Iterator[Metric]:
    """Solve times. One late solve in a hundred is bridged by the plan that the gateway holds, hence no limit on the largest."""
    solve_ms = np.array([command.solve_time_ms for command in _commands(recording, drive)])
    limit_ms = None if stage.is_lockstep else SAMPLE_TIME_MS
    is_known = len(solve_ms) > 0
    yield _at_most("solve time, mean", float(solve_ms.mean()) if is_known else None, "ms", limit_ms)
    yield _at_most("solve time, 99th percentile", float(np.percentile(solve_ms, 99.0)) if is_known else None, "ms", limit_ms)
    yield Metric("solve time, largest", float(solve_ms.max()) if is_known else None, "ms")
    yield Metric("solves longer than the sample time", float(np.sum(solve_ms > SAMPLE_TIME_MS)), "")
