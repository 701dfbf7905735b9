"""Recordings of drives that never happened: a car that follows a course with a lateral error of one's choice."""

from collections.abc import Callable

import numpy as np

from dbc.vehicle import Vehicle
from gateway.telemetry import CommandSample, StateSample, StatusSample, WorldSample
from xil.recording import Recording
from xil.scenario import Scenario

START_NS = 5_000_000_000
STEP_S = 0.01
ENGAGED_S = 1.0
AFTER_STOP_S = 1.0
COMMAND_EVERY_STEPS = 4
STATUS_EVERY_STEPS = 10


class RecordedDrive:
    """Makes a recording sample by sample; every argument is a way to spoil the drive.

    `left_of_reference_m` gives the lateral error by station, `speed_factor` scales the reference speed, `leaves_engaged` is time, mode
    and reason of a disengagement after which the car brakes with 4 m/s2, `keep` decides by topic and time what gets recorded.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: Vehicle,
        *,
        left_of_reference_m: Callable[[float], float] = lambda station_m: 0.0,
        yaw_error_rad: float = 0.0,
        speed_factor: float = 1.0,
        engaged_s: float = ENGAGED_S,
        leaves_engaged: tuple[float, str, str] | None = None,
        duration_s: float = 120.0,
        solve_time_ms: Callable[[float], float] = lambda t_s: 2.4,
        command_status: Callable[[float], str] = lambda t_s: "OK",
        blockers: tuple[str, ...] = (),
        keep: Callable[[str, float], bool] = lambda topic, t_s: True,
    ):
        self.course = scenario.course(vehicle)
        self.recording = Recording(START_NS)
        self._left_of_reference_m, self._yaw_error_rad, self._speed_factor = left_of_reference_m, yaw_error_rad, speed_factor
        self._engaged_s, self._leaves_engaged, self._blockers = engaged_s, leaves_engaged, blockers
        self._solve_time_ms, self._command_status, self._keep = solve_time_ms, command_status, keep
        self._seq = dict.fromkeys(("world", "state", "status", "command"), 0)
        self._drive(duration_s)

    def _drive(self, duration_s: float) -> None:
        station_m, speed_mps, stood_s, mode_before = float(self.course.station_m[0]), None, 0.0, ""
        for k in range(int(duration_s / STEP_S)):
            t_s = k * STEP_S
            wanted_mps = self._at(self.course.reference.speed_mps, station_m) * self._speed_factor
            is_lost = self._leaves_engaged is not None and t_s >= self._leaves_engaged[0]
            before_mps = wanted_mps if speed_mps is None else speed_mps
            speed_mps = max(before_mps - 4.0 * STEP_S, 0.0) if is_lost else wanted_mps
            mode = self._mode(t_s)
            self._record(k, t_s, station_m, speed_mps, (speed_mps - before_mps) / STEP_S, mode, mode != mode_before)
            mode_before = mode
            station_m += speed_mps * STEP_S
            stood_s = stood_s + STEP_S if speed_mps < 0.05 else 0.0
            if stood_s > AFTER_STOP_S:
                return

    def _mode(self, t_s: float) -> str:
        if self._leaves_engaged is not None and t_s >= self._leaves_engaged[0]:
            return self._leaves_engaged[1]
        return "ENGAGED" if t_s >= self._engaged_s else "READY"

    def _at(self, values: np.ndarray, station_m: float) -> float:
        return float(np.interp(station_m, self.course.station_m, values))

    def _add(self, kind: type, topic: str, t_s: float, **fields: object) -> None:
        if self._keep(topic, t_s):
            self.recording.add(kind(t_ns=START_NS + round(t_s * 1e9), seq=self._seq[topic], **fields))
        self._seq[topic] += 1

    def _record(self, k: int, t_s: float, station_m: float, speed_mps: float, ax_mps2: float, mode: str, is_new_mode: bool) -> None:
        path = self.course.reference
        yaw_rad = self._at(path.yaw_rad, station_m)
        ahead_rad = self._at(path.yaw_rad, station_m + 0.5)
        curvature_radpm = (ahead_rad - yaw_rad) / 0.5
        left_m = self._left_of_reference_m(station_m)
        steer_rad = 14.7 * (2.65 + 0.002 * speed_mps**2) * curvature_radpm
        drive_norm = (ax_mps2 + 0.3) / 3.2 if speed_mps > 0.05 else -0.3
        pose = {
            "x_m": self._at(path.x_m, station_m) - left_m * np.sin(yaw_rad),
            "y_m": self._at(path.y_m, station_m) + left_m * np.cos(yaw_rad),
            "yaw_rad": yaw_rad + self._yaw_error_rad, "vx_mps": speed_mps, "vy_mps": 0.0,
            "yaw_rate_radps": speed_mps * curvature_radpm, "ax_mps2": ax_mps2,
        }
        pedals = {"ar_position_norm": max(drive_norm, 0.0), "br_position_norm": max(-drive_norm, 0.0) / 3.0}
        self._add(
            WorldSample, "world", t_s, **pose, ay_mps2=speed_mps**2 * curvature_radpm, sr_angle_rad=steer_rad, **pedals,
            robots_engaged=mode == "ENGAGED",
        )
        self._add(
            StateSample, "state", t_s, mode=mode, is_valid=True, **pose, sr_angle_rad=steer_rad, **pedals,
            sr_command_rad=14.7 * 3.6 * (self._at(path.yaw_rad, station_m + 1.0) - ahead_rad) / 0.5,
            ar_command_norm=1.02 * pedals["ar_position_norm"], br_command_norm=1.02 * pedals["br_position_norm"],
        )
        if k % COMMAND_EVERY_STEPS == 0:
            self._add(
                CommandSample, "command", t_s, state_seq=k, status=self._command_status(t_s), solver="casadi-c", steer_rad=steer_rad / 14.7,
                drive_norm=drive_norm, solve_time_ms=self._solve_time_ms(t_s), step_time_ms=self._solve_time_ms(t_s) + 0.2,
                sqp_iterations=2, qp_iterations=4, work=-1, primal_residual=1e-9, dual_residual=1e-6, lateral_error_m=left_m,
                speed_error_mps=0.0, disturbance_mps2=0.0, parameters_version=0, objects=0, objects_rejected=0,
            )
        if k % STATUS_EVERY_STEPS == 0 or is_new_mode:
            left = self._leaves_engaged
            self._add(
                StatusSample, "status", t_s, mode=mode, reason=left[2] if left and t_s >= left[0] else "operator engaged",
                blockers=list(self._blockers), command_age_ms=12.0, frames_received=10 * k, frames_rejected={"wrong crc": 2},
                commands_rejected={}, ticks=k, ticks_late=0, step_cpu_ms=0.2,
            )
