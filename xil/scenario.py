"""Scenarios: a drive as data, read from TOML.

The base line of a scenario starts at (`path.start_m`, 0) and heads along x. Every position along the drive is a station: the distance
along the base line, so that on a straight base line a station is the x coordinate. Lateral positions are left positive.
"""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from controller.planning.reference import ReferencePath
from dbc.errors import UserMistake
from dbc.section import Section, between, misfit, read_section
from dbc.vehicle import Vehicle
from gateway.telemetry import Lane, SceneSample
from vehicle_emulator.faults.spec import Faults
from vehicle_emulator.road import RoadDescription, Station
from xil.course import SPACING_M, Array, Course, Outline, Pose, blend, fine_stations, integrate
from xil.scenario_objects import Acceleration, Lateral, RoadObject
from xil.scenario_road import Road

SCENARIO_FOLDER = Path(__file__).with_name("scenarios")

RUN_OUT_M = 20.0
"""Reference at zero speed behind the point where the car is to stand."""
LAUNCH_MPS = 1.0
"""Speed at the start of a reference that begins at standstill: a car on a path at zero speed would never leave."""

_SCENE_SPACING_M = 1.0


class ScenarioError(UserMistake):
    """A scenario cannot be used; one line per mistake, each with file, key, value and what is allowed."""


class Stage(StrEnum):
    """A step of the ladder from the desk to the car."""

    MIL = "mil"
    SIL = "sil"
    HIL = "hil"
    VEHIL = "vehil"

    @property
    def is_lockstep(self) -> bool:
        """Whether all cores run in one process in virtual time."""
        return self in (Stage.MIL, Stage.SIL)

    @property
    def pose_topic(self) -> str:
        """The telemetry topic whose pose is judged: ground truth, or the state estimate where there is none."""
        return "state" if self is Stage.VEHIL else "world"


Limit = Annotated[float, between(0.0, 100.0)]


class Start(Section):
    """The emulated car at the start of the path when the run begins, rolling or standing.

    Args:
        offset_m: position to the left of the base line.
    """

    offset_m: Lateral
    speed_kmh: Annotated[float, between(0.0, 250.0)]


class SpeedPlan(Section):
    """Cruise, after an acceleration where the start is slower, and the stop that ends every run.

    Args:
        stop_m: station at which the car is to stand.
    """

    cruise_kmh: Annotated[float, between(5.0, 250.0)]
    acceleration_mps2: Acceleration | None = None
    deceleration_mps2: Acceleration
    stop_m: Station

    @property
    def cruise_mps(self) -> float:
        """Cruise speed [m/s]."""
        return self.cruise_kmh / 3.6

    @property
    def brake_from_m(self) -> float:
        """Station at which the stop begins."""
        return self.stop_m - self.cruise_mps**2 / (2.0 * self.deceleration_mps2)


class Curve(Section):
    """A stretch of constant curvature between two transitions over which the curvature changes smoothly.

    Args:
        radius_m: of the base line; positive turns left.
        transition_m: length of each transition; both lie within the stretch.
    """

    start_m: Station
    end_m: Station
    radius_m: Annotated[float, between(-10_000.0, 10_000.0)]
    transition_m: Annotated[float, between(5.0, 500.0)]

    @model_validator(mode="after")
    def _is_drivable(self) -> Self:
        if self.end_m - self.start_m < 2.0 * self.transition_m:
            raise misfit("end_m at least twice transition_m behind start_m")
        if abs(self.radius_m) < 10.0:
            raise misfit("radius_m of at least 10, or at most -10")
        return self

    def curvature_radpm(self, station_m: Array) -> Array:
        """Curvature that this stretch adds at the stations."""
        rise, _ = blend((station_m - self.start_m) / self.transition_m)
        fall, _ = blend((station_m - self.end_m) / self.transition_m + 1.0)
        return (rise - fall) / self.radius_m


class Shift(Section):
    """A lateral move of the reference along a quintic: position, heading and curvature stay continuous."""

    start_m: Station
    length_m: Annotated[float, between(1.0, 1_000.0)]
    offset_m: Lateral

    def offset_and_slope(self, station_m: Array) -> tuple[Array, Array]:
        """What this move adds to the lateral position [m] and to its slope at the stations."""
        value, slope = blend((station_m - self.start_m) / self.length_m)
        return self.offset_m * value, self.offset_m / self.length_m * slope


class PathPlan(Section):
    """The line to drive: curves of the base line, and lateral shifts from it, which add up."""

    start_m: Station
    curves: list[Curve] = Field(default_factory=list)
    shifts: list[Shift] = Field(default_factory=list)


class Gate(Section):
    """A lane of cones along x, `car_widths` times the car's width plus `margin_m` wide."""

    name: str
    start_m: Station
    end_m: Station
    centre_m: Lateral
    car_widths: Annotated[float, between(1.0, 5.0)]
    margin_m: Annotated[float, between(0.0, 5.0)]

    @model_validator(mode="after")
    def _runs_forward(self) -> Self:
        if self.end_m <= self.start_m:
            raise misfit("end_m greater than start_m")
        return self


class Judgement(Section):
    """Where the drive is judged, and its limits; a figure without a limit is shown, not judged.

    Args:
        from_m, to_m: stations between which tracking is judged; the car must get past `to_m`.
        object_clearance_m: least distance from the car's outline to an object.
        stands_before: name of the object before which the car is to stand for good; it then need not get past `to_m`.
        stands_within_m: largest distance from there to that object.
    """

    from_m: Station
    to_m: Station
    entry_speed_error_kmh: Limit | None = None
    lateral_error_rms_m: Limit | None = None
    lateral_error_max_m: Limit | None = None
    heading_error_max_deg: Limit | None = None
    speed_error_rms_mps: Limit | None = None
    lateral_acceleration_max_mps2: Limit | None = None
    object_clearance_m: Limit = 0.0
    stands_before: str | None = None
    stands_within_m: Limit = 10.0


class Scenario(Section):
    """One drive: where, how fast, between what, and what counts as good."""

    name: str
    description: str
    time_limit_s: Annotated[float, between(1.0, 600.0)]
    start: Start
    speed: SpeedPlan
    path: PathPlan
    road: Road
    gates: list[Gate] = Field(default_factory=list)
    objects: list[RoadObject] = Field(default_factory=list)
    faults: Faults = ()
    judge: Judgement

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        end_m = self.speed.stop_m + RUN_OUT_M
        start_m, judge, is_slow = self.path.start_m, self.judge, self.start.speed_kmh < self.speed.cruise_kmh
        for is_wrong, rule in (
            (self.start.speed_kmh > self.speed.cruise_kmh, "start.speed_kmh of at most speed.cruise_kmh"),
            (is_slow and self.speed.acceleration_mps2 is None, "a start below cruise speed only with speed.acceleration_mps2"),
            (not start_m < judge.from_m < judge.to_m, "path.start_m < judge.from_m < judge.to_m"),
            (judge.to_m > self.speed.brake_from_m, f"judge.to_m before the stop begins, at {self.speed.brake_from_m:.1f}"),
            (bool(self.gates and self.path.curves), "gates only on a straight base line, without path.curves"),
            (any(g.start_m < start_m or g.end_m > judge.to_m for g in self.gates), "gates only between path.start_m and judge.to_m"),
            (len({thing.name for thing in self.objects}) < len(self.objects), "objects only with names that differ"),
            (
                judge.stands_before not in (None, *(thing.name for thing in self.objects)),
                "judge.stands_before only with the name of an object",
            ),
            (any(not start_m <= thing.station_m <= end_m for thing in self.objects), f"objects only from path.start_m to {end_m:g}"),
        ):
            if is_wrong:
                raise misfit(rule)
        return self

    @property
    def start_pose(self) -> Pose:
        """Where the emulated car is when the run begins."""
        return Pose(self.path.start_m, self.start.offset_m, 0.0, self.start.speed_kmh / 3.6)

    def road_surface(self) -> RoadDescription:
        """Height and grip of the road."""
        return self.road.surface(self.path.start_m)

    def lanes(self, vehicle: Vehicle) -> list[Lane]:
        """The gates, as wide as this car has them."""
        return [
            Lane(name=gate.name, start_m=gate.start_m, end_m=gate.end_m, right_m=gate.centre_m - half_m, left_m=gate.centre_m + half_m)
            for gate in self.gates
            for half_m in [(gate.car_widths * vehicle.body.width_m + gate.margin_m) / 2.0]
        ]

    def course(self, vehicle: Vehicle) -> Course:
        """The scenario laid out for one car.

        Raises:
            ScenarioError: the road leaves the car no room beside the reference.
        """
        fine_m = fine_stations(self.path.start_m, self.speed.stop_m + RUN_OUT_M)
        curvature_radpm = np.zeros_like(fine_m)
        for curve in self.path.curves:
            curvature_radpm += curve.curvature_radpm(fine_m)
        line = integrate(fine_m, curvature_radpm)

        offset_m, slope = np.zeros_like(line.x_m), np.zeros_like(line.x_m)
        for shift in self.path.shifts:
            more_m, steeper = shift.offset_and_slope(line.station_m)
            offset_m, slope = offset_m + more_m, slope + steeper
        position_m, half_width_m = line.beside_m(offset_m), vehicle.body.width_m / 2.0
        left_m, right_m = self.road.left_m - offset_m - half_width_m, self.road.right_m + offset_m - half_width_m
        self._check_room(line.station_m, left_m, right_m)
        reference = ReferencePath(
            x_m=position_m[:, 0],
            y_m=position_m[:, 1],
            yaw_rad=line.yaw_rad + np.arctan2(slope, 1.0 - line.curvature_radpm * offset_m),
            speed_mps=self._speed_mps(line.station_m),
            left_m=left_m,
            right_m=right_m,
        )
        return Course(
            line, reference, line.beside_m(self.road.left_m), line.beside_m(-self.road.right_m),
            self.lanes(vehicle), Outline.of(vehicle), self.judge.from_m, self.judge.to_m,
            self.judge.stands_before is not None,
        )  # fmt: skip

    def _speed_mps(self, station_m: Array) -> Array:
        plan, start_mps = self.speed, max(self.start.speed_kmh / 3.6, LAUNCH_MPS)
        stopping = np.sqrt(2.0 * plan.deceleration_mps2 * np.maximum(plan.stop_m - station_m, 0.0))
        speed_mps = np.minimum(stopping, plan.cruise_mps)
        if plan.acceleration_mps2 is not None:
            speed_mps = np.minimum(speed_mps, np.sqrt(start_mps**2 + 2.0 * plan.acceleration_mps2 * (station_m - station_m[0])))
        return speed_mps

    def _check_room(self, station_m: Array, left_m: Array, right_m: Array) -> None:
        for side, room_m in (("left", left_m), ("right", right_m)):
            k = int(np.argmin(room_m))
            if room_m[k] <= 0.0:
                edge_m = getattr(self.road, f"{side}_m")
                raise ScenarioError(
                    f"scenario {self.name}: road.{side}_m = {edge_m:g}: allowed: more than {edge_m - room_m[k]:.3f},"
                    f" for the car beside the reference at station {station_m[k]:.1f} m"
                )

    def reference(self, vehicle: Vehicle) -> ReferencePath:
        """The path for the controller, sampled every 0.2 m of the base line."""
        return self.course(vehicle).reference

    def scene(self, stage: Stage, vehicle: Vehicle, t_ns: int, seq: int) -> SceneSample:
        """What stands still, for those who look on; lines thinned to about 1 m."""
        course, thin = self.course(vehicle), slice(None, None, round(_SCENE_SPACING_M / SPACING_M))
        (left_x_m, left_y_m), (right_x_m, right_y_m) = (edge_m[thin].T.tolist() for edge_m in (course.left_edge_m, course.right_edge_m))
        return SceneSample(
            t_ns=t_ns, seq=seq, scenario=self.name, stage=stage.value,
            car_length_m=vehicle.body.length_m, car_width_m=vehicle.body.width_m, car_front_m=course.outline.front_m,
            steering_ratio=vehicle.steering.ratio,
            reference_x_m=course.reference.x_m[thin].tolist(), reference_y_m=course.reference.y_m[thin].tolist(),
            left_x_m=left_x_m, left_y_m=left_y_m, right_x_m=right_x_m, right_y_m=right_y_m, lanes=course.lanes,
        )


def scenario_names() -> list[str]:
    """Scenarios that come with xilgate."""
    return sorted(path.stem for path in SCENARIO_FOLDER.glob("*.toml"))


def scenario_path(name_or_path: str) -> Path:
    """The file of a scenario, given its name or its path.

    Raises:
        ScenarioError: neither a known name nor the path of a TOML file.
    """
    if name_or_path.endswith(".toml"):
        return Path(name_or_path)
    if name_or_path in scenario_names():
        return SCENARIO_FOLDER / f"{name_or_path}.toml"
    known = ", ".join(scenario_names())
    raise ScenarioError(f"scenario {name_or_path!r} is unknown; known: {known}; or give the path of a .toml file")


def load_scenario(name_or_path: str) -> Scenario:
    """Read a scenario by its name or from a TOML file of the user.

    Raises:
        ScenarioError: unknown name, missing file, malformed TOML, unknown or missing key, value out of range.
    """
    return read_section(scenario_path(name_or_path), Scenario, ScenarioError)
